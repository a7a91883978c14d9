"""A dependency graph in render mode, without rendering anything.

`context.evaluated_depsgraph_get()` evaluates what the viewport shows: viewport subdivision levels, viewport particle counts, `hide_viewport`. What Cycles
sees exists only inside a render. So a render is started with an engine of our own, which hands its graph to a callback and draws nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, ClassVar, TypeVar

import bpy

from ...core.errors import InputError

ENGINE = "LIPAC_EXTRACT"
STAND_IN = ".lipac stand-in camera"
T = TypeVar("T")


class ExtractEngine(bpy.types.RenderEngine):
    """Render engine that calls back with its dependency graph and leaves the picture empty."""

    bl_idname = ENGINE
    bl_label = "LiPaC extraction"
    bl_use_eevee_viewport = False
    callback: ClassVar[Callable[[Any], None] | None] = None

    def render(self, depsgraph: Any) -> None:
        """Called by Blender, on the thread that started the render when in background."""
        if ExtractEngine.callback is not None:
            ExtractEngine.callback(depsgraph)


@contextmanager
def _registered() -> Iterator[None]:
    """The engine exists only while it is in use, so users never see it in the list of engines."""
    bpy.utils.register_class(ExtractEngine)
    try:
        yield
    finally:
        bpy.utils.unregister_class(ExtractEngine)


@contextmanager
def changed(target: Any, **values: Any) -> Iterator[None]:
    """Sets properties of a Blender struct, and puts the old values back."""
    old = {name: getattr(target, name) for name in values}
    try:
        for name, value in values.items():
            setattr(target, name, value)
        yield
    finally:
        for name, value in old.items():
            setattr(target, name, value)


@contextmanager
def no_new_images() -> Iterator[None]:
    """Removes images that appear meanwhile: the first render of a file adds its "Render Result"."""
    before = {image.as_pointer() for image in bpy.data.images}
    try:
        yield
    finally:
        for image in [i for i in bpy.data.images if i.as_pointer() not in before]:
            bpy.data.images.remove(image)


@contextmanager
def _some_camera(scene: Any) -> Iterator[None]:
    """A render needs a camera object; without one a stand-in at the origin is linked for as long as the render lasts."""
    if scene.camera is not None:
        yield
        return
    data = bpy.data.cameras.new(STAND_IN)
    camera = bpy.data.objects.new(STAND_IN, data)
    scene.collection.objects.link(camera)
    scene.camera = camera
    try:
        yield
    finally:
        scene.camera = None
        bpy.data.objects.remove(camera)
        bpy.data.cameras.remove(data)


def with_render_depsgraph(scene: Any, frame: int | None, callback: Callable[[Any], T], view_layer: str | None = None) -> T:
    """Calls `callback(depsgraph)` with the graph that a final render of `scene` at `frame` would get, and returns what it returns.

    scene: bpy.types.Scene. frame: None keeps the current frame. view_layer: name, None takes the first one that is used for rendering.
    The graph and all evaluated data die when this returns, so the callback must copy what it needs (`extract` does: its result lives on by itself).
    No other render can be started inside the callback. Engine, compositing and sequencer settings are put back afterwards; the frame stays.
    Raises whatever the callback raises, and InputError when the scene cannot be rendered.
    """
    if frame is not None and frame != scene.frame_current:
        scene.frame_set(frame)
    layer = view_layer or next((v.name for v in scene.view_layers if v.use), scene.view_layers[0].name)
    results: list[T] = []
    errors: list[BaseException] = []

    def call(depsgraph: Any) -> None:
        try:
            results.append(callback(depsgraph))
        except BaseException as error:  # Blender would print it and go on; it is raised again below
            errors.append(error)

    render = scene.render
    with _registered(), no_new_images(), _some_camera(scene), changed(render, engine=ENGINE, use_compositing=False, use_sequencer=False, use_multiview=False):
        ExtractEngine.callback = call
        try:
            bpy.ops.render.render(layer=layer, scene=scene.name)
        except RuntimeError as error:
            if not errors:
                raise InputError(f"the scene {scene.name!r} cannot be rendered: {str(error).strip()}") from error
        finally:
            ExtractEngine.callback = None
    if errors:
        raise errors[0]
    if not results:
        raise InputError(f"the scene {scene.name!r} was not rendered: view layer {layer!r} is disabled or the render was cancelled")
    return results[0]
