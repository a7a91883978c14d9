"""`lipac analyze SCENE -o DIR`: culling only. Also `blender -b FILE -P scripts/analyze.py -- -o DIR`."""

from __future__ import annotations

from collections.abc import Sequence


def main(argv: Sequence[str]) -> int:
    """Write the states of each frame and report.json; returns the exit status."""
    from .options import do_frames, scene_parser

    do_frames(scene_parser("analyze", "Decide which instances of a scene light paths need: states per frame and report.json.").parse_args(argv))
    return 0


if __name__ == "__main__":
    import runpy
    import sys
    from pathlib import Path

    sys.exit(runpy.run_path(str(Path(__file__).with_name("by_path.py")))["run"]("analyze"))
