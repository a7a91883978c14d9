"""What the pages of the documentation hold: code blocks, links, headings."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import lipac

ROOT = Path(lipac.__file__).parent
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    ROOT / "CHANGELOG.md",
    *sorted((ROOT / "docs").glob("*.md")),
]
_MARK = re.compile(r"<!-- (slow|elsewhere): (.+?) -->")


@dataclass(frozen=True)
class Block:
    """A block of code. mark: "", or that another test runs it, or that it is slow."""

    page: Path
    line: int
    language: str
    text: str
    mark: str
    reason: str

    @property
    def name(self) -> str:
        """Of a test."""
        return f"{self.page.relative_to(ROOT)}:{self.line}"


def blocks(page: Path) -> Iterator[Block]:
    """The fenced blocks of a page."""
    lines = page.read_text().splitlines()
    at = 0
    while at < len(lines):
        opened = re.match(r"```(\w*)$", lines[at])
        if not opened:
            at += 1
            continue
        end = next(k for k in range(at + 1, len(lines)) if lines[k] == "```")
        mark = _MARK.fullmatch(lines[at - 1]) if at else None
        kind, reason = (mark[1], mark[2]) if mark else ("", "")
        yield Block(page, at + 1, opened[1], "\n".join(lines[at + 1 : end]) + "\n", kind, reason)
        at = end + 1


def prose(page: Path) -> str:
    """A page's text without fenced blocks."""
    return re.sub(r"^```.*?^```$", "", page.read_text(), flags=re.DOTALL | re.MULTILINE)


def anchors(page: Path) -> set[str]:
    """What the headings of a page are linked by, as GitHub and the site name them."""
    found: dict[str, int] = {}
    for heading in re.findall(r"^#+ (.+)$", prose(page), re.MULTILINE):
        text = re.sub(r"\[([^\]]+)\]\([^)]*\)", r"\1", heading)
        name = re.sub(r"[^\w\- ]", "", text.lower()).strip().replace(" ", "-")
        found[name] = found.get(name, -1) + 1
    return {name if not k else f"{name}-{k}" for name, count in found.items() for k in range(count + 1)}


def links(page: Path) -> list[str]:
    """Targets of a page's links and pictures."""
    text = re.sub(r"`[^`\n]*`", "", prose(page))
    return re.findall(r"\]\(([^)\s]+)\)", text) + re.findall(r"^\[[\w-]+\]: (\S+)$", text, re.MULTILINE)
