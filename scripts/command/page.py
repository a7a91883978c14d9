"""The page that a command leaves beside its report."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ...core.errors import Cancelled, InputError
from ...core.files.shell import quoted
from ...page.html import missing
from .streams import say

NOT_HERE = (
    "report.html is not written: {libraries} not in this Python, as in Blender's own; "
    "lipac report {folder} writes it where LiPaC is installed"
)


def not_here(folder: Path) -> str:
    """Why a folder's page cannot be written by this Python; nothing where it can."""
    lost = missing()
    return NOT_HERE.format(libraries=", ".join(lost), folder=quoted(folder)) if lost else ""


@contextmanager
def leaving(folder: Path) -> Iterator[None]:
    """The page of a folder is that of the report after the work in here, stopped or not; none until then."""
    from ...page.report_page import drop

    drop(folder)
    try:
        yield
    except Cancelled:
        leave(folder)
        raise
    leave(folder)


def leave(folder: Path) -> None:
    """Write the page of the report in a folder, or a line why not."""
    if line := not_here(folder):
        say(line, sys.stderr)
        return
    from ...page.report_page import write

    try:
        write(folder)
    except InputError as error:  # the pictures are there all the same
        say(f"warning: {error}", sys.stderr)
