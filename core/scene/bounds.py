"""World boxes of instances, by the million: (N, 2, 3) float32, least corner first. Empty ones, and those of broken
transforms, hold inf or NaN."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from ..arrays import F32, I32
from .placing import LARGEST

_LARGEST = np.float32(LARGEST)


@njit(nogil=True, cache=True, error_model="numpy")
def existing(boxes: Any) -> Any:
    """What can be met: has triangles, and coordinates that are finite and no larger than Embree takes. (N, 2, 3) ->
    (N,) bool."""
    out = np.ones(len(boxes), np.bool_)
    for i in range(len(boxes)):
        for axis in range(3):
            low, high = boxes[i, 0, axis], boxes[i, 1, axis]
            out[i] &= low <= high and low >= -_LARGEST and high <= _LARGEST  # false for NaN
    return out


@njit(nogil=True, cache=True, error_model="numpy")
def extents(boxes: Any) -> Any:
    """Longest sides of boxes (N, 2, 3): (N,) float32."""
    out = np.empty(len(boxes), np.float32)
    for i in range(len(boxes)):
        out[i] = max(boxes[i, 1, 0] - boxes[i, 0, 0], boxes[i, 1, 1] - boxes[i, 0, 1], boxes[i, 1, 2] - boxes[i, 0, 2])
    return out


@njit(nogil=True, cache=True, error_model="numpy")
def enclosing(boxes: Any, run: int) -> Any:
    """Boxes around each run of so many boxes, the last one perhaps of fewer: (N, 2, 3) -> (ceil(N / run), 2, 3)
    float32."""
    out = np.empty(((len(boxes) + run - 1) // run, 2, 3), np.float32)
    for i in range(len(boxes)):
        k = i // run
        for axis in range(3):
            low, high = boxes[i, 0, axis], boxes[i, 1, axis]
            out[k, 0, axis] = low if i % run == 0 else min(out[k, 0, axis], low)
            out[k, 1, axis] = high if i % run == 0 else max(out[k, 1, axis], high)
    return out


@njit(nogil=True, cache=True, error_model="numpy")
def _spread(x: Any) -> Any:
    """Bits of x (uint64, 16 used) moved to every third place."""
    x = (x | (x << np.uint64(32))) & np.uint64(0x1F00000000FFFF)
    x = (x | (x << np.uint64(16))) & np.uint64(0x1F0000FF0000FF)
    x = (x | (x << np.uint64(8))) & np.uint64(0x100F00F00F00F00F)
    x = (x | (x << np.uint64(4))) & np.uint64(0x10C30C30C30C30C3)
    return (x | (x << np.uint64(2))) & np.uint64(0x1249249249249249)


@njit(nogil=True, cache=True, error_model="numpy")
def extended_morton_codes(boxes: Any, bits: int, classes: int) -> Any:
    """Of the centres of existing boxes, at most 16 bits per axis, below a size class: each is a quarter as large as the
    one before it, class 0 the largest. (N, 2, 3) -> (N,) uint64.

    (Vinkler, Bittner, Havran, "Extended Morton Codes for High Performance Bounding Volume Hierarchy Construction", HPG
    2017.)
    """
    half = np.float32(0.5)
    low, high = np.full(3, np.inf, np.float32), np.full(3, -np.inf, np.float32)
    largest = np.float32(1e-30)
    for i in range(len(boxes)):
        for axis in range(3):
            center = (boxes[i, 0, axis] + boxes[i, 1, axis]) * half
            low[axis], high[axis] = min(low[axis], center), max(high[axis], center)
            largest = max(largest, boxes[i, 1, axis] - boxes[i, 0, axis])
    extent = max(high[0] - low[0], high[1] - low[1], high[2] - low[2], np.float32(1e-30))
    most = np.float32((1 << bits) - 1)
    scale = np.float32(1 << bits) / extent
    out = np.empty(len(boxes), np.uint64)
    for i in range(len(boxes)):
        code, size = np.uint64(0), np.float32(0)
        for axis in range(3):
            center = (boxes[i, 0, axis] + boxes[i, 1, axis]) * half
            cell = min(max((center - low[axis]) * scale, np.float32(0)), most)
            code |= _spread(np.uint64(cell)) << np.uint64(axis)
            size = max(size, boxes[i, 1, axis] - boxes[i, 0, axis])
        rank, bound = 0, largest / np.float32(4)
        while rank < classes - 1 and size <= bound:
            rank, bound = rank + 1, bound / np.float32(4)
        out[i] = code | (np.uint64(rank) << np.uint64(3 * bits))
    return out


def world_bounds(transform: F32, mesh_bounds: F32, mesh: I32) -> F32:
    """World boxes of instances: the transformed box of each mesh.

    transform (N, 3, 4) float32, mesh_bounds (M, 2, 3) float32, mesh (N,) int32 -> (N, 2, 3) float32, rounded outward to
    enclose the exact box.
    (Arvo, "Transforming axis-aligned bounding boxes", Graphics Gems, 1990.)
    """
    center = (mesh_bounds[:, 0].astype(np.float64) + mesh_bounds[:, 1]) * 0.5
    half = (mesh_bounds[:, 1].astype(np.float64) - mesh_bounds[:, 0]) * 0.5
    out = np.empty((len(mesh), 2, 3), np.float32)
    step = 1 << 17  # float64 temporaries of one block, not of a million instances
    for a in range(0, len(mesh), step):
        m = mesh[a : a + step]
        linear = transform[a : a + step, :, :3].astype(np.float64)
        c = np.einsum("nij,nj->ni", linear, center[m]) + transform[a : a + step, :, 3]
        h = np.einsum("nij,nj->ni", np.abs(linear), half[m])
        out[a : a + step, 0] = np.nextafter((c - h).astype(np.float32), np.float32(-np.inf))
        out[a : a + step, 1] = np.nextafter((c + h).astype(np.float32), np.float32(np.inf))
    return out
