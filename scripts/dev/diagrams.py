"""The diagrams of docs/, drawn for the site, which loads nothing from elsewhere:
`python -m lipac.scripts.dev.diagrams`, which `python -m lipac.scripts.dev.pages` calls.

A page has the Mermaid source of a diagram, which GitHub draws by itself. For the site a Chromium draws it into
docs/diagrams, under a name that follows from the source; docs/hooks.py puts it in. What is drawn already is left alone,
so Chromium, npm and the network are needed only where a source has changed.
"""

from __future__ import annotations

import hashlib
import re
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Iterable
from pathlib import Path

from .browser import open_browser

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
FOLDER = DOCS / "diagrams"
MERMAID = "mermaid@11.16.0"  # on npm
BLOCK = re.compile(r"^```mermaid\n(.*?)^```\n", re.DOTALL | re.MULTILINE)
# Labels of SVG text: HTML in an SVG is not drawn by everything that shows one
SETTINGS = "{startOnLoad: false, theme: 'neutral', htmlLabels: false, flowchart: {htmlLabels: false}}"


def main() -> int:
    """Draw what is missing, and remove what no page has; returns the exit status."""
    wanted = {file_of(source): source for page in DOCS.glob("*.md") for source in BLOCK.findall(page.read_text())}
    FOLDER.mkdir(exist_ok=True)
    for path in set(FOLDER.glob("*.svg")) - wanted.keys():
        path.unlink()
    missing = [path for path in wanted if not path.exists()]
    if missing:
        for path, svg in zip(missing, drawn(wanted[path] for path in missing), strict=True):
            path.write_text(svg + "\n")
    return 0


def file_of(source: str) -> Path:
    """Where the drawing of a Mermaid source is."""
    return FOLDER / f"{hashlib.sha256(source.encode()).hexdigest()[:12]}.svg"


def title_of(source: str) -> str:
    """What a diagram shows, in words: its line `accTitle: ...`."""
    found = re.search(r"^\s*accTitle:\s*(.+)$", source, re.MULTILINE)
    return found[1].strip() if found else ""


def drawn(sources: Iterable[str]) -> list[str]:
    """Mermaid sources as SVG, by a Chromium."""
    with tempfile.TemporaryDirectory() as folder, open_browser() as browser:
        subprocess.run(["npm", "pack", "--silent", MERMAID], cwd=folder, check=True, stdout=subprocess.DEVNULL)
        (packed,) = Path(folder).glob("*.tgz")
        with tarfile.open(packed) as archive:
            archive.extract("package/dist/mermaid.min.js", folder, filter="data")
        page = browser.new_page()
        page.add_script_tag(path=Path(folder) / "package/dist/mermaid.min.js")
        page.evaluate(f"mermaid.initialize({SETTINGS})")
        draw = "async ([name, source]) => (await mermaid.render(name, source)).svg"
        return [page.evaluate(draw, ["d" + file_of(source).stem, source]) for source in sources]


if __name__ == "__main__":
    sys.exit(main())
