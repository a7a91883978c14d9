"""Options that commands share, and what follows from them."""

from __future__ import annotations

import argparse
import dataclasses
import gc
import hashlib
import os
import signal
import socket
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from ..core.culling.options import DEFAULT_BUDGET, CullOptions
from ..core.culling.policies import LIGHT_PATHS, POLICIES, RULES
from ..core.error_budget.budget import SPREAD, Budget
from ..core.errors import InputError
from ..core.processors import processors
from ..core.progress import Progress, Terminal, silent
from ..core.warmup import load_ahead, telling
from ..version import __version__
from .arguments import byte_count, crop_count, frame_range, number, path_count, resolution, seed_number, thread_count
from .last_words import last_words
from .streams import say

if TYPE_CHECKING:
    from ..core.files.report import Report
    from ..lipac_addon.batch.job import Job

MOST_LINES = 20  # of a kind that a command prints
HARDWARE = {
    "eevee": "EEVEE is on the graphics card that the system's graphics driver gives it",
    "hybrid": "paths are traced on the CPU, and EEVEE is on the graphics card that the driver gives it",
    "path": "the path tracer is on the CPU",
}


class Parser(argparse.ArgumentParser):
    """Errors are one line, through `InputError`."""

    def error(self, message: str) -> NoReturn:
        raise InputError(f"{message}; {self.prog} --help tells the options")


def scene_parser(command: str, description: str) -> Parser:
    """A parser with the options of `analyze`, of which `render` has more."""
    parser = Parser(prog=f"lipac {command}", description=description)
    parser.set_defaults(command=command)
    parser.add_argument("scene", nargs="?", type=Path, metavar="SCENE", help=".blend, .glb, .gltf, .usd*, .obj, .ply or .stl; inside Blender: the open file")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help="folder for pictures, states and report.json")
    parser.add_argument("--frames", type=frame_range, metavar="A-B", help="frames to do (default: the scene's current one)")
    parser.add_argument("--resolution", type=resolution, metavar="WxH", help="size of the picture (default: the scene's)")
    parser.add_argument("--camera", metavar="NAME", help="camera to use; 'auto' frames the whole scene (default: the scene's)")
    culling = parser.add_argument_group("culling")
    listed = [name for name, policy in POLICIES.items() if policy.listed]
    culling.add_argument("--cull", choices=listed, default=LIGHT_PATHS, help="what decides (default: %(default)s)")
    error = "light-paths: share by which the mean of 16 x 9 tiles of the picture, and the worst of them, may change (default: 0.01; T: five times E)"
    culling.add_argument("--max-error", metavar="E[,T]", help=error)
    culling.add_argument("--min-share", type=number, metavar="S", help="light-paths: instead of an error, keep what at least this share of paths meets")
    culling.add_argument("--paths", type=path_count, metavar="N", help="light-paths: paths per pixel of the analysis (default: as many as the error needs)")
    for policy in [policy for policy in RULES.values() if policy.listed]:
        own = policy.setting
        assert own is not None
        culling.add_argument(own.option, type=number, metavar=own.unit, help=f"{policy.name}: {own.description[0].lower()}{own.description[1:]}")
    shot = parser.add_argument_group("frames of a shot")
    shot.add_argument("--bake", choices=("frame", "shot"), default="frame", help="frame: what each frame needs; shot: in all frames what any of them needs")
    part = "with --bake shot: the frames that the set is for, where --frames are a part of them: so a shot can be split"
    shot.add_argument("--shot", type=frame_range, metavar="A-B", help=part)
    shot.add_argument("--resume", action="store_true", help="leave frames alone that DIR has already, by the same options")
    shot.add_argument("--warm", action="store_true", help="begin each frame with what the one before it needed, and be slow to cull (hysteresis)")
    shot.add_argument("--no-parts", action="store_true", help="light-paths: keep or cull meshes as a whole; else large ones are culled by parts")
    shot.add_argument("--no-mitigation", action="store_true", help="with --warm: do not activate what comes into view before light paths ask for it")
    shot.add_argument("--blas-budget", type=byte_count, metavar="SIZE", help="acceleration structures of meshes may take so much, for example 2G")
    general = parser.add_argument_group("general")
    crops = "measure the error too: so many of 12 parts of the picture, picked at random, are rendered full and culled by the engine (default: 2)"
    general.add_argument("--verify", type=crop_count, nargs="?", const=2, default=0, metavar="N", help=crops)
    again = "with --verify: where that finds more change than --max-error allows, analyse again with a tighter one; in the end everything stays"
    general.add_argument("--enforce", action="store_true", help=again)
    general.add_argument("--seed", type=seed_number, default=0, metavar="S", help="of all random numbers (default: 0)")
    general.add_argument("--threads", type=thread_count, default=0, metavar="N", help="0: all cores (default)")
    general.add_argument("--quiet", action="store_true", help="no progress")
    return parser


@contextmanager
def progress_of(quiet: bool) -> Iterator[Progress]:
    """Progress on stderr: on a copy of it, which stays ours while Blender's chatter is muted."""
    if quiet:
        yield silent
        return
    stream = os.fdopen(os.dup(2), "w")
    try:
        with Terminal(stream) as terminal:
            yield terminal
    finally:
        with suppress(OSError):  # what nobody reads any more
            stream.close()


PATIENCE = 0.5  # seconds that work may take to notice Ctrl-C


@contextmanager
def ctrl_c() -> Iterator[Callable[[], bool]]:
    """A function that tells whether Ctrl-C was pressed within the block, for work to poll: an exception in the midst of Blender's would not come through.

    Where the work does not end soon (Blender evaluates a scene, a large structure is built), the process ends as it is: whatever it leaves on disk is whole.
    A second Ctrl-C ends it at once. Where whoever started the process had it ignore Ctrl-C, it does.
    """
    pressed = threading.Event()

    def note(_number: int, _frame: object) -> None:
        pressed.set()
        signal.signal(signal.SIGINT, signal.SIG_DFL)

    if threading.current_thread() is not threading.main_thread() or signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
        yield pressed.is_set
        return
    old = signal.signal(signal.SIGINT, note)
    with _impatient():
        try:
            yield pressed.is_set
        finally:
            signal.signal(signal.SIGINT, old)


@contextmanager
def _impatient() -> Iterator[None]:
    """Ends the process where Ctrl-C has no effect for a while. Python's handlers wait for the main thread; a thread of its own learns of signals at once."""
    here, there = socket.socketpair()
    there.setblocking(False)
    done = threading.Event()
    stderr = os.dup(2)  # what is written while Blender's chatter is muted

    def watch() -> None:
        while number := here.recv(1):
            if number[0] == signal.SIGINT and not done.wait(PATIENCE):
                with suppress(OSError):
                    os.write(stderr, b"lipac: stopped; finished frames and their report are kept\n")
                os._exit(130)

    thread = threading.Thread(target=watch, name="Ctrl-C", daemon=True)
    thread.start()
    old = signal.set_wakeup_fd(there.fileno(), warn_on_full_buffer=False)
    try:
        yield
    finally:
        done.set()
        signal.set_wakeup_fd(old)
        there.close()
        thread.join()
        here.close()
        os.close(stderr)


def cull_options(args: argparse.Namespace) -> CullOptions:
    """The culling options of a command line; what it does not say has the defaults of `core`.

    A hybrid picture shows what is culled all the same, so no tile of it need change by more than the mean may.
    """
    spread = 1.0 if getattr(args, "engine", "") == "hybrid" else SPREAD
    given = {name: getattr(args, name) for name in ("min_share", "paths")}
    own = POLICIES[args.cull].setting
    given["setting"] = None if own is None else getattr(args, own.name)
    given["max_error"] = Budget.parse(f"{DEFAULT_BUDGET.mean}" if args.max_error is None else args.max_error, spread)
    given["blas_budget_bytes"] = args.blas_budget
    said = {name: value for name, value in given.items() if value is not None}
    return CullOptions(policy=args.cull, seed=args.seed, threads=args.threads, mitigation=not args.no_mitigation, parts=_by_parts(args), **said)


def _by_parts(args: argparse.Namespace) -> bool:
    """Whether large meshes are culled by parts: where Blender renders them, and frames decide by themselves."""
    engine = getattr(args, "engine", "")
    return not (args.no_parts or args.warm or engine in ("path", "hybrid") or (not engine and args.verify))


def check(args: argparse.Namespace) -> None:
    """Raise InputError for what can be told before Blender starts: no scene, bad numbers, an output folder that cannot be written."""
    from ..core.files.report import output_folder

    if args.scene is None and "bpy" not in sys.modules:
        raise InputError("SCENE is missing: name a .blend or another scene file")
    if args.no_mitigation and not args.warm:
        raise InputError("--no-mitigation has a meaning with --warm alone: frames that decide by themselves have nothing that comes into view")
    if args.shot is not None and (args.bake != "shot" or args.warm):
        raise InputError("--shot is for --bake shot without --warm: other frames decide by themselves, or by all before them")
    if args.shot is not None and not (args.frames and set(args.frames) <= set(args.shot)):
        raise InputError("--shot goes with --frames that are a part of it")
    if args.verify and (args.bake == "shot" or getattr(args, "engine", "") == "hybrid"):
        raise InputError("--verify is for --bake frame, and for the engines cycles, eevee and path")
    if args.enforce and not args.verify:
        raise InputError("--enforce acts on what --verify measures: give both")
    if args.enforce and (args.cull != "light-paths" or args.min_share is not None or args.warm):
        raise InputError("--enforce keeps to --max-error: it goes with --cull light-paths, without --min-share and --warm")
    check_device(args)
    if args.verify and args.cull == "none":
        raise InputError("--verify measures what culling changes: with --cull none nothing does")
    if args.scene is not None and not args.scene.exists():
        raise InputError(f"no such file: {args.scene}")
    cull_options(args)
    output_folder(args.output)


def check_device(args: argparse.Namespace) -> None:
    """Raise InputError where a device is chosen for an engine that has no choice, or a texture cache for one that has none."""
    if getattr(args, "device", None) is not None and args.engine != "cycles":
        raise InputError(f"--device chooses where Cycles renders; {HARDWARE[args.engine]}")
    if getattr(args, "texture_cache", None) is not None and args.engine != "cycles":
        raise InputError(f"--texture-cache is of Cycles; {HARDWARE[args.engine]}")


def do_frames(args: argparse.Namespace, engine: str = "", samples: int | None = None, hybrid: dict[str, Any] | None = None, save: Path | None = None) -> Report:
    """What `analyze` and `render` share: check, open, work through the frames, and print the table. hybrid: fields of `HybridOptions`; save: as in `Job`."""
    check(args)
    # Blender's start, too: it swallows exceptions while it starts, and goes on half started
    with last_words(_crashed(args), 1), progress_of(args.quiet) as shown, telling(shown) as progress, ctrl_c() as cancelled:
        progress(0.0, "opening the scene")
        from ..lipac_addon.console import muted

        with muted():
            import bpy
        from ..lipac_addon.batch.baked import check_target
        from ..lipac_addon.batch.engines.as_scene import engine_of
        from ..lipac_addon.batch.engines.choices import AS_SET, BLENDER_ENGINES
        from ..lipac_addon.batch.engines.hybrid_frame import HybridOptions
        from ..lipac_addon.batch.job import Job
        from ..lipac_addon.batch.pipeline import run
        from ..lipac_addon.open import AUTO, leave_modes, missing_libraries, open_scene, use_camera
        from .lipac import began

        gc.freeze()  # what is loaded by now stays: who collects garbage need not look through it
        if args.cull != "none" or engine not in BLENDER_ENGINES:
            load_ahead()
        if args.scene is not None:
            unread = f"lipac {args.command}: cannot read {args.scene}: its reader crashed: it is damaged, or memory is short; save or export it again"
            with last_words(unread, 2):
                open_scene(args.scene)
        else:
            leave_modes()
        if save is not None:
            check_target(save)
        scene = bpy.context.scene
        if args.resolution:
            scene.render.resolution_x, scene.render.resolution_y = args.resolution
            scene.render.resolution_percentage = 100
        if args.camera:
            use_camera(scene, args.camera)
        if scene.camera is None:
            raise InputError(f"scene '{scene.name}' has no camera: add one and make it active, or use --camera {AUTO} to frame everything")
        as_scene = getattr(args, "as_scene", False)
        if as_scene:
            args.engine = engine = engine_of(scene)
            check_device(args)
        frames, mixed = args.frames or (scene.frame_current,), HybridOptions(**(hybrid or {}))
        more = (mixed, args.bake, save, args.resume, args.warm, args.shot or (), args.verify, args.enforce, getattr(args, "device", None) or AS_SET, as_scene)
        ahead = ahead_arguments(args, bool(bpy.app.module))
        tiles = getattr(args, "texture_cache", None)
        tiles = args.output / "texture_cache" if tiles == Path() else tiles
        job = Job(args.output, frames, cull_options(args), engine, samples, args.seed, args.threads, *more, ahead, tiles)
        report = new_report(args, job)
        report.began = began()
        if args.resume and (others := report.other_options(args.output)):
            what = ", ".join(others)
            raise InputError(f"--resume: {args.output} was made otherwise ({what}); give the same options, or another -o, or begin anew without --resume")
        report.note(report.warnings, missing_libraries())
        run(job, report, progress, cancelled)
    say(report.table(), sys.stdout)
    for kind, lines in (("warning", report.warnings), ("approximated", report.approximated)):
        for line in lines[:MOST_LINES]:
            say(f"{kind}: {line}", sys.stderr)
        if len(lines) > MOST_LINES:
            say(f"{kind}: {len(lines) - MOST_LINES} more, in {args.output / 'report.json'}", sys.stderr)
    return report


def ahead_arguments(args: argparse.Namespace, alone: bool) -> tuple[str, ...]:
    """What `lipac analyze` is to be told so that it decides in another process as this command would; none where it should not, or cannot.

    alone: Blender is a module of this Python, not a program that has it.
    """
    wanted = getattr(args, "ahead", False)
    if args.scene is None or not alone or wanted is False or args.cull != LIGHT_PATHS or args.bake != "frame" or args.enforce:
        return ()
    if wanted is None and not _off_the_cpu(args):
        return ()
    said = {"resolution": args.resolution and "{}x{}".format(*args.resolution), "blas-budget": args.blas_budget, "threads": args.threads, "seed": args.seed}
    said |= {name.replace("_", "-"): getattr(args, name) for name in ("camera", "max_error", "min_share", "paths")}
    flags = [f"--{name}" for name in ("warm", "no-mitigation") if getattr(args, name.replace("-", "_"))]
    return str(args.scene), *flags, *(text for name, value in said.items() if value is not None for text in (f"--{name}", str(value)))


def _off_the_cpu(args: argparse.Namespace) -> bool:
    """Whether the command renders on a graphics card."""
    import bpy

    from ..lipac_addon.batch.engines.choices import AS_SET, CPU
    from ..lipac_addon.batch.engines.devices import find_device

    if args.engine != "cycles":
        return bool(args.engine == "eevee")
    return find_device(bpy.context.scene, args.device or AS_SET).kind != CPU


def _crashed(args: argparse.Namespace) -> str:
    """What to say where native code crashes."""
    limit = ""
    if os.name != "nt":
        import resource

        space = resource.getrlimit(resource.RLIMIT_AS)[0]
        limit = "" if space == resource.RLIM_INFINITY else f" of the {space / 1e9:.1f} GB that this process may take (ulimit -v)"
    return f"lipac {args.command}: Blender, or a library of it, crashed: out of memory{limit}, or a fault of its own; finished frames and their report are kept"


def new_report(args: argparse.Namespace, job: Job) -> Report:
    """An empty report, with all that the results of a job on the open file depend on."""
    import bpy

    from ..core.files.report import Report
    from ..lipac_addon.batch.engines.choices import AS_SET
    from ..lipac_addon.batch.job import SHOT

    scene, path = bpy.context.scene, args.scene or bpy.data.filepath
    options: dict[str, Any] = {name: value for name, value in dataclasses.asdict(job.options).items() if name not in ("threads", "seed", "policy")}
    options |= {"resolution": [scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage], "camera": args.camera or ""}
    options |= {"samples": job.samples, "bake": job.bake, "warm": job.warm, "file": digest(Path(path), *linked_files()) if path else ""}
    if job.as_scene:
        options["as_scene"] = True
    if job.texture_cache is not None:
        options["texture_cache"] = True
    if job.device != AS_SET:
        options["device"] = str(job.device)
    if job.engine == "hybrid":
        options["hybrid"] = dataclasses.asdict(job.hybrid)
    if job.bake == SHOT or job.warm:
        together = job.shot or job.frames
        options["frames"] = [together[0], together[-1]]
    threads = args.threads or processors()
    return Report(str(path), bpy.app.version_string, __version__, args.cull, job.engine, args.seed, threads, options)


def linked_files() -> list[Path]:
    """The library files that the open file, or one of these, links."""
    import bpy

    return sorted({Path(bpy.path.abspath(library.filepath, library=library.parent)) for library in bpy.data.libraries if not library.packed_file})


def digest(*paths: Path) -> str:
    """SHA-256 of the contents of files, one after the other; what is no file counts as such. "" where the first is none."""
    if not paths[0].is_file():
        return ""
    found = hashlib.sha256()
    for path in paths:
        if not path.is_file():
            found.update(b"missing")
            continue
        with path.open("rb") as file:
            hashlib.file_digest(file, lambda: found)
    return found.hexdigest()
