"""Rows of memory.csv for a frame: objects, meshes and images, and why they stay."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ...core.arrays import F32, F64, I64
from ...core.files.memory_table import MemoryRow
from ...core.scene.mesh import divided_from
from ...core.scene.model import RAY_TYPES, InstanceFlag, Instances
from ...core.scene.render_costs import BVH_TRIANGLE
from ..extract import Extraction
from ..keys import Keys, full_name
from ..writeback.plan import Plan
from .costs import NamedCosts, costs_of

if TYPE_CHECKING:
    from ...core.culling.result import CullingResult

MOST = 10_000  # rows of a kind; what is smaller is in one together
OTHERS = "(others)"
NOTHING_KEPT: Mapping[str, str] = MappingProxyType({})
FLAGGED = 1 << 24  # pairs that are found by a flag for each that may be: many times faster than sorting a million
MET = "light paths meet it"
UNSURE = "no light path meets it, but too few looked there to let it go, or it is pinned"
UNMET = "culled: no light path meets it"
CHEAP = "culled: the picture changes little without it"
NOT_ASKED = "everything that is not culled by a rule stays"
CULLED = "culled"
SIMPLIFIED = "by a simplified mesh"
SHARED = "not divisible: several instances share its mesh"
WHOLE = "not divisible: its object, or a material of it, needs the whole mesh"


@dataclass(frozen=True)
class Outcome:
    """What became of N instances in a render. present: (N,) bool, those that it has; hits: (N, RAY_TYPES) light paths
    that met each; score: (N,) share of the picture that each may be worth, None where that was not measured; traced:
    whether light paths were. share: by row of an instance, which share of its triangles the render has, where that is
    not all; level: by mesh, which share of its triangles a simplified one has that takes its place. obstacles: by full
    name of an object, why it could not be culled."""

    present: NDArray[np.bool_]
    hits: I64
    score: F32 | None
    traced: bool
    share: Mapping[int, float] = field(default_factory=dict)
    level: Mapping[int, float] = field(default_factory=dict)
    obstacles: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Weighed:
    """A decided frame, to tell what its render takes, and who takes it, once it is known what of it is removed."""

    named: NamedCosts
    instances: Instances
    keys: Keys
    outcome: Outcome
    frame: int

    @staticmethod
    def of(extraction: Extraction, result: CullingResult, frame: int, scene: bpy.types.Scene) -> Weighed:
        """Of what was decided on a frame of a scene that was extracted."""
        named = costs_of(extraction, scene)
        score = result.score if "certified_mean" in result.stats else None
        sources, mesh = getattr(extraction.scene.meshes, "sources", None), extraction.scene.instances.mesh
        share = {
            row: float(mask.mean()) if sources is None else _of_triangles(sources[mesh[row]].geometry.mesh, mask)
            for row, mask in result.faces.items()
        }
        bvh = named.costs.bvh.tolist()
        level = {mesh: BVH_TRIANGLE * len(one) / max(bvh[mesh], 1) for mesh, one in result.stand_ins.items()}
        outcome = Outcome(result.active, result.hits, score, bool(result.stats.get("paths")), share, level)
        return Weighed(named, extraction.scene.instances, extraction.keys, outcome, frame)

    @staticmethod
    def whole(named: NamedCosts, instances: Instances, keys: Keys) -> Weighed:
        """Of a frame of which nothing is culled, nor anything traced."""
        n = len(instances)
        nothing = Outcome(np.ones(n, bool), np.zeros((n, RAY_TYPES), np.int64), None, False)
        return Weighed(named, instances, keys, nothing, 0)

    @property
    def in_full(self) -> Weighed:
        """The same frame with nothing culled."""
        outcome = replace(self.outcome, present=np.ones_like(self.outcome.present), share={}, level={})
        return replace(self, outcome=outcome)

    def by(self, plan: Plan) -> Weighed:
        """The same frame, of which goes what a plan can take away: of a mesh some of whose objects keep it, nothing."""
        cut, levelled = ({full_name(ob) for ob, _ in pairs} for pairs in (plan.faces, plan.levels))
        names, mesh, ob = self.keys.names, self.instances.mesh, self.keys.records["object"]
        share = {row: part for row, part in self.outcome.share.items() if names[ob[row]] in cut}
        there = np.flatnonzero(~plan.removed & np.isin(mesh, list(self.outcome.level)))
        whole = {
            number
            for number, n in zip(mesh[there].tolist(), ob[there].tolist(), strict=True)
            if names[n] not in levelled
        }
        level = {number: part for number, part in self.outcome.level.items() if number not in whole}
        return replace(self, outcome=replace(self.outcome, present=~plan.removed, share=share, level=level))

    def rows(
        self, removed: NDArray[np.bool_] | None = None, obstacles: Mapping[str, str] = NOTHING_KEPT
    ) -> list[MemoryRow]:
        """Rows of memory.csv. removed: (N,) bool, instances that the render has not, where that is known; obstacles:
        why others stay although they are culled."""
        present = self.outcome.present if removed is None else ~removed
        return memory_rows(
            self.named,
            self.instances,
            self.keys,
            replace(self.outcome, present=present, obstacles=obstacles),
            self.frame,
        )

    def figures(self, process: int, removed: NDArray[np.bool_] | None = None) -> dict[str, int]:
        """For the report: bytes that the process which renders is predicted to take, and how many more than that at
        most. process: what it takes before."""
        costs = replace(self.named.costs, process=process)
        total = replace(self, named=replace(self.named, costs=costs)).total(removed)
        return {"memory_bytes": total, "memory_error_bytes": costs.at_most(total) - total}

    def total(self, removed: NDArray[np.bool_] | None = None) -> int:
        """Bytes that the render takes."""
        share = np.ones(len(self.named.costs.geometry))
        for row, part in self.outcome.share.items():
            share[self.instances.mesh[row]] = part
        left = np.ones(len(share))
        for mesh, part in self.outcome.level.items():
            left[mesh], share[mesh] = part, 1.0
        costs = self.named.costs
        geometry, bvh = ((of * left).astype(np.int64) for of in (costs.geometry, costs.bvh))
        return replace(costs, geometry=geometry, bvh=bvh).total(
            self.instances.mesh, self.instances.slots, self.outcome.present if removed is None else ~removed, share
        )


def _of_triangles(mesh: Any, stays: NDArray[np.bool_]) -> float:
    """Which share of a mesh's triangles some of its faces have, (F,) bool; or, where each is a face, its triangles."""
    if len(stays) != len(mesh.polygons):
        return float(stays.mean())
    corners: NDArray[np.int32] = np.empty(len(mesh.polygons), np.int32)
    mesh.polygons.foreach_get("loop_total", corners)
    return float(np.average(stays, weights=corners - 2))


def memory_rows(named: NamedCosts, instances: Instances, keys: Keys, outcome: Outcome, frame: int) -> list[MemoryRow]:
    """The rows of a frame, the largest first."""
    ledger = _Ledger(named, instances, keys, outcome, frame)
    return [*ledger.objects(), *ledger.meshes(), *ledger.images()]


class _Ledger:
    """Bytes of a frame, added up by objects, meshes and images."""

    def __init__(self, named: NamedCosts, instances: Instances, keys: Keys, outcome: Outcome, frame: int) -> None:
        self.costs, self.named, self.keys, self.outcome, self.frame = named.costs, named, keys, outcome, frame
        self.mesh, self.slots, self.flags = instances.mesh, instances.slots, instances.flags
        records = keys.records
        self.owner = np.where(records["object"] >= 0, records["object"], records["host"])
        m = len(self.costs.geometry)
        self.share = np.ones(m)  # of the faces of each mesh
        for row, share in outcome.share.items():
            self.share[self.mesh[row]] = share
        self.cut = np.zeros(m, bool)
        self.cut[self.mesh[list(outcome.share)]] = True
        for mesh, share in outcome.level.items():
            self.share[mesh], self.cut[mesh] = share, False
        self.users = np.bincount(self.mesh, minlength=m)

    def objects(self) -> list[MemoryRow]:
        """Of objects that instances show."""
        names = len(self.keys.names)
        if not names:
            return []
        part = {kept: self._of_owners(kept, names) for kept in (False, True)}
        geometry, bvh, image = part[True]
        why = self._why_of_objects(names)
        return self._rows(
            "object", self.keys.names, self.owner, names, geometry, bvh, image, np.sum(part[False], axis=0), why
        )

    def _of_owners(self, present: bool, names: int) -> tuple[F64, F64, F64]:
        """Bytes of each object, (names,): geometry with instances, BVH, images. present: in the render as it was
        decided."""
        chosen = self.outcome.present if present else np.ones(len(self.mesh), bool)
        owner, instance = self.owner[chosen], self.costs.instance[chosen]
        geometry = np.bincount(owner, instance, names)
        share = self.share if present else np.ones(len(self.share))
        own, mesh = _pairs(owner, self.mesh[chosen])
        each = share[mesh] / np.bincount(mesh, minlength=len(share))[mesh]
        cutting = (self.costs.cutting * (self.cut & present))[mesh]
        geometry += np.bincount(own, self.costs.geometry[mesh] * each + cutting, names)
        bvh = np.bincount(own, self.costs.bvh[mesh] * each, names)
        own, image = self._users_of_images(owner, self.slots[chosen])
        size = self.costs.image[image] / np.bincount(image, minlength=len(self.costs.image))[image]
        return geometry, bvh, np.bincount(own, size, names)

    def _users_of_images(self, owner: NDArray[np.int32], slots: NDArray[np.int32]) -> tuple[I64, I64]:
        """Pairs of something that instances belong to and an image that it has, each once. owner, slots: of
        instances."""
        own, slot = _pairs(owner, slots)
        uses = self.costs.uses[np.argsort(self.costs.uses[:, 0], kind="stable")]
        first, last = (np.searchsorted(uses[:, 0], slot, side) for side in ("left", "right"))
        count = last - first
        at = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count) + np.repeat(first, count)
        return _pairs(np.repeat(own, count), uses[at, 1])

    def _why_of_objects(self, names: int) -> list[str]:
        met, kept = self._met(self.owner, names) > 0, self._count(self.owner, names, True) > 0
        triangles = self.costs.bvh // BVH_TRIANGLE
        large = (triangles >= divided_from(triangles)) & ~self.cut
        whole = np.where(large & (self.users > 1), 2, large.astype(np.int64))[self.mesh]
        whole[((self.flags & InstanceFlag.DIVISIBLE) != 0) & (whole == 1)] = 0
        simplified = np.zeros(len(self.users), bool)
        simplified[list(self.outcome.level)] = True
        coarse = np.zeros(names, bool)
        np.logical_or.at(coarse, self.owner, simplified[self.mesh])
        most = np.zeros(names, np.int64)
        np.maximum.at(most, self.owner, whole)
        out = []
        for n, name in enumerate(self.keys.names):
            if name in self.outcome.obstacles and kept[n]:
                out.append(f"cannot be culled: {self.outcome.obstacles[name]}")
            elif kept[n]:
                reason = NOT_ASKED if not self.outcome.traced else MET if met[n] else UNSURE
                more = (SIMPLIFIED,) if coarse[n] else (["", WHOLE, SHARED][most[n]],) * bool(most[n])
                out.append("; ".join([reason, *more]))
            else:
                out.append(CULLED if not self.outcome.traced else CHEAP if met[n] else UNMET)
        return out

    def meshes(self) -> list[MemoryRow]:
        """Of meshes, the instances of each included."""
        m, present = len(self.share), self.outcome.present
        there = np.bincount(self.mesh[present], minlength=m) > 0
        instance = [
            np.bincount(self.mesh[some], self.costs.instance[some], m) for some in (present, np.ones_like(present))
        ]
        geometry = (self.costs.geometry * self.share + self.costs.cutting * self.cut) * there + instance[0]
        bvh = self.costs.bvh * self.share * there
        full = self.costs.mesh * (self.users > 0) + instance[1]
        why = _users("used by", np.bincount(_pairs(self.mesh, self.owner)[0], minlength=m), there)
        return self._rows("mesh", self.named.meshes, self.mesh, m, geometry, bvh, np.zeros(m), full, why)

    def images(self) -> list[MemoryRow]:
        """Of images; instances are those that have one."""
        i = len(self.costs.image)
        rows = np.arange(len(self.mesh))
        if not i:
            return []
        row, image = self._users_of_images(rows.astype(np.int32), self.slots)
        there = np.bincount(image[self.outcome.present[row]], minlength=i) > 0
        nothing = np.zeros(i)
        objects = np.bincount(self._users_of_images(self.owner, self.slots)[1], minlength=i)
        why = _users("in materials of", objects, there)
        sizes = nothing, nothing, (self.costs.image * there).astype(np.float64)
        return self._rows("image", self.named.images, image, i, *sizes, self.costs.image, why, row)

    def _count(self, group: NDArray[np.integer], count: int, present: bool, row: I64 | None = None) -> I64:
        chosen = self.outcome.present if row is None else self.outcome.present[row]
        return np.bincount(group[chosen] if present else group, minlength=count)

    def _met(self, group: NDArray[np.integer], count: int, row: I64 | None = None) -> F64:
        """(count,) light paths that met each group."""
        return np.bincount(group, self.outcome.hits.sum(axis=1)[slice(None) if row is None else row], count)

    def _rows(
        self,
        kind: str,
        names: tuple[str, ...],
        group: NDArray[np.integer],
        count: int,
        geometry: F64,
        bvh: F64,
        image: F64,
        full: F64 | I64,
        why: list[str],
        row: I64 | None = None,
    ) -> list[MemoryRow]:
        """Rows of a kind. group: of instances, or of those that row names, which of count things each is of."""
        chosen: slice | I64 = slice(None) if row is None else row
        outcome = self.outcome
        hits = [np.bincount(group, outcome.hits[chosen, k], count).astype(np.int64).tolist() for k in range(RAY_TYPES)]
        worth = [None] * count if outcome.score is None else np.bincount(group, outcome.score[chosen], count).tolist()
        every, kept = (self._count(group, count, present, row).tolist() for present in (False, True))
        parts = [np.rint(x).astype(np.int64) for x in (geometry, bvh, image)]
        total, full = np.sum(parts, axis=0), np.rint(full).astype(np.int64)
        order = np.lexsort((-full, -total))
        order = order[(full[order] > 0) & (np.array(every)[order] > 0)]
        out = []
        for n in order[:MOST].tolist():
            seen: list[Any] = [of[n] for of in hits] if outcome.traced else [None] * RAY_TYPES
            sizes: list[Any] = [int(x[n]) for x in (total, full, *parts)]
            rest: list[Any] = [every[n], kept[n], worth[n], *seen, self.frame, why[n]]
            out.append(MemoryRow(kind, names[n], *sizes, *rest))
        if len(left := order[MOST:]):
            sums: list[Any] = [int(x[left].sum()) for x in (total, full, *parts, np.array(every), np.array(kept))]
            sums += [*[None] * (1 + RAY_TYPES), self.frame, f"{len(left):,} smaller ones together"]
            out.append(MemoryRow(kind, OTHERS, *sums))
        return out


def _users(what: str, objects: I64, there: NDArray[np.bool_]) -> list[str]:
    """Why each of (n,) things stays: objects use it; or that it is culled."""
    words = (f"{what} {n:,} object{'s' if n > 1 else ''}" for n in objects.tolist())
    return [word if kept else CULLED for word, kept in zip(words, there.tolist(), strict=True)]


def _pairs(a: NDArray[np.integer], b: NDArray[np.integer]) -> tuple[I64, I64]:
    """Each pair of (n,) and (n,) once."""
    high, most = int(b.max(initial=0)) + 1, int(a.max(initial=0)) + 1
    both = a.astype(np.int64) * high + b
    if high * most <= FLAGGED:
        flags = np.zeros(high * most, bool)
        flags[both] = True
        found = np.flatnonzero(flags)
    else:
        found = np.unique(both)
    return found // high, found % high
