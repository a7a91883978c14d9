"""Live culling: the viewport's own render goes without what live mode culls.

Blender evaluates a scatter anew as a whole when one row of it comes or goes, and its viewport render begins anew. So
the set changes seldom: what light paths ask for comes back at once (a few times a second at most, less often where that
takes long), what they do not need goes when nothing is asked for, and when it is worth it. Nothing goes before live
mode was at rest once. A change that is too large for one tick is made in parts, a decision before each: first what
comes back, largest first, then what goes.

What is taken out stays in what live mode reads (`Switches.everything`): objects with a closed eye are evaluated on,
masks are lifted while a scatter is read.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Generator
from dataclasses import dataclass
from heapq import nlargest
from typing import TypeVar

import bpy
import numpy as np

from ....core.arrays import F32, F64, I64
from ... import roles
from ...keys import Kind
from ...writeback.viewport_plan import Candidates, candidates, viewport_plan
from ..state import results, scatters, session
from .background import in_thread
from .foresight import Foresight, half_angle, is_large
from .viewport_switches import OutSet, Rows, Switches

INTERVAL = 0.1  # seconds from one change to the next, at least
DUTY = 4  # times as long as a change took that nothing changes again
PATIENCE = 2.0  # seconds from one time that something goes to the next, while the picture changes
WORTH = 0.1  # share of what is shown that must go at once; as many that come back do not wait
GRACE = 1.0  # seconds without a viewport that asks for it, after which all comes back
HOLD = 0.5  # seconds that what came into view at once stays, for paths to look there
NEAR = 0.1  # of the camera's distance to the 3D cursor, around which nothing goes
AT_ONCE = 20_000  # instances of which arrays take a tick no longer than it may; those of more are left to a thread
WALKS = 10_000_000  # objects that Blender may walk over to close or open all eyes: one takes it a walk over the layer
PART = 300_000  # of these in one change: as many as Blender then evaluates anyway take it no longer
ROWS = 100_000  # of scatters in one change, which Blender evaluates as a whole


T = TypeVar("T")


@dataclass(frozen=True)
class Decision:
    """What the viewport can go without by a result, and how many instances that are; how many are out already, of
    what was out then. guarded: what must not vanish, as it was when this was begun. largest: objects that are out, by
    session uid, the one that looks largest first."""

    result: results.FrameResult
    wanted: OutSet
    instances: int
    out: OutSet
    already: int
    guarded: tuple[object, ...]
    largest: list[int]


class ViewportCulling:
    """When what goes out of the viewports of one view layer of a scene, and comes back. message: what they show."""

    def __init__(self, uid: int, layer: str) -> None:
        self._layer = layer
        self.switches = Switches(uid, layer)
        self.message = ""
        self._result: results.FrameResult | None = None
        self._places: dict[str, F32] = {}
        self._fresh = self._settled = self._waits = self._touched = self._urgent = False
        self._whom: tuple[object, ...] = ()
        self._made = self.switches.out  # by the last decision
        self._cursor: tuple[float, ...] = ()
        self._next = self._soon = self._went = self._seen = 0.0  # soon: what matters does not wait longer
        self._due = self._more = False  # for a change, when the decision was begun; the last one was a part of one
        self._eye = np.zeros(3)
        self._sight: Foresight | None = None
        self._foreseen: list[tuple[float, I64]] = []  # until when they stay, and which
        self._pose: tuple[float, ...] = ()
        self._deciding: Generator[None, None, Decision] | None = None

    def take(self, result: results.FrameResult, places: dict[str, F32], eye: F64) -> None:
        """New states. places: of the rows of scatters, by the full name of the host. eye: (3,) where the camera is, as
        the result's bounds count."""
        last = self._result
        same = last is not None and last.keys.names == result.keys.names and np.array_equal(last.state, result.state)
        self._fresh |= not same
        self._urgent |= last is not None and not same and _matters(last, result, eye)
        self._result, self._places, self._eye = result, places, eye

    @property
    def is_deciding(self) -> bool:
        """Whether a decision was begun and is not finished."""
        return self._deciding is not None

    def touch(self) -> None:
        """Something has changed, be it what is selected: what must not vanish may be something else."""
        self._touched = True

    def foresee(self, graph: bpy.types.Depsgraph) -> None:
        """Show at once what looks large, where the camera has moved; called by a handler, with the graph as it is."""
        out, result = self.switches.out, self._result
        if result is None:
            return
        numbers = self._appearing(graph.scene_eval.camera, result)
        numbers = numbers[out.mask(result, numbers)]
        if len(numbers):
            self.switches.show(graph.view_layer, out.showing(result, numbers))
            self._foreseen = [*self._foreseen, (time.monotonic() + HOLD, numbers)]

    def _appearing(self, camera: bpy.types.Object | None, result: results.FrameResult) -> I64:
        """Numbers of the instances that look large and did not when this was asked last."""
        nothing, angle = np.zeros(0, np.int64), None if camera is None else half_angle(camera)
        if camera is None or angle is None:
            return nothing
        to_world = np.array(camera.matrix_world, np.float64)
        pose = (angle, *to_world.ravel().tolist())
        if self._sight is None or self._sight.bounds is not result.bounds:
            self._sight = Foresight(result.bounds, self._sight)
        elif pose == self._pose:
            return nothing
        self._pose = pose
        to_world[:3, 3] -= result.origin
        return self._sight.appearing(to_world, angle)

    def step(self, scene: bpy.types.Scene, resting: bool) -> bool:
        """Change what the viewport goes without, where it is time to; True where it did. resting: as of live mode."""
        layer, now = scene.view_layers[self._layer], time.monotonic()
        if not self._is_asked_for(scene, now):
            return self.off(layer)
        self.switches.take_prints(layer)
        self._settled |= resting
        if self._touched:
            whom, self._touched = _whom(layer), False
            self._fresh, self._whom = self._fresh or whom != self._whom, whom
        self._fresh |= self.switches.out is not self._made
        result, cursor = self._result, tuple(scene.cursor.location)
        lazy = resting or self._more or now > self._went + PATIENCE  # things may go
        anew = self._fresh or (self._waits and lazy) or cursor != self._cursor
        due = now >= self._next
        if self._deciding is None:
            if result is None or not self._settled or not anew or not (due or (self._urgent and now >= self._soon)):
                return False
            self._fresh, self._waits, self._urgent, self._cursor = False, False, False, cursor
            self._made, self._due = self.switches.out, due
            self._next = max(self._next, now + INTERVAL)
            self._deciding = self._decide(scene, result)
        try:
            next(self._deciding)
        except StopIteration as end:
            self._deciding = None
            return self._go(scene, layer, end.value, lazy)
        return False

    def _go(self, scene: bpy.types.Scene, layer: bpy.types.ViewLayer, made: Decision, lazy: bool) -> bool:
        """Have the viewport go by a decision, where it is time to; True where something changed. What has come to be
        needed since it was begun stays. lazy: things may go."""
        now, out, wanted, result = time.monotonic(), self.switches.out, made.wanted, self._result
        if result is None or (len(result.state), result.keys.names) != (len(made.result.state), made.result.keys.names):
            self._fresh = True
            return False
        if result is not made.result:
            wanted = wanted.showing(result, np.flatnonzero(result.state != results.CULLED))
        self._made = out
        if out.asks(wanted):
            wanted, self._waits = out.both(wanted), True
        elif result.stats["pending"] or not (lazy and self._due):
            self._waits = True
            return False
        elif out is not made.out or _guarded(scene, layer) != made.guarded:
            self._fresh = True
            return False
        elif made.instances - made.already < (1.0 if self._more else _worth(made)):
            self._more = False
            return False
        else:
            self._went = now
        start, eyes = time.monotonic(), max(1, PART // max(1, len(layer.objects)))
        part = out.towards(wanted, ROWS, eyes, made.largest)
        self.switches.change(layer, part, lambda uid: places_of(self._places, result, uid))
        self._made = self.switches.out
        self._appearing(scene.camera, result)  # what is seen now is known
        end, took = time.monotonic(), time.monotonic() - start
        self._next, self._soon = end + max(INTERVAL, DUTY * took), end + took
        self._more = not part.is_same(wanted)
        self._fresh, self._urgent = self._fresh or self._more, self._urgent or (self._more and part.asks(wanted))
        self.message = f"shows {_shown(part, result):,} of {len(result.state):,} instances"
        return True

    def off(self, layer: bpy.types.ViewLayer) -> bool:
        """All comes back; True where something was out."""
        was, self._settled, self._fresh, self._more = bool(self.switches.out), False, True, False
        self._drop()
        if was:
            self.switches.all_back(layer)
        self._made = self.switches.out
        return was

    def close(self) -> None:
        """All comes back, whatever happened."""
        self._drop()
        self.switches.all_back(None)

    def _drop(self) -> None:
        """Decide nothing; waits for a thread that does."""
        if self._deciding is not None:
            self._deciding.close()
            self._deciding = None

    def _decide(self, scene: bpy.types.Scene, result: results.FrameResult) -> Generator[None, None, Decision]:
        """What the viewport can go without, a step a tick: arrays of many instances are a thread's."""
        layer = scene.view_layers[self._layer]
        out, guarded = self.switches.out, _guarded(scene, layer)
        protected = protection(scene, layer, result)
        self._foreseen = [(until, numbers) for until, numbers in self._foreseen if until > time.monotonic()]
        foreseen, eye = [numbers for _, numbers in self._foreseen], self._eye

        def possible() -> Candidates:
            scatters.digest_all()
            culled = result.culled & ~protected()
            for numbers in foreseen:
                culled[numbers[numbers < len(culled)]] = False
            return candidates(culled, result.keys)

        found = yield from _apart(result, possible)
        now = session.find_scene(self.switches.uid)  # references may have died meanwhile
        wanted = OutSet(frozenset(), {}) if now is None else self._allowed(now, result, found)
        gone, already, largest = yield from _apart(
            result, lambda: (wanted.instances(result), out.instances(result), _largest(out.objects, result, eye))
        )
        return Decision(result, wanted, gone, out, already, guarded, largest)

    def _allowed(self, scene: bpy.types.Scene, result: results.FrameResult, found: Candidates) -> OutSet:
        """What Blender allows to take out of what could go."""
        layer = scene.view_layers[self._layer]
        objects, masks = viewport_plan(found, result.current_keys().names, scene)
        closed, there = set(self.switches.closed(layer)), set(layer.objects)
        eyes = [ob for ob in objects if ob in closed or (ob in there and not ob.hide_get(view_layer=layer))]
        if len(eyes) * len(there) > WALKS:
            eyes = nlargest(WALKS // len(there), eyes, key=lambda ob: len(getattr(ob.data, "vertices", ())))
        rows = {}
        for host, out in masks:
            if not self.switches.is_quiet(host):
                self._waits = True
            elif places_of(self._places, result, host.session_uid) is not None:
                rows[host.session_uid] = out
        return OutSet(frozenset(ob.session_uid for ob in eyes), rows)

    def _is_asked_for(self, scene: bpy.types.Scene, now: float) -> bool:
        """Whether the switch is on, and viewports show what it is for, or did a moment ago."""
        if not scene.lipac.cull_viewport:
            self.message = ""
            return False
        why = viewport_obstacle(scene, self._layer)
        if not why:
            self._seen = now
        elif now > self._seen + GRACE:
            self.message = f"shows everything: {why}"
            return False
        return True


def _largest(uids: frozenset[int], result: results.FrameResult, eye: F64) -> list[int]:
    """Objects by session uid, the one of which something looks largest from (3,) the eye first."""
    if not uids:
        return []
    records, found = result.keys.records, np.zeros(len(result.uids), np.float32)
    own = np.where(records["kind"] == Kind.OBJECT, records["object"], records["host"])
    numbers = np.flatnonzero(np.append(np.isin(result.uids, list(uids)), False)[own])  # index -1: nobody
    size, gap = _size_and_gap(result.bounds[numbers], eye)
    np.maximum.at(found, own[numbers], size / np.maximum(gap, 1e-6))
    return [uid for uid in result.uids[np.argsort(-found, kind="stable")].tolist() if uid in uids]


def _size_and_gap(bounds: F32, eye: F64) -> tuple[F64, F64]:
    """How large (N, 2, 3) boxes are, and how far from (3,) the eye."""
    low, high = bounds[:, 0], bounds[:, 1]
    gap = np.linalg.norm(np.maximum(np.maximum(low - eye, eye - high), 0), axis=1)
    return np.linalg.norm(high - low, axis=1), gap


def _matters(last: results.FrameResult, result: results.FrameResult, eye: F64) -> bool:
    """Whether what is kept now, and was not before, is much of what is kept, or looks large from (3,) the eye."""
    kept = result.state != results.CULLED
    if len(last.state) != len(kept):
        return False
    new = np.flatnonzero(kept & (last.state == results.CULLED))
    large = is_large(*_size_and_gap(result.bounds[new], eye))
    return bool(large.any() or 0 < len(new) >= WORTH * np.count_nonzero(kept))


def _worth(made: Decision) -> float:
    """How many instances must go, so that it is worth a change."""
    return max(1.0, WORTH * (len(made.result.state) - made.already))


def places_of(places: dict[str, F32], result: results.FrameResult, uid: int) -> F32 | None:
    """Where the rows of a host are, of those by full names."""
    number = np.flatnonzero(result.uids == uid)
    return places.get(result.keys.names[number[0]]) if len(number) else None


def _shown(out: OutSet, result: results.FrameResult) -> int:
    return len(result.state) - out.instances(result)


def viewport_obstacle(scene: bpy.types.Scene, layer: str) -> str:
    """Why no viewport of a view layer is to be culled, "" where one is: all that show Rendered must look through the
    camera that is analysed."""
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
    through = (
        region.view_perspective == "CAMERA" and (not space.use_local_camera or space.camera == scene.camera)
        for space, region in views
    )
    return "" if all(through) else "one in Rendered shading does not look through the camera"


def _whom(layer: bpy.types.ViewLayer) -> tuple[object, ...]:
    """What tells that other objects must not vanish."""
    chosen = frozenset(ob.session_uid for ob in (*layer.objects.selected, *session.not_in_object_mode()))
    active = layer.objects.active
    return chosen, active and active.session_uid, roles.changes


def _guarded(scene: bpy.types.Scene, layer: bpy.types.ViewLayer) -> tuple[object, ...]:
    """What tells that other instances must not vanish, as it is now."""
    return _whom(layer), tuple(scene.cursor.location)


def _apart(result: results.FrameResult, work: Callable[[], T]) -> Generator[None, None, T]:
    """Work on arrays of a result, by a thread where it has many instances; returns what the work returned."""
    if len(result.state) <= AT_ONCE:
        return work()
    return (yield from in_thread(work, lambda: None))


def protection(scene: bpy.types.Scene, layer: bpy.types.ViewLayer, result: results.FrameResult) -> Callable[[], Rows]:
    """What finds the instances that must not vanish, (N,) bool, asking nothing of Blender: pinned, ignored, selected,
    edited, active, or near the 3D cursor, as it is now."""
    chosen = {
        *layer.objects.selected,
        *session.not_in_object_mode(),
        *roles.marked(roles.PIN, roles.IGNORE),
    }
    whole, active = results.among(result.uids, chosen), layer.objects.active
    own = None if active is None else np.append(results.among(result.uids, {active}), False)
    reach, point = -1.0, np.zeros(3, np.float32)
    if scene.camera is not None:
        cursor = np.array(scene.cursor.location)
        reach = NEAR * float(np.linalg.norm(cursor - np.array(scene.camera.matrix_world.translation)))
        point = (cursor - result.origin).astype(np.float32)

    def found() -> Rows:
        records = result.keys.records
        out = roles.instances_of(result.keys, whole)
        if own is not None:
            out |= own[records["object"]] & (records["kind"] == Kind.OBJECT)
        if reach >= 0:
            gap = np.maximum(np.maximum(result.bounds[:, 0] - point, point - result.bounds[:, 1]), 0)
            out |= np.einsum("ij,ij->i", gap, gap) <= reach * reach
        return out

    return found
