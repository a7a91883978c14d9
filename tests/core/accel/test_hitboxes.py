"""Hitbox crossings are counted exactly: against brute force over the same arithmetic."""

from __future__ import annotations

import numpy as np
import pytest
from numba import njit

from lipac.core.accel import embree, hitboxes
from lipac.core.scene.model import RAY_TYPES


def rays(count: int, boxes: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Origins, directions and ends: random ones, axis-aligned ones with zeros of both signs, origins on faces, corners
    and inside of boxes."""
    rng = np.random.default_rng(7)
    origin = rng.uniform(-12, 12, (count, 3)).astype(np.float32)
    direction = rng.normal(size=(count, 3)).astype(np.float32)
    direction[::7, 0] = 0.0
    direction[::11, 1] = -0.0
    direction[::77, 1:] = 0.0, 1.0
    some = boxes[rng.integers(0, len(boxes), count)]
    origin[::5] = some[::5, 0]
    origin[1::5, 0] = some[1::5, 1, 0]
    origin[2::5] = some[2::5].mean(axis=1)
    return origin, direction, rng.uniform(0, 25, count).astype(np.float32)


@njit(nogil=True)
def traced(handle, counters, query, origin, direction, far, nearest):
    ray = np.zeros(embree.RAY, np.float32)
    for i in range(len(origin)):
        embree.set_ray(
            ray, origin[i, 0], origin[i, 1], origin[i, 2], direction[i, 0], direction[i, 1], direction[i, 2], 0.0, 1e30,
            1
        )
        hitboxes.count_crossings(handle, counters, query, ray, far[i], i % RAY_TYPES, nearest)


def brute_force(
    boxes: np.ndarray, origin: np.ndarray, direction: np.ndarray, far: np.ndarray, nearest: int
) -> np.ndarray:
    """The slab test of every ray with every box, in NumPy's float64."""
    counters = np.zeros((len(boxes), RAY_TYPES), np.int64)
    low, high = boxes[:, 0].astype(float), boxes[:, 1].astype(float)
    for i in range(len(origin)):
        o, d = origin[i].astype(float), direction[i].astype(float)
        with np.errstate(divide="ignore", invalid="ignore"):
            a, b = (low - o) / d, (high - o) / d
        inside = (o >= low) & (o <= high)
        a, b = (
            np.where(d == 0, np.where(inside, -np.inf, np.inf), a),
            np.where(d == 0, np.where(inside, np.inf, -np.inf), b),
        )
        near = np.maximum(np.minimum(a, b).max(axis=1), 0)
        near = np.where((d == 0) & ~inside, np.inf, 0).max(axis=1) + near
        met = near <= np.minimum(np.maximum(a, b).min(axis=1), float(far[i]))
        ids = np.flatnonzero(met)
        if nearest:
            ids = ids[np.lexsort((ids, near[ids]))][:nearest]
        counters[ids, i % RAY_TYPES] += 1
    return counters


@pytest.mark.parametrize("nearest", [hitboxes.ALL_CROSSINGS, 1, 4, hitboxes.MAX_NEAREST])
def test_counts_equal_brute_force(nearest: int) -> None:
    rng = np.random.default_rng(3)
    center, half = rng.uniform(-10, 10, (3000, 3)), rng.uniform(0.0, 1.5, (3000, 3))
    half[::50] = 0.0  # boxes without extent count too
    boxes = np.stack([center - half, center + half], axis=1).astype(np.float32)
    boxes[1::50] = boxes[:1]  # many at one place
    origin, direction, far = rays(1500, boxes)
    subject = hitboxes.Hitboxes(boxes)
    traced(subject.handle, subject.counters, np.zeros(hitboxes.QUERY, np.int64), origin, direction, far, nearest)
    expected = brute_force(boxes, origin, direction, far, nearest)
    assert expected.sum() > 1000
    np.testing.assert_array_equal(subject.counters, expected)


def test_no_boxes_cost_nothing() -> None:
    subject = hitboxes.Hitboxes(np.zeros((0, 2, 3), np.float32))
    assert subject.handle == 0
    assert subject.bytes == 0
    traced(
        subject.handle,
        subject.counters,
        np.zeros(hitboxes.QUERY, np.int64),
        *rays(3, np.zeros((1, 2, 3), np.float32)),
        4,
    )


def test_the_ray_is_left_as_it_was() -> None:
    subject = hitboxes.Hitboxes(np.array([[[-1, -1, -1], [1, 1, 1]]], np.float32))
    ray = np.arange(embree.RAY, dtype=np.float32)
    before = ray.copy()
    count_one(subject.handle, subject.counters, np.zeros(hitboxes.QUERY, np.int64), ray)
    np.testing.assert_array_equal(ray, before)


@njit(nogil=True)
def count_one(handle, counters, query, ray):
    hitboxes.count_crossings(handle, counters, query, ray, 5.0, 0, 0)
