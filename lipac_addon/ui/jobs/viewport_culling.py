"""Live culling: the viewport's own render goes without what live mode culls.

Blender evaluates a scatter anew as a whole when one row of it comes or goes, and its viewport render begins anew. So the set
changes seldom: what light paths ask for comes back at once (a few times a second at most, less often where that takes long),
what they do not need goes when nothing is asked for, and when it is worth it. Nothing goes before live mode was at rest once.

What is taken out stays in what live mode reads (`everything`): objects with a closed eye are evaluated on, masks are lifted while a scatter is read.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import bpy
import numpy as np
from numpy.typing import NDArray

from ....core.arrays import F32
from ...keys import Kind
from ...writeback import viewport
from ...writeback.viewport_plan import viewport_plan
from ..state import props, results, scatters, session
from .viewport import NotedGraph

INTERVAL = 0.25  # seconds from one change to the next, at least
DUTY = 4  # times as long as a change took that nothing changes again
PATIENCE = 2.0  # seconds from one time that something goes to the next, while the picture changes
WORTH = 0.1  # share of what is shown that must go at once
QUIET = 1.0  # seconds that a scatter must not have changed before it is masked
GRACE = 1.0  # seconds without a viewport that asks for it, after which all comes back
NEAR = 0.1  # of the camera's distance to the 3D cursor, around which nothing goes

Rows = NDArray[np.bool_]


@dataclass(frozen=True)
class _Set:
    """What is out of the viewport: objects by session uid, and of hosts by theirs the (R,) bool rows."""

    objects: frozenset[int]
    rows: dict[int, Rows]

    def asks(self, wanted: _Set) -> bool:
        """Whether something that is out is to come back."""
        return bool(self.objects - wanted.objects) or any((rows & ~_as_long(wanted.rows.get(uid), rows)).any() for uid, rows in self.rows.items())

    def both(self, other: _Set) -> _Set:
        """What is out of both."""
        rows = {uid: mine & _as_long(other.rows.get(uid), mine) for uid, mine in self.rows.items()}
        return _Set(self.objects & other.objects, {uid: mine for uid, mine in rows.items() if mine.any()})

    def without(self, host: int) -> _Set:
        """The same with all rows of a host there."""
        return _Set(self.objects, {uid: rows for uid, rows in self.rows.items() if uid != host})

    def instances(self, result: results.FrameResult) -> int:
        """How many instances of a result that are."""
        records = result.keys.records
        kind, host, ob, row = records["kind"], records["host"], records["object"], records["path"][:, 0]
        eyes = np.append(np.isin(result.uids, list(self.objects)), False)  # index -1: nobody
        out = eyes[np.where(kind == Kind.OBJECT, ob, host)]
        number = {uid: n for n, uid in enumerate(result.uids.tolist())}
        for uid, gone in self.rows.items():
            mine = np.flatnonzero((host == number.get(uid, -2)) & (kind == Kind.GEOMETRY_NODES))
            out[mine] |= np.append(gone, False)[np.minimum(row[mine], len(gone))]
        return int(np.count_nonzero(out))


_NOTHING = _Set(frozenset(), {})


class ViewportCulling:
    """Culling in the viewports of one view layer of a scene.

    message: what they show; own: Blender evaluates a change of ours, of which there is nothing to note.
    """

    def __init__(self, uid: int, layer: str) -> None:
        self._uid, self._layer_name = uid, layer
        self.message, self.own = "", False
        self._out = _NOTHING
        self._places: dict[int, F32] = {}  # of the rows of masked hosts
        self._result: results.FrameResult | None = None
        self._scatters: dict[str, F32] = {}
        self._fresh = self._settled = self._waits = False
        self._cursor: tuple[float, ...] = ()
        self._next = self._went = self._seen = 0.0
        self._quiet: dict[int, float] = {}

    # What live mode tells

    def take(self, result: results.FrameResult, places: dict[str, F32]) -> None:
        """New states. places: of the rows of scatters, by the full name of the host."""
        same = self._result is not None and np.array_equal(self._result.state, result.state) and self._result.keys.names == result.keys.names
        self._fresh |= not same
        self._result, self._scatters = result, places

    def touch(self) -> None:
        """Something was selected, or is edited: what must not vanish is something else."""
        self._fresh = True

    @contextmanager
    def everything(self, layer: bpy.types.ViewLayer, graph: NotedGraph, follows: Callable[[], bool]) -> Iterator[None]:
        """While it lasts, the graph has all rows of those scatters that are going to be read: those that have changed, or all of a graph of other data-blocks.

        Scatters that have changed are masked no more.
        """
        hosts = self._hosts()
        changed = {uid: ob for uid, ob in hosts.items() if graph.lists_geometry(ob)}
        goes_on = not hosts or follows()
        rest = [] if goes_on else [ob for uid, ob in hosts.items() if uid not in changed]
        copies = [] if goes_on else [ob for ob in viewport.masked() if ob.session_uid not in hosts]
        if changed or rest or copies:
            with self._ours(layer):
                viewport.unmask([*changed.values(), *copies])
                viewport.set_masks_shown(rest, False)
        for uid in changed:
            self._forget_host(uid)
        try:
            yield
        finally:
            if rest:
                with self._ours(layer):
                    viewport.set_masks_shown(rest, True)

    def closed(self, layer: bpy.types.ViewLayer) -> list[bpy.types.Object]:
        """Objects whose eyes are closed."""
        return viewport.closed_eyes(layer) if self._out.objects else []

    # What it does

    def step(self, scene: bpy.types.Scene, resting: bool) -> bool:
        """Change what the viewport goes without, where it is time to; True where it did."""
        layer, now = scene.view_layers[self._layer_name], time.monotonic()
        if not self._is_asked_for(scene, now):
            return self.off(layer)
        self._settled |= resting
        result, cursor = self._result, tuple(scene.cursor.location)
        waited = self._waits and (resting or now > self._went + PATIENCE)
        if result is None or not self._settled or now < self._next or not (self._fresh or waited or cursor != self._cursor):
            return False
        self._fresh, self._waits, self._cursor, self._next = False, False, cursor, now + INTERVAL
        wanted = self._plan(scene, layer, result, now)
        if self._out.asks(wanted):
            wanted, self._waits = self._out.both(wanted), True
        elif result.stats["pending"] or not (resting or now > self._went + PATIENCE):
            self._waits = True
            return False
        else:
            out = self._out.instances(result)
            if wanted.instances(result) - out < max(1.0, WORTH * (len(result.state) - out)):
                return False
            self._went = now
        self._change(layer, result, wanted)
        return True

    def off(self, layer: bpy.types.ViewLayer | None) -> bool:
        """All comes back; True where something was out. layer: None where Blender need not evaluate it now."""
        was = self._out is not _NOTHING
        self._out, self._settled, self._fresh = _NOTHING, False, True
        self._places.clear()
        scatters.stand_ins.clear()
        if was and layer is not None:
            with self._ours(layer):
                viewport.restore()
        elif was:
            viewport.restore()
        return was

    # Around what must not meet it

    def lift(self, masks_only: bool) -> None:
        """Before a save or a step of undo: take it off, and remember it."""
        if self._out is not _NOTHING:
            if masks_only:  # an undo restores eyes and their record together
                viewport.unmask()
            else:
                viewport.restore()

    def put_back(self) -> None:
        """After it: as it was, as far as the objects are there."""
        viewport.unmask()
        scene = session.find_scene(self._uid)
        if scene is None or self._layer_name not in scene.view_layers or self._out is _NOTHING:
            viewport.restore()
            return
        layer = scene.view_layers[self._layer_name]
        hosts = self._hosts()
        with self._ours(layer):
            for uid, rows in self._out.rows.items():
                if uid in hosts:
                    viewport.mask_rows(hosts[uid], rows, self._places[uid])
            there = {ob.session_uid: ob for ob in layer.objects} if self._out.objects else {}
            viewport.close_eyes(layer, [there[uid] for uid in self._out.objects if uid in there])
        self._out = _Set(frozenset(ob.session_uid for ob in viewport.closed_eyes(layer)), self._out.rows)
        self._fresh = True

    # How

    def _plan(self, scene: bpy.types.Scene, layer: bpy.types.ViewLayer, result: results.FrameResult, now: float) -> _Set:
        """What the viewport can go without."""
        culled = result.culled & ~_protected(scene, layer, result)
        keys = result.current_keys()
        objects, masks, _ = viewport_plan(culled, keys, scene)
        there = set(layer.objects)
        closed = set(self.closed(layer))
        eyes = frozenset(ob.session_uid for ob in objects if ob in closed or (ob in there and not ob.hide_get(view_layer=layer)))
        rows = {}
        for host, out in masks:
            if self._quiet.get(host.session_uid, 0.0) > now:
                self._waits = True
            elif host.session_uid in self._places or self._place(result, host) is not None:
                rows[host.session_uid] = out
        return _Set(eyes, rows)

    def _place(self, result: results.FrameResult, host: bpy.types.Object) -> F32 | None:
        """Where the rows of a host are."""
        names = {uid: name for uid, name in zip(result.uids.tolist(), result.keys.names, strict=True) if uid == host.session_uid}
        return self._scatters.get(names.get(host.session_uid, ""))

    def _change(self, layer: bpy.types.ViewLayer, result: results.FrameResult, wanted: _Set) -> None:
        """Have that out of the viewport, and nothing else."""
        objects, rows = wanted.objects, wanted.rows
        layer.update()  # what the user did is noted as such
        start = time.perf_counter()
        hosts = {ob.session_uid: ob for ob in bpy.data.objects if ob.session_uid in rows or ob.session_uid in self._out.rows}
        new = {uid: scatters.print_of(hosts[uid], layer.depsgraph) for uid in rows if uid not in self._out.rows and uid in hosts}
        with self._ours(layer):
            viewport.unmask([ob for uid, ob in hosts.items() if uid not in rows])
            for uid in [uid for uid in self._out.rows if uid not in rows]:
                self._forget_host(uid, changed=False)
            for uid, out in rows.items():
                before = self._out.rows.get(uid)
                if uid in hosts and (before is None or not np.array_equal(before, out)):
                    if uid not in self._places:
                        self._places[uid] = np.array(self._place(result, hosts[uid]), np.float32)
                    viewport.mask_rows(hosts[uid], out, self._places[uid])
            closing, opening = objects - self._out.objects, self._out.objects - objects
            there = {ob.session_uid: ob for ob in layer.objects} if closing or opening else {}
            viewport.open_eyes(layer, [there[uid] for uid in opening if uid in there])
            viewport.close_eyes(layer, [there[uid] for uid in closing if uid in there])
        for uid in rows:
            if uid in hosts:
                full = new[uid] if uid in new else scatters.stand_ins[uid][1]
                scatters.stand_ins[uid] = scatters.print_of(hosts[uid], layer.depsgraph), full
        self._out = wanted if objects or rows else _NOTHING
        self._next = time.monotonic() + max(INTERVAL, DUTY * (time.perf_counter() - start))
        count = len(result.state)
        self.message = f"shows {count - wanted.instances(result):,} of {count:,} instances"

    def _forget_host(self, uid: int, changed: bool = True) -> None:
        self._places.pop(uid, None)
        scatters.stand_ins.pop(uid, None)
        self._out = self._out.without(uid)
        if changed:
            self._quiet[uid], self._fresh = time.monotonic() + QUIET, True

    def _hosts(self) -> dict[int, bpy.types.Object]:
        """Hosts that are masked."""
        return {ob.session_uid: ob for ob in bpy.data.objects if ob.session_uid in self._out.rows} if self._out.rows else {}

    def _is_asked_for(self, scene: bpy.types.Scene, now: float) -> bool:
        """Whether the switch is on, and viewports show what it is for, or did a moment ago."""
        if not scene.lipac.cull_viewport:
            self.message = ""
            return False
        why = viewport_obstacle(scene, self._layer_name)
        if not why:
            self._seen = now
        elif now > self._seen + GRACE:
            self.message = f"shows everything: {why}"
            return False
        return True

    @contextmanager
    def _ours(self, layer: bpy.types.ViewLayer) -> Iterator[None]:
        """Evaluate what is changed meanwhile as ours."""
        self.own = True
        try:
            yield
            layer.update()
        finally:
            self.own = False


def viewport_obstacle(scene: bpy.types.Scene, layer: str) -> str:
    """Why no viewport of a view layer is to be culled, "" where one is: all that show Rendered must look through the camera that is analysed."""
    views = [
        (space, region)
        for window in bpy.context.window_manager.windows
        if (window.scene, window.view_layer.name) == (scene, layer)
        for area in window.screen.areas
        if area.type == "VIEW_3D" and area.spaces.active.shading.type == "RENDERED"
        for space in [area.spaces.active]
        for region in (space.region_quadviews or [space.region_3d])
    ]
    if not views:
        return "no viewport is in Rendered shading"
    through = (region.view_perspective == "CAMERA" and (not space.use_local_camera or space.camera == scene.camera) for space, region in views)
    return "" if all(through) else "one in Rendered shading does not look through the camera"


def _protected(scene: bpy.types.Scene, layer: bpy.types.ViewLayer, result: results.FrameResult) -> Rows:
    """(N,) bool: instances that must not vanish: pinned, ignored, selected, edited, active, or near the 3D cursor."""
    chosen = {*layer.objects.selected, *session.not_in_object_mode(), *props.marked(props.PIN), *props.marked(props.IGNORE)}
    found = result.of_objects(chosen)
    records, active = result.keys.records, layer.objects.active
    if active is not None:
        own = np.append(results.among(result.uids, {active}), False)
        found |= own[records["object"]] & (records["kind"] == Kind.OBJECT)
    if scene.camera is not None:
        cursor = np.array(scene.cursor.location)
        reach = NEAR * float(np.linalg.norm(cursor - np.array(scene.camera.matrix_world.translation)))
        point = (cursor - result.origin).astype(np.float32)
        gap = np.maximum(np.maximum(result.bounds[:, 0] - point, point - result.bounds[:, 1]), 0)
        found |= np.einsum("ij,ij->i", gap, gap) <= reach * reach
    return found


def _as_long(rows: Rows | None, like: Rows) -> Rows:
    """Rows as many as others: those that are missing stay."""
    out = np.zeros(len(like), bool)
    if rows is not None:
        count = min(len(rows), len(like))
        out[:count] = rows[:count]
    return out
