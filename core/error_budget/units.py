"""What is decided together: instances by themselves where paths have met them often enough, else with their neighbours.

One or two hits say little of a single instance: of many that are met by chance, those that were missed are worth as
much as those that were met. So thinly met instances are pooled by the region that they lie in, as deep in the region
tree as there is evidence, and a pool is kept or culled as a whole.

What no path met is a unit of its own in each pool. Its worth is that of the pool's members that exactly one path met:
the expected light of what is yet to be met (Good 1953, Turing's estimate). Where few of many members are met, but those
often, that is little; where all are met by chance, as in a meadow, much.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..accel.region_tree import FANOUT, Regions
from ..arrays import F64, I32, I64
from ..feedback.tiles import TILES
from .budget import Savings

# paths that must meet an instance, or a pool, for it to be a unit: their number is then known to a third (1 / sqrt(8))
EVIDENCE = 8


@dataclass(frozen=True)
class Seen:
    """Light by which the camera sees small emitters. of: (S,) int32 unit or instance, -1 for what is always culled;
    tile: (S,) int32; share: (S,) float64 of the light of that tile."""

    of: I32 | I64
    tile: I32
    share: F64

    def without(self, keep: np.ndarray) -> F64:
        """(T,) what tiles lack where only keep, bool by unit or instance and one more for -1, stays."""
        lost = ~keep[self.of]
        return np.bincount(self.tile[lost], self.share[lost], TILES)


NOTHING_SEEN = Seen(np.zeros(0, np.int32), np.zeros(0, np.int32), np.zeros(0))


@dataclass(frozen=True)
class Units:
    """U units of what is decided together: those with TLAS entries first, then what no path met, by pool.

    of_entry: (A,) int32 unit of each entry. worth: (U, T) float64 relative change of each tile that culling it is
    expected to make, infinite for what must stay. unmet: of how many units no member was met: they come last. pool_of:
    (R,) int32 number among those for each lowest region of the tree, -1 for none. members: (U,) how many instances each
    has. seen: what the camera sees of them, beside what paths met.
    """

    of_entry: I32
    worth: F64
    unmet: int
    pool_of: I32
    members: I64
    seen: Seen = NOTHING_SEEN

    @staticmethod
    def single(worth: F64) -> Units:
        """Each TLAS entry by itself, and nothing else. worth: (A, T)."""
        return Units(
            np.arange(len(worth), dtype=np.int32), worth, 0, np.zeros(0, np.int32), np.ones(len(worth), np.int64)
        )

    def __len__(self) -> int:
        return len(self.worth)

    @property
    def with_entries(self) -> int:
        """How many units have TLAS entries."""
        return len(self.worth) - self.unmet

    @property
    def met_members(self) -> I64:
        """(U,) how many instances of each paths met."""
        return np.append(self.members[: self.with_entries], np.zeros(self.unmet, np.int64))

    def entries(self, cull: np.ndarray) -> NDArray[np.bool_]:
        """(A,) which entries are in the units of cull, (U,) bool."""
        return np.asarray(cull[self.of_entry])

    def owed(self, cull: np.ndarray) -> F64:
        """(T,) what is charged for the units of cull, (U,) bool, that no path met, and for what the camera sees of
        others."""
        n = self.with_entries
        return np.asarray(self.worth[n:][cull[n:]].sum(axis=0) + self.seen.without(np.append(~cull, False)))

    def saved(self, savings: Savings, stay: np.ndarray) -> F64:
        """(U,) bytes that culling each unit saves where those of stay, (U,) bool, are what is left. savings: of the
        entries."""
        left = self.entries(stay)
        share = np.zeros(len(left))
        share[left] = savings.among_these(left).share
        out = np.bincount(self.of_entry, share, len(self)) if len(left) else np.zeros(len(self))
        out[self.with_entries :] = savings.typical * self.members[self.with_entries :]
        return np.maximum(out, 1.0)

    def unmet_kept(self, cull: np.ndarray, regions: Regions) -> I32:
        """Instances in the regions of those pools whose unmet members stay, others of the regions included. cull: (U,)
        bool."""
        kept = np.append(~cull[self.with_entries :], False)
        rows = np.flatnonzero(kept[self.pool_of])
        places = (rows[:, None] * FANOUT + np.arange(FANOUT)).ravel()
        return regions.order[places[places < len(regions.order)]]


def units_of(
    regions: Regions, ids: I32, paths_met: I64, worth: F64, pinned: np.ndarray, seen: Seen = NOTHING_SEEN
) -> Units:
    """Units for TLAS entries of instances ids, (A,). paths_met: (A,) paths that met each. worth: (A, T). pinned: (N,)
    bool, what stays whatever it is worth. seen: what the camera sees of TLAS entries."""
    alone = pinned[ids] | (paths_met >= EVIDENCE)
    thin = ~alone & (paths_met > 0)
    pool_of, pools = _pools(regions, regions.place[ids[thin]].astype(np.int64) // FANOUT, paths_met[thin])
    # Units: single instances, then the thinly met of each pool, then what was not met in it.
    region = regions.place[ids].astype(np.int64) // FANOUT
    pool = pool_of[region] if len(region) else np.zeros(0, np.int32)
    singles = int(alone.sum())
    of_entry = np.where(alone, np.cumsum(alone) - 1, singles + pool)
    unmet_entry = ~alone & ~thin
    of_entry[unmet_entry] += pools  # built, but no path has met it
    total = singles + 2 * pools
    by_unit = np.zeros((total, worth.shape[1]))
    once = thin & (paths_met == 1)
    _add_rows(by_unit, of_entry, worth)
    _add_rows(by_unit, of_entry[once] + pools, worth[once])
    by_unit[of_entry[pinned[ids]]] = np.inf
    runs = np.bincount(pool_of[pool_of >= 0], _sizes(regions)[pool_of >= 0], pools).astype(np.int64)
    met = np.bincount(pool[~unmet_entry], minlength=pools)  # those that stand alone are among the region's members too
    members = np.concatenate([np.ones(singles, np.int64), np.bincount(pool[thin], minlength=pools), runs - met])
    of_entry = of_entry.astype(np.int32)
    seen = Seen(np.append(of_entry, np.int32(-1))[seen.of], seen.tile, seen.share)
    return Units(of_entry, by_unit, pools, pool_of, members, seen)


def _add_rows(out: F64, rows: np.ndarray, values: F64) -> None:
    """Add each of values (A, T) to the row of out (U, T) that rows (A,) names."""
    if not len(rows):
        return
    order = np.argsort(rows, kind="stable")
    named, starts = np.unique(rows[order], return_index=True)
    out[named] += np.add.reduceat(values[order], starts, axis=0)


def _sizes(regions: Regions) -> I64:
    """(R,) members of each lowest region."""
    count = -(-len(regions.order) // FANOUT)
    sizes = np.full(count, FANOUT, np.int64)
    if count:
        sizes[-1] = len(regions.order) - FANOUT * (count - 1)
    return sizes


def _pools(regions: Regions, nodes: I64, hits: I64) -> tuple[I32, int]:
    """The pool of each lowest region, (R,) int32, and how many there are: the deepest nodes of the tree with hits
    enough on thinly met instances that no deeper one has taken, and the whole tree for the rest. nodes, hits: the
    lowest region of each thinly met instance, and how many paths met it.
    """
    count = -(-len(regions.order) // FANOUT)
    if not count:
        return np.zeros(0, np.int32), 0
    sums = np.bincount(nodes, hits, count).astype(np.int64)
    formed: list[np.ndarray] = []
    while True:
        enough = sums >= EVIDENCE if len(sums) > 1 else np.ones(1, bool)
        formed.append(enough)
        if len(sums) == 1:
            break
        left = np.where(enough, 0, sums)
        sums = np.add.reduceat(left, np.arange(0, len(left), FANOUT))
    pool = np.zeros(0, np.int32)
    pools = 0
    for enough in reversed(formed):
        above = np.repeat(pool, FANOUT)[: len(enough)] if len(pool) else np.full(1, -1, np.int32)
        number = np.cumsum(enough, dtype=np.int32) - 1 + pools
        pool = np.where(enough, number, above).astype(np.int32)
        pools += int(enough.sum())
    return pool, pools
