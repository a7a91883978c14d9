"""`lipac analyze SCENE -o DIR`: culling only. Also `blender -b FILE -P scripts/analyze.py -- -o DIR`."""

from __future__ import annotations

from collections.abc import Sequence


def main(argv: Sequence[str]) -> int:
    """Write the states of each frame and report.json; returns the exit status."""
    from pathlib import Path

    from ..core.errors import InputError
    from .command.frames import do_frames
    from .command.options import scene_parser

    parser = scene_parser(
        "analyze", "Decide which instances of a scene light paths need: states per frame and report.json."
    )
    saved = "with --bake shot: save a copy of the scene with the set baked in, which any Blender renders"
    parser.add_argument("--save", type=Path, metavar="FILE.blend", help=saved)
    args = parser.parse_args(argv)
    if args.save is not None and args.bake != "shot":
        raise InputError("--save bakes one set for all frames into a copy of the scene: it goes with --bake shot")
    return int(do_frames(args, save=args.save).status)


if __name__ == "__main__":
    import runpy
    import sys
    from pathlib import Path

    sys.exit(runpy.run_path(str(Path(__file__).with_name("by_path.py")))["run"]("analyze"))
