"""World boxes of instances, by the million: (N, 2, 3) float32, least corner first. Empty ones, and those of broken transforms, hold inf or NaN."""

from __future__ import annotations

import numpy as np

from .placing import LARGEST
from .scene import F32


def columns(boxes: F32) -> F32:
    """Boxes (N, 2, 3) as (6, N): numpy is many times as fast along a long axis as along one of three."""
    return np.ascontiguousarray(boxes.reshape(-1, 6).T)


def existing(boxes: F32) -> np.ndarray:
    """What can be met: has triangles, and coordinates that are finite and no larger than Embree takes. (N, 2, 3) -> (N,) bool."""
    c = columns(boxes)
    with np.errstate(invalid="ignore"):
        return np.logical_and.reduce(c[:3] <= c[3:]) & np.logical_and.reduce(np.abs(c) <= LARGEST)


def extents(boxes: F32) -> F32:
    """Longest sides of boxes (N, 2, 3): (N,)."""
    c = columns(boxes)
    sides = c[3:] - c[:3]
    return np.maximum(np.maximum(sides[0], sides[1]), sides[2])


def enclosing(boxes: F32, run: int) -> F32:
    """Boxes around each run of so many boxes, the last one perhaps of fewer: (N, 2, 3) -> (ceil(N / run), 2, 3)."""
    starts = np.arange(0, len(boxes), run)
    return np.stack([np.minimum.reduceat(boxes[:, 0], starts), np.maximum.reduceat(boxes[:, 1], starts)], axis=1)
