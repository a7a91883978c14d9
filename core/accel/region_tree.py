"""A spatial tree over instances, and the cut through it that stands in for what is culled.

The tree is implicit: instances in extended Morton order, nodes of level l are runs of 8**l neighbours. No pointers, no
loops over instances; bounds of every level are reductions over the level below. The cut holds, for every culled
instance, exactly one node that contains it and nothing active.

Over frames the tree stays: boxes follow what moves, and the order is made anew where it has degraded. A region that
paths ask for is split; one whose parts they do not ask for any more is merged again. One that is split again soon after
that stays split for a while, twice as long each time (exponential backoff), so that none splits and merges forever.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..arrays import F32, I32, I64
from ..scene.bounds import enclosing, extended_morton_codes, extents
from ..scene.frustum import View

FANOUT = 8
MERGE_BELOW = 4  # crossings of all parts of a region below which they are merged into it
RESPLIT_WINDOW = 4  # changed frames: a region that is split again within so many after it was merged backs off
MIN_OPEN = 16  # changed frames that it then stays split, at first; doubled each time (exponential backoff)
_MAX_DOUBLINGS = 6  # doublings of MIN_OPEN at most
REBUILD_SAH_RATIO = 2.0  # growth of the regions' surface at which the order is made anew
_MORTON_BITS = 16
_SIZE_CLASSES = 8  # an instance is at most a quarter as large as one of the class before it


def spatial_order(bounds: F32) -> I32:
    """Order of boxes (N, 2, 3) along a Morton curve, large boxes first, so that a house and a pebble never share a
    region: (N,) int32."""
    code = extended_morton_codes(bounds, _MORTON_BITS, _SIZE_CLASSES)
    del bounds  # of a large mesh, they take as much as the mesh
    # The index in the low bits makes keys distinct: a plain sort of integers is then an argsort, stable and several
    # times as fast.
    bits = max(len(code) - 1, 1).bit_length()
    code >>= np.uint64(max(3 * _MORTON_BITS + 3 + bits - 64, 0))
    code <<= np.uint64(bits)
    code |= np.arange(len(code), dtype=np.uint64)
    code.sort()
    code &= np.uint64((1 << bits) - 1)
    return code.astype(np.int32)


@dataclass(frozen=True)
class Cut:
    """Nodes of the tree that stand in for everything culled.

    level: (H,) uint8; index: (H,) int64 node within its level; bounds: (H, 2, 3) float32 world boxes.
    """

    level: np.ndarray
    index: I64
    bounds: F32

    def __len__(self) -> int:
        return len(self.index)


class Regions:
    """The tree of one set of boxes, with what feedback has split.

    order: (N,) int32, instance of every place along the curve.
    """

    def __init__(self, bounds: F32, members: np.ndarray | None = None) -> None:
        """bounds: (N, 2, 3) float32 world boxes; members: ascending indices into it to take (default all)."""
        self.members: I32 = np.arange(len(bounds), dtype=np.int32) if members is None else members.astype(np.int32)
        boxes = bounds if len(self.members) == len(bounds) else bounds.take(self.members, axis=0)
        order = spatial_order(boxes)
        self.order: I32 = self.members[order]
        self.place: I32 = np.full(len(bounds), -1, np.int32)  # of every instance along the curve, -1 for none
        self.place[self.order] = np.arange(len(order), dtype=np.int32)
        self._bounds: list[F32] = [boxes.take(order, axis=0)]
        self._extent: list[F32] = [extents(self._bounds[0])]  # of the largest instance in each node, its longest side
        while len(self._bounds[-1]) > FANOUT:
            self._bounds.append(enclosing(self._bounds[-1], FANOUT))
            self._extent.append(np.maximum.reduceat(self._extent[-1], np.arange(0, len(self._extent[-1]), FANOUT)))
        self.split = [np.zeros(len(level), bool) for level in self._bounds]
        # By level, of each node: frame in which it was last merged, frame until which it stays split, and how often it
        # was split again within RESPLIT_WINDOW of being merged.
        self._merged_at = [np.zeros(len(level), np.int32) for level in self._bounds]
        self._open_until = [np.zeros(len(level), np.int32) for level in self._bounds]
        self._resplits = [np.zeros(len(level), np.uint8) for level in self._bounds]
        self._now: F32 | None = None  # boxes of the last frame, where some have moved; _bounds[0] spans the motion
        self._moving = np.zeros(0, np.int64)  # places that moved in the last frame
        self._surface = _surface_of(self._bounds)
        self._frame = RESPLIT_WINDOW  # changed frames so far

    @property
    def levels(self) -> int:
        """Levels of the tree, level 0 being single instances."""
        return len(self._bounds)

    @property
    def decayed(self) -> bool:
        """Whether things have moved so far that a new Morton order is worth its cost (REBUILD_SAH_RATIO)."""
        return _surface_of(self._bounds) > REBUILD_SAH_RATIO * self._surface

    def move(self, rows: np.ndarray, bounds: F32) -> None:
        """Take over new boxes (N, 2, 3) of the instances rows; a box then spans the place before the motion and the one
        after, until the next call."""
        places = self.place[rows].astype(np.int64)
        if not len(places) and not len(self._moving):
            return
        if self._now is None:
            self._now = self._bounds[0].copy()
        self._bounds[0][self._moving] = self._now[self._moving]
        new = bounds[rows]
        self._bounds[0][places, 0] = np.minimum(self._now[places, 0], new[:, 0])
        self._bounds[0][places, 1] = np.maximum(self._now[places, 1], new[:, 1])
        self._now[places] = new
        self._extent[0][places] = extents(new)
        changed, self._moving = np.concatenate([places, self._moving]), places
        for level in range(1, self.levels):
            changed = np.unique(changed // FANOUT)
            parts = np.minimum(changed[:, None] * FANOUT + np.arange(FANOUT), len(self._bounds[level - 1]) - 1)
            self._bounds[level][changed, 0] = self._bounds[level - 1][parts, 0].min(axis=1)
            self._bounds[level][changed, 1] = self._bounds[level - 1][parts, 1].max(axis=1)
            self._extent[level][changed] = self._extent[level - 1][parts].max(axis=1)

    def renewed(self, bounds: F32, members: np.ndarray, previous: np.ndarray | None = None) -> Regions:
        """A tree in new order over members of bounds, (N, 2, 3), that is split where this one is.

        previous: (N,) row of each instance in this tree's bounds, -1 for new ones; None: the same.
        """
        new = Regions(bounds, members)
        rows = new.order if previous is None else previous[new.order]
        old = np.where(rows >= 0, self.place[rows], -1)
        known, old = np.flatnonzero(old >= 0), old[old >= 0]
        for mine, theirs in (
            (self.split, new.split),
            (self._merged_at, new._merged_at),
            (self._open_until, new._open_until),
            (self._resplits, new._resplits),
        ):
            for level in range(min(self.levels, new.levels)):
                run = FANOUT**level
                values = mine[level][old // run]
                told = np.flatnonzero(values)
                theirs[level][known[told] // run] = values[told]
        new._frame = self._frame
        return new

    def pass_frame(self) -> None:
        """The picture has changed: time passes for what is remembered."""
        self._frame += 1

    def _occupied(self, active: np.ndarray) -> list[np.ndarray]:
        """Nodes with something active (instances) in them, by level, each an ascending array."""
        places = self.place[active]
        nodes = np.sort(places[places >= 0].astype(np.int64))
        out = [nodes]
        for _ in range(1, self.levels):
            nodes = nodes // FANOUT
            nodes = nodes[np.flatnonzero(np.diff(nodes, prepend=-1))]
            out.append(nodes)
        return out

    def cut(self, active: np.ndarray, waiting: np.ndarray | None = None) -> Cut:
        """The coarsest cut that keeps the instances active (indices, distinct) out of every node and honours `split`.

        waiting: instances that are culled for now, and stand in by boxes of their own.
        """
        occupied = self._occupied(active if waiting is None else np.concatenate([active, waiting]))
        if waiting is not None:
            occupied[0] = np.sort(self.place[active][self.place[active] >= 0])
        levels, indices, bounds = [], [], []
        nodes = np.arange(len(self._bounds[-1]))
        for level in range(self.levels - 1, -1, -1):
            opened = self.split[level].copy() if level else np.zeros(len(self._bounds[0]), bool)
            opened[occupied[level]] = True
            inside = opened[nodes]
            chosen = nodes[~inside]
            levels.append(np.full(len(chosen), level, np.uint8))
            indices.append(chosen)
            bounds.append(self._bounds[level][chosen])
            if level:
                nodes = (nodes[inside, None] * FANOUT + np.arange(FANOUT)).ravel()
                nodes = nodes[nodes < len(self._bounds[level - 1])]
        # Finest first: where boxes coincide, a ray that counts the nearest few takes the first, and so gets to single
        # instances without opening all of them.
        return Cut(np.concatenate(levels[::-1]), np.concatenate(indices[::-1]), np.concatenate(bounds[::-1]))

    def close(self, active: np.ndarray, cut: Cut, crossings: I64) -> None:
        """Merge regions again whose parts paths do not ask for: crossings (H,) of all the boxes of a cut around active
        (indices)."""
        occupied = self._occupied(active)
        leaves = cut.level == 0
        sums, open_below = np.zeros(0, np.int64), np.zeros(0, bool)
        for level in range(1, self.levels):
            count = len(self._bounds[level])
            if level == 1:
                sums = np.bincount(cut.index[leaves] // FANOUT, crossings[leaves], count).astype(np.int64)
                open_below = np.zeros(count, bool)
            else:
                starts = np.arange(0, len(sums), FANOUT)
                sums, open_below = np.add.reduceat(sums, starts), np.logical_or.reduceat(open_below, starts)
            open_below[occupied[level]] = True
            here = cut.level == level
            sums[cut.index[here]] = crossings[here]
            closed = self.split[level] & ~open_below & (self._open_until[level] <= self._frame) & (sums < MERGE_BELOW)
            self.split[level] &= ~closed
            self._merged_at[level][closed] = self._frame
            open_below |= self.split[level]

    def split_nodes(self, cut: Cut, rows: np.ndarray, wanted: np.ndarray) -> None:
        """Open nodes of a cut (rows into it) deep enough for wanted (one per row) boxes to stand in for each; single
        instances are passed over.

        Those that were merged just now are opened by one level only: what paths did not ask for before, they hardly do
        now.
        """
        depth = np.log2(np.maximum(wanted, 1)) / np.log2(FANOUT)
        for level in range(1, self.levels):
            chosen = cut.level[rows] == level
            nodes, below = cut.index[rows[chosen]], depth[chosen]
            below[self._reopened(level, nodes)] = 0
            for deeper in range(level, 0, -1):
                self.split[deeper][nodes] = True
                more = below > level - deeper + 1
                nodes = (nodes[more, None] * FANOUT + np.arange(FANOUT)).ravel()
                below = np.repeat(below[more], FANOUT)
                inside = nodes < len(self.split[deeper - 1])
                nodes, below = nodes[inside], below[inside]

    def _reopened(self, level: int, nodes: np.ndarray) -> np.ndarray:
        """Which of the nodes that paths ask for were merged just now, (K,) bool; these then stay open for a while
        (re-split backoff)."""
        recent = self._merged_at[level][nodes] > self._frame - RESPLIT_WINDOW
        again = nodes[recent]
        self._open_until[level][again] = self._frame + (MIN_OPEN << self._resplits[level][again].astype(np.int32))
        self._resplits[level][again] = np.minimum(self._resplits[level][again] + 1, _MAX_DOUBLINGS)
        return recent

    def instances_of(self, cut: Cut, rows: np.ndarray) -> I32:
        """Instances of those rows of a cut that are single instances, to be activated."""
        places = cut.index[rows[cut.level[rows] == 0]]
        self._reopened(0, places)
        return self.order[places]

    def in_view(self, view: View, share: float) -> I32:
        """Instances whose box touches what a camera sees and is as large as this share of the picture's width, or
        larger: by descent, not one by one."""
        nodes = np.arange(len(self._bounds[-1]))
        for level in range(self.levels - 1, -1, -1):
            nodes = nodes[view.shows(self._bounds[level][nodes], self._extent[level][nodes], share)]
            if level:
                nodes = (nodes[:, None] * FANOUT + np.arange(FANOUT)).ravel()
                nodes = nodes[nodes < len(self._bounds[level - 1])]
        return self.order[nodes]

    def release(self, instances: np.ndarray) -> np.ndarray:
        """Of active instances (indices) that no path met: those to be culled. The others were culled not long ago, and
        asked for again."""
        places = self.place[instances]
        free = self._open_until[0][places] <= self._frame
        self._merged_at[0][places[free]] = self._frame
        return instances[free]


def _surface_of(levels: list[F32]) -> float:
    """Surface of the boxes of the lowest regions of a tree, by levels: what rays meet, about."""
    if len(levels) < 2:
        return 0.0
    e = (levels[1][:, 1] - levels[1][:, 0]).astype(np.float64)
    return float((e[:, 0] * e[:, 1] + e[:, 1] * e[:, 2] + e[:, 2] * e[:, 0]).sum())
