"""A spatial tree over instances, and the cut through it that stands in for what is culled.

The tree is implicit: instances in extended Morton order, nodes of level l are runs of 8**l neighbours. No pointers, no loops over instances; bounds of every
level are reductions over the level below. The cut holds, for every culled instance, exactly one node that contains it and nothing active.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .scene import F32, I32, I64

FANOUT = 8
_MORTON_BITS = 16
_SIZE_CLASSES = 8  # an instance is at most a quarter as large as one of the class before it


def _spread(x: np.ndarray) -> np.ndarray:
    """Bits of x (uint64, 16 used) moved to every third place."""
    for shift, mask in ((32, 0x1F00000000FFFF), (16, 0x1F0000FF0000FF), (8, 0x100F00F00F00F00F), (4, 0x10C30C30C30C30C3), (2, 0x1249249249249249)):
        x = (x | (x << np.uint64(shift))) & np.uint64(mask)
    return x


def spatial_order(bounds: F32) -> I32:
    """Order of boxes (N, 2, 3) along a Morton curve, large boxes first, so that a house and a pebble never share a region.

    (Morton codes extended by size: Vinkler, Bittner, Havran, "Extended Morton Codes for High Performance Bounding Volume Hierarchy Construction", HPG 2017.)
    """
    if not len(bounds):
        return np.zeros(0, np.int32)
    center = (bounds[:, 0] + bounds[:, 1]) * np.float32(0.5)
    low = center.min(axis=0)
    extent = max(float((center.max(axis=0) - low).max()), 1e-30)
    cell = np.clip((center - low) * np.float32((1 << _MORTON_BITS) / extent), 0, (1 << _MORTON_BITS) - 1).astype(np.uint64)
    code = _spread(cell[:, 0]) | (_spread(cell[:, 1]) << np.uint64(1)) | (_spread(cell[:, 2]) << np.uint64(2))
    size = (bounds[:, 1] - bounds[:, 0]).max(axis=1)
    largest = max(float(size.max()), 1e-30)
    rank = np.clip(-np.log2(np.maximum(size / np.float32(largest), 1e-30)) / 2, 0, _SIZE_CLASSES - 1).astype(np.uint64)
    # The index in the low bits makes keys distinct: a plain sort of integers is then an argsort, stable and several times as fast.
    bits = max(len(bounds) - 1, 1).bit_length()
    code |= rank << np.uint64(3 * _MORTON_BITS)
    code >>= np.uint64(max(3 * _MORTON_BITS + 3 + bits - 64, 0))
    code = (code << np.uint64(bits)) | np.arange(len(bounds), dtype=np.uint64)
    code.sort()
    return (code & np.uint64((1 << bits) - 1)).astype(np.int32)


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
        """bounds: (N, 2, 3) float32 world boxes; members: indices into it to take (default all)."""
        self.members: I32 = np.arange(len(bounds), dtype=np.int32) if members is None else members.astype(np.int32)
        boxes = bounds if members is None else bounds[self.members]
        order = spatial_order(boxes)
        self.order: I32 = self.members[order]
        self._bounds: list[F32] = [np.ascontiguousarray(boxes[order])]
        while len(self._bounds[-1]) > FANOUT:
            below = self._bounds[-1]
            starts = np.arange(0, len(below), FANOUT)
            self._bounds.append(np.stack([np.minimum.reduceat(below[:, 0], starts), np.maximum.reduceat(below[:, 1], starts)], axis=1))
        self.split: list[np.ndarray] = [np.zeros(len(level), bool) for level in self._bounds]

    @property
    def levels(self) -> int:
        """Levels of the tree, level 0 being single instances."""
        return len(self._bounds)

    def cut(self, active: np.ndarray) -> Cut:
        """The coarsest cut that keeps active (N,) bool out of every node and honours `split`."""
        occupied = active[self.order]
        opened = [occupied]
        for level in range(1, self.levels):
            occupied = np.logical_or.reduceat(occupied, np.arange(0, len(occupied), FANOUT))
            opened.append(occupied | self.split[level])
        levels, indices, bounds = [], [], []
        reachable = np.ones(len(self._bounds[-1]), bool)
        for level in range(self.levels - 1, -1, -1):
            chosen = np.flatnonzero(reachable & ~opened[level])
            levels.append(np.full(len(chosen), level, np.uint8))
            indices.append(chosen)
            bounds.append(self._bounds[level][chosen])
            if level:
                reachable = np.repeat(reachable & opened[level], FANOUT)[: len(self._bounds[level - 1])]
        # Finest first: where boxes coincide, a ray that counts the nearest few takes the first, and so gets to single instances without opening all of them.
        return Cut(np.concatenate(levels[::-1]), np.concatenate(indices[::-1]), np.concatenate(bounds[::-1]))

    def merge(self) -> None:
        """Take back every split."""
        for level in self.split:
            level[:] = False

    def split_nodes(self, cut: Cut, rows: np.ndarray, wanted: np.ndarray) -> None:
        """Open nodes of a cut (rows into it) deep enough for wanted (one per row) boxes to stand in for each; single instances are passed over."""
        depth = np.log2(np.maximum(wanted, 1)) / np.log2(FANOUT)
        for level in range(1, self.levels):
            chosen = cut.level[rows] == level
            nodes, below = cut.index[rows[chosen]], depth[chosen]
            for deeper in range(level, 0, -1):
                self.split[deeper][nodes] = True
                more = below > level - deeper + 1
                nodes = (nodes[more, None] * FANOUT + np.arange(FANOUT)).ravel()
                below = np.repeat(below[more], FANOUT)
                inside = nodes < len(self.split[deeper - 1])
                nodes, below = nodes[inside], below[inside]

    def instances_of(self, cut: Cut, rows: np.ndarray) -> I32:
        """Instances of those rows of a cut that are single instances."""
        return self.order[cut.index[rows[cut.level[rows] == 0]]]
