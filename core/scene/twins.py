"""Instances that lie exactly where another one does: an object that was duplicated and never moved.

A renderer shows neither of two coincident surfaces properly: each shadows the other. Where one goes, the other is lit.
So they stay or go together, although light paths meet but one of them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..arrays import F32

_MIX = np.uint64(0x9E3779B97F4A7C15)  # SplitMix64's


class Twins:
    """The groups of instances with the same box, found again where the boxes have changed. A million boxes take a fifth
    of a second, the same boxes nothing."""

    def __init__(self) -> None:
        self._boxes: F32 | None = None
        self._rows = np.zeros(0, np.intp)
        self._group = np.zeros(0, np.intp)

    def joined(self, boxes: F32, keep: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """keep, (N,) bool, with all that lie exactly where one of them does. boxes: (N, 2, 3) float32, of the
        instances."""
        if boxes is not self._boxes:
            self._boxes = boxes
            _, group, count = np.unique(_codes(boxes), return_inverse=True, return_counts=True)
            self._rows = np.flatnonzero(count[group] > 1)
            self._group = group[self._rows]
        if not len(self._rows):
            return keep
        stays = np.zeros(int(self._group.max()) + 1, bool)
        stays[self._group[keep[self._rows]]] = True
        out = keep.copy()
        out[self._rows] |= stays[self._group]
        return out


def _codes(boxes: F32) -> NDArray[np.uint64]:
    """(N,) hashes of the six numbers of each box, bit for bit; -0 is 0."""
    words = (np.asarray(boxes, np.float32).reshape(len(boxes), 6) + np.float32(0.0)).view(np.uint32)
    out = np.zeros(len(boxes), np.uint64)
    for column in words.T:
        out = (out ^ column) * _MIX
        out ^= out >> np.uint64(29)
    return out
