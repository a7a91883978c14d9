"""What the site is besides docs/: README as its first page, and no links to files that are not on it."""

import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File

ROOT = Path(__file__).parents[1]


def on_files(files: Any, config: Any) -> Any:
    """README is the first page; its links to docs/ are links to pages beside it."""
    text = (ROOT / "README.md").read_text().replace("](docs/", "](")
    text = re.sub(r"\[([^\]]+)\]\((?:CONTRIBUTING\.md|examples/|CHANGELOG\.md|CITATION\.cff)[^)]*\)", r"\1", text)
    files.append(File.generated(config, "index.md", content=text))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Links out of docs/ are text: the site has no repository beside it."""
    return re.sub(r"\[([^\]]+)\]\(\.\./[^)]*\)", r"\1", markdown)
