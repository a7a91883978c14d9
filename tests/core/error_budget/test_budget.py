"""Selection under an error budget: bounds hold, what is worth nothing goes, what saves most goes first."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from lipac.core.error_budget import budget
from lipac.core.errors import InputError


def test_budget_from_the_command_line() -> None:
    assert budget.Budget.parse("0.01") == budget.Budget(0.01, 0.05)
    assert budget.Budget.parse("0.02,0.03") == budget.Budget(0.02, 0.03)
    assert budget.Budget.parse("0.5").worst == 1.0
    assert budget.Budget.parse("1%") == budget.Budget(0.01, 0.05)
    assert budget.Budget.parse("0.5 %, 100%") == budget.Budget(0.005, 1.0)
    for text in ("", "a", "0.1,0.2,0.3", "-0.1", "1", "2", "0.1,1", "nan", "%", "101%", "-1%", "nan%"):
        with pytest.raises(InputError, match="--max-error"):
            budget.Budget.parse(text)


def test_bounds_hold_and_are_used() -> None:
    rng = np.random.default_rng(0)
    weights = rng.exponential(1e-3, (500, 144)) * (rng.random((500, 144)) < 0.05) * 10 ** rng.uniform(-2, 2, (500, 1))
    chosen = budget.select(weights, np.ones(500), 0.01, 0.05)
    sums = weights[chosen.cull].sum(axis=0)
    assert sums.max() <= 0.05
    assert sums.mean() <= 0.01
    np.testing.assert_allclose([chosen.mean, chosen.worst], [sums.mean(), sums.max()])
    assert 50 < chosen.cull.sum() < 500
    for i in np.flatnonzero(~chosen.cull):  # nothing more would have fitted
        more = sums + weights[i]
        assert more.max() > 0.05 or more.mean() > 0.01


def test_greedy_is_near_the_best_set() -> None:
    rng = np.random.default_rng(1)
    for _ in range(20):
        weights, saved = rng.exponential(0.01, (12, 4)), rng.uniform(1, 100, 12)
        chosen = budget.select(weights, saved, 0.03, 0.06)
        best = 0.0
        for subset in itertools.product((False, True), repeat=12):
            sums = weights[list(subset)].sum(axis=0)
            if sums.mean() <= 0.03 and sums.max() <= 0.06:
                best = max(best, saved[list(subset)].sum())
        assert saved[chosen.cull].sum() >= best - saved.max()


def test_a_zero_budget_keeps_all_that_is_worth_anything() -> None:
    weights = np.array([[0.0, 0.0], [1e-9, 0.0], [0.0, 0.5]])
    assert budget.select(weights, np.ones(3), 0.0, 0.0).cull.tolist() == [True, False, False]


def test_a_shared_blas_is_counted_once() -> None:
    savings = budget.Savings.among(np.array([0, 0, 0, 0, 1]), np.array([4000, 1000]))
    assert savings.share.sum() == pytest.approx(5000 + 5 * budget.ENTRY_BYTES)
    # fewer share it, each more of it
    for stay, left in (([False, False, False, True, True], 5000), ([True, True, False, False, False], 4000)):
        rest = savings.among_these(np.array(stay))
        assert rest.share.sum() == pytest.approx(left + 2 * budget.ENTRY_BYTES)


def test_what_is_rather_to_stay_saves_less_also_where_others_are_gone() -> None:
    savings = budget.Savings.among(np.array([0, 0, 1]), np.array([4000, 1000]), np.array([1.0, 2.0, 4.0]))
    plain = budget.Savings.among(np.array([0, 1]), np.array([4000, 1000]))
    assert savings.among_these(np.array([False, True, True])).share == pytest.approx(plain.share / [2.0, 4.0])
