"""Live mode: the loop runs beside the user's work and playback, and the overlay follows.

Blender's handlers only note what changed. A timer ticks: it reads what was noted from the viewport's dependency graph,
as a `Change`, and hands it to a thread, which does one round of the loop (`Shot`); a later tick takes the states. A
tick does one of these things. So live mode shows what the viewport has: its subdivision levels, its particles, less
what is hidden from renders.

Instances are kept by counts, as the method's real-time loop does, and BLASes are built on another thread within a
budget: until they are there, instances are pending. The error budget is for Analyze.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import bpy
import numpy as np

from ....core.culling.policies import LIGHT_PATHS
from ....core.errors import InputError
from ... import roles
from ..state import applying, props, results, session
from . import engine, job
from .background import AskedMeshes, in_thread
from .viewport import LiveWorld, NotedGraph
from .viewport_culling import ViewportCulling

if TYPE_CHECKING:
    from ....core.arrays import F32, I64
    from ....core.culling.options import CullOptions
    from ....core.culling.result import CullingResult
    from ....core.culling.shot import Shot
    from ....core.scene.change import Change
    from ...extract import Extraction
    from ...extract.scene import SceneReader

INTERVAL = 0.04  # seconds between ticks
SERVE = 0.004  # seconds of a tick to load meshes that the thread asks for
SHARE = 1e-4  # of the paths that must meet an instance
BUILD_MS = 20.0  # of BLAS building to start in a round
REST = 2  # rounds in a row that change nothing, after which there is nothing to do
# times as long as it took to read the scene that nothing is read again: a scene that is slow to read leaves Blender
# most of its time
DUTY = 8


class Live:
    """Live mode over one view layer of a scene.

    message: what it does; error: why it cannot go on before something changes, "" where it can; rounds: done so far;
    closed: it has ended; read_s: seconds of the main thread that the scene took to read, the last time; culling: what
    the viewport goes without.
    """

    def __init__(self, scene: bpy.types.Scene, layer: bpy.types.ViewLayer) -> None:
        self.uid, self.layer = scene.session_uid, layer.name
        self.message, self.error = engine.LOADING, ""
        self.rounds, self.read_s = 0, 0.0
        self.closed = False
        self._noted: dict[int, bool] = {}
        self._dirty, self._goes_on = True, False  # something changed; the graph is the one that was read last
        self._reader: SceneReader | None = None
        self._world = LiveWorld()
        self._role_changes = roles.changes
        self._frame: _Frame | None = None
        self._shot: Shot | None = None
        self._rest = 0
        self._next_read = 0.0
        self.culling = ViewportCulling(self.uid, self.layer)
        self._steps = self._run()

    @property
    def resting(self) -> bool:
        """Whether there is nothing to do before something changes."""
        return not self._dirty and (bool(self.error) or self._rest >= REST)

    def note(self, depsgraph: bpy.types.Depsgraph) -> None:
        """Take down what changed in a graph, if it is ours; called by Blender's handlers."""
        if (
            self.culling.switches.own
            or depsgraph.mode != "VIEWPORT"
            or depsgraph.view_layer.name != self.layer
            or depsgraph.scene.session_uid != self.uid
        ):
            return
        for update in depsgraph.updates:
            address = update.id.as_pointer()
            self._noted[address] = self._noted.get(address, False) or update.is_updated_geometry
            self._dirty = True
        if self.culling.switches.out and not is_busy():
            self.culling.foresee(depsgraph)

    def forget(self) -> None:
        """All references into Blender are about to die (undo, redo): everything is read again, and compared."""
        if self._reader is not None:
            self._reader.graph.forget()
        self._noted.clear()
        self._goes_on, self._dirty = False, True

    def tick(self) -> bool:
        """Do a little on the main thread. True where there is something new to show."""
        before = self.rounds, self.error
        if self._role_changes != roles.changes:
            self._role_changes, self._dirty = roles.changes, True
        try:
            next(self._steps, None)
            changed = self._cull_viewport()
        except BaseException:
            self.error = "live mode failed; see the console"
            self.close()
            raise
        return changed or (self.rounds, self.error) != before

    def close(self, quitting: bool = False) -> None:
        """Stop, wait until the thread has ended, and have the viewport show everything. quitting: Blender goes down,
        nobody looks."""
        self.closed = True
        self._steps.close()  # type: ignore[attr-defined]
        if not quitting:
            self.culling.close()
        self._reader = self._frame = self._shot = None
        results.live.pop(self.uid, None)

    def _cull_viewport(self) -> bool:
        """Have the viewport go without what is culled, where that is asked for; True where something changed."""
        scene = session.find_scene(self.uid)
        if scene is None or self.layer not in scene.view_layers or is_busy():
            return False
        if self.error:
            return self.culling.off(scene.view_layers[self.layer])
        return self.culling.step(scene, self.resting)

    def _run(self) -> Iterator[None]:
        try:
            yield from engine.load(lambda: None)
        except InputError as error:
            self.error = str(error)
            return
        while True:
            scene = session.find_scene(self.uid)
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
        from ....core.culling.shot import Shot

        options = live_options(scene.lipac)
        if self._shot is None or self._shot.options != options:
            self._shot, self._rest = Shot(options), 0
            self.error = ""
        late = self._dirty and (time.monotonic() < self._next_read or session.is_edited())
        return not (self.resting or late or is_busy())

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
            lambda: shot.advance(asked, change, cancelled=lambda: self.closed, pinned=frame.pinned),
            lambda: None,
            meshes,
            SERVE,
        )
        yield
        self._show(frame, result)

    def _read(self, scene: bpy.types.Scene) -> Iterator[None]:
        """Read the viewport's graph in one tick, find out what changed in another. Raises InputError where there is
        nothing to trace."""
        from ...extract.graph import addresses_of
        from ...extract.scene import SceneReader

        if applying.marks():
            self._dirty = False
            raise InputError("culled instances are hidden from renders: Restore to go on")
        layer = scene.view_layers[self.layer]
        layer.update()
        graph = NotedGraph(layer.depsgraph, self._noted, self.culling.switches.closed(layer))
        self._noted, self._dirty = {}, False
        goes_on, self._goes_on = self._goes_on, False
        world, rendered = self._world.read(scene, layer, graph, goes_on)
        goes_on = goes_on and not rendered
        start = time.perf_counter()
        reader = self._reader = self._reader or SceneReader()
        same = goes_on and reader.graph.addresses == addresses_of(graph)
        with self.culling.switches.everything(layer, graph, same):
            number, frame = scene.frame_current, reader.read(graph, goes_on)
        self.culling.touch()
        self._goes_on, self._rest, self.error = True, 0, ""
        uids = results.session_uids(frame.keys)
        self.read_s = time.perf_counter() - start
        self._next_read = time.monotonic() + DUTY * self.read_s
        yield
        extraction = replace(reader.finish(frame, world), scatters={})
        self._frame = _Frame(
            number, extraction, extraction.change, uids, props.pinned(frame.keys, uids), frame.scatters
        )
        yield

    def _show(self, frame: _Frame, result: CullingResult) -> None:
        """Hand new states to the panel and the overlay."""
        last = results.live.get(self.uid)
        now = results.FrameResult.of(frame.number, frame.extraction, frame.uids, result, frame.pinned)
        same = last is not None and np.array_equal(last.state, now.state) and len(last.regions) == len(now.regions)
        self._rest = self._rest + 1 if same and not result.stats["pending"] else 0
        results.live[self.uid] = now
        self.culling.take(now, frame.places, frame.extraction.scene.camera.to_world[:, 3])
        self.rounds += 1
        self.message = f"frame {frame.number}, {'at rest' if self._rest >= REST else f'round {self.rounds}'}"

    def _fail(self, line: str) -> None:
        """Wait for another scene."""
        self.error, self._frame, self._reader, self._goes_on = line, None, None, False
        results.live.pop(self.uid, None)


@dataclass
class _Frame:
    """What was read last; change: what the next round has to know of it; places: of the rows of scatters, by the full
    name of the host."""

    number: int
    extraction: Extraction
    change: Change | None
    uids: I64
    pinned: np.ndarray | None
    places: dict[str, F32]


def _still() -> Change:
    from ....core.scene.change import Change

    nothing = np.zeros(0, np.int32)
    return Change(None, None, nothing, nothing, False, False)


def live_options(settings: props.LipacSettings) -> CullOptions:
    """The options of the scene's settings for a loop in real time: few paths and one round at a time, whose requests
    the next one meets."""
    options = replace(props.cull_options(settings), levels=False, memory=0)
    if options.policy != LIGHT_PATHS:
        return options
    return replace(options, min_share=SHARE, paths=1, max_iterations=1, blas_budget_ms=BUILD_MS)


def is_busy() -> bool:
    """Whether Blender renders, or an analysis runs: live mode waits."""
    return session.is_rendering() or job.is_running()


# The one that is on

current: Live | None = None
_on = False


def is_on() -> bool:
    """Whether live mode is switched on."""
    return _on


def start() -> None:
    """Switch live mode on: it follows the scene of the first window from now on, through whatever files are opened."""
    global _on  # noqa: PLW0603
    suspend()
    _on = True
    if not bpy.app.timers.is_registered(tick):
        bpy.app.timers.register(tick, first_interval=0.0, persistent=True)


def stop(quitting: bool = False) -> None:
    """Switch it off. quitting: Blender goes down."""
    global _on  # noqa: PLW0603
    _on = False
    suspend(quitting)
    if bpy.app.timers.is_registered(tick):
        bpy.app.timers.unregister(tick)


def suspend(quitting: bool = False) -> None:
    """Let go of the scene; where live mode is on, the next tick begins anew. quitting: as of `stop`."""
    global current  # noqa: PLW0603
    if current is not None:
        current.close(quitting)
    current = None


def tick() -> float:
    """Called by Blender's timer; returns the seconds until the next call. After an error of ours Blender calls no more:
    live mode is off."""
    global current, _on  # noqa: PLW0603
    window = next(iter(bpy.context.window_manager.windows), None)
    if window is not None and _on:
        target = window.scene.session_uid, window.view_layer.name
        if current is None or (current.uid, current.layer) != target:
            suspend()
            current = Live(window.scene, window.view_layer)
        try:
            if current.tick():
                session.redraw()
        except BaseException:
            _on = False
            session.redraw()
            raise
    return INTERVAL
