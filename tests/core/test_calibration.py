"""Tracing again only what can differ: exact for every path, and good enough a judge to spend a budget by."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest

from lipac.core import analysis
from lipac.core.budget import Budget, Savings
from lipac.core.calibration import CONFIDENCE, Base, Search
from lipac.core.change import Change
from lipac.core.culling import CullOptions
from lipac.core.frames import Shot
from lipac.core.loop import Loop, Measurement
from lipac.core.path_log import RECORD, PathLog
from lipac.core.tiles import COLUMNS, ROWS, TILES

from .test_loop import stage


@pytest.fixture(scope="module")
def measured() -> tuple[Loop, Measurement]:
    loop = Loop(stage(), CullOptions(width=96, paths=4))
    loop.run()
    assert loop.measured is not None
    return loop, loop.measured


def cull_some(loop: Loop, m: Measurement, seed: int) -> tuple[np.ndarray, np.ndarray]:
    cull = np.random.default_rng(seed).random(len(m.tlas.ids)) < 0.4
    keep = np.zeros(len(loop.active), bool)
    keep[m.tlas.ids[~cull]] = True
    return cull, keep


@pytest.mark.parametrize("seed", range(3))
def test_paths_that_met_nothing_culled_do_not_change(measured: tuple[Loop, Measurement], seed: int) -> None:
    """Bit for bit; and those that are traced again alone come out as in a trace of all."""
    loop, m = measured
    cull, keep = cull_some(loop, m, seed)
    only = m.log.affected(cull)
    assert 0 < only.mean() < 1
    everything = loop.trace_paths(keep, m.first_sample, np.ones_like(only))[1]
    np.testing.assert_array_equal(everything[only == 0], m.log.luminance[only == 0])
    np.testing.assert_array_equal(loop.trace_paths(keep, m.first_sample, only)[1][only == 1], everything[only == 1])
    assert (everything[only == 1] != m.log.luminance[only == 1]).any()


def test_affected_against_a_plain_search() -> None:
    rng = np.random.default_rng(0)
    log = PathLog.zeros(3, 4, 5)
    log.records[..., 1:] = rng.integers(0, 40, log.records[..., 1:].shape)
    log.records[..., 0] = rng.integers(0, RECORD + 1, log.luminance.shape)
    culled = rng.random(40) < 0.1
    records = log.records.reshape(-1, RECORD)
    expected = [count == RECORD or culled[list(met[:count])].any() for count, met in zip(records[:, 0], records[:, 1:], strict=True)]
    assert log.affected(culled).ravel().tolist() == [int(x) for x in expected]


def test_step_by_step_is_as_at_once(measured: tuple[Loop, Measurement]) -> None:
    """Culling a set in three steps, each tracing only what it changes: luminances, records and changes as of a trace of every path without the whole set."""
    loop, m = measured
    base, log, after = Base(m.log), m.log.copy(), m.log.copy()  # what a trial's log held before does not matter
    trial = base.nothing()
    culled = np.zeros(len(m.tlas.ids), bool)
    for seed in range(3):
        more, _ = cull_some(loop, m, seed)
        only = log.affected(more & ~culled)
        keep = np.zeros(len(loop.active), bool)
        keep[m.tlas.ids[~(culled | more)]] = True
        assert 0 < only.mean() < 1
        loop.trace_without(m.tlas, m.first_sample, keep, only, after)
        trial = base.compare(only, after.luminance, log, trial)
        log.update(only, after)
        culled |= more
        everything = PathLog.zeros(*only.shape)
        loop.trace_without(m.tlas, m.first_sample, keep, np.ones_like(only), everything)
        np.testing.assert_array_equal(log.luminance, everything.luminance)
        entries = np.arange(RECORD) <= np.minimum(log.records[..., :1], RECORD - 1)  # what is behind them is nobody's
        np.testing.assert_array_equal(np.where(entries, log.records, 0), np.where(entries, everything.records, 0))
        assert not (culled[log.records[..., 1:]] & entries[..., 1:]).any()
        at_once = base.compare(m.log.affected(culled), everything.luminance, m.log, base.nothing())
        np.testing.assert_allclose(trial.change, at_once.change, atol=1e-12)
        np.testing.assert_allclose(trial.deviation, at_once.deviation, atol=1e-12)


def test_change_is_that_of_the_picture(measured: tuple[Loop, Measurement]) -> None:
    """By tiles, against the sums of whole pictures: equal but for float32 luminances, 1e-6 of the tile."""
    loop, m = measured
    base = Base(m.log)
    cull, keep = cull_some(loop, m, 1)
    only = m.log.affected(cull)
    luminance = loop.trace_paths(keep, m.first_sample, only)[1]
    trial = base.compare(only, luminance, m.log, base.nothing())
    height, width, samples = only.shape
    y, x = np.arange(height) * ROWS // height, np.arange(width) * COLUMNS // width
    tile = np.repeat((y[:, None] * COLUMNS + x[None, :]).ravel(), samples)
    a = np.bincount(tile, m.log.luminance.ravel(), TILES)
    b = np.bincount(tile, loop.trace_paths(keep, m.first_sample, np.ones_like(only))[1].ravel(), TILES)
    np.testing.assert_allclose(trial.change, (b - a) / base.light, atol=1e-6)


def test_a_difference_is_put_down_to_what_the_path_met_first() -> None:
    """Two paths meet entry 1, one of them after entry 0 and so for 0's account; entry 2 is not culled and has no row."""
    log = PathLog.zeros(ROWS, COLUMNS, 2)
    log.luminance[:] = 0.5
    log.records[0, 0, 0, :3], log.records[0, 0, 1, :3], log.records[0, 1, 0, :4] = (2, 2, 1), (1, 1, 0), (3, 2, 0, 1)
    culled = np.array([True, True, False])
    other = np.where(log.affected(culled) == 1, np.float32(0.25), np.float32(0))
    bounds = Base(log, confidence=2.0).bound_by_entry(culled, log.affected(culled), other, log)
    expected = np.zeros((2, TILES))
    expected[1, 0] = 2 * 0.25 + 2 * np.sqrt(2 * 0.25**2)
    expected[0, 1] = 0.25 + 2 * 0.25
    np.testing.assert_allclose(bounds, expected, atol=1e-12)  # a tile has two paths, of luminance 1 together


def test_a_search_goes_on_from_what_was_culled_before() -> None:
    """From a set that uses up little; where it uses up all but a factor of the hysteresis, that is the choice."""
    world = Additive(8)
    savings, worth = Savings.among(np.arange(8, dtype=np.int32), np.full(8, 1000)), np.full((8, TILES), 1e-4)
    before = np.arange(8) < 2
    budget = Budget(0.02, 0.2)
    on = Search(Base(world.log), world.log.copy(), world.without, worth, savings, budget, before=before).run()
    assert on.cull[before].all()
    assert on.cull.sum() > 2
    assert world.excess(on.cull, budget) <= 1
    kept = Search(Base(world.log), world.log.copy(), world.without, worth, savings, budget, before=before, hysteresis=1e3).run()
    assert (kept.cull == before).all()


def test_deviation_is_that_of_repeated_measurements() -> None:
    """The deviation that one measurement states, against the scatter of many: their ratio of variances, summed over tiles, within a quarter
    (40 repetitions of 144 tiles, some of them correlated by nothing: the scatter's own error is a few per cent)."""
    rng = np.random.default_rng(3)
    stated, changes = [], []
    for _ in range(40):
        log = PathLog.zeros(18, 32, 64)
        log.luminance[:] = 1.0
        other = log.luminance.copy()
        affected = rng.random(other.shape) < 0.05
        other[affected] = rng.exponential(2.0, int(affected.sum()))
        base = Base(log)
        trial = base.compare(affected.astype(np.uint8), other, log, base.nothing())
        stated.append(trial.deviation**2)
        changes.append(trial.change)
    assert np.mean(stated) == pytest.approx(np.var(changes, axis=0, ddof=1).mean(), rel=0.25)


class Additive:
    """A picture of one path per pixel that meets one entry each, which hides it where it is culled."""

    def __init__(self, entries: int) -> None:
        rng = np.random.default_rng(5)
        self.log = PathLog.zeros(36, 64, 4)
        self.log.luminance[:] = 1.0
        self.log.records[..., 0], self.log.records[..., 1] = 1, rng.integers(0, entries, self.log.luminance.shape)
        self.log.records[..., 1][rng.random(self.log.luminance.shape) < 0.9] = entries - 1  # most paths meet the last one
        self.traced = self.met = 0  # paths: that were asked for, and that met anything culled

    def without(self, cull: np.ndarray, only: np.ndarray) -> PathLog:
        self.traced += int(only.sum())
        self.met += int(self.log.affected(cull).sum())
        return PathLog(self.log.records, np.where(only == 1, np.float32(0.9), self.log.luminance))

    def excess(self, cull: np.ndarray, budget: Budget) -> float:
        """Of the true change, without margin."""
        only = self.log.affected(cull)
        base = Base(self.log)
        trial = base.compare(only, self.without(cull, only).luminance, self.log, base.nothing())
        return max(trial.mean / budget.mean, float(np.abs(trial.change).max()) / budget.worst)


def test_search_spends_the_budget_and_no_more() -> None:
    """Ten entries that are predicted to be worth ten times what they are: the search finds out, and comes near the best of all 1,024 sets."""
    world = Additive(10)
    budget = Budget(0.006, 0.03)
    savings = Savings.among(np.arange(10, dtype=np.int32), np.full(10, 1000))
    worth = np.zeros((10, TILES))
    for entry in range(10):
        only = world.log.affected(np.arange(10) == entry)
        worth[entry] = np.bincount(Base(world.log).tile, only.ravel(), TILES) / Base(world.log).light
    chosen = Search(Base(world.log), world.log.copy(), world.without, worth, savings, budget).run()
    assert 0 < world.traced < 0.7 * world.met  # larger sets at the cost of what is new in them
    assert world.excess(chosen.cull, budget) <= 1
    assert chosen.trial.worst >= np.abs(chosen.trial.change).max() + CONFIDENCE * chosen.trial.deviation.min()
    most = max(sum(s) for s in itertools.product((0, 1), repeat=10) if world.excess(np.array(s, bool), budget) <= 1)
    assert most - 2 <= chosen.cull.sum() <= most


def test_what_must_stay_stays_and_paths_are_limited() -> None:
    world = Additive(6)
    worth = np.full((6, TILES), 1e-6)
    worth[2] = np.inf
    search = Search(Base(world.log), world.log.copy(), world.without, worth, Savings.among(np.zeros(6, np.int32), np.array([100])), Budget(1.0, 1.0))
    chosen = search.run()
    assert not chosen.cull[2]
    assert chosen.cull.sum() >= 1
    assert search.traced <= world.log.luminance.size


def test_a_budget_of_nothing_culls_what_no_path_met() -> None:
    world = Additive(4)
    worth = np.vstack([np.full((4, TILES), 1e-3), np.zeros((1, TILES))])  # the fifth is met by no path
    chosen = Search(Base(world.log), world.log.copy(), world.without, worth, Savings.among(np.zeros(5, np.int32), np.array([100])), Budget(0.0, 0.0)).run()
    assert chosen.cull.tolist() == [False, False, False, False, True]


def test_a_measurement_in_two_parts_is_one_of_all_paths() -> None:
    """Counts, fixed-point sums and logs, bit for bit."""
    options = CullOptions(width=96, max_error=Budget(0.02, 0.1))
    loop = Loop(stage(), options)
    loop.run()
    first = loop.measured
    assert first is not None
    assert first.log.luminance.shape[2] == loop.first_samples < loop.samples
    both = loop.measure_on(first)
    loop.first_samples = loop.samples
    at_once = loop.measure(first.tlas)
    assert both.feedback.paths == at_once.feedback.paths == both.log.luminance.size
    for a, b in (
        (both.feedback.hits, at_once.feedback.hits),
        (both.weights.light, at_once.weights.light),
        (both.weights.total, at_once.weights.total),
        (both.log.records, at_once.log.records),
        (both.log.luminance, at_once.log.luminance),
    ):
        np.testing.assert_array_equal(a, b)


def test_more_paths_are_measured_where_more_than_a_little_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    """And the measurement says what the whole scene shows, whatever has been culled since."""
    options = CullOptions(width=96, max_error=Budget(0.02, 0.1))
    for share, refined in ((0.0, True), (1.0, False)):
        monkeypatch.setattr(analysis, "REFINED", share)
        loop = Loop(stage(), options)
        analysis.decide(loop)
        assert loop.measured is not None
        assert loop.measured.log.luminance.shape[2] == (loop.samples if refined else loop.first_samples)
        again = Loop(stage(), options)
        again.run()
        assert again.measured is not None
        np.testing.assert_array_equal(loop.measured.log.luminance[..., : loop.first_samples], again.measured.log.luminance)


def test_a_frame_after_one_that_needed_all_paths_measures_them_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(analysis, "REFINED", 0.0)
    searches: list[int] = []
    run = Search.run

    def counted(self: Search, *args: Any) -> Any:
        searches.append(self.log.luminance.shape[2])
        return run(self, *args)

    monkeypatch.setattr(Search, "run", counted)
    shot, scene = Shot(CullOptions(width=96, max_error=Budget(0.02, 0.1))), stage()
    shot.advance(scene)
    assert shot.loop is not None
    some, every = shot.loop.options.first_paths_per_pixel(scene.film), shot.loop.samples
    assert searches == [some, every]
    shot.advance(scene, Change(None, None, np.zeros(0, np.int32), np.zeros(0, np.int32), False, False))
    assert searches == [some, every, every]


def test_where_the_last_set_breaks_the_budget_another_is_searched_for() -> None:
    """Also where what is owed to the unseen uses up half of the budget as soon as anything changes at all."""
    world = Additive(10)
    savings, worth = Savings.among(np.arange(10, dtype=np.int32), np.full(10, 1000)), np.full((10, TILES), 1e-4)
    worth[0] = 0.0  # predicted to be worth nothing, though paths meet it
    budget, before = Budget(0.012, 0.3), np.arange(10) > 0

    def without(cull: np.ndarray, only: np.ndarray) -> PathLog:
        hidden = np.where(world.log.records[..., 1] == 0, np.float32(1 - 1e-6), np.float32(0.9))
        return PathLog(world.log.records, np.where(only == 1, hidden, world.log.luminance))

    def chosen(**more: Any) -> np.ndarray:
        return Search(Base(world.log), world.log.copy(), without, worth, savings, budget, unseen=0.02, **more).run().cull

    assert chosen(before=before, hysteresis=2.0).sum() == chosen().sum() > 1
