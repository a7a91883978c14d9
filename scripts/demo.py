"""`lipac demo NAME -o FILE.blend`: write a procedural scene. Also `blender -b -P scripts/demo.py -- NAME -o
FILE.blend`."""

from __future__ import annotations

from collections.abc import Sequence


def main(argv: Sequence[str]) -> int:
    """Build the scene and save it; returns the exit status."""
    import errno
    import sys
    from pathlib import Path

    from ..core.errors import Cancelled, InputError
    from .command.arguments import count, seed_number
    from .command.interrupt import ctrl_c
    from .command.options import Parser
    from .command.streams import progress_of, say

    parser = Parser(
        prog="lipac demo",
        description="Write a procedural demo scene to a .blend file.",
        epilog="mirror-city: streets of instanced buildings, seen in a large mirror. flythrough: the same city; the "
        "camera drives through it, turns a corner, and is cut to another place and back, frames 1-120. "
        "crowd: walking characters with skeletons, each deformed on its own, frames 1-48. "
        "textures: panels with an image of 64 MB each, most of them behind a wall. "
        "family: a random scatter for each --seed, as of lipac evaluate --family.",
    )
    parser.add_argument("name", metavar="NAME", help="mirror-city, flythrough, crowd, textures, or family (see below)")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FILE.blend")
    instances = (
        "in the city: 1,000 to 1,000,000; in the crowd: figures, 1 to 20,000; in the family: 1 to 60,000; "
        "images in textures: 1 to 512"
    )
    parser.add_argument("--instances", type=count, metavar="N", help=instances)
    parser.add_argument(
        "--figure",
        type=Path,
        metavar="FILE",
        help="crowd: an animated character, .glb for example (default: a plain figure of our own)",
    )
    parser.add_argument(
        "--seed", type=seed_number, default=0, metavar="S", help="the same seed gives the same scene (default: 0)"
    )
    parser.add_argument("--quiet", action="store_true", help="no progress")
    args = parser.parse_args(argv)
    if args.output.suffix.lower() != ".blend":
        raise InputError(f"-o {args.output}: the name of the file must end in .blend")
    from ..core.files.report import output_folder

    output_folder(args.output.parent)
    from ..lipac_addon.console import muted

    with progress_of(args.quiet) as progress, ctrl_c() as cancelled, muted():
        progress(0.0, "building the scene")
        from ..lipac_addon.batch.baked import save_copy
        from ..lipac_addon.demo import build

        build(args.name, args.instances, args.seed, args.figure)
        if cancelled():
            raise Cancelled
        progress(0.7, "saving the file")
        try:
            save_copy(args.output)
        except RuntimeError as error:
            raise OSError(
                errno.EIO, str(error).strip().removeprefix("Error: ").splitlines()[0], str(args.output)
            ) from error
    say(str(args.output), sys.stdout)
    return 0


if __name__ == "__main__":
    import runpy
    import sys
    from pathlib import Path

    sys.exit(runpy.run_path(str(Path(__file__).with_name("by_path.py")))["run"]("demo"))
