"""`lipac shot STEP DIR`: a step of a shot that `lipac farm` has written. Also `blender -b -P scripts/farm/step.py --
STEP DIR`."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ...core.progress import Progress
    from ...lipac_addon.batch.job import Cancel

STEPS = {
    "analyze": "what each of the frames proposes",
    "unite": "one set for all frames, in shot.blend",
    "judge": "whether that set keeps the budget in each of the frames, by paths that chose nothing",
    "render": "pictures of frames of shot.blend, by a Blender that need not have LiPaC",
    "verify": "measure what culling changes in frames of the sample; where it is too much, mend the frames around",
    "certify": "certificate.json and certificate.html",
    "pack": "shot.blend and the files that it needs, to be sent",
}


def main(argv: Sequence[str]) -> int:
    """Do a step; returns the exit status: 3 where a frame is above the budget in the end."""
    import gc
    import signal
    import sys
    from pathlib import Path

    from ...core.threads import limit
    from ...core.warmup import load_ahead, telling
    from ..command.arguments import frame_range, thread_count
    from ..command.interrupt import ctrl_c
    from ..command.options import Parser
    from ..command.streams import progress_of

    steps = "; ".join(f"{name}: {what}" for name, what in STEPS.items())
    parser = Parser(
        prog="lipac shot",
        description=f"Do a step of a shot. {steps}. What is there already, made from the same, is left alone.",
    )
    parser.add_argument("step", choices=STEPS, metavar="STEP", help=", ".join(STEPS))
    parser.add_argument("folder", type=Path, metavar="DIR", help="the shot's folder")
    parser.add_argument(
        "--frames", type=frame_range, metavar="A-B", help="analyze, judge, render: these (default: all)"
    )
    parser.add_argument(
        "--check", type=frame_range, metavar="A-B", help="verify: these of the sample, by number from 1 (default: all)"
    )
    parser.add_argument(
        "--scene",
        type=Path,
        metavar="FILE.blend",
        help="the scene, where this machine sees it elsewhere than the job says",
    )
    parser.add_argument(
        "--blender",
        default="",
        metavar="PATH",
        help="render, verify: a Blender, or a Python with the module bpy (default: this one)",
    )
    parser.add_argument(
        "--threads", type=thread_count, default=0, metavar="N", help="of the analysis; 0: all cores (default)"
    )
    parser.add_argument("--quiet", action="store_true", help="no progress")
    args = parser.parse_args(argv)
    limit(args.threads)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # a farm ends tasks so; Blenders of their own end, too
    with progress_of(args.quiet) as shown, telling(shown) as progress, ctrl_c() as cancelled:
        from ...lipac_addon.console import muted

        with muted():
            import bpy  # noqa: F401
        gc.freeze()
        if args.step in ("analyze", "judge", "verify"):
            load_ahead()
        return done(args, progress, cancelled)


def done(args: argparse.Namespace, progress: Progress, cancelled: Cancel) -> int:
    """The exit status of a step that is done. Raises InputError, Cancelled."""
    import sys

    from ...core.errors import InputError
    from ...core.files.figures import size
    from ...core.progress import part
    from ...lipac_addon.farm import analyse, certificate, children, judge, unite, verify
    from ...lipac_addon.farm.jobs import pack
    from ...lipac_addon.farm.layout import FarmShot
    from ..command.streams import say

    shot = FarmShot.load(args.folder, args.scene)
    frames, checks = args.frames or shot.frames, args.check or tuple(range(1, shot.checks + 1))
    if not set(frames) <= set(shot.frames) or not set(checks) <= set(range(1, shot.checks + 1)):
        raise InputError(
            f"{shot.folder} is of frames {shot.first}-{shot.last}, {shot.checks} of which are verified: name a part of "
            "these"
        )
    line, status = "", 0
    if args.step == "analyze":
        done = analyse.analyse(shot, frames, args.threads, progress, cancelled)
        unite.unite_chunk(shot, frames)
        line = f"{done} of {len(frames)} frames analysed, the others were there"
    elif args.step == "unite":
        found = unite.unite(shot, progress, cancelled)
        line = f"{found['active']:,} of {found['instances']:,} instances stay"
    elif args.step == "judge":
        told = judge.judge(shot, frames, args.threads, progress, cancelled)
        held = sum(one["holds"] for one in told)
        line = f"the set is certified in {held} of {len(told)} frames"
    elif args.step == "render":
        children.render(shot, frames, args.blender, cancelled=cancelled)
        line = f"{shot.picture(frames[0]).parent} has the pictures of {len(frames)} frames"
    elif args.step == "verify":
        results = []
        for k, number in enumerate(checks):
            results.append(
                verify.verify(
                    shot,
                    number,
                    args.blender,
                    args.threads,
                    part(progress, k / len(checks), (k + 1) / len(checks)),
                    cancelled,
                )
            )
        line = "\n".join(certificate.verdict(found) for found in results)
    elif args.step == "pack":
        found = pack.pack(shot, args.blender)
        sizes = [f"{found[name]['files']} files, {size(found[name]['bytes'])}" for name in ("culled", "full")]
        line = f"{shot.folder / pack.PACKED} has {sizes[0]}; in full: {sizes[1]}"
        for path in found["culled"]["missing"]:
            say(f"warning: missing: {path}", sys.stderr)
    else:
        written = certificate.certify(shot)
        line, status = certificate.summary(written), 3 if written["broken"] else 0
    say(line, sys.stdout)
    return status


if __name__ == "__main__":
    import runpy
    import sys
    from pathlib import Path

    sys.exit(runpy.run_path(str(Path(__file__).parents[1] / "by_path.py"))["run"]("shot"))
