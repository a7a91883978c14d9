"""Renders of the open file by Blender's engines as they are."""

from __future__ import annotations

import re
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bpy

from ....core.errors import InputError
from ....core.progress import Progress, silent
from ...console import muted
from ...depsgraph import changed, rendered_layers
from ...pictures import save_render_result, saved_as
from .choices import AS_SET, BLENDER_ENGINES, DeviceChoice
from .devices import Device, eevee_device, on_device
from .wishes import samples_of

_SAMPLE = re.compile(r"(\d+)\s*/\s*(\d+)")
_MEMORY = re.compile(r"(?:Mem|Peak):\s*(\d+(?:\.\d+)?)([KMG])")


@dataclass(frozen=True)
class Rendered:
    """What a render took. seconds: of the render alone; device: what it ran on; first_sample_s: until Blender first
    told of a finished sample; device_bytes: of the device's memory at most, by Cycles' own count, to a megabyte. None:
    Blender did not say."""

    seconds: float
    device: str
    first_sample_s: float | None = None
    device_bytes: int | None = None

    def entry(self) -> dict[str, Any]:
        """For a frame of report.json."""
        return {
            "render_s": self.seconds,
            "device": self.device,
            "first_sample_s": self.first_sample_s,
            "device_bytes": self.device_bytes,
        }


def render_blender(
    engine: str,
    stem: Path,
    samples: int | None = None,
    seed: int = 0,
    threads: int = 0,
    progress: Progress = silent,
    border: tuple[float, float, float, float] | None = None,
    device: DeviceChoice = AS_SET,
) -> Rendered:
    """Render the current frame of the open file by 'cycles' or 'eevee', save stem.exr and stem.png, and return what
    that took.

    samples: per pixel, None as in the scene. seed: Cycles' noise; EEVEE has none. threads: 0 for all. border: left,
    bottom, right, top of the part of the picture that is wanted, 0 to 1 (default: all). device: for Cycles. All else is
    as the scene says; its settings are put back.
    Raises InputError where Blender cannot render, or not there. Ctrl-C during the render ends the process at once, for
    Blender cannot be asked to stop.
    """
    scene = bpy.context.scene
    if not rendered_layers(scene):
        raise InputError(f"scene {scene.name!r}: no view layer is used for rendering; switch one on")
    where = on_device(scene, device) if engine == "cycles" else nullcontext()
    with _render_settings(scene, engine, samples, seed, threads, border), where as used, _no_file_outputs():
        rendered = rendered_by(engine, used, progress)
    with muted():
        save_render_result(scene, stem)
    return rendered


def rendered_by(engine: str, used: Device | None, progress: Progress, animation: bool = False) -> Rendered:
    """Have Blender render the open scene as it is now set, and say what that took. used: the device, None for EEVEE's.
    animation: the frames of its range, to its own files. Raises InputError where Blender cannot."""
    scene = bpy.context.scene
    with _stats(progress) as told:
        start = told.start = time.perf_counter()
        try:
            with muted(), _ctrl_c_ends_the_process(), _other_scenes_where_they_are(scene):
                bpy.ops.render.render(animation=animation, scene=scene.name)
        except RuntimeError as error:
            raise InputError(
                f"{engine} cannot render the scene: {str(error).removeprefix('Error:').strip()}"
            ) from error
        seconds = time.perf_counter() - start
    return Rendered(seconds, eevee_device() if used is None else str(used), told.first_sample_s, told.device_bytes)


@contextmanager
def _other_scenes_where_they_are(scene: bpy.types.Scene) -> Iterator[None]:
    """A render moves scenes that its compositor shows to its own frame, and leaves them there."""
    others = [(other, other.frame_current, other.frame_subframe) for other in bpy.data.scenes if other != scene]
    try:
        yield
    finally:
        for other, frame, subframe in others:
            if (other.frame_current, other.frame_subframe) != (frame, subframe):
                other.frame_current, other.frame_subframe = frame, subframe


@contextmanager
def _render_settings(
    scene: bpy.types.Scene,
    engine: str,
    samples: int | None,
    seed: int,
    threads: int,
    border: tuple[float, float, float, float] | None,
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
            stack.enter_context(changed(scene.cycles, **sampling))
        yield


@contextmanager
def _no_file_outputs() -> Iterator[None]:
    """Mute the compositor's File Output nodes: they would overwrite files of the user's."""
    trees = (tree for tree in bpy.data.node_groups if tree.type == "COMPOSITING")
    with ExitStack() as stack:
        for node in [node for tree in trees for node in tree.nodes if node.type == "OUTPUT_FILE"]:
            stack.enter_context(changed(node, mute=True))
        yield


class _Told:
    """What an engine says while it renders. start: when that began, by `perf_counter`."""

    def __init__(self, progress: Progress) -> None:
        self.progress = progress
        self.start = 0.0
        self.first_sample_s: float | None = None
        self.device_bytes: int | None = None

    def note(self, text: Any, *_rest: object) -> None:
        """A handler of `render_stats`."""
        if not isinstance(text, str):
            return
        for number, unit in _MEMORY.findall(text):
            size = int(float(number) * 1024 ** " KMG".index(unit))
            self.device_bytes = max(size, self.device_bytes or 0) or None
        if found := _SAMPLE.search(text.split("|")[-1]):
            done, of = map(int, found.groups())
            if done and self.first_sample_s is None:
                self.first_sample_s = time.perf_counter() - self.start
            self.progress(done / max(of, 1), f"sample {done} of {of}")


@contextmanager
def _stats(progress: Progress) -> Iterator[_Told]:
    """Hand on what the engine says about its samples, and note it."""
    told, handlers = _Told(progress), bpy.app.handlers.render_stats
    note = told.note  # one object, to be found again
    handlers.append(note)
    try:
        yield told
    finally:
        handlers.remove(note)


@contextmanager
def _ctrl_c_ends_the_process() -> Iterator[None]:
    """Blender looks at no signal while it renders and Python at none until it is done; the system's own handling is
    what works."""
    if threading.current_thread() is not threading.main_thread() or signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
        yield
        return
    old = signal.signal(signal.SIGINT, signal.SIG_DFL)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, old)
