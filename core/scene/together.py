"""Instances that stay or go together: for a file has no means to take out one without the others, or for they lie
exactly in one place, as an object does that was duplicated and never moved.

A renderer shows neither of two coincident surfaces properly: each shadows the other. Where one goes, the other is lit.
So they stay or go together, although light paths meet but one of them, and those that paths meet stay: how dark they
are to a renderer, or how much light they let through together, nobody knows.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..arrays import F32, I32, I64

_MIX = np.uint64(0x9E3779B97F4A7C15)  # SplitMix64's


@dataclass(frozen=True)
class Removal:
    """What instances can be taken out with: an instance of a group goes where all of one of its groups does.

    rows: (R,) int64, instances that are in a group; all others go one by one. groups: (G, R) int32 numbers, -1 for
    none.
    """

    rows: I64
    groups: I32

    def staying(self, keep: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """keep, (N,) bool, with what cannot be taken out."""
        wanted = keep[self.rows]
        if wanted.all():
            return keep
        live = np.zeros(int(self.groups.max(initial=-1)) + 2, bool)  # the last is that of -1
        for group in self.groups:
            live[group[wanted]] = True
        live[-1] = True
        out = keep.copy()
        out[self.rows] |= live[self.groups].all(axis=0)
        return out


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

    def rows(self, boxes: F32, transform: F32) -> NDArray[np.intp]:
        """Instances that lie where another one does, and are placed as that is: others with the same box may cross.
        boxes, transform: (N, 2, 3) and (N, 3, 4) float32, of the instances."""
        self._find(boxes)
        if self._placed is None:
            placed = transform[self._rows].reshape(len(self._rows), 12)
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

    def whole(self, keep: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """(W,) bool, instances of which something stays, parts of them included, where keep, (N,) bool, does."""
        if not len(self._owner):
            return keep
        out = keep[: self._first].copy()
        out[self._owner[keep[self._first :]]] = True
        return out

    def with_parts(self, keep: NDArray[np.bool_], more: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """keep, (N,) bool, with all parts of more, (W,) bool."""
        if not len(self._owner):
            return keep | more
        undivided = more.copy()
        undivided[self._owner] = False
        return keep | np.concatenate([undivided, more[self._owner]])

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
