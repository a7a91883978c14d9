"""The shared statistics reject what is wrong, and what is right about as often as they say."""

from __future__ import annotations

import numpy as np
import pytest

from lipac.tests.stats import SIGNIFICANCE, assert_mean, chi_square, level, standard_error, z_limit


def test_limits_are_those_of_the_tables() -> None:
    assert z_limit(1, 0.05) == pytest.approx(1.95996, abs=1e-5)
    assert z_limit(1, 0.0027) == pytest.approx(3.0, abs=1e-3)
    assert 1 - (1 - level(250)) ** 250 == pytest.approx(SIGNIFICANCE, rel=1e-9)


def test_a_right_mean_passes_and_a_wrong_one_fails() -> None:
    """Of 20,000 right means at 5 %: a twentieth fails, to three deviations of a binomial; one that is off by ten errors
    is found."""
    rng = np.random.default_rng(0)
    samples = rng.standard_normal((100, 20000))
    failed = np.abs(samples.mean(0)) > z_limit(1, 0.05) * standard_error(samples)
    # Student's t with 99 degrees of freedom: 5.28 %.
    assert failed.mean() == pytest.approx(0.0528, abs=3 * np.sqrt(0.05 * 0.95 / 20000))
    error = standard_error(samples[:, :50])
    assert_mean(samples[:, :50].mean(0), 0.0, error)
    with pytest.raises(AssertionError, match="bright"):
        assert_mean(samples[:, :50].mean(0) + 10 * error * (np.arange(50) == 7), 0.0, error, what="bright")


def test_chi_square_is_uniform_where_counts_are_right() -> None:
    rng = np.random.default_rng(1)
    wanted = np.array([200.0, 50.0, 20.0, 3.0, 1.0, 0.5, 0.0])
    p = np.array([chi_square(rng.poisson(wanted), wanted) for _ in range(3000)])
    assert (p < 0.1).mean() == pytest.approx(0.1, abs=0.025)
    assert chi_square(rng.poisson(wanted * [1.5, 1, 1, 1, 1, 1, 1]), wanted) < 1e-4
    assert chi_square([200, 50, 20, 3, 1, 0, 0], wanted) > 0.5
    assert chi_square([0, 0, 0, 1], [0.0, 0.0, 0.0, 0.0]) == 0.0
