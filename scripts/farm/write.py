"""`lipac farm SCENE -o DIR`: describe a shot as a job for a farm. Also `blender -b FILE -P scripts/farm/write.py -- -o
DIR`."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ...core.progress import Progress
    from ...lipac_addon.batch.job import Cancel

FARMS = ("openjd", "flamenco", "local")


def main(argv: Sequence[str]) -> int:
    """Write the job; returns the exit status."""
    from pathlib import Path

    from ..command.arguments import count, frame_range, path_count, resolution, sample_count, seed_number
    from ..command.interrupt import ctrl_c
    from ..command.options import Parser
    from ..command.streams import progress_of

    parser = Parser(
        prog="lipac farm",
        description="Describe a shot as a job: analyse its frames, unite, judge, render, verify a sample, certify.",
    )
    parser.add_argument("scene", nargs="?", type=Path, metavar="SCENE", help=".blend; inside Blender: the open file")
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="DIR", help="the shot's folder, which all machines share"
    )
    parser.add_argument(
        "--for",
        dest="farm",
        choices=FARMS,
        default="openjd",
        help="who runs it; local: this machine, at once (default: %(default)s)",
    )
    parser.add_argument(
        "--frames", type=frame_range, default=(), metavar="A-B", help="of the shot (default: the scene's)"
    )
    parser.add_argument(
        "--resolution", type=resolution, metavar="WxH", help="size of the picture (default: the scene's)"
    )
    parser.add_argument("--samples", type=sample_count, metavar="N", help="per pixel (default: the scene's)")
    parser.add_argument(
        "--max-error",
        default="0.01",
        metavar="E[,T]",
        help="as of lipac analyze (default: %(default)s; T: five times E)",
    )
    parser.add_argument(
        "--paths",
        type=path_count,
        default=0,
        metavar="N",
        help="per pixel of the analysis (default: as many as the error needs)",
    )
    parser.add_argument(
        "--seed", type=seed_number, default=0, metavar="S", help="of the analysis and the sample (default: 0)"
    )
    parser.add_argument(
        "--verify",
        type=count,
        metavar="N",
        help="frames to render in full as well, in parts (default: one in 25, at least 2)",
    )
    parser.add_argument("--chunk", type=count, default=10, metavar="N", help="frames to a task (default: %(default)s)")
    parser.add_argument(
        "--lipac", default="", metavar="PATH", help="the lipac command on the farm's machines (default: this one)"
    )
    parser.add_argument(
        "--blender",
        default="",
        metavar="PATH",
        help="the Blender there, or a Python with the module bpy (default: this one)",
    )
    parser.add_argument(
        "--workers", type=count, metavar="N", help="--for local: processes at a time (default: one for every 8 cores)"
    )
    parser.add_argument(
        "--no-measure",
        action="store_true",
        help="--for openjd: ask for no memory; else one frame is analysed, and a part of it rendered",
    )
    parser.add_argument("--quiet", action="store_true", help="no progress")
    args = parser.parse_args(argv)
    with progress_of(args.quiet) as progress, ctrl_c() as cancelled:
        return written(args, progress, cancelled)


def written(args: argparse.Namespace, progress: Progress, cancelled: Cancel) -> int:
    """The exit status of a job that is written. Raises InputError, Cancelled."""
    import sys
    from pathlib import Path

    from ...core.error_budget.budget import Budget
    from ...core.errors import InputError
    from ...lipac_addon.console import muted

    with muted():
        import bpy
    from ...lipac_addon.farm import children
    from ...lipac_addon.farm.jobs import local, measure
    from ...lipac_addon.farm.jobs.graph import Programs, graph
    from ...lipac_addon.farm.jobs.submitting import describe
    from ...lipac_addon.farm.jobs.writing import Wanted, write_shot
    from ...lipac_addon.open import open_scene
    from ..command.streams import say

    if args.scene is not None:
        open_scene(args.scene)
    elif not bpy.data.filepath:
        raise InputError("SCENE is missing: name a .blend, or inside Blender save the open file first")
    scene = args.scene or Path(bpy.data.filepath)
    if scene.suffix.lower() != ".blend":
        raise InputError(f"{scene}: save it as a .blend first: that is what a farm's machines open")
    wanted = Wanted(
        args.frames, Budget.parse(args.max_error), args.paths, args.seed, args.resolution, args.samples, args.verify
    )
    shot = write_shot(args.output, scene, wanted)
    programs = Programs(children.lipac_program(args.lipac), children.program(args.blender))
    measured = (
        None
        if args.no_measure or args.farm != "openjd"
        else measure.measure(shot, programs.lipac, args.blender, progress, cancelled)
    )
    if args.farm == "local":
        status, text = local.run_here(
            shot, graph(shot, args.chunk, programs), programs, args.workers or local.processes(), progress, cancelled
        )
        say(text.strip(), sys.stdout)
        return status
    say(describe(shot, args.farm, args.chunk, programs, measured), sys.stdout)
    return 0
