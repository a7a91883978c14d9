"""`lipac report DIR`: report.html anew, from what is in a folder; needs no Blender, but for a view from outside."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path


def main(argv: Sequence[str]) -> int:
    """Write DIR/report.html; returns the exit status."""
    import sys

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
    outside = "the scene file: draw tlas.png, too, what stays of the scene seen from outside (reads the scene)"
    parser.add_argument("--outside", type=Path, metavar="SCENE", help=outside)
    args = parser.parse_args(argv)
    if line := not_here(args.folder):
        raise InputError(line)
    from ..page.report_page import write

    if args.outside:
        draw_outside(args.folder, args.outside)
    say(str(write(args.folder, args.full)), sys.stdout)
    return 0


def draw_outside(folder: Path, scene: Path) -> None:
    """Draw folder/tlas.png: of the frame that the page shows, what stays of the scene, and boxes for the rest. Raises
    InputError where the folder does not have its states, or the scene is another one."""
    from matplotlib.image import imsave

    from ..core.errors import InputError
    from ..core.files.atomic import replacing
    from ..core.files.report import found_report
    from ..lipac_addon.console import muted
    from ..page.report_page import shown_frame
    from .studies.compare import tlas_of

    report = found_report(folder)
    shown = None if report is None else shown_frame(report, folder)
    frame = 0 if report is None or shown is None else report["frames"][shown]["frame"]
    states = folder / "states" / f"frame_{frame:04}.npz"
    if not states.is_file():
        raise InputError(f"{folder} has no states of a frame: name a folder that lipac render or analyze filled")
    with muted():
        picture = tlas_of(scene, states, frame)
    with replacing(folder / "tlas.png") as part:
        imsave(part, picture)
