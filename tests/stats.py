"""Statistics that tests share: how far chance may take a figure, at one significance for everything that a test
compares.

A limit is derived, not set: `SIGNIFICANCE` is the probability that a right program fails a whole test, for random
numbers of any seed (with the fixed seeds of a test it passes for good); Sidak's correction shares it among the
comparisons.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

SIGNIFICANCE = 1e-3


def level(comparisons: int, significance: float = SIGNIFICANCE) -> float:
    """Significance of each of so many comparisons (Sidak)."""
    return float(-np.expm1(np.log1p(-significance) / comparisons))


def z_limit(comparisons: int, significance: float = SIGNIFICANCE) -> float:
    """Standard errors (two-sided, normal) that none of so many comparisons exceeds, but by chance at the
    significance."""
    return float(stats.norm.isf(level(comparisons, significance) / 2))


def standard_error(samples: Any, axis: int = 0) -> NDArray[np.float64]:
    """Of the mean of independent samples along an axis."""
    samples = np.asarray(samples, np.float64)
    return samples.std(axis, ddof=1) / np.sqrt(samples.shape[axis])


def assert_mean(
    found: Any, wanted: Any, error: Any, comparisons: int | None = None, bias: Any = 0.0, what: object = ""
) -> None:
    """Z-test of means, elementwise. error: standard error of found - wanted; bias: what may differ without noise
    (rounding, tables), stated by the test.

    comparisons: all that the test makes; of this call alone if not given. Raises AssertionError.
    """
    off = np.abs(np.asarray(found, np.float64) - wanted)
    limit = z_limit(comparisons or off.size) * np.asarray(error) + bias
    assert (off <= limit).all(), f"{what} {found} instead of {wanted}: off by {off}, where {limit} is chance"


def chi_square(observed: Any, expected: Any, bias: float = 0.0, least: float = 5.0) -> float:
    """P-value of counts against expected ones; cells that expect fewer than `least` are taken together (Cochran). bias:
    relative error of `expected` itself.

    The expected counts need not sum to the observed: no degree of freedom is taken off.
    """
    observed, expected = np.ravel(observed).astype(np.float64), np.ravel(expected).astype(np.float64)
    rare = expected < least
    if rare.any():
        observed, expected = (
            np.append(observed[~rare], observed[rare].sum()),
            np.append(expected[~rare], expected[rare].sum()),
        )
    kept = expected > 0
    if (observed[~kept] > 0).any():
        return 0.0  # what cannot happen did
    observed, expected = observed[kept], expected[kept]
    return float(stats.chi2.sf(((observed - expected) ** 2 / (expected + (bias * expected) ** 2)).sum(), len(expected)))
