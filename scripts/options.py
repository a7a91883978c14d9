"""Options that commands share, and what follows from them."""

from __future__ import annotations

import argparse
import os
import re
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from ..core.budget import Budget
from ..core.culling import POLICIES, CullOptions
from ..core.errors import InputError
from ..core.progress import Progress, Terminal, silent

if TYPE_CHECKING:
    from ..core.report import Report

LAST_FRAME = 1048574  # Blender's own limit


class Parser(argparse.ArgumentParser):
    """Errors are one line, through `InputError`."""

    def error(self, message: str) -> NoReturn:
        raise InputError(f"{message}; {self.prog} --help tells the options")


def scene_parser(command: str, description: str) -> Parser:
    """A parser with the options of `analyze`, of which `render` has more."""
    parser = Parser(prog=f"lipac {command}", description=description)
    parser.add_argument("scene", nargs="?", type=Path, metavar="SCENE", help=".blend, .glb, .gltf, .usd*, .obj, .ply or .stl; inside Blender: the open file")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help="folder for pictures, states and report.json")
    parser.add_argument("--frames", type=frame_range, metavar="A-B", help="frames to do (default: the scene's current one)")
    parser.add_argument("--resolution", type=resolution, metavar="WxH", help="size of the picture (default: the scene's)")
    parser.add_argument("--camera", metavar="NAME", help="camera to use; 'auto' frames the whole scene (default: the scene's)")
    culling = parser.add_argument_group("culling")
    culling.add_argument("--cull", choices=POLICIES, default="light-paths", help="what decides (default: %(default)s)")
    culling.add_argument("--max-error", type=Budget.parse, metavar="E[,T]", help="light-paths: share by which the picture, and its worst tile, may change")
    culling.add_argument("--min-share", type=number, metavar="S", help="light-paths: instead of an error, keep what at least this share of paths meets")
    culling.add_argument("--paths", type=count, metavar="N", help="light-paths: paths per pixel of the analysis")
    culling.add_argument("--solid-angle", type=number, metavar="DEG", help="solid-angle: keep what spans at least this angle")
    culling.add_argument("--distance", type=number, metavar="M", help="distance: keep what is nearer than this")
    culling.add_argument("--margin", type=number, metavar="S", help="frustum: widen the picture by this share of it")
    general = parser.add_argument_group("general")
    general.add_argument("--seed", type=int, default=0, metavar="S", help="of all random numbers (default: 0)")
    general.add_argument("--threads", type=int, default=0, metavar="N", help="0: all cores (default)")
    general.add_argument("--quiet", action="store_true", help="no progress")
    return parser


def frame_range(text: str) -> tuple[int, ...]:
    """Frames of 'A-B' or 'A'. Raises ArgumentTypeError."""
    found = re.fullmatch(r"(\d+)(?:-(\d+))?", text.strip())
    first, last = (int(found[1]), int(found[2] or found[1])) if found else (1, 0)
    if not first <= last <= LAST_FRAME:
        raise argparse.ArgumentTypeError(f"'{text}' is no frame range: give A-B with A not after B, for example 1-24")
    return tuple(range(first, last + 1))


def resolution(text: str) -> tuple[int, int]:
    """Width and height of 'WxH'. Raises ArgumentTypeError."""
    found = re.fullmatch(r"(\d+)x(\d+)", text.strip().lower())
    if not found or not all(4 <= int(n) <= 65536 for n in found.groups()):
        raise argparse.ArgumentTypeError(f"'{text}' is no resolution: give WxH in pixels, 4 to 65536 each, for example 1920x1080")
    return int(found[1]), int(found[2])


def number(text: str) -> float:
    """A number that is finite and not negative. Raises ArgumentTypeError."""
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0 <= value < float("inf"):
        raise argparse.ArgumentTypeError(f"'{text}' is not a number from 0 up")
    return value


def count(text: str) -> int:
    """A whole number from 1 up. Raises ArgumentTypeError."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"'{text}' is not a whole number from 1 up")
    return int(text)


@contextmanager
def progress_of(quiet: bool) -> Iterator[Progress]:
    """Progress on stderr: on a copy of it, which stays ours while Blender's chatter is muted."""
    if quiet:
        yield silent
        return
    with os.fdopen(os.dup(2), "w") as stream, Terminal(stream) as terminal:
        yield terminal


@contextmanager
def ctrl_c() -> Iterator[Callable[[], bool]]:
    """A function that tells whether Ctrl-C was pressed within the block, for work to poll: an exception in the midst of Blender's would not come through.

    A second Ctrl-C ends the process at once.
    """
    pressed = threading.Event()

    def note(_number: int, _frame: object) -> None:
        pressed.set()
        signal.signal(signal.SIGINT, signal.SIG_DFL)

    if threading.current_thread() is not threading.main_thread():
        yield pressed.is_set
        return
    old = signal.signal(signal.SIGINT, note)
    try:
        yield pressed.is_set
    finally:
        signal.signal(signal.SIGINT, old)


def cull_options(args: argparse.Namespace) -> CullOptions:
    """The culling options of a command line; what it does not say has the defaults of `core`."""
    given = {name: getattr(args, name) for name in ("max_error", "min_share", "paths", "solid_angle", "distance", "margin")}
    return CullOptions(policy=args.cull, seed=args.seed, threads=args.threads, **{name: value for name, value in given.items() if value is not None})


def check(args: argparse.Namespace) -> None:
    """Raise InputError for what can be told before Blender starts: no scene, bad numbers, an output folder that cannot be written."""
    from ..core.report import output_folder

    if args.scene is None and "bpy" not in sys.modules:
        raise InputError("SCENE is missing: name a .blend or another scene file")
    if not 0 <= args.threads <= 1024:
        raise InputError(f"--threads {args.threads}: give a number from 1 to 1024, or 0 for all cores")
    if not 0 <= args.seed < 2**31:
        raise InputError(f"--seed {args.seed}: give a number from 0 to {2**31 - 1}")
    if args.scene is not None and not args.scene.exists():
        raise InputError(f"no such file: {args.scene}")
    output_folder(args.output)


def do_frames(args: argparse.Namespace, engine: str = "", samples: int | None = None, hybrid: dict[str, Any] | None = None) -> Report:
    """What `analyze` and `render` share: check, open, work through the frames, and print the table. hybrid: fields of `HybridOptions`."""
    check(args)
    from ..lipac_addon.console import muted

    with muted():
        import bpy

    from ..core.report import Report
    from ..lipac_addon.hybrid import HybridOptions
    from ..lipac_addon.open import AUTO, missing_libraries, open_scene, use_camera
    from ..lipac_addon.pipeline import Job, run

    with progress_of(args.quiet) as progress, ctrl_c() as cancelled:
        progress(0.0, "opening the scene")
        if args.scene is not None:
            open_scene(args.scene)
        scene = bpy.context.scene
        if args.resolution:
            scene.render.resolution_x, scene.render.resolution_y = args.resolution
            scene.render.resolution_percentage = 100
        if args.camera:
            use_camera(scene, args.camera)
        if scene.camera is None:
            raise InputError(f"scene '{scene.name}' has no camera: add one and make it active, or use --camera {AUTO} to frame everything")
        report = Report(
            scene=str(args.scene or bpy.data.filepath),
            blender=bpy.app.version_string,
            lipac=own_version(),
            policy=args.cull,
            engine=engine,
            seed=args.seed,
            threads=args.threads or os.cpu_count() or 1,
        )
        report.note(report.warnings, missing_libraries())
        frames, mixed = args.frames or (scene.frame_current,), HybridOptions(**(hybrid or {}))
        job = Job(args.output, frames, cull_options(args), engine, samples, args.seed, args.threads, mixed)
        run(job, report, progress, cancelled)
    print(report.table())
    for line in report.warnings:
        print(f"warning: {line}", file=sys.stderr)
    return report


def own_version() -> str:
    """Version of this package: of the installation, or of the extension's manifest."""
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("lipac")
    except PackageNotFoundError:
        import tomllib

        manifest = Path(__file__).parent.parent / "blender_manifest.toml"
        return str(tomllib.loads(manifest.read_text())["version"]) if manifest.exists() else "unknown"
