"""Links lead somewhere, in the repository and on the site; words are spelt as dictionaries have them."""

from __future__ import annotations

import logging
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from lipac.scripts.dev.browser import BROWSERS, open_browser
from lipac.scripts.dev.diagrams import BLOCK, file_of, title_of
from lipac.scripts.studies.pictures.strips import LARGEST

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


def test_pictures_are_small() -> None:
    """So that pages load quickly, and the repository stays small."""
    pictures = [path for kind in ("png", "jpg", "svg") for path in (ROOT / "docs").rglob(f"*.{kind}")]
    assert len(pictures) > 30
    assert not {path.name: path.stat().st_size for path in pictures if path.stat().st_size > LARGEST}


def test_lines_of_text_are_short() -> None:
    """But tables, formulas, and what is written from the code."""
    written = {"api.md", "reference.md", "supported.md"}
    for page in (*PAGES, ROOT / "CHANGELOG.md"):
        text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.DOTALL | re.MULTILINE)
        lines = [line for line in text.splitlines() if len(line) > 120 and not line.startswith(("|", "!["))]
        assert page.name in written or not lines, (page.name, lines)


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
    assert re.search(r'<img alt="[^"]+" src="diagrams/\w+.svg"', page) and "mermaid" not in page
    for file in tmp_path.rglob("*.html"):
        assert not re.search(r'<(?:script|link|img)[^>]+(?:src|href)="(?:https?:)?//', file.read_text()), file
    assert not requests_elsewhere(tmp_path)


def requests_elsewhere(site: Path) -> list[str]:
    """What the pages of a site ask other hosts for, opened in a browser one after the other, none where there is no
    browser."""
    if not any(map(shutil.which, BROWSERS)):
        return []
    pytest.importorskip("playwright")
    asked: list[str] = []
    with open_browser() as browser:
        page = browser.new_page()
        page.on("request", lambda request: asked.append(request.url))
        for name in ("index", "method", "architecture", "results"):
            page.goto((site / f"{name}.html").as_uri())
            page.wait_for_load_state("networkidle")
    assert any(url.endswith(".svg") for url in asked)
    return [url for url in asked if not url.startswith(("file:", "data:"))]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_diagrams_are_drawn(page: Path) -> None:
    """As their sources say: `python -m lipac.scripts.dev.diagrams`."""
    for source in BLOCK.findall(page.read_text()):
        assert title_of(source)
        assert file_of(source).read_text().startswith("<svg")
