"""Transforms of instances, composed and checked by the million.

Affine transforms are (3, 4) float64 until the end: the origin is subtracted in float64, then they become float32.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

LARGEST = 1.8e18  # Embree takes no coordinate beyond this (FLT_LARGE)


@njit(nogil=True, cache=True, error_model="numpy")
def compose_rows(parents: Any, placement: Any, columns: Any, rows: Any, out: Any) -> None:
    """out[k] = parents[placement[k]] * columns[rows[k]].

    parents (n, 3, 4) float64; columns (m, 4, 4) float32, column-major as Blender stores matrices; placement, rows (k,) int64; out (k, 3, 4) float64.
    """
    for k in range(len(rows)):
        a, b = parents[placement[k]], columns[rows[k]]
        for i in range(3):
            for j in range(4):
                out[k, i, j] = a[i, 0] * b[j, 0] + a[i, 1] * b[j, 1] + a[i, 2] * b[j, 2]
            out[k, i, 3] += a[i, 3]


@njit(nogil=True, cache=True, error_model="numpy")
def finish(transform: Any, origin: Any, low: Any, high: Any, out: Any, bounds: Any, good: Any) -> int:
    """float32 transforms relative to origin, and the world boxes of a mesh with the object-space box low, high; returns how many are usable.

    transform (n, 3, 4) float64; origin, low, high (3,) float64; out (n, 3, 4) float32; bounds (n, 2, 3) float32, rounded outward; good (n,) bool.
    Usable: finite and not singular, that is, the determinant exceeds 1e-7 (float32's precision) of the product of the column lengths, which exceed 1e-18 each.
    (Boxes: Arvo, "Transforming axis-aligned bounding boxes", Graphics Gems, 1990.)
    """
    count = 0
    for k in range(len(transform)):
        m = transform[k]
        finite = True
        for i in range(3):
            lo = hi = m[i, 3] - origin[i]
            out[k, i, 3] = lo
            for j in range(4):
                size = abs(m[i, j])
                finite &= size <= LARGEST  # false for NaN
            for j in range(3):
                a, b = m[i, j] * low[j], m[i, j] * high[j]
                lo += min(a, b)
                hi += max(a, b)
                out[k, i, j] = m[i, j]
            # one part in 2**23 is at least the spacing of float32 numbers
            bounds[k, 0, i] = np.float32(lo) - abs(np.float32(lo)) * np.float32(1.1920929e-07)
            bounds[k, 1, i] = np.float32(hi) + abs(np.float32(hi)) * np.float32(1.1920929e-07)
        x = np.sqrt(m[0, 0] * m[0, 0] + m[1, 0] * m[1, 0] + m[2, 0] * m[2, 0])
        y = np.sqrt(m[0, 1] * m[0, 1] + m[1, 1] * m[1, 1] + m[2, 1] * m[2, 1])
        z = np.sqrt(m[0, 2] * m[0, 2] + m[1, 2] * m[1, 2] + m[2, 2] * m[2, 2])
        volume = (
            (m[1, 0] * m[2, 1] - m[2, 0] * m[1, 1]) * m[0, 2]
            + (m[2, 0] * m[0, 1] - m[0, 0] * m[2, 1]) * m[1, 2]
            + (m[0, 0] * m[1, 1] - m[1, 0] * m[0, 1]) * m[2, 2]
        )
        ok = finite and min(x, y, z) > 1e-18 and abs(volume) > 1e-7 * x * y * z
        good[k] = ok
        count += ok
    return count


def usable_transforms(transform: Any) -> Any:
    """(n,) bool of (n, 3, 4) float64 transforms: finite and not singular, as `finish` has it."""
    n, zero = len(transform), np.zeros(3)
    good = np.empty(n, np.bool_)
    finish(np.ascontiguousarray(transform, np.float64), zero, zero, zero, np.empty((n, 3, 4), np.float32), np.empty((n, 2, 3), np.float32), good)
    return good
