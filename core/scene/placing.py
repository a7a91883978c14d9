"""Transforms of instances, composed and checked by the million.

Affine transforms are (3, 4) float64 until the end: the origin is subtracted in float64, then they become float32.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from ..arrays import F64
from ..jit import healing as _healing  # noqa: F401
from .model import Camera

LARGEST = 1.8e18  # Embree takes no coordinate beyond this (FLT_LARGE)


@njit(nogil=True, cache=True, error_model="numpy")
def compose_rows(parents: Any, placement: Any, columns: Any, rows: Any, out: Any) -> None:
    """out[k] = parents[placement[k]] * columns[rows[k]].

    parents (n, 3, 4) float64; columns (m, 4, 4) float32, column-major as Blender stores matrices; placement, rows (k,)
    int64; out (k, 3, 4) float64.
    """
    for k in range(len(rows)):
        a, b = parents[placement[k]], columns[rows[k]]
        for i in range(3):
            for j in range(4):
                out[k, i, j] = a[i, 0] * b[j, 0] + a[i, 1] * b[j, 1] + a[i, 2] * b[j, 2]
            out[k, i, 3] += a[i, 3]


@njit(nogil=True, cache=True, error_model="numpy")
def finish(transform: Any, origin: Any, low: Any, high: Any, out: Any, bounds: Any, good: Any) -> tuple[int, float]:
    """float32 transforms relative to origin, and the world boxes of a mesh with the object-space box low, high.

    Returns how many are usable, and the largest factor by which any of them stretches an axis, infinite where a number
    is not finite.

    transform (n, 3, 4) float64; origin, low, high (3,) float64; out (n, 3, 4) float32; bounds (n, 2, 3) float32,
    rounded outward; good (n,) bool. Usable: finite and not singular, that is, the determinant exceeds 1e-7 (float32's
    precision) of the product of the column lengths, which exceed 1e-18 each. (Boxes: Arvo, "Transforming axis-aligned
    bounding boxes", Graphics Gems, 1990.)
    """
    count, stretch = 0, 0.0
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
        stretch = max(stretch, x, y, z) if finite else np.inf
        volume = (
            (m[1, 0] * m[2, 1] - m[2, 0] * m[1, 1]) * m[0, 2]
            + (m[2, 0] * m[0, 1] - m[0, 0] * m[2, 1]) * m[1, 2]
            + (m[0, 0] * m[1, 1] - m[1, 0] * m[0, 1]) * m[2, 2]
        )
        ok = finite and min(x, y, z) > 1e-18 and abs(volume) > 1e-7 * x * y * z
        good[k] = ok
        count += ok
    return count, stretch


def usable_transforms(transform: Any) -> Any:
    """(n,) bool of (n, 3, 4) float64 transforms: finite and not singular, as `finish` has it."""
    n, zero = len(transform), np.zeros(3)
    good = np.empty(n, np.bool_)
    finish(
        np.ascontiguousarray(transform, np.float64),
        zero,
        zero,
        zero,
        np.empty((n, 3, 4), np.float32),
        np.empty((n, 2, 3), np.float32),
        good,
    )
    return good


# coordinates over distance from the camera: float32 rounds them to 2**-24 of that, 1/16 of a pixel of a milliradian
_COARSEST = 2.0**10


def scene_origin(camera: Camera) -> F64:
    """Where the coordinates of a scene should begin, (3,) float64: near the camera, on a grid as coarse as what it sees
    nearest allows.

    On a grid, so that coordinates of few digits stay exact and neighbours stay flush, and so that a camera that moves a
    little moves nothing else: in an animation what stands still keeps its numbers. The grid depends on the one frame
    alone.
    """
    cell = 2.0 ** np.floor(np.log2(max(local_reach(camera), 1e-30)))
    return np.asarray(np.round(camera.to_world[:, 3] / cell) * cell, np.float64)


def local_origin(low: F64, high: F64, transform: F64, camera: Camera) -> F64:
    """Where the coordinates of a mesh should begin, in its own space, (3,) float64: zeros where they may stay as they
    are.

    low, high (3,) float64: its box; transform (n, 3, 4) float64: its instances; camera: in the same world. A mesh far
    from its own origin, or one that reaches far beyond the camera, loses digits just where it is looked at. Its
    coordinates then begin near the point of its box that is nearest to the camera, of the instance that is nearest; on
    a grid, so that a camera that moves a little changes nothing.
    """
    zero = np.zeros(3)
    reach = np.maximum(np.abs(low), np.abs(high)).max()
    # no axis is longer than that: quickly said, as a rule
    if reach * 1.7321 * np.abs(transform[:, :, :3]).max(initial=0) <= local_reach(camera):
        return zero
    scale = np.linalg.norm(transform[:, :, :3], axis=1).max(axis=1)
    if not (reach * scale).max(initial=0) > local_reach(camera):
        return zero
    sound = usable_transforms(transform)
    if not sound.any():
        return zero
    linear, scale = transform[sound, :, :3], scale[sound]
    eye = np.linalg.solve(linear, (camera.to_world[:, 3] - transform[sound, :, 3])[:, :, None])[:, :, 0]
    nearest = np.clip(eye, low, high)
    distance = np.linalg.norm(np.einsum("nij,nj->ni", linear, nearest - eye), axis=1)
    k = int(distance.argmin())
    detail = _detail(camera, distance[k]) / scale[k]
    if not np.abs(nearest[k]).max() > _COARSEST * detail:
        return zero
    cell = 2.0 ** np.floor(np.log2(_COARSEST * detail))
    return np.asarray(np.round(nearest[k] / cell) * cell)


def local_reach(camera: Camera) -> float:
    """Metres that a mesh may reach from its own origin before `local_origin` looks at where it is."""
    return _COARSEST * _detail(camera)


def _detail(camera: Camera, distance: float = 0.0) -> float:
    """A thousand pixels of a picture of a thousand pixels, in metres, at a distance from the camera; at least at where
    it begins to see."""
    width = float(max(camera.frame[1] - camera.frame[0], camera.frame[3] - camera.frame[2]))
    return width if camera.orthographic else max(distance, camera.clip_start) * min(width, 1.0)


def shifted(transform: F64, origin: F64) -> F64:
    """Transforms (n, 3, 4) float64 of a mesh whose coordinates begin at origin (3,), in its own space."""
    out = transform.copy()
    out[:, :, 3] += transform[:, :, :3] @ origin
    return out
