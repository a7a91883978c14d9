"""Tracing again only what can differ: exact for every path, and good enough a judge to spend a budget by."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from lipac.core.culling.loop import Loop
from lipac.core.culling.measurement import Measurement
from lipac.core.culling.options import CullOptions
from lipac.core.error_budget.budget import Budget, Savings
from lipac.core.error_budget.error_estimate import Light, Reference
from lipac.core.error_budget.search import LIKELY, Search, gain, gain_of_all, pieces
from lipac.core.error_budget.trial import Trial
from lipac.core.error_budget.units import Units
from lipac.core.feedback.path_log import RECORD, PathLog
from lipac.core.feedback.tiles import TILES

from ..culling.test_loop import stage


@pytest.fixture(scope="module")
def measured() -> tuple[Loop, Measurement]:
    loop = Loop(stage(), CullOptions(width=96, paths=4))
    loop.run()
    assert loop.measured is not None
    return loop, loop.measured


def cull_some(loop: Loop, m: Measurement, seed: int) -> tuple[np.ndarray, np.ndarray]:
    cull = np.random.default_rng(seed).random(len(m.tlas.ids)) < 0.4
    keep = np.zeros(len(loop.activation), bool)
    keep[m.tlas.ids[~cull]] = True
    return cull, keep


def everything_of(log: PathLog) -> PathLog:
    return log.copy(np.ones(log.shape, np.uint8))


@pytest.mark.parametrize("seed", range(3))
def test_paths_that_met_nothing_culled_do_not_change(measured: tuple[Loop, Measurement], seed: int) -> None:
    """Bit for bit; and those that are traced again alone come out as in a trace of all."""
    loop, m = measured
    cull, keep = cull_some(loop, m, seed)
    only = m.log.affected(cull)
    assert 0 < only.mean() < 1
    everything = loop.tracer.trace_paths(keep, m.traced[0].first_sample, np.ones_like(only))[1]
    np.testing.assert_array_equal(everything[only == 0], m.log.color[only == 0])
    np.testing.assert_array_equal(
        loop.tracer.trace_paths(keep, m.traced[0].first_sample, only)[1][only == 1], everything[only == 1]
    )
    assert (everything[only == 1] != m.log.color[only == 1]).any()


def test_affected_against_a_plain_search() -> None:
    rng = np.random.default_rng(0)
    log = PathLog.zeros(3, 4, 5)
    log.records[..., 1:] = rng.integers(0, 40, log.records[..., 1:].shape)
    log.records[..., 0] = rng.integers(0, RECORD + 1, log.luminance.shape)
    culled = rng.random(40) < 0.1
    records = log.records.reshape(-1, RECORD)
    expected = [
        count == RECORD or culled[list(met[:count])].any()
        for count, met in zip(records[:, 0], records[:, 1:], strict=True)
    ]
    assert log.affected(culled).ravel().tolist() == [int(x) for x in expected]


def test_step_by_step_is_as_at_once(measured: tuple[Loop, Measurement]) -> None:
    """Culling a set in three steps, each tracing only what it changes: colours, records and changes as of a trace of
    every path without the whole set."""
    loop, m = measured
    # what a trial's log held before does not matter
    reference, log, after = Reference(m.log), everything_of(m.log), everything_of(m.log)
    difference = reference.nothing
    culled = np.zeros(len(m.tlas.ids), bool)
    for seed in range(3):
        more, _ = cull_some(loop, m, seed)
        only = log.affected(more & ~culled)
        keep = np.zeros(len(loop.activation), bool)
        keep[m.tlas.ids[~(culled | more)]] = True
        assert 0 < only.mean() < 1
        loop.tracer.trace_without(m.tlas, m.traced[0].first_sample, keep, loop.tracer.build(keep), only, after)
        difference = reference.compare(only, after.color, log, difference)
        log.update(only, after)
        culled |= more
        everything = PathLog.zeros(*only.shape)
        loop.tracer.trace_without(
            m.tlas, m.traced[0].first_sample, keep, loop.tracer.build(keep), np.ones_like(only), everything
        )
        np.testing.assert_array_equal(log.color, everything.color)
        entries = np.arange(RECORD) <= np.minimum(log.records[..., :1], RECORD - 1)  # what is behind them is nobody's
        np.testing.assert_array_equal(np.where(entries, log.records, 0), np.where(entries, everything.records, 0))
        assert not (culled[log.records[..., 1:]] & entries[..., 1:]).any()
        at_once = reference.compare(m.log.affected(culled), everything.color, m.log, reference.nothing)
        np.testing.assert_allclose(difference.pixels, at_once.pixels, atol=1e-9)  # sums of float64 in another order
        np.testing.assert_allclose(difference.squares, at_once.squares, atol=1e-9)


def test_a_difference_is_put_down_to_what_the_path_met_first() -> None:
    """Two paths meet entry 1, one of them after entry 0 and so for 0's account; entry 2 is not culled and has no row.
    Units are entries here."""
    log = PathLog.zeros(9, 16, 2)
    log.color[:] = 0.5
    log.records[0, 0, 0, :3], log.records[0, 0, 1, :3], log.records[0, 1, 0, :4] = (2, 2, 1), (1, 1, 0), (3, 2, 0, 1)
    culled = np.array([True, True, False])
    only = log.affected(culled)
    other = np.where(only[..., None] == 1, np.float32(0.25), np.zeros(3, np.float32))
    reference = Reference(log)
    found = reference.changes_by_unit(np.arange(3, dtype=np.int32), culled, only, other, log, Light.of(reference))
    change, squares = np.zeros((2, 2, TILES))
    change[1, 0], squares[1, 0] = 2 * -0.25, 2 * 0.25**2
    change[0, 1], squares[0, 1] = -0.25, 0.25**2
    # a tile has two paths, of luminance 1 together; its weights sum to 1 in float32
    np.testing.assert_allclose(found, (change, squares), atol=1e-7)


def test_a_search_goes_on_from_what_was_culled_before() -> None:
    """From a set that uses up little; where it uses up all but a factor of the hysteresis, that is the choice."""
    world = Additive(8)
    savings, worth = Savings.among(np.arange(8, dtype=np.int32), np.full(8, 1000)), np.full((8, TILES), 1e-4)
    before = np.arange(8) < 2
    budget = Budget(0.02, 0.2)
    on = world.search(worth, savings, budget, before=before).run()[-1]
    assert on.cull[before].all()
    assert on.cull.sum() > 2
    assert world.excess(on.cull, budget) <= 1
    (kept,) = world.search(worth, savings, budget, before=before, hysteresis=1e3).run()
    assert (kept.cull == before).all()


class Additive:
    """A picture of paths that meet one entry each, which hides it where it is culled."""

    def __init__(self, entries: int) -> None:
        rng = np.random.default_rng(5)
        self.log = PathLog.zeros(36, 64, 16)
        self.log.color[:] = 1.0
        self.log.records[..., 0], self.log.records[..., 1] = 1, rng.integers(0, entries, self.log.shape)
        self.log.records[..., 1][rng.random(self.log.shape) < 0.9] = entries - 1  # most paths meet the last one
        self.traced = self.met = 0  # paths: that were asked for, and that met anything culled

    def without(self, cull: np.ndarray, only: np.ndarray) -> PathLog:
        self.traced += int(only.sum())
        self.met += int(self.log.affected(cull).sum())
        return PathLog(self.log.records, np.where(only[..., None] == 1, np.float32(0.9), self.log.color))

    def search(self, worth: np.ndarray, savings: Savings, budget: Budget, **more: Any) -> Search:
        return Search(
            [Trial(Reference(self.log), everything_of(self.log), self.without)],
            Units.single(worth),
            savings,
            budget,
            **more,
        )

    def excess(self, cull: np.ndarray, budget: Budget) -> float:
        """Of the true change, without margin."""
        only = self.log.affected(cull)
        reference = Reference(self.log)
        difference = reference.compare(only, self.without(cull, only).color, self.log, reference.nothing)
        estimate = Light.of(reference).estimate(difference)
        return max(estimate.mean / budget.mean, estimate.worst / budget.worst)


def test_search_spends_the_budget_and_no_more() -> None:
    """Ten entries that are predicted to be worth ten times what they are: the search finds out, and comes near the best
    of all 1,024 sets."""
    world = Additive(10)
    budget = Budget(0.006, 0.03)
    savings = Savings.among(np.arange(10, dtype=np.int32), np.full(10, 1000))
    worth = np.zeros((10, TILES))
    for entry in range(10):
        only = world.log.affected(np.arange(10) == entry)
        # paths of a tile
        worth[entry] = np.bincount(np.repeat(Reference(world.log).tile, 16), only.ravel(), TILES) / 256
    steps = world.search(worth, savings, budget).run()
    chosen = steps[-1]
    assert 0 < world.traced < 0.7 * world.met  # larger sets at the cost of what is new in them
    assert world.excess(chosen.cull, budget) <= 1
    assert chosen.estimate.excess(budget, LIKELY) <= 1
    assert all(not (a.cull & ~b.cull).any() for a, b in itertools.pairwise(steps))
    most = max(sum(s) for s in itertools.product((0, 1), repeat=10) if world.excess(np.array(s, bool), budget) <= 1)
    assert most - 2 <= chosen.cull.sum() <= most


def test_what_lies_between_two_sets_is_cut_into_pieces_of_equal_worth() -> None:
    units = Units.single(np.repeat(np.arange(9.0)[:, None], TILES, axis=1))
    sets = pieces(np.arange(9) < 1, np.arange(9) < 9, units)
    # 1 + 2 + 3 are less than a quarter of 36, with 4 and 5 less than a half
    assert [int(x.sum()) for x in sets] == [4, 6, 7]
    assert pieces(np.arange(9) < 8, np.arange(9) < 9, units) == []  # one unit is one piece


def test_two_traces_are_one_measurement() -> None:
    """Paths of two trials count as those of one of both; what is proposed costs paths only where it is new."""
    world = Additive(6)
    both = Reference(world.log)
    halves = [np.arange(16) < 8, np.arange(16) >= 8]
    only = [np.broadcast_to(half, world.log.shape).astype(np.uint8) for half in halves]
    trials = [Trial(Reference(world.log, marked), world.log.copy(marked), world.without, marked) for marked in only]
    for culled in (1, 3):
        cull = np.arange(6) < culled
        world.traced = 0
        paths = sum(trial.propose(cull) for trial in trials)
        difference = trials[0].trace() + trials[1].trace()
        assert paths == world.traced > 0
        whole = both.compare(
            world.log.affected(cull), world.without(cull, world.log.affected(cull)).color, world.log, both.nothing
        )
        np.testing.assert_allclose(difference.squares, whole.squares, atol=1e-9)  # sums of float64 in another order
        np.testing.assert_allclose(difference.pixels.sum(axis=0), whole.pixels.sum(axis=0), atol=1e-9)
        for trial in trials:
            trial.accept()
        assert sum(trial.propose(cull) for trial in trials) == 0


def test_sets_that_are_given_up_for_noise_are_doubted() -> None:
    """A set whose change is half of the bound, by too few paths to be sure: the tiles that it changes are; a set that
    changes far too much leaves no doubt."""
    world = Additive(2)
    savings = Savings.among(np.arange(2, dtype=np.int32), np.full(2, 1000))
    worth = np.full((2, TILES), 1e-4)
    worth[1] = np.inf
    change = world.search(worth, savings, Budget(1.0, 1.0)).run()[-1].estimate
    noisy = world.search(worth, savings, Budget(1.0, change.worst + 0.5 * change.worst_deviation))
    noisy.run()
    assert noisy.doubted.any()
    assert noisy.promise == 0.5  # one of the two would go
    hopeless = world.search(worth, savings, Budget(1.0, 0.05 * change.worst))
    hopeless.run()
    assert not hopeless.doubted.any()
    assert hopeless.promise == 0


def test_a_gain_is_of_what_stays() -> None:
    """Four units, one of them 97 instances: by number, and by bytes where a mesh is large."""
    members = np.array([97, 1, 1, 1])
    units = replace(Units.single(np.zeros((4, TILES))), members=members)
    alike = Savings.among(np.arange(4, dtype=np.int32), np.full(4, 1000))
    nothing, first, both = np.zeros(4, bool), np.arange(4) < 1, np.arange(4) < 2
    assert gain(units, alike, nothing, first) == 0.97
    assert gain(units, alike, first, both) == pytest.approx(1 / 3)
    large = Savings.among(np.arange(4, dtype=np.int32), np.array([10, 10**6, 10, 10]))
    assert gain(units, large, first, both) > 0.99
    assert gain(units, alike, both, both) == 0
    assert gain_of_all(units, alike, nothing, first) == 0.97
    assert gain_of_all(units, alike, first, both) == pytest.approx(1 / 4)  # of bytes; of instances a hundredth
    assert gain_of_all(units, alike, both, both) == 0
    shared = Savings.among(np.zeros(4, np.int32), np.array([10**6]))
    assert gain_of_all(units, shared, np.arange(4) < 3, np.ones(4, bool)) == pytest.approx(1 / 4)
    assert gain(units, shared, np.arange(4) < 3, np.ones(4, bool)) == 1


def test_what_must_stay_stays_and_paths_are_limited() -> None:
    world = Additive(6)
    worth = np.full((6, TILES), 1e-6)
    worth[2] = np.inf
    search = world.search(worth, Savings.among(np.zeros(6, np.int32), np.array([100])), Budget(1.0, 1.0))
    chosen = search.run()[-1]
    assert not chosen.cull[2]
    assert chosen.cull.sum() >= 1
    assert search.traced <= np.prod(world.log.shape)


def test_a_budget_of_nothing_culls_what_no_path_met() -> None:
    world = Additive(4)
    worth = np.vstack([np.full((4, TILES), 1e-3), np.zeros((1, TILES))])  # the fifth is met by no path
    chosen = world.search(worth, Savings.among(np.zeros(5, np.int32), np.array([100])), Budget(0.0, 0.0)).run()[-1]
    assert chosen.cull.tolist() == [False, False, False, False, True]


def test_where_the_last_set_breaks_the_budget_another_is_searched_for() -> None:
    world = Additive(10)
    savings, worth = Savings.among(np.arange(10, dtype=np.int32), np.full(10, 1000)), np.full((10, TILES), 1e-4)
    budget, before = Budget(0.012, 0.3), np.arange(10) > 0
    chosen = world.search(worth, savings, budget).run()[-1]
    assert (
        world.search(worth, savings, budget, before=before, hysteresis=2.0).run()[-1].cull.sum()
        == chosen.cull.sum()
        > 1
    )
