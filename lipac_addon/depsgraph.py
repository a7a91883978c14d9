"""A dependency graph in render mode, without rendering anything.

`context.evaluated_depsgraph_get()` evaluates what the viewport shows: viewport subdivision levels, viewport particle
counts, `hide_viewport`. What Cycles sees exists only inside a render. So a render is started with an engine of our own,
which hands its graph to a callback and draws nothing.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any, ClassVar, TypeVar

import bpy

from ..core.errors import InputError

ENGINE = "LIPAC_EXTRACT"
STAND_IN = ".lipac stand-in camera"
OWN_SLOT = "LiPaC"
DICED = ((200, 3), (5000, 2), (50_000, 1))  # up to so many faces, levels that stand for Cycles' own subdivision
T = TypeVar("T")


class ExtractEngine(bpy.types.RenderEngine):
    """Render engine that calls back with its dependency graph and leaves the picture empty."""

    bl_idname = ENGINE
    bl_label = "LiPaC extraction"
    bl_use_eevee_viewport = False
    callback: ClassVar[Callable[[Any, bool], None] | None] = None
    owner: ClassVar[object] = None  # whose callback it is
    running: ClassVar[Any] = None  # the engine that renders now
    lipac_served: object = None  # whose it was last

    def render(self, depsgraph: Any) -> None:
        """Called by Blender, on the thread that started the render when in background. An engine that Blender keeps has
        kept its graph."""
        goes_on, self.lipac_served = self.lipac_served is ExtractEngine.owner, ExtractEngine.owner
        if ExtractEngine.callback is not None:
            ExtractEngine.running = self
            try:
                ExtractEngine.callback(depsgraph, goes_on)
            finally:
                ExtractEngine.running = None


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
    """Sets properties of a Blender struct, and puts the old values back: all that can be, whatever becomes of one.

    An enumeration may hold a value that it has no name for, as the colour mode of a film whose codec lacks it. It reads
    "" and cannot be written; Blender then goes by what it was set to.
    """
    old = {name: getattr(target, name) for name in values}
    with ExitStack() as stack:
        for name in reversed(old):  # what is called back first was named first
            if old[name] != "" or target.bl_rna.properties[name].type != "ENUM":
                stack.callback(setattr, target, name, old[name])
        for name, value in values.items():
            setattr(target, name, value)
        yield


def render_result() -> Any | None:
    """The image of the latest render, whatever its name; None before the first."""
    return next((image for image in bpy.data.images if image.type == "RENDER_RESULT"), None)


@contextmanager
def own_slot() -> Iterator[None]:
    """Renders within the block leave the user's Render Result alone, which may not be saved yet: they go into a slot of
    ours, which stays for the next time.

    Only for renders of the scene that the user renders, or such that follow on one in our slot: Blender moves the
    result of the slot that was rendered last out of the way of a render of its own scene alone.
    """
    image = render_result()
    if image is None:
        yield
        return
    slots = image.render_slots
    shown, names = slots.active_index, [slot.name for slot in slots]
    if OWN_SLOT not in names:
        slots.new(name=OWN_SLOT)
        names.append(OWN_SLOT)
    slots.active_index = names.index(OWN_SLOT)
    try:
        yield
    finally:
        slots.active_index = shown


def go_to(scene: Any, frame: float) -> None:
    """Make a frame, perhaps between two, the scene's current one. Nothing is evaluated, but for frames before 0, which
    Blender's properties take for 0."""
    if frame < 0 and frame != scene.frame_float:
        whole = math.floor(frame)
        scene.frame_set(whole, subframe=frame - whole)
    elif frame != scene.frame_float:
        scene.frame_float = frame


def show_frame(scene: Any, number: int) -> None:
    """Make a frame the current one, as `go_to`; a scene that is there already may be between it and the next one, and
    stays."""
    if number != scene.frame_current:
        go_to(scene, number)


def rendered_layers(scene: Any) -> tuple[str, ...]:
    """Names of the view layers that a render of a scene renders."""
    return tuple(layer.name for layer in scene.view_layers if layer.use)


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
    """A render needs a camera object; without one a stand-in at the origin is linked for as long as the render
    lasts."""
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


def _diced(scene: Any) -> list[tuple[Any, int]]:
    """Modifiers whose meshes Cycles subdivides by itself, as finely as the picture needs, whatever levels they have,
    and levels by which they come close to that; those that have as many already are left out."""
    if scene.render.engine == "BLENDER_EEVEE":
        return []
    found = []
    for item in bpy.data.objects:
        last = item.modifiers[-1] if item.type == "MESH" and len(item.modifiers) else None
        if last is not None and last.type == "SUBSURF" and getattr(last, "use_adaptive_subdivision", False):
            levels = next((k for most, k in DICED if len(item.data.polygons) <= most), 0)
            if last.render_levels < levels:
                found.append((last, levels))
    return found


class RenderGraph:
    """The dependency graph of final renders of a scene, kept from frame to frame, so that Blender evaluates only what
    changes.

    While it is held the scene's render engine and some of its render settings are ours (Freestyle is off: it ends the
    process where an engine draws nothing); the user's Render Result is left alone; `release` puts them back, and
    Blender frees the graph. A render of another engine makes Blender free the graph, too: the next frame then gets a
    new one. No other render can be started inside a callback.
    """

    def __init__(self, scene: Any, view_layer: str | None = None) -> None:
        """scene: bpy.types.Scene. view_layer: name, None takes the first one that is used for rendering."""
        self.scene = scene
        self.layer = view_layer or next(iter(rendered_layers(scene)), scene.view_layers[0].name)
        self._held: ExitStack | None = None
        self.freestyle = False  # whether renders of the scene draw its lines

    def evaluate(self, callback: Callable[[Any, bool], T], keep: bool = True) -> T:
        """Calls `callback(depsgraph, goes_on)` with the graph at the scene's current frame, and returns what it
        returns.

        goes_on: it is the graph of the last call, so `depsgraph.updates` lists all that changed. keep: hold the graph
        for the next call.
        Evaluated data may change or die when this returns, so the callback must copy what it needs.
        Raises whatever the callback raises, and InputError when the scene cannot be rendered.
        """
        if self._held is None:
            self._hold(keep)
        try:
            return self._render(callback)
        finally:
            if not keep:
                self.release()

    @staticmethod
    def move_to(frame: float) -> None:
        """Within a callback: evaluate its graph at another frame, perhaps between two."""
        whole = math.floor(frame)
        ExtractEngine.running.frame_set(whole, frame - whole)

    def release(self) -> None:
        """Put the scene's settings back, and let Blender free the graph."""
        if self._held is not None:
            held, self._held = self._held, None
            held.close()

    def _hold(self, keep: bool) -> None:
        render = self.scene.render
        self.freestyle = render.use_freestyle
        with ExitStack() as stack:
            stack.enter_context(_registered())
            stack.enter_context(no_new_images())
            ours = {
                "use_persistent_data": keep,
                "use_compositing": False,
                "use_sequencer": False,
                "use_multiview": False,
                "use_freestyle": False,
            }
            stack.enter_context(changed(render, engine=ENGINE, **ours))
            # Blender evaluates and renders all that are used, whatever the operator is told
            for layer in self.scene.view_layers:
                if layer.use != (layer.name == self.layer):
                    stack.enter_context(changed(layer, use=layer.name == self.layer))
            for modifier, levels in _diced(self.scene):
                stack.enter_context(changed(modifier, render_levels=levels))
            self._held = stack.pop_all()

    def _render(self, callback: Callable[[Any, bool], T]) -> T:
        results: list[T] = []
        errors: list[BaseException] = []

        def call(depsgraph: Any, goes_on: bool) -> None:
            try:
                results.append(callback(depsgraph, goes_on))
            except BaseException as error:  # Blender would print it and go on; it is raised again below
                errors.append(error)

        with _some_camera(self.scene), own_slot():
            ExtractEngine.callback, ExtractEngine.owner = call, self
            try:
                bpy.ops.render.render(layer=self.layer, scene=self.scene.name)
            except RuntimeError as error:
                if not errors:
                    raise InputError(
                        f"the scene {self.scene.name!r} cannot be rendered: {str(error).strip()}"
                    ) from error
            finally:
                ExtractEngine.callback = ExtractEngine.owner = None
        if errors:
            raise errors[0]
        if not results:
            raise InputError(
                f"the scene {self.scene.name!r} was not rendered: view layer {self.layer!r} is disabled or the render "
                "was cancelled"
            )
        return results[0]


def with_render_depsgraph(
    scene: Any, frame: int | None, callback: Callable[[Any], T], view_layer: str | None = None
) -> T:
    """Calls `callback(depsgraph)` with the graph that a final render of `scene` at `frame` would get, and returns what
    it returns.

    frame: None keeps the current frame, which stays afterwards. The graph and all evaluated data die when this returns,
    so the callback must copy what it needs (`extract` does: its result lives on by itself). Raises as
    `RenderGraph.evaluate`.
    """
    if frame is not None and frame != scene.frame_current:
        scene.frame_set(frame)
    return RenderGraph(scene, view_layer).evaluate(lambda depsgraph, _: callback(depsgraph), keep=False)
