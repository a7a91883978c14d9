"""`lipac render SCENE -o DIR`: cull and render. Also `blender -b FILE -P scripts/render.py -- -o DIR`."""

from __future__ import annotations

from argparse import BooleanOptionalAction
from collections.abc import Sequence


def main(argv: Sequence[str]) -> int:
    """Write a picture and the states of each frame, and report.json; returns the exit status."""
    from pathlib import Path

    from ..core.errors import InputError
    from ..core.hybrid.modes import MODES
    from ..lipac_addon.batch.engines.choices import ENGINES
    from .command.arguments import device, sample_count
    from .command.frames import do_frames
    from .command.options import scene_parser

    parser = scene_parser(
        "render", "Cull a scene by its light paths and render it: pictures, states per frame and report.json."
    )
    described = (f"{engine.name}: {engine.description}" for engine in ENGINES.values() if engine.description)
    engines = "; ".join(("default: cycles", *described))
    parser.add_argument("--engine", choices=ENGINES, help=engines)
    scene = (
        "render by the scene's own engine to its own files, as blender -b -f does: format, passes, layers, "
        "views, compositor, region; DIR gets the report"
    )
    parser.add_argument("--as-scene", action="store_true", help=scene)
    parser.add_argument("--samples", type=sample_count, metavar="N", help="per pixel (default: the scene's)")
    where = (
        "where Cycles renders: auto (default: as the file and the preferences say), cpu, cuda, optix, hip, "
        "oneapi or metal; cards by number or name"
    )
    parser.add_argument("--device", type=device, metavar="KIND[:CARD,...]", help=where)
    ahead = (
        "analyse in a separate process, other frames while one is rendered; the render then takes less memory "
        "(default: for several frames that are not rendered on the CPU)"
    )
    parser.add_argument("--ahead", action=BooleanOptionalAction, help=ahead)
    tiles = (
        "Cycles reads only those tiles of images that it needs, at the size that it needs, from files in DIR that are "
        "made once (default: texture_cache in the output folder; Blender 5.2 and later)"
    )
    parser.add_argument("--texture-cache", type=Path, nargs="?", const=Path(), metavar="DIR", help=tiles)
    hybrid = parser.add_argument_group("--engine hybrid")
    hybrid.add_argument(
        "--gi",
        choices=MODES,
        default="path",
        help="light that paths add: all, one bounce of a kind, no diffuse bounces, none (default: %(default)s)",
    )
    hybrid.add_argument(
        "--primary",
        choices=("raster", "traced"),
        default="raster",
        help="how first hits are found: by OpenGL, or by rays, which need none (default: %(default)s)",
    )
    hybrid.add_argument(
        "--denoise", choices=("on", "off"), default="on", help="denoise the traced light (default: %(default)s)"
    )
    hybrid.add_argument(
        "--raster-samples",
        type=sample_count,
        default=8,
        metavar="N",
        help="EEVEE's samples per pixel (default: %(default)s)",
    )
    args = parser.parse_args(argv)
    if args.as_scene and args.engine:
        raise InputError("--as-scene renders by the engine that the scene is set to: leave --engine out")
    if args.as_scene and args.enforce:
        raise InputError(
            "--enforce renders frames again, and --as-scene writes the scene's own files: give one of them"
        )
    args.engine = args.engine or "cycles"
    for option in ("gi", "primary", "denoise", "raster_samples"):
        if args.engine != "hybrid" and getattr(args, option) != parser.get_default(option):
            raise InputError(f"--{option.replace('_', '-')} is of --engine hybrid: give both, or neither")
    options = {
        "gi": args.gi,
        "primary": args.primary,
        "denoise": args.denoise == "on",
        "raster_samples": args.raster_samples,
    }
    return int(do_frames(args, args.engine, args.samples, options).status)


if __name__ == "__main__":
    import runpy
    import sys
    from pathlib import Path

    sys.exit(runpy.run_path(str(Path(__file__).with_name("by_path.py")))["run"]("render"))
