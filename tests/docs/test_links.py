"""Links lead somewhere, in the repository and on the site; words are spelt as dictionaries have them."""

from __future__ import annotations

import logging
import re
import subprocess
import sys
from pathlib import Path

import pytest

from .pages import PAGES, ROOT, anchors, links


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page: Path) -> None:
    """Without the network: files and headings."""
    for target in links(page):
        if re.match(r"https?:|mailto:", target):
            continue
        name, _, anchor = target.partition("#")
        file = (page.parent / name).resolve() if name else page
        assert file.exists(), f"{page.name}: {target}"
        assert file.is_relative_to(ROOT.resolve()), f"{page.name}: {target}"
        if anchor and file.suffix == ".md":
            assert anchor in anchors(file), f"{page.name}: {target}"


def test_each_page_is_linked() -> None:
    """From another page, so that a reader can find it."""
    linked = {(page.parent / t.partition("#")[0]).resolve() for page in PAGES for t in links(page) if ":" not in t}
    alone = [page.name for page in PAGES if page.resolve() not in linked and page.name not in ("README.md",)]
    assert not alone


def test_each_picture_is_shown() -> None:
    """By a page."""
    pages = "\n".join(page.read_text() for page in PAGES)
    for folder in ("pictures", "animation"):
        for picture in (ROOT / "docs" / folder).iterdir():
            assert f"{folder}/{picture.name}" in pages, picture.name


def test_spelling() -> None:
    """Of pages, docstrings, comments and names. Settings are in pyproject.toml."""
    done = subprocess.run(
        [sys.executable, "-m", "codespell_lib"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout) == (0, "")


@pytest.mark.slow
def test_the_site(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Built with no warning: pages without a place, links and anchors that lead nowhere."""
    pytest.importorskip("mkdocs")
    from mkdocs.commands.build import build
    from mkdocs.config import load_config

    with caplog.at_level(logging.WARNING, "mkdocs"):
        build(load_config(str(ROOT / "mkdocs.yml"), site_dir=str(tmp_path)))
    assert not [record.getMessage() for record in caplog.records if record.name.startswith("mkdocs")]
    page = (tmp_path / "method.html").read_text()
    assert page.count('<div class="formula"><math') > 8 and page.count("<math") > 90
    assert "arithmatex" not in page and "\\tag" not in page  # none is left as it was written
    assert 'class="mermaid"' in page
    for file in tmp_path.rglob("*.html"):  # a page loads nothing from the net; Mermaid's script is loaded by another
        assert not re.search(r'<(?:script|link|img)[^>]+(?:src|href)="(?:https?:)?//', file.read_text()), file
