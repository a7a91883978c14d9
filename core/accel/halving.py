"""Triangles of a mesh in runs of neighbours, by halving: the parts that a large mesh is divided into."""

from __future__ import annotations

import numpy as np
from numba import njit

_CLASSES = 5  # of size: up to four times the median triangle's box, then a class for each factor of four
_STEPS = 0x7FFFFFFF  # places along the side of a box that tell centres apart; the rest is for the triangle's number


@njit(nogil=True, cache=True, error_model="numpy")
def halved(positions, triangles, most):
    """Runs of neighbouring triangles: (T,) int32, one run after the other, and (P,) int64 where each ends.

    positions: (V, 3) float32; triangles: (T, 3) uint32; most: triangles of a run. Triangles of a size class are halved
    by their centres along the longest side of the box around these, until a run is left; all runs of a class have as
    many as they may have, but its last. So boxes of runs overlap little, and no run is as large as a wall because of
    one triangle of it.
    """
    count = len(triangles)
    centre, size = np.empty((count, 3), np.float32), np.empty(count, np.float32)
    for t in range(count):
        size[t] = 0
        for axis in range(3):
            a, b, c = (
                positions[triangles[t, 0], axis],
                positions[triangles[t, 1], axis],
                positions[triangles[t, 2], axis],
            )
            low, high = min(a, b, c), max(a, b, c)
            centre[t, axis], size[t] = np.float32(0.5) * (low + high), max(size[t], high - low)
    order, pending = _by_size(size)
    ends, runs = np.empty(count // most + _CLASSES, np.int64), 0
    keys = np.empty(count, np.int64)
    while len(pending) > 0:
        first, end = pending.pop()
        parts = (end - first + most - 1) // most
        if parts > 1:
            middle = first + parts // 2 * most
            _halve(centre, order, keys, first, middle, end)
            pending.append((middle, end))
            pending.append((first, middle))
        else:
            ends[runs], runs = end, runs + 1
    return order, ends[:runs].copy()


@njit(nogil=True, cache=True, error_model="numpy")
def _by_size(size):
    """Triangles by size class, the smallest first, (T,) int32, and where classes begin and end, the first one last."""
    of, starts = np.empty(len(size), np.uint8), np.zeros(_CLASSES + 1, np.int64)
    median = np.partition(size, len(size) // 2)[len(size) // 2] if len(size) else np.float32(0)
    for t in range(len(size)):
        k, most = 0, 4 * median
        while k < _CLASSES - 1 and size[t] > most:
            k, most = k + 1, 4 * most
        of[t] = k
        starts[k + 1] += 1
    starts = np.cumsum(starts)
    pending = [(starts[k], starts[k + 1]) for k in range(_CLASSES - 1, -1, -1) if starts[k] < starts[k + 1]]
    order = np.empty(len(size), np.int32)
    for t in range(len(size)):
        order[starts[of[t]]] = t
        starts[of[t]] += 1
    return order, pending


@njit(nogil=True, cache=True, error_model="numpy")
def _halve(centre, order, keys, first, middle, end):
    """Order triangles [first, end) so that those before the middle have the smaller centres along the longest side of
    the box around all centres, ties by number. keys: (T,) int64 to work with."""
    axis, low, longest = 0, np.float64(0), np.float64(-1)
    for side in range(3):
        least = most = centre[order[first], side]
        for k in range(first, end):
            c = centre[order[k], side]
            least, most = min(least, c), max(most, c)
        if np.float64(most) - np.float64(least) > longest:
            axis, low, longest = side, np.float64(least), np.float64(most) - np.float64(least)
    scale = _STEPS / longest if longest > 0 else 0.0
    for k in range(first, end):  # keys are distinct: what is on either side does not depend on how it is found
        keys[k] = (np.int64((centre[order[k], axis] - low) * scale) << 32) | np.int64(order[k])
    left, right = first, end - 1  # quickselect (Hoare 1961)
    while left < right:
        a, b, c = keys[left], keys[(left + right) // 2], keys[right]
        pivot = max(min(a, b), min(max(a, b), c))
        i, j = left, right
        while i <= j:
            while keys[i] < pivot:
                i += 1
            while keys[j] > pivot:
                j -= 1
            if i <= j:
                keys[i], keys[j] = keys[j], keys[i]
                i, j = i + 1, j - 1
        if middle <= j:
            right = j
        elif middle >= i:
            left = i
        else:
            break
    for k in range(first, end):
        order[k] = keys[k] & 0xFFFFFFFF
