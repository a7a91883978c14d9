"""Instances that lie exactly where another one does: an object that was duplicated and never moved.

A renderer shows neither of two coincident surfaces properly: each shadows the other. Where one goes, the other is lit.
So they stay or go together, although light paths meet but one of them, and those that paths meet stay: how dark they
are to a renderer, or how much light they let through together, nobody knows.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..arrays import F32, I64
from .model import Instances

_MIX = np.uint64(0x9E3779B97F4A7C15)  # SplitMix64's


class Twins:
    """The groups of instances with the same box, found again where the boxes have changed. A million boxes take a fifth
    of a second, the same boxes nothing."""

    def __init__(self) -> None:
        self._boxes: F32 | None = None
        self._rows = np.zeros(0, np.intp)
        self._group = np.zeros(0, np.intp)
        self._placed: NDArray[np.intp] | None = None
        self._first, self._owner = 0, np.zeros(0, np.int64)

    def divide(self, first: int, owner: I64) -> None:
        """Rows from first on are parts of instances, (P,) their rows: those of one have no place in common, although
        their boxes may be the same."""
        self._first, self._owner, self._placed = first, owner, None

    def rows(self, instances: Instances) -> NDArray[np.intp]:
        """Instances that lie where another one does, and are placed as that is: others with the same box may cross."""
        self._find(instances.bounds)
        if self._placed is None:
            placed = instances.transform[self._rows].reshape(len(self._rows), 12)
            code = _codes(placed) ^ self._group.astype(np.uint64) * _MIX
            _, group = np.unique(code, return_inverse=True)
            of = self._owners()
            least, most = np.full(len(of), np.iinfo(np.int64).max), np.full(len(of), -1)
            np.minimum.at(least, group, of)
            np.maximum.at(most, group, of)
            self._placed = self._rows[(least < most)[group]]
        return self._placed

    def _owners(self) -> I64:
        """The instance that each of the rows found is, or is a part of."""
        out = self._rows.astype(np.int64)
        if len(self._owner):
            parts = out >= self._first
            out[parts] = self._owner[out[parts] - self._first]
        return out

    def joined(self, boxes: F32, keep: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """keep, (N,) bool, with all that lie exactly where one of them does. boxes: (N, 2, 3) float32, of the
        instances."""
        self._find(boxes)
        if not len(self._rows):
            return keep
        stays = np.zeros(int(self._group.max()) + 1, bool)
        stays[self._group[keep[self._rows]]] = True
        out = keep.copy()
        out[self._rows] |= stays[self._group]
        return out

    def _find(self, boxes: F32) -> None:
        if boxes is self._boxes:
            return
        self._boxes, self._placed = boxes, None
        _, group, count = np.unique(_codes(boxes.reshape(len(boxes), 6)), return_inverse=True, return_counts=True)
        self._rows = np.flatnonzero(count[group] > 1)
        self._group = group[self._rows]


def _codes(numbers: F32) -> NDArray[np.uint64]:
    """(N,) hashes of (N, K) numbers, bit for bit; -0 is 0."""
    words = (np.asarray(numbers, np.float32) + np.float32(0.0)).view(np.uint32)
    out = np.zeros(len(numbers), np.uint64)
    for column in words.T:
        out = (out ^ column) * _MIX
        out ^= out >> np.uint64(29)
    return out
