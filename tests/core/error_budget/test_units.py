"""Instances that paths have met often are judged alone, others with their neighbours, and what no path met is worth
what was met once."""

from __future__ import annotations

import numpy as np
import pytest

from lipac.core.accel.region_tree import FANOUT, Regions
from lipac.core.error_budget.budget import ENTRY_BYTES, Savings
from lipac.core.error_budget.units import EVIDENCE, Units, units_of
from lipac.core.feedback.tiles import TILES


def field(count: int) -> Regions:
    """Small boxes in a row."""
    bounds = np.zeros((count, 2, 3), np.float32)
    bounds[:, 0, 0] = np.arange(count)
    bounds[:, 1] = bounds[:, 0] + 0.5
    return Regions(bounds)


def grouped(regions: Regions, met: np.ndarray, pinned: np.ndarray | None = None, light: float = 1.0) -> Units:
    """Units where (N,) paths met each instance; what none met is not built. Each path is worth `light` in the first
    tile."""
    ids = np.flatnonzero(met).astype(np.int32)
    worth = np.zeros((len(ids), TILES))
    worth[:, 0] = light * met[ids]
    return units_of(
        regions, ids, met[ids].astype(np.int64), worth, np.zeros(len(met), bool) if pinned is None else pinned
    )


@pytest.mark.parametrize("count", [1, 5, 8, 9, 100, 4097])
def test_every_instance_is_in_one_unit(count: int) -> None:
    rng = np.random.default_rng(count)
    regions, met = field(count), rng.poisson(2.0, count) * (rng.random(count) < 0.7)
    units = grouped(regions, met)
    assert units.members.sum() == count
    assert (units.members >= 0).all()
    assert units.members[units.with_entries :].sum() == (met == 0).sum()
    assert units.worth[: units.with_entries, 0].sum() == met.sum()


def test_often_met_instances_stand_alone_and_thin_ones_are_pooled() -> None:
    met = np.zeros(64, int)
    met[3], met[8:16] = EVIDENCE, 1  # along the curve neighbours are neighbours
    units = grouped(field(64), met)
    singles = np.bincount(units.of_entry, minlength=units.with_entries)
    assert sorted(singles[singles > 0].tolist()) == [1, 8]


def test_where_few_are_met_but_often_the_others_are_worth_nothing_and_where_all_are_met_by_chance_much() -> None:
    often, chance = np.zeros(512, int), np.zeros(512, int)
    often[::16], chance[::2] = 4, 1
    a, b = grouped(field(512), often), grouped(field(512), chance)
    assert a.owed(np.ones(len(a), bool))[0] == 0
    assert b.owed(np.ones(len(b), bool))[0] == 256
    assert a.members[a.with_entries :].sum() == 480


def test_what_is_charged_is_what_fresh_paths_meet_of_the_unmet() -> None:
    """A thousand instances met with probabilities that span three decades: over 200 repetitions the charge for all that
    was not met is in the mean what n further paths meet of it, within 4 standard errors."""
    rng = np.random.default_rng(5)
    regions = field(1000)
    rate = 10 ** rng.uniform(-2, 1, 1000)
    charged, missed = [], []
    for _ in range(200):
        met = rng.poisson(rate)
        units = grouped(regions, met)
        charged.append(float(units.owed(np.ones(len(units), bool))[0]))
        missed.append(float(rate[met == 0].sum()))
    difference = np.array(charged) - missed
    assert abs(difference.mean()) < 4 * difference.std() / np.sqrt(200)
    assert np.mean(missed) > 50


def test_pools_are_as_small_as_evidence_allows() -> None:
    """In a meadow met densely the pools are the lowest regions; where a single path met anything, one pool holds
    all."""
    dense, sparse = np.full(4096, 2), np.zeros(4096, int)
    dense[::3], sparse[77] = 0, 1
    a, b = grouped(field(4096), dense), grouped(field(4096), sparse)
    assert a.unmet == 4096 // FANOUT + 1  # and the whole tree, for which nothing is left
    assert a.members[a.with_entries] == 0
    assert b.unmet == 1
    assert b.members[-1] == 4095


def test_kept_pools_name_their_instances_and_save_their_entries() -> None:
    met = np.full(64, 2)
    met[::3] = 0
    regions = field(64)
    units = grouped(regions, met)
    cull = np.ones(len(units), bool)
    pool = units.with_entries + 1
    cull[pool] = False  # the unmet of one lowest region stay
    kept = units.unmet_kept(cull, regions)
    assert len(kept) == FANOUT
    assert (met[kept] == 0).sum() == units.members[pool]
    saved = units.saved(Savings.among(np.zeros((met > 0).sum(), np.int32), np.array([100])), np.ones(len(units), bool))
    assert saved[pool] == ENTRY_BYTES * units.members[pool]


def test_what_is_pinned_stays() -> None:
    met, pinned = np.full(16, 2), np.arange(16) == 3
    units = grouped(field(16), met, pinned)
    row = units.of_entry[3]
    assert np.isinf(units.worth[row]).all()
    assert units.members[row] == 1
