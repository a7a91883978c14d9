"""Renders as the scene says, all of its output included: what `blender -b FILE -f FRAME` does and writes."""

from __future__ import annotations

from contextlib import ExitStack, nullcontext
from pathlib import Path
from typing import Any

import bpy

from ....core.errors import InputError
from ....core.progress import Progress, silent
from ...depsgraph import changed, rendered_layers
from .blender import Rendered, rendered_by
from .choices import AS_SET, BLENDER_ENGINES, DeviceChoice
from .devices import on_device


def engine_of(scene: Any) -> str:
    """The engine that a scene is set to. Raises InputError where that is none of Blender's that culling reaches, or the
    output is a film."""
    found = [name for name, identifier in BLENDER_ENGINES.items() if scene.render.engine == identifier]
    if not found:
        raise InputError(
            f"--as-scene: scene '{scene.name}' is rendered by {scene.render.engine}, which culling does not reach; use "
            "Cycles or EEVEE"
        )
    if scene.render.is_movie_format:
        raise InputError(
            f"--as-scene: scene '{scene.name}' is rendered to a film, and frames are rendered one by one; choose "
            "pictures as its output"
        )
    return found[0]


def files_of(scene: Any, frame: int) -> list[Path]:
    """The pictures that a render of a frame writes where the scene's output says, without those of the compositor's
    File Output nodes."""
    render = scene.render
    views = (
        [view.name for view in render.views if view.use]
        if render.use_multiview and render.image_settings.views_format == "INDIVIDUAL"
        else [""]
    )
    return [Path(bpy.path.abspath(render.frame_path(frame=frame, view=view))) for view in views]


def render_as_scene(
    engine: str,
    frame: int,
    samples: int | None = None,
    threads: int = 0,
    progress: Progress = silent,
    device: DeviceChoice = AS_SET,
) -> Rendered:
    """Render a frame of the open file, the current one, as its scene says, and write what it says where it says.
    Returns what that took, the writing included.

    samples, threads, device: as of `render_blender`; what is not given, the seed too, is as the scene says. Its
    settings are put back.
    Raises InputError where Blender cannot render, or cannot write.
    """
    scene = bpy.context.scene
    if frame < 0:  # a range begins at 0
        raise InputError(f"--as-scene: frame {frame} is before 0; give --frames, or render it without --as-scene")
    if not rendered_layers(scene):
        raise InputError(f"scene {scene.name!r}: no view layer is used for rendering; switch one on")
    with ExitStack() as stack:
        stack.enter_context(changed(scene, frame_start=frame, frame_end=frame, frame_step=1))
        if threads:
            stack.enter_context(changed(scene.render, threads_mode="FIXED", threads=threads))
        if samples and engine == "eevee":
            stack.enter_context(changed(scene.eevee, taa_render_samples=samples))
        elif samples:
            stack.enter_context(changed(scene.cycles, samples=samples))
        used = stack.enter_context(on_device(scene, device) if engine == "cycles" else nullcontext())
        return rendered_by(engine, used, progress, animation=True)
