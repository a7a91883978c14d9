"""The page that a command leaves beside its report."""

from __future__ import annotations

import sys
from pathlib import Path

from ...core.page.html import missing
from .streams import say

NOT_HERE = (
    "report.html is not written: {libraries} not in this Python, as in Blender's own; "
    "lipac report {folder} writes it where LiPaC is installed"
)


def not_here(folder: Path) -> str:
    """Why a folder's page cannot be written by this Python; nothing where it can."""
    lost = missing()
    return NOT_HERE.format(libraries=", ".join(lost), folder=folder) if lost else ""


def leave(folder: Path) -> None:
    """Write the page of the report in a folder, or a line why not."""
    if line := not_here(folder):
        say(line, sys.stderr)
        return
    from ...core.page.report_page import write

    write(folder)
