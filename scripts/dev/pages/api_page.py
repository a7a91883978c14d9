"""docs/api.md, from the signatures and docstrings of `import lipac`: `python -m lipac.scripts.dev.pages`."""

from __future__ import annotations

import inspect
import re
import sys
from pathlib import Path
from typing import Any

import lipac
from lipac.core.culling.result import CullingResult
from lipac.core.files.report import Report
from lipac.lipac_addon.batch.deciding import Decided
from lipac.lipac_addon.writeback import WritebackResult

PAGE = Path(__file__).resolve().parents[3] / "docs" / "api.md"
FUNCTIONS = (lipac.analyze, lipac.apply, lipac.restore, lipac.render)
# given and returned
CLASSES = (lipac.Budget, lipac.CullOptions, lipac.Scene, CullingResult, Decided, WritebackResult, Report)
HEAD = """# `import lipac`

<!-- written by scripts/dev/pages/api_page.py -->

A program that culls a scene in Blender and renders it:
[examples/cull_and_render.py](../examples/cull_and_render.py). Types are in the package (`py.typed`).
"""


def page() -> str:
    """The page as Markdown."""
    parts = [HEAD, "## Functions", *(entry(f, f"lipac.{f.__name__}") for f in FUNCTIONS)]
    parts += ["## What they take and return", *(entry(c, f"{c.__module__}.{c.__name__}") for c in CLASSES)]
    return "\n\n".join(part.strip("\n") for part in parts) + "\n"


def entry(thing: Any, name: str) -> str:
    """Heading, signature and docstring of a function or class."""
    home = lipac.__all__
    shown = f"lipac.{thing.__name__}" if thing.__name__ in home else name
    text = inspect.cleandoc(thing.__doc__ or "")
    text = re.sub(r"(?m)^( +)(\w[\w, ]*):( |$)", r"\1- `\2`:\3", text)  # items of Parameters
    text = (
        text.replace("\nParameters:\n", "\nParameters:\n\n").replace("\n    - ", "\n- ").replace("\n        ", "\n  ")
    )
    return f"### `{shown}`\n\n```text\n{signature(thing)}\n```\n\n{text}"


def signature(thing: Any) -> str:
    """The call of a function or class, a parameter a line."""
    found = inspect.signature(thing)
    lines = [f"    {parameter}," for parameter in map(str, found.parameters.values())]
    lines = [
        re.sub(r": '([^']*)'", r": \1", re.sub(r"<function (\w+)( at 0x[0-9a-f]+)?>", r"\1", line)) for line in lines
    ]
    keyword = next((k for k, p in enumerate(found.parameters.values()) if p.kind is p.KEYWORD_ONLY), None)
    if keyword is not None:
        lines.insert(keyword, "    *,")
    back = f" -> {found.return_annotation}" if found.return_annotation not in (found.empty, None, "None") else ""
    inside = "\n".join(line.replace("<factory>", "...") for line in lines)
    return f"{thing.__name__}(\n{inside}\n){back}" if lines else f"{thing.__name__}(){back}"


if __name__ == "__main__":
    PAGE.write_text(page())
    sys.exit(0)
