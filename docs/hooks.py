"""What the site is besides docs/: README as its first page, no links to files that are not on it, formulas as MathML,
which browsers show by themselves, and diagrams as they were drawn before. So it loads nothing from elsewhere."""

import html
import re
from pathlib import Path
from typing import Any

from latex2mathml.converter import convert
from mkdocs.structure.files import File

from lipac.scripts.dev.diagrams import BLOCK, file_of, title_of

ROOT = Path(__file__).parents[1]
_FORMULA = re.compile(r'<(span|div) class="arithmatex">\s*\\[(\[](.*?)\\[)\]]\s*</\1>', re.DOTALL)
_NUMBER = re.compile(r"\\tag\{(\w+)\}")


def on_files(files: Any, config: Any) -> Any:
    """README is the first page; its links to docs/ are links to pages beside it."""
    text = (ROOT / "README.md").read_text().replace("](docs/", "](")
    text = re.sub(r"\[([^\]]+)\]\((?:CONTRIBUTING\.md|examples/|CHANGELOG\.md|CITATION\.cff)[^)]*\)", r"\1", text)
    files.append(File.generated(config, "index.md", content=text))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Links out of docs/ are text: the site has no repository beside it. Diagrams are pictures."""
    markdown = BLOCK.sub(lambda found: f"![{title_of(found[1])}](diagrams/{file_of(found[1]).name})\n", markdown)
    return re.sub(r"\[([^\]]+)\]\(\.\./[^)]*\)", r"\1", markdown)


def on_page_content(content: str, **_: Any) -> str:
    """Formulas as MathML. Their numbers, which it has no word for, stand behind them."""
    return _FORMULA.sub(lambda found: _formula(html.unescape(found[2]), found[1] == "div"), content)


def _formula(tex: str, is_block: bool) -> str:
    number = _NUMBER.search(tex)
    shown = convert(_NUMBER.sub("", tex), display="block" if is_block else "inline")
    if not is_block:
        return shown
    return f'<div class="formula">{shown}<span>{f"({number[1]})" if number else ""}</span></div>'
