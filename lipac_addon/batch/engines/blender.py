"""Renders of the open file by Blender's engines as they are."""

from __future__ import annotations

import re
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import bpy

from ....core.errors import InputError
from ....core.progress import Progress, silent
from ...console import muted
from ...depsgraph import changed, rendered_layers
from ...pictures import save_render_result, saved_as
from .choices import BLENDER_ENGINES
from .wishes import samples_of

_SAMPLE = re.compile(r"(\d+)\s*/\s*(\d+)")


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
