"""The diagrams of docs/architecture.md, from the imports: `python -m lipac.scripts.dev.pages`."""

from __future__ import annotations

import ast
import re
import sys
from collections import defaultdict
from graphlib import TopologicalSorter
from pathlib import Path

ROOT = Path(__file__).resolve().parents[3]
PAGE = ROOT / "docs" / "architecture.md"
FOLDERS = ("core", "page", "lipac_addon", "scripts")


def main() -> int:
    """Write the diagrams, and what each room says of itself, into the page; the text around them stays."""
    PAGE.write_text(page(PAGE.read_text()))
    return 0


def page(text: str) -> str:
    """The page's text with each part between `<!-- NAME -->` and `<!-- end -->` written anew."""
    return filled(text, {"core": diagram("core"), "lipac_addon": diagram("lipac_addon"), "rooms": rooms()})


def filled(text: str, parts: dict[str, str]) -> str:
    """A page's text with what lies between `<!-- NAME -->` and `<!-- end -->` replaced by the part of that name."""
    return re.sub(
        r"(<!-- (\w+) -->\n).*?(<!-- end -->)", lambda m: f"{m[1]}{parts[m[2]]}\n{m[3]}", text, flags=re.DOTALL
    )


def diagram(folder: str) -> str:
    """A Mermaid graph of the rooms of a folder: an arrow from each to those that it imports from, less those that
    follow from others."""
    uses = room_imports(folder)
    lines = ["```mermaid", "graph TD", f"    accTitle: What imports what in {folder}"]
    depth: dict[str, int] = {}
    for room in TopologicalSorter(uses).static_order():
        depth[room] = 1 + max((depth[used] for used in uses[room]), default=0)
    for room in sorted(uses, key=lambda room: (-depth[room], room)):
        lines += [
            f"    {room} --> {used}"
            for used in sorted(uses[room])
            if not any(used in reached(uses, other) for other in uses[room])
        ]
    return "\n".join([*lines, "```"])


def reached(uses: dict[str, set[str]], room: str) -> set[str]:
    """All rooms that one imports from, directly or not."""
    found: set[str] = set()
    pending = [room]
    while pending:
        new = uses[pending.pop()] - found
        found |= new
        pending += new
    return found


def room_imports(folder: str) -> dict[str, set[str]]:
    """The rooms of a folder, its packages and its own modules, and which of the others each imports from, in functions
    too."""
    uses: dict[str, set[str]] = defaultdict(set)
    for path in sorted((ROOT / folder).rglob("*.py")):
        parts = path.relative_to(ROOT).with_suffix("").parts
        if len(parts) == 2 and parts[1] == "__init__":
            continue
        uses[parts[1]]
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and node.level:
                target = [
                    *parts[: len(parts) - node.level],
                    *(node.module or "").split("."),
                    *(alias.name for alias in node.names[:1]),
                ]
                target = [part for part in target if part]
                if target[0] == folder and target[1] != parts[1]:
                    uses[parts[1]].add(target[1])
    return dict(uses)


def rooms() -> str:
    """What lives in each package, as its docstring says."""
    lines = []
    for folder in FOLDERS:
        for path in sorted((ROOT / folder).rglob("__init__.py")):
            text = " ".join((ast.get_docstring(ast.parse(path.read_text())) or "").split("\n\n")[0].split())
            lines.append(f"| `{path.parent.relative_to(ROOT)}/` | {text} |")
    return "\n".join(["| room | what lives there |", "|---|---|", *lines])


if __name__ == "__main__":
    sys.exit(main())
