"""Random numbers are uniform and independent; warps land where they should."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from lipac.core.jit import sampling

F = np.float32
U = np.uint64


def numbers(count: int, pixel: int = 0, dimension: int = 0, seed: int = 1) -> np.ndarray:
    return np.array(
        [sampling.uniform2(U(sampling.path_key(U(seed), U(pixel), U(k))), U(dimension)) for k in range(count)]
    )


def test_numbers_are_uniform_in_the_square() -> None:
    x = numbers(8000)
    assert x.dtype == np.float32 or x.max() < 1.0
    observed = np.histogram2d(x[:, 0], x[:, 1], bins=10, range=[[0, 1], [0, 1]])[0].ravel()
    assert stats.chisquare(observed).pvalue > 1e-4
    assert x.min() >= 0.0 and x.max() < 1.0


@pytest.mark.parametrize("other", [{"pixel": 1}, {"dimension": 1}, {"seed": 2}, {"pixel": 1 << 20}])
def test_pixels_dimensions_and_seeds_are_independent(other: dict[str, int]) -> None:
    a, b = numbers(4000)[:, 0], numbers(4000, **other)[:, 0]
    # Correlation of independent uniforms has standard deviation 1 / sqrt(n): five of them
    assert abs(np.corrcoef(a, b)[0, 1]) < 5 / np.sqrt(len(a))
    assert (a != b).mean() > 0.99


def test_same_key_same_number() -> None:
    assert (numbers(10) == numbers(10)).all()


def test_disk_is_uniform() -> None:
    p = np.array([sampling.disk(F(a), F(b)) for a, b in numbers(6000)])
    radius2 = (p**2).sum(1)
    angle = np.arctan2(p[:, 1], p[:, 0]) / (2 * np.pi) % 1.0
    assert stats.kstest(radius2, "uniform").pvalue > 1e-4
    assert stats.kstest(angle, "uniform").pvalue > 1e-4


def test_sphere_and_cone_are_uniform() -> None:
    z = np.array([sampling.sphere(F(a), F(b))[2] for a, b in numbers(4000)])
    assert stats.kstest((z + 1) / 2, "uniform").pvalue > 1e-4
    axis = np.array([0.6, -0.48, 0.64], np.float32)
    d = np.array([sampling.cone(*axis, F(0.3), F(a), F(b)) for a, b in numbers(4000)])
    assert np.linalg.norm(d, axis=1) == pytest.approx(1.0, abs=1e-6)
    assert stats.kstest((1 - d @ axis) / 0.3, "uniform").pvalue > 1e-4


def test_basis_is_right_handed_and_orthonormal() -> None:
    rng = np.random.default_rng(0)
    for v in [*rng.normal(size=(50, 3)), np.array([0, 0, -1.0]), np.array([0, 0, 1.0])]:
        n = (v / np.linalg.norm(v)).astype(np.float32)
        b = np.array(sampling.basis(*n))
        frame = np.stack([b[:3], b[3:], n])
        assert frame @ frame.T == pytest.approx(np.eye(3), abs=2e-6)
        assert np.linalg.det(frame) == pytest.approx(1.0, abs=2e-6)


def test_power_heuristic_sums_to_one() -> None:
    for a, b in ((1.0, 3.0), (1e-3, 5.0), (1e7, 1e8)):
        assert sampling.power_heuristic(F(a), F(b)) + sampling.power_heuristic(F(b), F(a)) == pytest.approx(
            1.0, abs=1e-6
        )
    assert sampling.power_heuristic(F(1e30), F(1.0)) == 1.0
