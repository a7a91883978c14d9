"""`lipac report DIR`: report.html anew, from what is in a folder; needs no Blender."""

from __future__ import annotations

from collections.abc import Sequence


def main(argv: Sequence[str]) -> int:
    """Write DIR/report.html; returns the exit status."""
    import sys
    from pathlib import Path

    from ..core.errors import InputError
    from .command.options import Parser
    from .command.page import not_here
    from .command.streams import say

    parser = Parser(
        prog="lipac report",
        description="Write report.html, a page to look at, from what lipac render or analyze left in a folder.",
    )
    parser.add_argument("folder", type=Path, metavar="DIR", help="the folder that was given to -o")
    whole = (
        "a folder where the same frames were rendered with --cull none: pictures before and after, and what was saved"
    )
    parser.add_argument("--full", type=Path, metavar="DIR", help=whole)
    args = parser.parse_args(argv)
    if line := not_here(args.folder):
        raise InputError(line)
    from ..page.report_page import write

    say(str(write(args.folder, args.full)), sys.stdout)
    return 0
