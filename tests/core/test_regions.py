"""The cut through the region tree stands in for every culled instance once, and for nothing active."""

from __future__ import annotations

import numpy as np

from lipac.core.regions import FANOUT, Cut, Regions


def boxes(count: int) -> np.ndarray:
    rng = np.random.default_rng(count)
    center, half = rng.uniform(-100, 100, (count, 3)), 10 ** rng.uniform(-2, 1.5, (count, 1))
    return np.stack([center - half, center + half], axis=1).astype(np.float32)


def members(regions: Regions, cut: Cut, row: int) -> np.ndarray:
    run = FANOUT ** int(cut.level[row])
    return regions.order[cut.index[row] * run : (cut.index[row] + 1) * run]


def check(regions: Regions, bounds: np.ndarray, active: np.ndarray) -> Cut:
    cut = regions.cut(np.flatnonzero(active))
    covered = np.zeros(len(bounds), int)
    for row in range(len(cut)):
        inside = members(regions, cut, row)
        covered[inside] += 1
        assert (bounds[inside, 0] >= cut.bounds[row, 0]).all()
        assert (bounds[inside, 1] <= cut.bounds[row, 1]).all()
    np.testing.assert_array_equal(covered, ~active)
    return cut


def test_every_culled_instance_is_in_one_box() -> None:
    for count in (1, 7, 8, 9, 64, 1000, 4099):
        bounds = boxes(count)
        regions = Regions(bounds)
        rng = np.random.default_rng(1)
        for share in (0.0, 0.01, 0.5, 1.0):
            check(regions, bounds, rng.random(count) < share)


def test_splitting_opens_a_region_down_to_its_instances() -> None:
    bounds = boxes(1000)
    regions, active = Regions(bounds), np.zeros(1000, bool)
    cut = regions.cut(np.flatnonzero(active))
    while (cut.level > 0).any():
        regions.split_nodes(cut, np.arange(len(cut)), np.ones(len(cut)))
        deeper = check(regions, bounds, active)
        assert len(deeper) > len(cut)
        cut = deeper
    np.testing.assert_array_equal(np.sort(regions.instances_of(cut, np.arange(len(cut)))), np.arange(1000))


def test_all_culled_costs_few_boxes_and_large_ones_stand_alone() -> None:
    bounds = boxes(4096)
    bounds[7] = [[-1000, -1000, -1], [1000, 1000, 0]]  # a ground plane
    regions = Regions(bounds)
    cut = regions.cut(np.zeros(0, int))
    assert len(cut) <= FANOUT
    assert regions.order[0] == 7


def test_members_that_do_not_take_part_are_left_out() -> None:
    bounds = boxes(50)
    regions = Regions(bounds, np.arange(0, 50, 2))
    cut = regions.cut(np.zeros(0, int))
    assert set(np.concatenate([members(regions, cut, r) for r in range(len(cut))])) == set(range(0, 50, 2))
