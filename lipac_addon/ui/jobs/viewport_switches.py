"""What live culling has out of the viewports of a view layer: changed, read around, lifted and put back."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import bpy
import numpy as np
from numpy.typing import NDArray

from ....core.arrays import F32, I64
from ...keys import Kind
from ...writeback import viewport
from ..state import results, scatters, session
from .viewport import NotedGraph

QUIET = 1.0  # seconds that a scatter must not have changed before it is masked

Rows = NDArray[np.bool_]


@dataclass(frozen=True)
class OutSet:
    """What is out of the viewport: objects by session uid, and of hosts by theirs the (R,) bool rows."""

    objects: frozenset[int]
    rows: dict[int, Rows]

    def __bool__(self) -> bool:
        return bool(self.objects or self.rows)

    def asks(self, wanted: OutSet) -> bool:
        """Whether something that is out is to come back."""
        return bool(self.objects - wanted.objects) or any(self._asks_for_rows(wanted, uid) for uid in self.rows)

    def both(self, other: OutSet) -> OutSet:
        """What is out of both."""
        rows = {uid: mine & _as_long(other.rows.get(uid), mine) for uid, mine in self.rows.items()}
        return OutSet(self.objects & other.objects, {uid: mine for uid, mine in rows.items() if mine.any()})

    def without(self, host: int) -> OutSet:
        """The same with all rows of a host there."""
        return OutSet(self.objects, {uid: rows for uid, rows in self.rows.items() if uid != host})

    def mask(self, result: results.FrameResult, numbers: I64 | slice = slice(None)) -> Rows:
        """(N,) bool: the instances of a result that are out, or for (N,) numbers which of these."""
        records = result.keys.records[numbers]
        kind, host, ob, row = records["kind"], records["host"], records["object"], records["path"][:, 0]
        eyes = np.append(np.isin(result.uids, list(self.objects)), False)  # index -1: nobody
        out = eyes[np.where(kind == Kind.OBJECT, ob, host)]
        number = {uid: n for n, uid in enumerate(result.uids.tolist())}
        for uid, gone in self.rows.items():
            mine = np.flatnonzero((host == number.get(uid, -2)) & (kind == Kind.GEOMETRY_NODES))
            out[mine] |= np.append(gone, False)[np.minimum(row[mine], len(gone))]
        return out

    def instances(self, result: results.FrameResult) -> int:
        """How many instances of a result that are."""
        return int(np.count_nonzero(self.mask(result)))

    def showing(self, result: results.FrameResult, numbers: I64) -> OutSet:
        """The same with some instances of a result there."""
        records = result.keys.records[numbers]
        own = np.where(records["kind"] == Kind.OBJECT, records["object"], records["host"])
        uid, row = result.uids[own], records["path"][:, 0]
        rows = {}
        for host, gone in self.rows.items():
            mine = row[(uid == host) & (records["kind"] == Kind.GEOMETRY_NODES)]
            rows[host] = gone.copy()
            rows[host][mine[mine < len(gone)]] = False
        return OutSet(self.objects - set(uid.tolist()), rows)

    def towards(self, other: OutSet, rows: int, eyes: int, first: Iterable[int]) -> OutSet:
        """As far towards another as one change goes, this where there is no difference: scatters of so many rows in
        all, but one at least, and so many eyes. What comes back goes before what is hidden; of objects, those that come
        first.

        Blender evaluates a scatter as a whole, so its rows change together.
        """
        changed = [uid for uid in self.rows.keys() | other.rows.keys() if not self.is_alike(other, uid)]
        back = {uid for uid in changed if self._asks_for_rows(other, uid)}
        length = {uid: len(self.rows[uid] if uid in self.rows else other.rows[uid]) for uid in changed}
        changed.sort(key=lambda uid: (uid not in back, length[uid], uid))
        evaluated = np.cumsum([length[uid] for uid in changed])
        now = changed[: max(1, int(np.searchsorted(evaluated, rows, side="right")))]
        made = {uid: mine for uid, mine in self.rows.items() if uid not in now}
        made |= {uid: other.rows[uid] for uid in now if uid in other.rows}
        opening, closing = self.objects - other.objects, other.objects - self.objects
        rank = {uid: k for k, uid in enumerate(first)}
        opened = sorted(opening, key=lambda uid: (rank.get(uid, len(rank)), uid))[:eyes]
        all_back = len(opened) == len(opening) and back <= set(now)
        closed = sorted(closing)[: eyes - len(opened)] if all_back else []
        return OutSet(self.objects.difference(opened).union(closed), made)

    def is_same(self, other: OutSet) -> bool:
        """Whether the same is out of both."""
        uids = self.rows.keys() | other.rows.keys()
        return self.objects == other.objects and all(self.is_alike(other, uid) for uid in uids)

    def is_alike(self, other: OutSet, uid: int) -> bool:
        """Whether the same rows of a host are out of both."""
        return uid in self.rows and uid in other.rows and np.array_equal(self.rows[uid], other.rows[uid])

    def _asks_for_rows(self, other: OutSet, uid: int) -> bool:
        """Whether rows of a host that are out are not out of the other."""
        return uid in self.rows and bool((self.rows[uid] & ~_as_long(other.rows.get(uid), self.rows[uid])).any())


NOTHING = OutSet(frozenset(), {})


class Switches:
    """The switches of a view layer's viewports.

    uid: of the scene; out: what is out by them, another object whenever that has changed; own: Blender evaluates a
    change of ours, of which there is nothing to note.
    """

    def __init__(self, uid: int, layer: str) -> None:
        """uid: of the scene."""
        self.uid, self._layer = uid, layer
        self.out, self.own = NOTHING, False
        self._places: dict[int, F32] = {}  # of the rows of masked hosts
        self._quiet: dict[int, float] = {}

    def is_quiet(self, host: bpy.types.Object) -> bool:
        """Whether a scatter has not changed for a while."""
        return time.monotonic() >= self._quiet.get(host.session_uid, 0.0)

    def closed(self, layer: bpy.types.ViewLayer) -> list[bpy.types.Object]:
        """Objects that are out; what the user has shown since is out no more."""
        if not self.out.objects:
            return []
        found = viewport.closed_eyes(layer)
        self._see(found)
        return found

    @contextmanager
    def everything(self, layer: bpy.types.ViewLayer, graph: NotedGraph, goes_on: bool) -> Iterator[None]:
        """While it lasts, the graph has all rows of those scatters that are going to be read: those that have changed,
        or all of them where the graph does not go on from the last one with the same data-blocks.

        Scatters that have changed are masked no more.
        """
        hosts = _by_uid(self.out.rows)
        reshaped = graph.reshaped()
        self._quiet |= dict.fromkeys(reshaped, time.monotonic() + QUIET)
        changed = {uid: ob for uid, ob in hosts.items() if uid in reshaped}
        rest = [] if goes_on else [ob for uid, ob in hosts.items() if uid not in changed]
        copies = [] if goes_on else [ob for ob in viewport.masked() if ob.session_uid not in hosts]
        if changed or rest or copies:
            with self._ours(layer):
                viewport.unmask([*changed.values(), *copies])
                viewport.set_masks_shown(rest, False)
        for uid in changed:
            self._forget(uid)
        try:
            yield
        finally:
            if rest:
                with self._ours(layer):
                    viewport.set_masks_shown(rest, True)

    def change(self, layer: bpy.types.ViewLayer, wanted: OutSet, places: Callable[[int], F32 | None]) -> None:
        """Have that out, and nothing else. places: where the rows of a host are, by its session uid."""
        layer.update()  # what the user did is noted as such
        before, rows = self.out, wanted.rows
        hosts = _by_uid({*rows, *before.rows})
        new = rows.keys() & hosts.keys() - before.rows.keys()
        full = {uid: scatters.print_of(hosts[uid], layer.depsgraph) for uid in new}
        full |= {uid: scatters.stand_ins[uid][1] for uid in rows.keys() & before.rows.keys()}
        changed = [uid for uid in rows.keys() & hosts.keys() if uid in new or not before.is_alike(wanted, uid)]
        self.out = wanted
        with self._ours(layer):
            viewport.unmask([ob for uid, ob in hosts.items() if uid not in rows])
            for uid in before.rows.keys() - rows.keys():
                self._forget(uid)
            for uid in changed:
                if uid in new:
                    self._places[uid] = np.array(places(uid), np.float32)
                viewport.mask_rows(hosts[uid], rows[uid], self._places[uid], full[uid].distinct)
            closing, opening = wanted.objects - before.objects, before.objects - wanted.objects
            there = {ob.session_uid: ob for ob in layer.objects} if closing or opening else {}
            viewport.open_eyes(layer, [there[uid] for uid in opening & there.keys()])
            viewport.close_eyes(layer, [there[uid] for uid in closing & there.keys()])
        for uid in changed:
            scatters.stand_ins[uid] = scatters.print_of(hosts[uid], layer.depsgraph), full[uid]

    def show(self, layer: bpy.types.ViewLayer, wanted: OutSet) -> None:
        """Have less out, from within a handler: Blender evaluates it after that, before it draws."""
        hosts, before = _by_uid(wanted.rows), self.out
        for uid in wanted.rows.keys() & hosts.keys():
            if not np.array_equal(before.rows[uid], wanted.rows[uid]):
                viewport.mask_rows(hosts[uid], wanted.rows[uid], self._places[uid])
                scatters.stand_ins[uid] = None, scatters.stand_ins[uid][1]
        viewport.open_eyes(layer, _by_uid(before.objects - wanted.objects).values())
        self.out = wanted

    def take_prints(self, layer: bpy.types.ViewLayer) -> None:
        """Take the prints of what `show` has changed, now that it is evaluated."""
        for uid, ob in _by_uid([uid for uid, (now, _) in scatters.stand_ins.items() if now is None]).items():
            scatters.stand_ins[uid] = scatters.print_of(ob, layer.depsgraph), scatters.stand_ins[uid][1]

    def all_back(self, layer: bpy.types.ViewLayer | None) -> None:
        """All comes back, in the whole file. layer: whose graph is evaluated, None where nobody reads it any more."""
        self.out = NOTHING
        self._places.clear()
        scatters.stand_ins.clear()
        if layer is None:
            viewport.restore()
        else:
            with self._ours(layer):
                viewport.restore()

    # Around what must not meet it

    def lift(self, masks_only: bool) -> None:
        """Before a save or a step of undo: take it off, and remember it."""
        if masks_only:  # an undo restores eyes and their record together
            viewport.unmask()
        else:
            viewport.restore()

    def put_back(self) -> None:
        """After it: as it was, as far as the objects are there."""
        viewport.unmask()
        scene = session.find_scene(self.uid)
        if scene is None or self._layer not in scene.view_layers or not self.out:
            viewport.restore()
            return
        layer = scene.view_layers[self._layer]
        hosts = _by_uid(self.out.rows)
        with self._ours(layer):
            for uid in self.out.rows.keys() & hosts.keys():
                distinct = scatters.stand_ins[uid][1].distinct
                viewport.mask_rows(hosts[uid], self.out.rows[uid], self._places[uid], distinct)
            there = {ob.session_uid: ob for ob in layer.objects} if self.out.objects else {}
            viewport.close_eyes(layer, [there[uid] for uid in self.out.objects & there.keys()])
        self._see(viewport.closed_eyes(layer))  # those of a step of undo, too

    def _see(self, closed: list[bpy.types.Object]) -> None:
        """Take down which eyes are closed."""
        objects = frozenset(ob.session_uid for ob in closed)
        if objects != self.out.objects:
            self.out = OutSet(objects, self.out.rows)

    def _forget(self, uid: int) -> None:
        """A host is masked no more."""
        self._places.pop(uid, None)
        scatters.stand_ins.pop(uid, None)
        self.out = self.out.without(uid)

    @contextmanager
    def _ours(self, layer: bpy.types.ViewLayer) -> Iterator[None]:
        """Evaluate what is changed meanwhile as ours."""
        self.own = True
        try:
            yield
            layer.update()
        finally:
            self.own = False


def _by_uid(uids: Collection[int]) -> dict[int, bpy.types.Object]:
    """The objects of the file with these session uids."""
    return {ob.session_uid: ob for ob in bpy.data.objects if ob.session_uid in uids} if uids else {}


def _as_long(rows: Rows | None, like: Rows) -> Rows:
    """Rows as many as others: those that are missing stay."""
    out = np.zeros(len(like), bool)
    if rows is not None:
        count = min(len(rows), len(like))
        out[:count] = rows[:count]
    return out
