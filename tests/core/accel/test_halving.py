"""Runs of neighbouring triangles: each is in one, their boxes overlap little, and large ones are among themselves."""

from __future__ import annotations

import numpy as np
import pytest

from lipac.core.accel.halving import halved
from lipac.core.accel.region_tree import spatial_order
from lipac.core.arrays import F32, F64, I32, I64, U32

MOST = 32


def triangles_at(centres: F32, size: F32) -> tuple[F32, U32]:
    """A triangle of a size, (T,), around each of centres, (T, 3)."""
    corners = np.array([(-1, -1, -1), (1, -1, 0), (0, 1, 1)], np.float32) / 2
    positions: F32 = (centres[:, None] + size[:, None, None] * corners).astype(np.float32)
    return positions.reshape(-1, 3), np.arange(3 * len(centres), dtype=np.uint32).reshape(-1, 3)


def boxes(positions: F32, triangles: U32) -> F32:
    corners = positions[triangles]
    return np.stack((corners.min(axis=1), corners.max(axis=1)), axis=1)


def surface(of: F32, order: I32, ends: I64) -> F64:
    """Of the box of each run."""
    starts = np.append(0, ends[:-1])
    side = np.maximum.reduceat(of[order, 1], starts) - np.minimum.reduceat(of[order, 0], starts)
    return 2 * (side * np.roll(side, 1, axis=1)).sum(axis=1).astype(np.float64)


def test_each_triangle_is_in_one_run_and_boxes_are_small() -> None:
    """Points of a folded sheet: runs along a Morton curve have twice the surface."""
    rng = np.random.default_rng(0)
    u, v = rng.random((2, 5000), np.float32)
    mesh = triangles_at(np.stack((u, v, np.sin(9 * u) * np.cos(7 * v)), axis=1), np.full(5000, 0.01, np.float32))
    order, ends = halved(*mesh, MOST)
    assert np.array_equal(np.sort(order), np.arange(5000))
    sizes = np.diff(ends, prepend=0)
    assert (sizes[:-1] == MOST).all()
    assert 0 < sizes[-1] <= MOST
    of = boxes(*mesh)
    curve = np.minimum(np.arange(MOST, 5000 + MOST, MOST), 5000)
    assert surface(of, order, ends).sum() < 0.6 * surface(of, spatial_order(of), curve).sum()


def test_a_large_triangle_is_not_in_a_run_with_small_ones() -> None:
    rng = np.random.default_rng(1)
    size = np.where(np.arange(1000) % 100 == 0, 1.0, 0.01).astype(np.float32)
    order, ends = halved(*triangles_at(rng.random((1000, 3), np.float32), size), MOST)
    runs = np.split(size[order], ends[:-1])
    assert all(len(np.unique(run)) == 1 for run in runs)
    assert np.array_equal(np.sort(order), np.arange(1000))


@pytest.mark.parametrize("count", [0, 1, MOST, MOST + 1, 300])
def test_triangles_in_one_place(count: int) -> None:
    """Ties go by number."""
    order, ends = halved(*triangles_at(np.ones((count, 3), np.float32), np.zeros(count, np.float32)), MOST)
    assert np.array_equal(np.sort(order), np.arange(count))
    assert len(ends) == -(-count // MOST)
    assert all(np.ptp(run) < MOST for run in np.split(order, ends[:-1]) if len(run))
