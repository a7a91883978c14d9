"""Composition, checks and boxes of instance transforms, against NumPy in float64."""

from __future__ import annotations

import numpy as np
import pytest

from lipac.core.scene.placing import compose_rows, finish, usable_transforms


def random_transforms(n: int, seed: int) -> np.ndarray:
    """(n, 3, 4) float64, float32 values."""
    return np.random.default_rng(seed).normal(size=(n, 3, 4)).astype(np.float32).astype(np.float64)


def test_compose_rows() -> None:
    """Product of the selected pairs, columns as Blender stores them."""
    parents, local = random_transforms(3, 0), random_transforms(5, 1)
    columns = np.zeros((5, 4, 4), np.float32)
    columns[:, :, :3] = local.transpose(0, 2, 1)
    columns[:, 3, 3] = 1
    placement, rows = np.array([0, 2, 2, 1]), np.array([4, 0, 3, 3])
    out = np.empty((4, 3, 4))
    compose_rows(parents, placement, columns, rows, out)
    square = [np.vstack((m, [0, 0, 0, 1])) for m in local]
    expected = [parents[p] @ square[r] for p, r in zip(placement, rows, strict=True)]
    np.testing.assert_allclose(out, expected, rtol=0, atol=1e-14)  # a few roundings of float64 near 1


def test_finish_boxes_enclose_tightly() -> None:
    """World boxes hold all corners in float64 and exceed them by float32's rounding only; far away the origin goes
    first."""
    transform, origin = random_transforms(200, 2), np.array([1e6, -2e6, 5.0])
    transform[:, :, 3] += origin
    low, high = np.array([-1.0, 0.5, -3.0]), np.array([2.0, 0.75, 4.0])
    out, bounds, good = np.empty((200, 3, 4), np.float32), np.empty((200, 2, 3), np.float32), np.empty(200, np.bool_)
    usable, stretch = finish(transform, origin, low, high, out, bounds, good)
    assert usable == 200
    assert stretch == pytest.approx(np.linalg.norm(transform[:, :, :3], axis=1).max(), rel=1e-12)
    corners = np.stack(np.meshgrid(*zip(low, high, strict=True), indexing="ij"), axis=-1).reshape(8, 3)
    world = np.einsum("nij,kj->nki", transform[:, :, :3], corners) + (transform[:, :, 3] - origin)[:, None]
    tolerance = 4 * np.finfo(np.float32).eps * np.abs(world).max()
    for side, exact, sign in ((0, world.min(axis=1), 1), (1, world.max(axis=1), -1)):
        gap = sign * (exact - bounds[:, side])
        assert (gap >= -1e-9).all()  # float64 roundings of 1e6
        assert (gap <= tolerance).all()
    np.testing.assert_array_equal(out[:, :, 3], (transform[:, :, 3] - origin).astype(np.float32))


def test_usable() -> None:
    """Not finite, collapsed, sheared flat and absurdly large transforms are told apart from tiny and thin ones."""
    m = np.repeat(np.eye(3, 4)[None], 8, axis=0)
    m[0, 0, 0] = np.nan
    m[1, 2, 3] = np.inf
    m[2, 1, 1] = 0
    m[3, :, 2] = m[3, :, 0] + m[3, :, 1]
    m[4, 0, 3] = 1e19
    m[5, :, :3] *= 1e-6
    m[6, 2, 2] = 1e-9
    m[7, 0, 0] = -1
    assert usable_transforms(m).tolist() == [False] * 5 + [True] * 3
