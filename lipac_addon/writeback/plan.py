"""Which means removes which culled instance: a plan, made without changing anything."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import bpy
import numpy as np
from numpy.typing import NDArray

from ...core.arrays import Records
from ...core.files.level import AnyLevel, Level
from ..coarsening import Setting, is_animated, setting_of
from ..keys import Keys, Kind, full_name
from .emptying import can_be_emptied
from .references import References, instances_others, scenes_in_picture, simulates, takes_modifiers
from .sources import unread

Mask = NDArray[np.bool_]
EMPTY: Mapping[str, Mask] = MappingProxyType({})
NO_LEVELS: Mapping[str, AnyLevel] = MappingProxyType({})

# Why a culled instance stays; the words of the report and of docs/write-back.md
MISSING = "its object is gone"
ANIMATED = "render visibility is animated"
METABALL = "metaballs merge: one cannot be hidden alone"
MORE = "its object also shows lights, volumes, hair or metaballs"
SIMULATION = "its object takes part in a simulation"
UNBAKED = "its simulation is not baked: hiding it would empty the cache"
DRIVES = "a driver reads whether its object renders"
ELSEWHERE = "another scene that is part of the picture shows it, too"
NOT_KEPT = "its object is linked: Blender neither saves nor undoes a change of it (a library override takes it)"
PICKED = "a particle system picks from its collection"
FEEDS = "its host is itself instanced by another object"
LINKED = "its host takes no modifier: linked from a library, or of a type without modifiers"
SHARED = "its object also makes instances that stay"
NESTED = "other parts of the same nested instance stay"
PART = "part of a collection instance: the same part stays elsewhere"
READS_IDS = "a material reads the ids of instances, which the mask stores"
PARTICLE = "single particles cannot be removed"
SHAPES = "something else is made from its faces"
IN_RENDER = "the render at hand reads another scene, too: no mesh can be exchanged meanwhile"
DUPLI = "single vertex and face duplicates cannot be removed"

_BY_KIND = {
    Kind.OBJECT: SHARED,
    Kind.COLLECTION: PART,
    Kind.GEOMETRY_NODES: NESTED,
    Kind.PARTICLE: PARTICLE,
    Kind.DUPLI: DUPLI,
}


@dataclass(frozen=True)
class Plan:
    """objects: to hide; masks: hosts and (R,) bool rows to delete; particle_modifiers: emitters and modifier names to
    switch off; sources: objects to empty.

    faces: objects and (F,) bool faces to delete. levels: objects and what takes the place of their meshes. removed:
    (N,) bool, the instances that go; kept: culled ones that stay, by reason; whole: objects that keep all faces, by
    reason; reasons: why, by name of objects of which culled instances stay.
    """

    objects: tuple[bpy.types.Object, ...]
    masks: tuple[tuple[bpy.types.Object, Mask], ...]
    particle_modifiers: tuple[tuple[bpy.types.Object, str], ...]
    sources: tuple[bpy.types.Object, ...]
    faces: tuple[tuple[bpy.types.Object, Mask], ...]
    levels: tuple[tuple[bpy.types.Object, AnyLevel], ...]
    removed: Mask
    kept: dict[str, int]
    whole: dict[str, int]
    reasons: dict[str, str]


def make_plan(
    culled: Mask,
    keys: Keys,
    scene: bpy.types.Scene,
    lasting: bool = False,
    in_render: bool = False,
    faces: Mapping[str, Mask] = EMPTY,
    free: bool = False,
    levels: Mapping[str, AnyLevel] = NO_LEVELS,
) -> Plan:
    """The means for culled (N,) bool instances of `keys` in the open file; scene, lasting, in_render, faces, free,
    levels: as of `apply`."""
    if not culled.any() and not faces and not levels:
        return Plan((), (), (), (), (), (), np.zeros(len(culled), bool), {}, {}, {})
    return Planner(np.asarray(culled, bool), keys, scene, lasting, in_render).plan(faces, free, levels)


@dataclass(frozen=True)
class Columns:
    """The fields of key records as contiguous arrays: kind (N,) uint8; host, object, row (N,) int32, row the first of
    the path; deep (N,) bool, whether the path goes on."""

    kind: NDArray[np.uint8]
    host: NDArray[np.int32]
    object: NDArray[np.int32]
    row: NDArray[np.int32]
    deep: Mask

    @staticmethod
    def of(records: Records) -> Columns:
        """Columns of (N,) records of KEY."""
        kind, host, ob = (np.ascontiguousarray(records[name]) for name in ("kind", "host", "object"))
        return Columns(kind, host, ob, np.ascontiguousarray(records["path"][:, 0]), records["path"][:, 1] >= 0)


def deletable_rows(row: NDArray[np.int32], stays: Mask) -> Mask:
    """Rows of one geometry-nodes host that can go: (R,) bool, R one more than the highest row seen.

    row (N,) int32 of the host's instances, stays (N,) bool; a row is deletable when it has instances and none of them
    stays.
    """
    seen = np.zeros(int(row.max()) + 1, bool)
    seen[row] = True
    seen[row[stays]] = False
    return seen


def hideable_names(culled: Mask, columns: Columns, members: Mask) -> Mask:
    """(number of names,) bool: objects whose `hide_render` takes away some instances, all of them culled; members as in
    `by_source`."""
    touched = np.zeros(len(members), np.int64)
    live = np.zeros(len(members), np.int64)
    for name, chosen in ((columns.object, by_source(columns, members)), (columns.host, columns.host >= 0)):
        touched += np.bincount(name[chosen], minlength=len(members))
        live += np.bincount(name[chosen & ~culled], minlength=len(members))
    return (touched > 0) & (live == 0)


def by_source(columns: Columns, members: Mask) -> Mask:
    """(N,) bool: instances that vanish, or may vanish, when the object they show is hidden.

    Objects themselves, vertex and face duplicates, and parts of instanced collections; not what geometry nodes or
    particles make of a single object. members: (number of names,) bool, the objects that are in an instanced
    collection.
    """
    kind, ob = columns.kind, columns.object
    parts = (kind == Kind.COLLECTION) | ((kind == Kind.GEOMETRY_NODES) & columns.deep)
    return ((kind == Kind.OBJECT) | (kind == Kind.DUPLI) | (parts & members[ob])) & (ob >= 0)


def hosts(columns: Columns, kind: Kind) -> Iterator[tuple[int, NDArray[np.int64]]]:
    """Name index and instance indices of each host of a kind."""
    chosen = np.flatnonzero((columns.kind == kind) & (columns.host >= 0))
    host = columns.host[chosen]
    if len(host) and (host[0] == host).all():
        yield int(host[0]), chosen
        return
    order = np.argsort(host, kind="stable")
    numbers, first = np.unique(host[order], return_index=True)
    for n, instances in zip(numbers, np.split(chosen[order], first[1:]), strict=False):
        yield int(n), instances


class Obstacles:
    """What stands against changing an object of the open file, as it is now. found: objects by `full_name`."""

    def __init__(self, scene: bpy.types.Scene, lasting: bool, in_render: bool) -> None:
        # Blender's own search takes as long as there are objects
        self.found = {full_name(ob): ob for ob in bpy.data.objects}
        self.scene = scene
        others = scenes_in_picture(scene)
        self.references = References(others)
        # these only take an assignment, which would crash such a render
        self.keeps_linked = lasting or (in_render and bool(others))
        self.keeps_meshes = in_render and bool(others)

    def obstacle(self, ob: bpy.types.Object | None) -> str | None:
        """Why hiding an object would not work, or would touch more than it should; None where it can be hidden."""
        if ob is None:
            return MISSING
        if ob.library and self.keeps_linked:
            return NOT_KEPT
        if why := self.hiding_does_more(ob):
            return why
        if self.references.picked_by_particles(ob):
            return PICKED
        if instances_others(ob) and self.references.feeds(ob):
            return FEEDS
        if is_animated(ob, "hide_render"):
            return ANIMATED
        return self.any_change(ob)

    def hiding_does_more(self, ob: bpy.types.Object) -> str | None:
        """What else would vanish or change with an object, wherever it is hidden."""
        if ob.type == "META":
            return METABALL
        if self.references.carries_more(ob):
            return MORE
        return SIMULATION if simulates(ob) else None

    def any_change(self, ob: bpy.types.Object) -> str | None:
        """Why nothing of an object may be changed, its modifiers included."""
        if self.references.drives(ob):
            return DRIVES
        if self.references.elsewhere(ob):
            return ELSEWHERE
        return UNBAKED if self.references.holds_cache(ob) else None

    def modifier_obstacle(self, ob: bpy.types.Object | None) -> str | None:
        """Why no modifier of a host may be added or switched off; None where it may."""
        if ob is None:
            return MISSING
        if not takes_modifiers(ob):
            return LINKED
        return FEEDS if self.references.feeds(ob) else self.any_change(ob)


class Planner(Obstacles):
    """The steps of `make_plan`; `removed` and `reasons` fill up on the way."""

    def __init__(self, culled: Mask, keys: Keys, scene: bpy.types.Scene, lasting: bool, in_render: bool) -> None:
        super().__init__(scene, lasting, in_render)
        self.culled, self.columns, self.names = culled, Columns.of(keys.records), keys.names
        self.members = np.array(
            [self.references.in_instanced_collection(self.found.get(name)) for name in keys.names], bool
        )
        self.removed = np.zeros(len(culled), bool)
        self.object_reason: dict[int, str] = {}  # name index: why the object cannot be hidden
        self.host_reason: dict[int, str] = {}  # name index: why the host cannot be masked or switched off

    def plan(self, faces: Mapping[str, Mask], free: bool, levels: Mapping[str, AnyLevel] = NO_LEVELS) -> Plan:
        hidden = self.hidden_objects()
        masks = tuple(self.masks(hidden))
        particles = tuple(self.particle_modifiers(hidden))
        self.removed &= self.culled
        sources = tuple(self.sources()) if free else ()
        whole: Counter[str] = Counter()
        gone = {*hidden.values(), *sources}
        simplified = tuple(self.levels(levels, gone, whole))
        cut = tuple(self.faces(faces, gone | {ob for ob, _ in simplified}, whole))
        kept, reasons = self.kept()
        means = tuple(hidden.values()), masks, particles, sources, cut, simplified
        return Plan(*means, self.removed, kept, dict(whole), reasons)

    def hidden_objects(self) -> dict[int, bpy.types.Object]:
        """Objects to hide by their name index."""
        hidden = {}
        for n in np.flatnonzero(hideable_names(self.culled, self.columns, self.members)):
            ob = self.found.get(self.names[n])
            reason = self.obstacle(ob)
            if reason is not None:
                self.object_reason[int(n)] = reason
            elif ob is not None and not ob.hide_render:
                hidden[int(n)] = ob
        gone = np.zeros(len(self.names), bool)
        gone[list(hidden)] = True
        # Nodes may instance an object both alone and in a collection; only the collection minds hide_render, so nothing
        # is claimed for such a source.
        sure = np.zeros(len(self.names), bool)
        sure[[n for n, ob in hidden.items() if not self.references.alone_in_nodes(ob)]] = True
        if hidden:
            kind, host, ob = self.columns.kind, self.columns.host, self.columns.object
            # object -1 reads the last name: ruled out by by_source
            own = np.where(kind == Kind.OBJECT, gone[ob], sure[ob])
            self.removed = (own & by_source(self.columns, self.members)) | (gone[host] & (host >= 0))
        return hidden

    def masks(self, hidden: dict[int, bpy.types.Object]) -> Iterator[tuple[bpy.types.Object, Mask]]:
        """Hosts and rows for the mask modifier."""
        for n, instances in hosts(self.columns, Kind.GEOMETRY_NODES):
            if n in hidden or not self.culled[instances].any():
                continue
            ob = self.found.get(self.names[n])
            reason = self.modifier_obstacle(ob) or (READS_IDS if self.references.ids_are_read else None)
            if ob is None or reason is not None:
                self.host_reason[n] = reason or MISSING
                continue
            row, stays = self.columns.row[instances], ~self.culled[instances]
            if self.references.carries_more(ob):
                self.host_reason[n] = MORE
                stays |= self.columns.deep[instances]  # nested parts may hold lights, which have no instance here
            rows = deletable_rows(row, stays)
            if rows.any():
                self.removed[instances] |= rows[row]
                yield ob, rows

    def particle_modifiers(self, hidden: dict[int, bpy.types.Object]) -> Iterator[tuple[bpy.types.Object, str]]:
        """Emitters and particle modifiers to switch off: all of an emitter's instances are culled, the emitter itself
        stays."""
        for n, instances in hosts(self.columns, Kind.PARTICLE):
            if n in hidden or not self.culled[instances].all():
                continue
            ob = self.found.get(self.names[n])
            reason = self.modifier_obstacle(ob)
            if reason is None and ob is not None:
                reason = (
                    FEEDS if self.references.particle_source(ob) else MORE if self.references.carries_more(ob) else None
                )
            if ob is None or reason is not None:
                self.host_reason[n] = reason or MISSING
                continue
            self.removed[instances] = True
            for modifier in ob.modifiers:
                if modifier.type == "PARTICLE_SYSTEM" and modifier.show_render:
                    yield ob, modifier.name

    def faces(
        self, stay: Mapping[str, Mask], hidden: set[bpy.types.Object], whole: Counter[str]
    ) -> Iterator[tuple[bpy.types.Object, Mask]]:
        """Objects and faces for the face modifier; why others keep all of theirs goes into whole."""
        for name, mask in stay.items():
            ob = self.found.get(name)
            if ob in hidden or mask.all():
                continue
            reason = self.modifier_obstacle(ob) or self.shape_obstacle(ob)
            if ob is None or reason is not None:
                whole[reason or MISSING] += 1
            else:
                yield ob, ~mask

    def shape_obstacle(self, ob: bpy.types.Object | None) -> str | None:
        """Why an object must keep its shape; None where it need not."""
        if ob is None:
            return MISSING
        if simulates(ob):
            return SIMULATION
        if self.references.carries_more(ob):
            return MORE
        return SHAPES if self.references.shapes_others(ob) else None

    def levels(
        self, levels: Mapping[str, AnyLevel], hidden: set[bpy.types.Object], whole: Counter[str]
    ) -> Iterator[tuple[bpy.types.Object, AnyLevel]]:
        """Objects whose mesh is exchanged, and for what; of those that share one all or none; why others keep theirs
        goes into whole."""
        shared: dict[bpy.types.ID | None, list[tuple[bpy.types.Object | None, AnyLevel, str | None]]] = {}
        for name, level in levels.items():
            ob = self.found.get(name)
            if ob is None or ob not in hidden:
                reason = self.shape_obstacle(ob)
                if ob is not None and reason is None:
                    reason = self.any_change(ob) if self._takes(ob, level) else LINKED
                if self.keeps_meshes:
                    reason = reason or IN_RENDER
                alone = ob is None or len(ob.modifiers) > 0
                shared.setdefault(ob if ob is None or alone else ob.data, []).append((ob, level, reason))
        for members in shared.values():
            reasons = [reason for ob, _, reason in members if ob is None or reason is not None]
            if reasons:
                whole[reasons[0] or MISSING] += len(members)
            else:
                yield from ((ob, level) for ob, level, _ in members if ob is not None)

    def _takes(self, ob: bpy.types.Object, level: AnyLevel) -> bool:
        if isinstance(level, Level):
            return can_be_emptied(ob)
        setting = setting_of(ob, self.scene)
        return isinstance(setting, Setting) and level.steps <= len(setting.values)

    def sources(self) -> list[bpy.types.Object]:
        """Objects that something instances, and that no instance shows which stays: what they look like is of no use to
        anyone."""
        count = np.bincount(self.columns.object[self.columns.object >= 0], minlength=len(self.names))
        gone = count == np.bincount(
            self.columns.object[self.removed & (self.columns.object >= 0)], minlength=len(self.names)
        )
        stays = {
            self.found[name] for name, left in zip(self.names, gone, strict=True) if not left and name in self.found
        }
        shown = [self.found.get(self.names[n]) for n in np.flatnonzero(gone & (count > 0))]
        chosen = [ob for ob in shown if ob is not None and self.references.feeds(ob) and can_be_emptied(ob)]
        chosen = [
            ob
            for ob in chosen
            if not simulates(ob) and not self.references.carries_more(ob) and self.any_change(ob) is None
        ]
        free = unread(ob for ob in chosen if stays.isdisjoint(self.references.instanced_by(ob)))
        return [ob for ob in chosen if ob in free]

    def kept(self) -> tuple[dict[str, int], dict[str, str]]:
        """Culled instances that stay, by reason; and the reason by the name of the object that they show."""
        rest = np.flatnonzero(self.culled & ~self.removed)
        who = np.stack(
            [self.columns.kind[rest].astype(np.int32), self.columns.host[rest], self.columns.object[rest]], axis=1
        )
        numbers, counts = np.unique(who, axis=0, return_counts=True)
        kept: Counter[str] = Counter()
        named: dict[str, str] = {}
        for (kind, host, ob), count in zip(numbers, counts, strict=True):
            by_host, own = self.host_reason.get(int(host)), self.object_reason
            reason = by_host or own.get(int(host)) or own.get(int(ob)) or _BY_KIND[Kind(int(kind))]
            kept[reason] += int(count)
            named[self.names[ob if ob >= 0 else host]] = reason
        return dict(kept.most_common()), named
