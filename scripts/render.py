"""`lipac render SCENE -o DIR`: cull and render. Also `blender -b FILE -P scripts/render.py -- -o DIR`."""

from __future__ import annotations

from collections.abc import Sequence

ENGINES = ("cycles", "eevee", "path")


def main(argv: Sequence[str]) -> int:
    """Write a picture and the states of each frame, and report.json; returns the exit status."""
    from .options import count, do_frames, scene_parser

    parser = scene_parser("render", "Cull a scene by its light paths and render it: pictures, states per frame and report.json.")
    parser.add_argument("--engine", choices=ENGINES, default="cycles", help="default: %(default)s; path: the path tracer of the analysis")
    parser.add_argument("--samples", type=count, metavar="N", help="per pixel (default: the scene's)")
    args = parser.parse_args(argv)
    do_frames(args, args.engine, args.samples)
    return 0


if __name__ == "__main__":
    import runpy
    import sys
    from pathlib import Path

    sys.exit(runpy.run_path(str(Path(__file__).with_name("by_path.py")))["run"]("render"))
