"""What `lipac analyze` and `lipac render` share: they work through the frames of a file."""

from __future__ import annotations

import argparse
import dataclasses
import gc
import os
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...core.culling.policies import LIGHT_PATHS
from ...core.errors import InputError
from ...core.files.digest import digest
from ...core.threads import limit, processors
from ...core.warmup import load_ahead, not_needed, telling
from ...version import __version__
from .clock import began
from .interrupt import ctrl_c
from .last_words import last_words
from .options import check, check_device, cull_options, renders_meanwhile
from .page import leaving
from .streams import progress_of, say

if TYPE_CHECKING:
    from ...core.files.report import Report
    from ...lipac_addon.batch.ahead import Ahead
    from ...lipac_addon.batch.job import Job

CULLED = "linked library was saved with culling applied, which is taken back here, nowhere else: Restore it in {}"
MOST_LINES = 20  # of a kind that a command prints
HESITATION = 0.5  # seconds until kernels are loaded that may not be needed: a small scene is open and weighed by then


def do_frames(
    args: argparse.Namespace,
    engine: str = "",
    samples: int | None = None,
    hybrid: dict[str, Any] | None = None,
    save: Path | None = None,
) -> Report:
    """What `analyze` and `render` share: check, open, work through the frames, and print the table. hybrid: fields of
    `HybridOptions`; save: as in `Job`."""
    check(args)
    limit(args.threads)
    # Blender's start, too: it swallows exceptions while it starts, and goes on half started
    with (
        last_words(_crashed(args), 1),
        progress_of(args.quiet) as shown,
        telling(shown) as progress,
        ctrl_c() as cancelled,
        ExitStack() as at_end,
    ):
        at_end.callback(not_needed)
        progress(0.0, "opening the scene")
        begun = at_end.enter_context(early) if (early := begun_early(args)) else None
        from ...lipac_addon.console import muted

        with muted():
            import bpy
        from ...lipac_addon.batch.baked import check_target
        from ...lipac_addon.batch.engines.as_scene import engine_of
        from ...lipac_addon.batch.engines.choices import AS_SET, BLENDER_ENGINES
        from ...lipac_addon.batch.engines.hybrid_frame import HybridOptions
        from ...lipac_addon.batch.job import Job
        from ...lipac_addon.batch.pipeline import run
        from ...lipac_addon.open import AUTO, leave_modes, missing_libraries, open_scene, use_camera
        from ...lipac_addon.writeback.marks import culled_libraries

        gc.freeze()  # what is loaded by now stays: who collects garbage need not look through it
        # where another process analyses, this one holds nothing of what that takes
        elsewhere = engine and (args.memory or getattr(args, "ahead", False) or begun)
        if (args.cull != "none" or engine not in BLENDER_ENGINES) and not elsewhere:
            load_ahead(HESITATION if args.if_it_pays else 0.0)
        if args.scene is not None:
            unread = (
                f"lipac {args.command}: cannot read {args.scene}: its reader crashed: it is damaged, or memory is "
                "short; save or export it again"
            )
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
            raise InputError(
                f"scene '{scene.name}' has no camera: add one and make it active, or use --camera {AUTO} to frame "
                "everything"
            )
        as_scene = getattr(args, "as_scene", False)
        if as_scene:
            args.engine = engine = engine_of(scene)
            check_device(args)
        frames, mixed = args.frames or (scene.frame_current,), HybridOptions(**(hybrid or {}))
        more = (
            mixed,
            args.bake,
            save,
            args.resume,
            args.warm,
            args.shot or (),
            args.verify,
            args.enforce,
            getattr(args, "device", None) or AS_SET,
            as_scene,
        )
        ahead = ahead_arguments(args, bool(bpy.app.module))
        tiles = getattr(args, "texture_cache", None)
        tiles = args.output / "texture_cache" if tiles == Path() else tiles
        job = Job(
            args.output,
            frames,
            cull_options(args),
            engine,
            samples,
            args.seed,
            args.threads,
            *more,
            ahead,
            tiles,
            args.process or 0,
            args.if_it_pays and engine == "cycles" and not _off_the_cpu(args),
            begun,
        )
        report = new_report(args, job)
        report.began = began()
        if args.resume and (others := report.other_options(args.output)):
            what = ", ".join(others)
            raise InputError(
                f"--resume: {args.output} was made otherwise ({what}); give the same options, or another -o, or begin "
                "anew without --resume"
            )
        report.note(report.warnings, [*missing_libraries(), *map(CULLED.format, culled_libraries())])
        with leaving(args.output):
            run(job, report, progress, cancelled)
    say(report.table(), sys.stdout)
    for kind, lines in (("warning", report.warnings), ("approximated", report.approximated)):
        for line in lines[:MOST_LINES]:
            say(f"{kind}: {line}", sys.stderr)
        if len(lines) > MOST_LINES:
            say(f"{kind}: {len(lines) - MOST_LINES} more, in {args.output / 'report.json'}", sys.stderr)
    return report


def ahead_arguments(args: argparse.Namespace, alone: bool) -> tuple[str, ...]:
    """What `lipac analyze` is to be told so that it decides in another process as this command would; none where it
    should not, or cannot.

    alone: Blender is a module of this Python, not a program that has it.
    """
    limited = bool(args.memory) and hasattr(args, "ahead")
    if limited and (not alone or _off_the_cpu(args)):
        raise InputError("--memory is for the lipac command, and for renders on the CPU: add --device cpu")
    wanted = limited or getattr(args, "ahead", False)
    if (
        args.scene is None
        or not alone
        or wanted is False
        or args.cull != LIGHT_PATHS
        or args.enforce
        or (args.bake == "shot" and not renders_meanwhile(args))
    ):
        return ()
    several = args.frames is not None and len(args.frames) > 1
    if wanted is None and not (several and _off_the_cpu(args)):
        return ()
    said = {
        "resolution": args.resolution and "{}x{}".format(*args.resolution),
        "blas-budget": args.blas_budget,
        "memory": args.memory,
        "threads": args.threads,
        "seed": args.seed,
    }
    said |= {name.replace("_", "-"): getattr(args, name) for name in ("camera", "max_error", "min_share", "paths")}
    switches = ("warm", "no-mitigation", "no-parts", "levels")
    flags = [f"--{name}" for name in switches if getattr(args, name.replace("-", "_"))]
    flags += ["--bake=shot"] if args.bake == "shot" else []
    return (
        str(args.scene),
        *flags,
        *(text for name, value in said.items() if value is not None for text in (f"--{name}", str(value))),
    )


def begun_early(args: argparse.Namespace) -> Ahead | None:
    """The process that analyses ahead, begun while Blender is not loaded here yet: where the command line alone says
    that there is one, and which frames are its."""
    known = hasattr(args, "ahead") and args.frames is not None and not (args.memory or args.resume or args.as_scene)
    if not known or "bpy" in sys.modules:
        return None
    from ...lipac_addon.batch.ahead import Ahead
    from ...lipac_addon.batch.engines.choices import AS_SET, AUTO

    unknown = args.engine == "cycles" and (args.device or AS_SET).kind == AUTO
    if args.ahead is not True and unknown:
        return None
    arguments = ahead_arguments(args, True)
    return Ahead(arguments, args.frames) if arguments else None


def _off_the_cpu(args: argparse.Namespace) -> bool:
    """Whether the command renders on a graphics card."""
    from ...lipac_addon.batch.engines.choices import AS_SET, AUTO, BLENDER_ENGINES, CPU

    if args.engine != "cycles":
        return args.engine in BLENDER_ENGINES
    choice = args.device or AS_SET
    if choice.kind != AUTO:
        return bool(choice.kind != CPU)
    import bpy

    from ...lipac_addon.batch.engines.devices import find_device

    return find_device(bpy.context.scene, choice).kind != CPU


def _crashed(args: argparse.Namespace) -> str:
    """What to say where native code crashes."""
    limit = ""
    if os.name != "nt":
        import resource

        space = resource.getrlimit(resource.RLIMIT_AS)[0]
        limit = (
            ""
            if space == resource.RLIM_INFINITY
            else f" of the {space / 1e9:.1f} GB that this process may take (ulimit -v)"
        )
    return (
        f"lipac {args.command}: Blender, or a library of it, crashed: out of memory{limit}, or a fault of its "
        "own; finished frames and their report are kept"
    )


def new_report(args: argparse.Namespace, job: Job) -> Report:
    """An empty report, with all that the results of a job on the open file depend on."""
    import bpy

    from ...core.files.report import Report
    from ...lipac_addon.batch.engines.choices import AS_SET
    from ...lipac_addon.batch.job import SHOT
    from ...lipac_addon.open import linked_files

    scene, path = bpy.context.scene, args.scene or bpy.data.filepath
    options: dict[str, Any] = {
        name: value
        for name, value in dataclasses.asdict(job.options).items()
        if name not in ("threads", "seed", "policy")
    }
    options |= {
        "resolution": [scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage],
        "camera": args.camera or "",
    }
    options |= {
        "samples": job.samples,
        "bake": job.bake,
        "warm": job.warm,
        "file": digest(Path(path), *linked_files()) if path else "",
    }
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
