"""Live mode: the loop runs beside the user's work and playback, and the overlay follows.

Blender's handlers only note what changed. A timer ticks: it reads what was noted from the viewport's dependency graph, as a `Change`, and hands it to a thread,
which does one round of the loop (`core.frames.Shot`); a later tick takes the states. A tick does one of these things. So live mode shows what the viewport has:
its subdivision levels, its particles, less what is hidden from renders.

Instances are kept by counts, as the method's real-time loop does, and BLASes are built on another thread within a budget: until they are there, instances are
pending. The error budget is for Analyze.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import bpy
import numpy as np

from ...core.errors import InputError
from . import job, props, results
from .background import AskedMeshes, in_thread
from .wheels import REINSTALL

if TYPE_CHECKING:
    from ...core.change import Change
    from ...core.culling import CullOptions
    from ...core.frames import Shot
    from ...core.loop import CullingResult
    from ...core.scene import I64
    from ..extract import ExtractedWorld, Extraction
    from ..extract.scene import SceneReader

INTERVAL = 0.04  # seconds between ticks
SERVE = 0.004  # seconds of a tick to load meshes that the thread asks for
SHARE = 1e-4  # of the paths that must meet an instance
BUILD_MS = 20.0  # of BLAS building to start in a round
REST = 2  # rounds in a row that change nothing, after which there is nothing to do
_WORLDLY = ("World", "NodeTree", "Image", "Texture")
DUTY = 8  # times as long as it took to read the scene that nothing is read again: a scene that is slow to read leaves Blender most of its time


@dataclass(frozen=True)
class Listed:
    """A data-block of the graph that changed, as `bpy.types.DepsgraphUpdate` says it."""

    id: Any
    is_updated_geometry: bool


class NotedGraph:
    """The viewport's dependency graph, with all that changed since it was last read (Blender keeps no more than the latest), and without what renders hide."""

    def __init__(self, depsgraph: bpy.types.Depsgraph, noted: dict[int, bool]) -> None:
        """noted: by the address of a data-block, whether its geometry changed."""
        self._depsgraph = depsgraph
        found = [(block, noted.get(block.as_pointer())) for block in depsgraph.ids] if noted else []
        self.updates = [Listed(block, geometry) for block, geometry in found if geometry is not None]

    def __getattr__(self, name: str) -> Any:
        return getattr(self._depsgraph, name)

    @property
    def objects(self) -> Iterator[Any]:
        """Objects of the viewport that a render shows, too."""
        layer = self._depsgraph.view_layer.layer_collection
        unseen = {ob.name_full for c in _hidden(layer) for ob in c.all_objects}
        if unseen:
            unseen -= {ob.name_full for c in _rendered(layer) for ob in c.objects}
        return (item for item in self._depsgraph.objects if not item.hide_render and item.name_full not in unseen)


def _hidden(layer: bpy.types.LayerCollection) -> Iterator[bpy.types.Collection]:
    """Collections of a view layer that renders hide, the topmost of each branch."""
    if layer.collection.hide_render:
        yield layer.collection
        return
    for child in layer.children:
        yield from _hidden(child)


def _rendered(layer: bpy.types.LayerCollection) -> Iterator[bpy.types.Collection]:
    if not layer.collection.hide_render:
        yield layer.collection
        for child in layer.children:
            yield from _rendered(child)


class Live:
    """Live mode over one view layer of a scene.

    message: what it does; error: why it cannot go on before something changes, "" where it can; rounds: done so far; closed: it has ended; read_s: seconds of
    the main thread that the scene took to read, the last time.
    """

    def __init__(self, scene: bpy.types.Scene, layer: bpy.types.ViewLayer) -> None:
        self.uid, self.layer = scene.session_uid, layer.name
        self.message, self.error = "loading; the first time, kernels are compiled, which takes a minute", ""
        self.rounds, self.read_s = 0, 0.0
        self.closed = False
        self._noted: dict[int, bool] = {}
        self._dirty, self._goes_on = True, False  # something changed; the graph is the one that was read last
        self._reader: SceneReader | None = None
        self._world: ExtractedWorld | None = None
        self._fingerprint = ""
        self._frame: _Frame | None = None
        self._shot: Shot | None = None
        self._rest = 0
        self._next_read = 0.0
        self._steps = self._run()

    @property
    def resting(self) -> bool:
        """Whether there is nothing to do before something changes."""
        return not self._dirty and (bool(self.error) or self._rest >= REST)

    def note(self, depsgraph: bpy.types.Depsgraph) -> None:
        """Take down what changed in a graph, if it is ours; called by Blender's handlers."""
        if depsgraph.mode != "VIEWPORT" or depsgraph.view_layer.name != self.layer or depsgraph.scene.session_uid != self.uid:
            return
        for update in depsgraph.updates:
            address = update.id.as_pointer()
            self._noted[address] = self._noted.get(address, False) or update.is_updated_geometry
            self._dirty = True

    def touch(self) -> None:
        """Something changed that no graph tells: a pin, an option."""
        self._dirty = True

    def forget(self) -> None:
        """All references into Blender are about to die (undo, redo): everything is read again, and compared."""
        if self._reader is not None:
            self._reader.graph.forget()
        self._noted.clear()
        self._goes_on, self._dirty = False, True

    def tick(self) -> bool:
        """Do a little on the main thread. True where there is something new to show."""
        before = self.rounds, self.error
        try:
            next(self._steps, None)
        except BaseException:
            self.error = "live mode failed; see the console"
            self.close()
            raise
        return (self.rounds, self.error) != before

    def close(self) -> None:
        """Stop, and wait until the thread has ended."""
        self.closed = True
        self._steps.close()  # type: ignore[attr-defined]
        self._reader = self._frame = self._shot = None
        results.live.pop(self.uid, None)

    def _run(self) -> Iterator[None]:
        try:
            yield from in_thread(_load_engine, lambda: None)
        except (ImportError, OSError) as error:
            self.error = f"LiPaC's libraries cannot be loaded ({error}): {REINSTALL}"
            return
        while True:
            scene = job.find_scene(self.uid)
            if scene is None or self.layer not in scene.view_layers:
                self.error = "the scene or its view layer was removed"
                return
            if not self._is_due(scene):
                yield
                continue
            try:
                yield from self._round(scene)
            except InputError as error:
                self._fail(str(error))
            except MemoryError:
                self._fail("live mode ran out of memory: set a memory budget in the preferences")

    def _is_due(self, scene: bpy.types.Scene) -> bool:
        """Whether there is something to do, and now."""
        from ...core.frames import Shot

        options = live_options(scene.lipac)
        if self._shot is None or self._shot.options != options:
            self._shot, self._rest = Shot(options), 0
            self.error = ""
        late = self._dirty and (time.monotonic() < self._next_read or self._is_edited(scene))
        return not (self.resting or late or is_busy())

    def _is_edited(self, scene: bpy.types.Scene) -> bool:
        """Whether a mesh is in Edit Mode: Blender then gives out no faces of it."""
        active = scene.view_layers[self.layer].objects.active
        return active is not None and active.mode == "EDIT"

    def _round(self, scene: bpy.types.Scene) -> Iterator[None]:
        """Read what changed; do a round of the loop in a thread; take its states."""
        if self._dirty or self._frame is None:
            yield from self._read(scene)
        frame, shot = self._frame, self._shot
        assert frame is not None
        assert shot is not None
        meshes = AskedMeshes(frame.extraction.scene.meshes)
        asked, change = replace(frame.extraction.scene, meshes=meshes), frame.change
        frame.change = _still()
        result = yield from in_thread(
            lambda: shot.advance(asked, change, cancelled=lambda: self.closed, pinned=frame.pinned), lambda: None, meshes, SERVE
        )
        yield
        self._show(frame, result)

    def _read(self, scene: bpy.types.Scene) -> Iterator[None]:
        """Read the viewport's graph in one tick, find out what changed in another. Raises InputError where there is nothing to trace."""
        from ..extract.scene import SceneReader

        if any(other.lipac.applied for other in bpy.data.scenes):
            self._dirty = False
            raise InputError("culled instances are hidden from renders: Restore to go on")
        layer = scene.view_layers[self.layer]
        layer.update()
        graph = NotedGraph(layer.depsgraph, self._noted)
        self._noted, self._dirty = {}, False
        world = self._read_world(scene, layer, graph)
        start = time.perf_counter()
        self._reader, goes_on = self._reader or SceneReader(), self._goes_on
        self._goes_on = False
        number, frame = scene.frame_current, self._reader.read(graph, goes_on)
        self._goes_on, self._rest, self.error = True, 0, ""
        uids, pins = results.session_uids(frame.keys), props.marked(props.PIN)
        pinned = results.among(uids, pins) if pins else None
        self.read_s = time.perf_counter() - start
        self._next_read = time.monotonic() + DUTY * self.read_s
        yield
        extraction = replace(self._reader.finish(frame, world), scatters={})
        self._frame = _Frame(number, extraction, extraction.change, uids, None if pinned is None else results.instances_of(frame.keys, pinned))
        yield

    def _read_world(self, scene: bpy.types.Scene, layer: bpy.types.ViewLayer, graph: NotedGraph) -> ExtractedWorld:
        """The world; one that is not constant is rendered, where it is new or changed."""
        from ..extract.world import constant_world, extract_world, fingerprint

        if self._world is not None and self._goes_on and not any(part in type(u.id).__name__ for u in graph.updates for part in _WORLDLY):
            return self._world
        item = getattr(graph.view_layer_eval, "world_override", None) or graph.scene_eval.world
        world, mark = constant_world(item), ""
        if world is None:
            mark = fingerprint(item, scene.frame_current)
            if self._world is None or mark != self._fingerprint:
                world = extract_world(scene, layer)
                layer.update()  # the render came with data-blocks of its own
                self._goes_on = False
        self._world, self._fingerprint = world or self._world, mark
        assert self._world is not None
        return self._world

    def _show(self, frame: _Frame, result: CullingResult) -> None:
        """Hand new states to the panel and the overlay."""
        last = results.live.get(self.uid)
        now = results.FrameResult.of(frame.number, frame.extraction, frame.uids, result)
        same = last is not None and np.array_equal(last.state, now.state) and len(last.regions) == len(now.regions)
        self._rest = self._rest + 1 if same and not result.stats["pending"] else 0
        results.live[self.uid] = now
        self.rounds += 1
        self.message = f"frame {frame.number}, {'at rest' if self._rest >= REST else f'round {self.rounds}'}"

    def _fail(self, line: str) -> None:
        """Wait for another scene."""
        self.error, self._frame, self._reader, self._goes_on = line, None, None, False
        results.live.pop(self.uid, None)


@dataclass
class _Frame:
    """What was read last; change: what the next round has to know of it."""

    number: int
    extraction: Extraction
    change: Change | None
    uids: I64
    pinned: np.ndarray | None


def _still() -> Change:
    from ...core.change import Change

    nothing = np.zeros(0, np.int32)
    return Change(None, None, nothing, nothing, False, False)


def _load_engine() -> None:
    """Import what the loop needs: on another thread, for it takes seconds."""
    from ...core import frames  # noqa: F401


def live_options(settings: props.LipacSettings) -> CullOptions:
    """The options of the scene's settings for a loop in real time: few paths and one round at a time, whose requests the next one meets."""
    options = props.cull_options(settings)
    if options.policy != "light-paths":
        return options
    return replace(options, min_share=SHARE, paths=1, max_iterations=1, blas_budget_ms=BUILD_MS)


def is_busy() -> bool:
    """Whether Blender renders, or an analysis runs: live mode waits."""
    return bpy.app.is_job_running("RENDER") or job.is_running()


# The one that is on

current: Live | None = None
_on = False


def is_on() -> bool:
    """Whether live mode is switched on."""
    return _on


def start() -> None:
    """Switch live mode on: it follows the scene of the first window from now on, through whatever files are opened."""
    global _on  # noqa: PLW0603
    _on = True
    if not bpy.app.timers.is_registered(tick):
        bpy.app.timers.register(tick, first_interval=0.0, persistent=True)


def stop() -> None:
    """Switch it off."""
    global _on  # noqa: PLW0603
    _on = False
    suspend()
    if bpy.app.timers.is_registered(tick):
        bpy.app.timers.unregister(tick)


def suspend() -> None:
    """Let go of the scene; where live mode is on, the next tick begins anew."""
    global current  # noqa: PLW0603
    if current is not None:
        current.close()
    current = None


def touch() -> None:
    """Something changed that no dependency graph tells."""
    if current is not None:
        current.touch()


def tick() -> float:
    """Called by Blender's timer; returns the seconds until the next call."""
    global current  # noqa: PLW0603
    window = next(iter(bpy.context.window_manager.windows), None)
    if window is not None and _on:
        target = window.scene.session_uid, window.view_layer.name
        if current is None or (current.uid, current.layer) != target:
            suspend()
            current = Live(window.scene, window.view_layer)
        if current.tick():
            props.redraw()
    return INTERVAL
