"""The frames of a scene, one after the other."""

from __future__ import annotations

import time
from functools import partial
from types import TracebackType
from typing import Any

from ...core.errors import InputError
from ...core.tracing.second_process import share
from ..depsgraph import RenderGraph, go_to, show_frame
from .camera import NO_CAMERA, what_draws_lines
from .scene import Extraction, Frame, Look, SceneReader
from .shutter import Shutter, read_shutter
from .world import ExtractedWorld, baked_world, constant_world, fingerprint, world_of


class Extractor:
    """Extracts frames of a scene as a final render would see them, at a cost that follows what changes from each to the
    next.

        with Extractor(bpy.context.scene) as extractor:
            for number in (1, 2, 3):
                extraction = extractor.frame(number)     # extraction.change: what is other than in the frame before

    Every frame is as if it were extracted alone, but for the numbers of meshes, which stay what they were. While
    Blender's graph is held (`RenderGraph`), Blender evaluates, and we read, what it says has changed; with a new graph
    everything is read, and compared with what was there.

    read_s: seconds of the last frame that were ours; the others are Blender's, for evaluating it.
    """

    def __init__(
        self,
        scene: Any,
        view_layer: str | None = None,
        allow_no_camera: bool = False,
        world: ExtractedWorld | None = None,
        whole: bool = True,
    ) -> None:
        """scene: bpy.types.Scene; view_layer: name, None takes the first that is used for rendering; world: instead of
        the scene's own, for all frames. whole: true displacement and what happens while the shutter is open are allowed
        for, as pictures of Blender's engines need it; ours show neither."""
        share()
        self.scene = scene
        self.allow_no_camera = allow_no_camera
        self._graph = RenderGraph(scene, view_layer)
        self._reader = SceneReader(allow_no_camera, whole)
        self._whole, self._at, self._shutter = whole, 0.0, Shutter()
        self._given, self._world, self._fingerprint = world, world, ""
        self.read_s = 0.0

    def __enter__(self) -> Extractor:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.release()

    def frame(
        self, number: int | None = None, keep: bool = True, at: float = 0.0, look: Look | None = None
    ) -> Extraction:
        """A frame, by default the scene's current one, which it then is. keep: hold the graph for the next frame, until
        `release`.

        at: what is where so many frames later, seen by the cameras of the frame itself, which must have been extracted
        just before; what moves is there at one of `Extraction.moments`.
        look: is shown what Blender has evaluated before more of it is read, and may raise what ends it.
        Raises InputError: no camera, an unsupported camera, nothing to render, the scene cannot be rendered.
        """
        if number is not None:
            show_frame(self.scene, number)
        if self.scene.camera is None and not self.allow_no_camera:
            raise InputError(NO_CAMERA)
        own, self._at = self.scene.frame_float, at
        try:
            if at:
                go_to(self.scene, own + at)
            frame, world, mark = self._graph.evaluate(partial(self._read, look=look), keep)
        finally:
            if at:
                go_to(self.scene, own)
        if world is None:
            if self._world is None or mark != self._fingerprint:
                self._world = self._bake()
            world = self._world
        self._fingerprint = mark
        if not keep:
            self._reader.graph.forget()
        start = time.perf_counter()
        extraction = self._reader.finish(frame, world)
        self.read_s += time.perf_counter() - start
        return extraction

    def follow(self, scene: Any) -> None:
        """Go on with another reference to the same scene: undo makes new ones of everything."""
        self.scene = self._graph.scene = scene

    def release(self) -> None:
        """Put the scene's render settings back, and let Blender free its graph; the next frame gets a new one."""
        self._reader.graph.forget()
        self._graph.release()

    def _read(
        self, depsgraph: Any, goes_on: bool, look: Look | None = None
    ) -> tuple[Frame, ExtractedWorld | None, str]:
        """What there is to read of a graph: the frame, the world where it needs no render, and what tells that it is
        another."""
        start, world = time.perf_counter(), self._given
        item = world_of(depsgraph.scene_eval, depsgraph.view_layer_eval)
        if world is None:
            world = constant_world(item)
        frame = self._reader.read(depsgraph, goes_on, look)
        if self._whole and not self._at:
            number = depsgraph.scene_eval.frame_float  # perhaps between two frames
            self._shutter = read_shutter(depsgraph, frame.scene.film, lambda time: self._graph.move_to(number + time))
        frame = frame.exposed(self._shutter)
        if self._whole:
            frame = frame.drawn(*what_draws_lines(depsgraph, self._graph.freestyle))
        self.read_s = time.perf_counter() - start
        return frame, world, "" if world is not None else fingerprint(item, depsgraph.scene_eval.frame_current)

    def _bake(self) -> ExtractedWorld:
        """The world of the current frame, rendered. Blender then frees the graph."""
        # animated values get to the world that is rendered
        self.scene.frame_set(self.scene.frame_current, subframe=self.scene.frame_subframe)
        return baked_world(world_of(self.scene, self.scene.view_layers[self._graph.layer]))


def extract_frame(
    scene: Any,
    frame: int | None = None,
    view_layer: str | None = None,
    allow_no_camera: bool = False,
    world: ExtractedWorld | None = None,
) -> Extraction:
    """One frame of a Blender scene as a final render would see it. Raises as `Extractor.frame`.

    world: from `extract_world`, to bake an unchanging world once for many frames; None bakes it here.
    """
    return Extractor(scene, view_layer, allow_no_camera, world).frame(frame, keep=False)
