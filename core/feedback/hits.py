"""What rays met: integer counts per instance and per hitbox, by ray type. Integers add up to the same whatever the
order and the number of threads."""

from __future__ import annotations

import math
import mmap
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..accel.hitboxes import Hitboxes
from ..arrays import F64, I64
from ..scene.model import RAY_TYPES
from .tiles import COLUMNS, DARK, ROWS, TILES

__all__ = ["COLUMNS", "ROWS", "TILES", "Feedback", "Weights"]  # the kernel's

_FIXED = float(1 << 20)  # units of fixed point to the picture's mean luminance
MOST = np.float32(1e12)  # units of one event, so that no sum of them overflows: of one without bound, just so many


def sparse_zeros(shape: tuple[int, ...], dtype: Any = np.int64) -> Any:
    """Zeros of which few are ever written: in pages of 4 kB, where NumPy asks the system for pages of 2 MB, so that
    hits on a few hundred of a million instances would take, and clear, all 40 MB in every round."""
    size, each = math.prod(shape), np.dtype(dtype).itemsize
    if hasattr(mmap, "MADV_NOHUGEPAGE"):  # private: what is only read takes nothing either
        memory = mmap.mmap(-1, max(each * size, 1), flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
        memory.madvise(mmap.MADV_NOHUGEPAGE)
    else:
        memory = mmap.mmap(-1, max(each * size, 1))
    return np.frombuffer(memory, dtype, size).reshape(shape)


@dataclass(frozen=True)
class Weights:
    """What TLAS entries are worth to the picture, in fixed point: order and threads do not matter.

    light: (A, T) int64, luminance that paths gathered behind entry a in tile t, or at least what they carried times the
    mean luminance, since something that bright may stand behind it; and what its blocking denied to shadow rays. total:
    (T,) int64, luminance of all paths of a tile. Tiles in rows from the bottom. ambient: mean luminance of the picture.
    unit: luminance of one unit. first: the TLAS entry that row 0 is for; those before it are not weighed. The number
    behind the last entry of a TLAS, where there is a row for it, stands for the boxes of all that is not built. known:
    (T,) what share of the light is surely there: changes are relative to that.
    """

    light: I64
    total: I64
    ambient: float
    unit: float
    first: int = 0
    known: F64 = field(default_factory=lambda: np.ones(TILES))

    @staticmethod
    def zeros(entries: int, ambient: float, first: int = 0) -> Weights:
        """Nothing gathered yet, for so many TLAS entries from the first on; ambient: mean luminance expected."""
        ambient = max(ambient, 1e-30)
        return Weights(
            np.zeros((entries, TILES), np.int64), np.zeros(TILES, np.int64), ambient, ambient / _FIXED, first
        )

    @property
    def unbounded(self) -> NDArray[np.bool_]:
        """(A,) which entries some event credited without bound. Beside a tile of many paths, or a bright one, that need
        not be much."""
        return np.asarray((self.light >= np.int64(MOST)).any(axis=1))

    def relative(self, samples: F64 | I64 | int = 1) -> F64:
        """What each entry is worth in each tile, relative to the tile's luminance: (A, T) float64. samples: paths per
        pixel of each tile, (T,), where tiles differ in that.

        Tiles darker than DARK times the mean are judged against that.
        """
        total = self.total * self.known
        return self.light / np.maximum(total, np.maximum(DARK * (total / samples).mean() * samples, 1.0))


@dataclass
class Feedback:
    """Counts of one trace.

    hits: (N, RAY_TYPES) int64, rays of a type whose closest hit was the instance; in the column SHADOW: shadow rays
    that it blocked, or that arrived at it where it is an emitter. boxes: (H, RAY_TYPES) int64, ray segments that
    crossed the hitbox. hitboxes: their Embree scene (uint64), 0 for none. paths: how many camera paths made these
    counts. weights: what the light was worth, where it is asked for.
    """

    hits: I64
    boxes: I64
    hitboxes: np.uint64
    paths: int = 0
    weights: Weights | None = None

    @staticmethod
    def zeros(instances: int, boxes: Hitboxes | None = None, weights: Weights | None = None) -> Feedback:
        """Counts of 0 for so many instances, and the counters of boxes."""
        hits = sparse_zeros((instances, RAY_TYPES))
        if boxes is None:
            return Feedback(hits, np.zeros((0, RAY_TYPES), np.int64), np.uint64(0), weights=weights)
        return Feedback(hits, boxes.counters, boxes.handle, weights=weights)
