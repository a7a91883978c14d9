"""What each path of a trace met, and how bright it came out: so that a scene without some instances is traced again
only where it can differ.

A path that met nothing of what is culled takes the same course without it, bit for bit: random numbers belong to the
path, and nothing else is in its way.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ..arrays import F32, I32, I64
from ..scene.film import LUMINANCE
from ..threads import over_parts
from .hits import sparse_zeros

# int32 per path, a cache line: how many entries it met, then the entries; a path that met more than fit counts as one
# that met all
RECORD = 16


@dataclass(frozen=True)
class PathLog:
    """records: (H, W, S, RECORD) int32, count and TLAS entries met by each of S paths per pixel; the number behind the
    last entry stands for boxes of what is not built. color: (H, W, S, 3) float32, linear light of each path, less
    backdrop where the picture is transparent: what appears there, or vanishes, changes the picture by that much more
    than by its own light, however dark it is."""

    records: I32
    color: F32
    backdrop: float = 0.0

    @property
    def shape(self) -> tuple[int, int, int]:
        """Height, width, samples."""
        height, width, samples = self.color.shape[:3]
        return height, width, samples

    @property
    def luminance(self) -> F32:
        """(H, W, S) float32 of each path."""
        return np.asarray(self.color @ LUMINANCE.astype(np.float32))

    @staticmethod
    def zeros(height: int, width: int, samples: int, *, backdrop: float = 0.0) -> PathLog:
        """Nothing traced yet. Paths that never are, as of most tiles where some get many, take no memory."""
        return PathLog(
            sparse_zeros((height, width, samples, RECORD), np.int32),
            sparse_zeros((height, width, samples, 3), np.float32),
            backdrop,
        )

    def copy(self, only: NDArray[np.uint8]) -> PathLog:
        """A copy of the paths that only, (H, W, S), marks. The others take no memory."""
        out = PathLog.zeros(*self.shape, backdrop=self.backdrop)
        out.update(only, self)
        return out

    def update(self, only: NDArray[np.uint8], other: PathLog) -> None:
        """Take the paths that only, (H, W, S), marks from another log."""
        mine, theirs = ((log.records.reshape(-1, RECORD), log.color.reshape(-1, 3)) for log in (self, other))
        marked = only.reshape(-1)
        over_parts(lambda a, b: _take(marked[a:b], *(x[a:b] for x in (*mine, *theirs))), only.size)

    def clear(self, only: NDArray[np.uint8]) -> None:
        """Empty the records of the paths that only, (H, W, S), marks."""
        marked, records = only.reshape(-1), self.records.reshape(-1, RECORD)
        over_parts(lambda a, b: _clear(marked[a:b], records[a:b]), only.size)

    def affected(self, culled: np.ndarray, among: NDArray[np.uint8] | None = None) -> NDArray[np.uint8]:
        """1 for each path that met one of the culled TLAS entries, (A,) bool, a box of what is not built, or more than
        its record holds: (H, W, S) uint8.

        among: (H, W, S), marks the paths that there are, where those are not all.
        """
        out = np.ones(self.shape, np.uint8) if among is None else among.copy()
        records, gone, marked = self.records.reshape(-1, RECORD), np.append(culled, True), out.reshape(-1)
        over_parts(lambda a, b: _mark(records[a:b], gone, marked[a:b]), out.size)
        return out

    def paths_met(self, entries: int) -> I64:
        """How many paths met each of so many TLAS entries, (entries,) int64; of a path that met more than its record
        holds, only what that holds."""
        out = np.zeros(entries + 1, np.int64)
        _count(self.records.reshape(-1, RECORD), out)
        return out[:entries]


def numbers(only: NDArray[np.uint8]) -> I64:
    """Numbers of the paths that only, (H, W, S), marks."""
    return np.flatnonzero(only.reshape(-1) != 0)  # of bool: ten times faster than of bytes


def renumber(records: I32, only: NDArray[np.uint8], entries: I32) -> None:
    """Write other numbers into those records (P, RECORD) that only, (P,), marks, in place: entries[e] for entry e."""
    over_parts(lambda a, b: _renumber(records[a:b], only[a:b], entries), len(records))


@njit(cache=True, nogil=True, error_model="numpy")
def _renumber(records, only, entries):
    for p in range(len(records)):
        if only[p] == 0:
            continue
        for k in range(1, min(records[p, 0] + 1, RECORD)):
            records[p, k] = entries[records[p, k]]


@njit(cache=True, nogil=True, error_model="numpy")
def _mark(records, culled, out):
    """out[p] = 0 unless records[p] holds a culled entry or is over-full."""
    for p in range(len(records)):
        if out[p] == 0:
            continue
        count = records[p, 0]
        marked = count == RECORD
        for k in range(1, min(count + 1, RECORD)):
            marked = marked or culled[records[p, k]]
        if not marked:
            out[p] = 0


@njit(cache=True, nogil=True, error_model="numpy")
def _take(only, records, color, other_records, other_color):
    """Rows that only, (P,), marks, from another's (P, RECORD) and (P, 3)."""
    for p in range(len(only)):
        if only[p] != 0:
            for k in range(min(other_records[p, 0] + 1, RECORD)):
                records[p, k] = other_records[p, k]
            for c in range(3):
                color[p, c] = other_color[p, c]


@njit(cache=True, nogil=True, error_model="numpy")
def _clear(only, records):
    for p in range(len(only)):
        if only[p] != 0:
            records[p, 0] = 0


@njit(cache=True, nogil=True, error_model="numpy")
def _count(records, out):
    """Add to out the number of records that hold each entry."""
    for p in range(len(records)):
        for k in range(1, min(records[p, 0] + 1, RECORD)):
            out[records[p, k]] += 1


@njit(cache=True, nogil=True, error_model="numpy")
def attribute_to_first_hit(records, paths, row, tile, difference, change, squares):
    """Add each path's difference, and its square, to change and squares (C, T) of the first entry that it met which has
    a row there, in the path's tile.

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
