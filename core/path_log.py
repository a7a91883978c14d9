"""What each path of a trace met, and how bright it came out: so that a scene without some instances is traced again only where it can differ.

A path that met nothing of what is culled takes the same course without it, bit for bit: random numbers belong to the path, and nothing else is in its way.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from .scene import F32, I32

RECORD = 16  # int32 per path, a line of the cache: how many entries it met, then the entries; a path that met more counts as one that met everything


@dataclass(frozen=True)
class PathLog:
    """records: (H, W, S, RECORD) int32, count and TLAS entries met by each of S paths per pixel; luminance: (H, W, S) float32 of each path."""

    records: I32
    luminance: F32

    @staticmethod
    def zeros(height: int, width: int, samples: int) -> PathLog:
        """Nothing traced yet."""
        return PathLog(np.zeros((height, width, samples, RECORD), np.int32), np.zeros((height, width, samples), np.float32))

    def copy(self) -> PathLog:
        """One of its own."""
        return PathLog(self.records.copy(), self.luminance.copy())

    def joined(self, more: PathLog) -> PathLog:
        """With the samples of another log behind these."""
        return PathLog(np.concatenate([self.records, more.records], axis=2), np.concatenate([self.luminance, more.luminance], axis=2))

    def update(self, only: NDArray[np.uint8], other: PathLog) -> None:
        """Take the paths that only, (H, W, S), marks from another log."""
        marked = only != 0
        self.records[marked], self.luminance[marked] = other.records[marked], other.luminance[marked]

    def affected(self, culled: np.ndarray) -> NDArray[np.uint8]:
        """1 for each path that met one of the culled TLAS entries, (A,) bool, or more than its record holds: (H, W, S) uint8."""
        out = np.zeros(self.luminance.shape, np.uint8)
        _mark(self.records.reshape(-1, RECORD), np.append(culled, False), out.reshape(-1))
        return out


@njit(cache=True, nogil=True, error_model="numpy")
def renumber(records, only, entries):
    """Write other numbers into those records (P, RECORD) that only, (P,), marks, in place: entries[e] for entry e."""
    for p in range(len(records)):
        if only[p] == 0:
            continue
        for k in range(1, min(records[p, 0] + 1, RECORD)):
            records[p, k] = entries[records[p, k]]


@njit(cache=True, nogil=True, error_model="numpy")
def _mark(records, culled, out):
    """out[p] = 1 where records[p] holds a culled entry or is over-full."""
    for p in range(len(records)):
        count = records[p, 0]
        if count == RECORD:
            out[p] = 1
        for k in range(1, min(count + 1, RECORD)):
            if culled[records[p, k]]:
                out[p] = 1
                break


@njit(cache=True, nogil=True, error_model="numpy")
def put_down(records, paths, row, tile, difference, change, squares):
    """Add each path's difference, and its square, to change and squares (C, T) of the first entry that it met which has a row there, in the path's tile.

    paths: (D,) rows of records (P, RECORD). row: (A,) of each entry, -1: none. tile, difference: (D,).
    """
    for i in range(len(paths)):
        p = paths[i]
        for k in range(1, min(records[p, 0] + 1, RECORD)):
            r = row[records[p, k]]
            if r >= 0:
                change[r, tile[i]] += difference[i]
                squares[r, tile[i]] += difference[i] ** 2
                break
