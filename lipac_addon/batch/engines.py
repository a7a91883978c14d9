"""Renders of the open file: Blender's engines as they are, and the path tracer of `core`."""

from __future__ import annotations

import re
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ...core.errors import Cancelled, InputError
from ...core.progress import Progress, silent
from ...core.scene.model import Scene
from ..console import muted
from ..depsgraph import changed, rendered_layers
from ..pictures import save_pixels, save_render_result, saved_as
from .choices import BLENDER_ENGINES

if TYPE_CHECKING:
    from ...core.culling.result import Built

HYBRID_SAMPLES = 64  # at most, where nobody says: the rest is the denoiser's
_SAMPLE = re.compile(r"(\d+)\s*/\s*(\d+)")


def samples_of(scene: bpy.types.Scene, engine: str) -> int:
    """Samples per pixel that the scene asks of an engine of `ENGINES`."""
    if engine == "eevee":
        return int(scene.eevee.taa_render_samples)
    return min(scene.cycles.samples, HYBRID_SAMPLES) if engine == "hybrid" else int(scene.cycles.samples)


def left_out(scene: bpy.types.Scene, engine: str) -> list[str]:
    """What the scene asks of its renders and an engine of `ENGINES`, or "" for none, leaves out, a line each."""
    out, render = [], scene.render
    if render.use_border and engine:
        out.append("render region: the whole picture is rendered")
    if render.use_multiview and engine:
        out.append("stereo: one view is rendered, by the camera itself")
    if render.use_freestyle and engine in BLENDER_ENGINES:
        out.append("Freestyle: lines of what is culled are not drawn")
    if engine in BLENDER_ENGINES and len(used := rendered_layers(scene)) > 1 and not (render.use_compositing and scene.compositing_node_group):
        out.append(f"view layers: the picture is of '{used[0]}', of {len(used)} that were analysed")
    if engine in ("hybrid", "path"):
        if len(used := rendered_layers(scene)) > 1:
            out.append(f"view layers: '{used[0]}' alone is rendered, of {len(used)}")
        if render.use_freestyle:
            out.append("Freestyle: no lines are drawn")
        if render.use_motion_blur:
            out.append("motion blur: pictures are of one moment")
        if render.use_compositing and scene.compositing_node_group is not None:
            out.append("compositing: pictures are as they come out of the engine")
    return out


def render_blender(
    engine: str,
    stem: Path,
    samples: int | None = None,
    seed: int = 0,
    threads: int = 0,
    progress: Progress = silent,
    border: tuple[float, float, float, float] | None = None,
) -> float:
    """Render the current frame of the open file by 'cycles' (on the CPU) or 'eevee', save stem.exr and stem.png, and return the seconds of the render alone.

    samples: per pixel, None as in the scene. seed: Cycles' noise; EEVEE has none. threads: 0 for all. border: left, bottom, right, top of the part of the
    picture that is wanted, 0 to 1 (default: all). All else is as the scene says; its settings are put back.
    Raises InputError where Blender cannot render. Ctrl-C during the render ends the process at once, for Blender cannot be asked to stop.
    """
    scene = bpy.context.scene
    if not rendered_layers(scene):
        raise InputError(f"scene {scene.name!r}: no view layer is used for rendering; switch one on")
    with _render_settings(scene, engine, samples, seed, threads, border), _no_file_outputs(), _stats(progress):
        start = time.perf_counter()
        try:
            with muted(), _ctrl_c_ends_the_process():
                bpy.ops.render.render(scene=scene.name)
        except RuntimeError as error:
            raise InputError(f"{engine} cannot render the scene: {str(error).removeprefix('Error:').strip()}") from error
        seconds = time.perf_counter() - start
    with muted():
        save_render_result(scene, stem)
    return seconds


def render_path(
    scene: Scene,
    active: NDArray[np.bool_],
    stem: Path,
    samples: int | None = None,
    seed: int = 0,
    threads: int = 0,
    progress: Progress = silent,
    cancelled: Callable[[], bool] | None = None,
    built: Built | None = None,
) -> float:
    """Render the active instances, (N,) bool, of a core scene by the path tracer, save stem.exr and stem.png, and return the seconds, building included.

    samples: per pixel, None as the open file asks of Cycles; its view transform gives the .png. built: the structures of the active instances, where they
    are there.
    Raises Cancelled, and saves nothing, where cancelled() says so.
    """
    from ...core.accel.blas import BlasCache
    from ...core.accel.embree import shared_device
    from ...core.accel.tlas import Tlas
    from ...core.culling.result import Built
    from ...core.tracing.tracer import prepare, trace

    blender_scene = bpy.context.scene
    start = time.perf_counter()
    if built is None:
        blas = BlasCache(scene.meshes, shared_device(threads))
        blas.need(scene.instances.mesh[active])
        built = Built(blas, Tlas(scene.instances, blas, active), prepare(scene, blas))
    prepared, tlas = built.prepared.with_emitters(active), built.tlas
    picture = trace(prepared, tlas, samples or samples_of(blender_scene, "path"), seed=seed, threads=threads, progress=progress, cancelled=cancelled)
    if cancelled is not None and cancelled():
        raise Cancelled
    seconds = time.perf_counter() - start
    with muted():
        save_pixels(picture.mean, blender_scene, stem)
    return seconds


@contextmanager
def _render_settings(
    scene: bpy.types.Scene, engine: str, samples: int | None, seed: int, threads: int, border: tuple[float, float, float, float] | None
) -> Iterator[None]:
    render = scene.render
    with ExitStack() as stack:
        plain = {"use_border": False, "use_sequencer": False, "use_multiview": False, "use_persistent_data": False}
        stack.enter_context(changed(render, engine=BLENDER_ENGINES[engine], **plain))
        stack.enter_context(saved_as(scene, ".exr"))  # Blender renders no film of less than 16 pixels, nor a part of it
        if border is not None:
            sides = dict(zip(("border_min_x", "border_min_y", "border_max_x", "border_max_y"), border, strict=True))
            stack.enter_context(changed(render, use_border=True, use_crop_to_border=True, **sides))
        if threads:
            stack.enter_context(changed(render, threads_mode="FIXED", threads=threads))
        if engine == "eevee":
            stack.enter_context(changed(scene.eevee, taa_render_samples=samples or samples_of(scene, engine)))
        else:
            sampling = {"samples": samples or samples_of(scene, engine), "seed": seed, "use_animated_seed": False}
            stack.enter_context(changed(scene.cycles, device="CPU", **sampling))
        yield


@contextmanager
def _no_file_outputs() -> Iterator[None]:
    """Mute the compositor's File Output nodes: they would overwrite files of the user's."""
    trees = (tree for tree in bpy.data.node_groups if tree.type == "COMPOSITING")
    with ExitStack() as stack:
        for node in [node for tree in trees for node in tree.nodes if node.type == "OUTPUT_FILE"]:
            stack.enter_context(changed(node, mute=True))
        yield


@contextmanager
def _stats(progress: Progress) -> Iterator[None]:
    """Hand on what the engine says about its samples."""

    def note(text: Any, *_rest: object) -> None:
        if isinstance(text, str) and (found := _SAMPLE.search(text.split("|")[-1])):
            done, of = map(int, found.groups())
            progress(done / max(of, 1), f"sample {done} of {of}")

    handlers = bpy.app.handlers.render_stats
    handlers.append(note)
    try:
        yield
    finally:
        handlers.remove(note)


@contextmanager
def _ctrl_c_ends_the_process() -> Iterator[None]:
    """Blender looks at no signal while it renders and Python at none until it is done; the system's own handling is what works."""
    if threading.current_thread() is not threading.main_thread() or signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
        yield
        return
    old = signal.signal(signal.SIGINT, signal.SIG_DFL)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, old)
