"""The cut through the region tree stands in for every culled instance once, and for nothing active."""

from __future__ import annotations

import numpy as np

from lipac.core.accel.region_tree import FANOUT, Cut, Regions
from lipac.core.scene.frustum import View
from lipac.core.scene.model import Camera


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


def parts(regions: Regions, cut: Cut) -> set[tuple[int, int]]:
    return set(zip(cut.level.tolist(), cut.index.tolist(), strict=True))


def test_boxes_follow_motion_and_span_it() -> None:
    bounds = boxes(700)
    regions, nothing = Regions(bounds), np.zeros(0, int)
    rng = np.random.default_rng(2)
    for moved in (20, 0, 700, 3):
        rows = rng.permutation(700)[:moved]
        after = bounds.copy()
        after[rows] += rng.uniform(-5, 5, (moved, 1, 3)).astype(np.float32)
        regions.move(rows, after)
        spanned = np.stack([np.minimum(bounds[:, 0], after[:, 0]), np.maximum(bounds[:, 1], after[:, 1])], axis=1)
        cut = regions.cut(nothing)
        while (cut.level > 0).any():  # down to the instances, every level is as tight as it can be
            for row in range(len(cut)):
                inside = members(regions, cut, row)
                np.testing.assert_array_equal(
                    cut.bounds[row], [spanned[inside, 0].min(axis=0), spanned[inside, 1].max(axis=0)]
                )
            regions.split_nodes(cut, np.arange(len(cut)), np.ones(len(cut)))
            cut = regions.cut(nothing)
        bounds = after


def test_order_decays_as_things_mix() -> None:
    bounds = boxes(700)
    regions = Regions(bounds)
    regions.move(np.arange(10), bounds)
    assert not regions.decayed
    shuffled = bounds[np.random.default_rng(3).permutation(700)]
    regions.move(np.arange(700), shuffled)
    assert regions.decayed
    assert not regions.renewed(shuffled, np.arange(700)).decayed


def test_a_new_order_is_split_where_the_old_one_was() -> None:
    bounds = boxes(2000)
    regions, nothing = Regions(bounds), np.zeros(0, int)
    cut = regions.cut(nothing)
    regions.split_nodes(cut, np.array([0]), np.array([60]))
    before = regions.cut(nothing)
    assert parts(regions, regions.renewed(bounds, np.arange(2000)).cut(nothing)) == parts(regions, before)
    # some are gone, the others have other rows
    previous = np.random.default_rng(5).permutation(2000)[:1900].astype(np.int32)
    new = regions.renewed(bounds[previous], np.arange(1900), previous)
    after = check(new, bounds[previous], np.zeros(1900, bool))
    finest = {int(i) for row in np.flatnonzero(before.level <= 1).tolist() for i in members(regions, before, row)}
    level = {int(previous[i]): int(after.level[row]) for row in range(len(after)) for i in members(new, after, row)}
    assert max(level[i] for i in finest if i in level) <= 1  # as fine as before, or finer


def test_regions_that_nobody_asks_for_are_closed_and_those_closed_in_vain_stay_open() -> None:
    bounds = boxes(4096)
    regions, nothing = Regions(bounds), np.zeros(0, int)
    coarse = parts(regions, regions.cut(nothing))
    cut = regions.cut(nothing)
    regions.split_nodes(cut, np.array([0, 1]), np.array([1, 1]))
    quiet, asked = cut.index[0], cut.index[1]
    fine = regions.cut(nothing)
    regions.close(nothing, fine, np.zeros(len(fine), np.int64))
    assert parts(regions, regions.cut(nothing)) == coarse
    flips = []

    def frame() -> None:
        """The second region is crossed, none of its parts is."""
        cut = regions.cut(nothing)
        crossings = np.where((cut.level == cut.level.max()) & (cut.index == asked), 100, 0)
        rows = np.flatnonzero(crossings)
        flips.append(len(rows))
        regions.split_nodes(cut, rows, crossings[rows])
        cut = regions.cut(nothing)
        regions.close(nothing, cut, np.zeros(len(cut), np.int64))

    for _ in range(200):
        frame()
    assert sum(flips) == 1  # asked for once more, and open since: nothing changed
    for _ in range(400):
        regions.pass_frame()
        frame()
    assert 2 < sum(flips) < 8  # tried again, less and less often
    assert (regions.levels - 1, int(quiet)) in parts(regions, regions.cut(nothing))


def test_large_things_in_view_are_found_by_descent() -> None:
    bounds = boxes(4099)
    regions = Regions(bounds)
    for orthographic in (False, True):
        frame = np.array([-0.5, 0.3, -0.2, 0.25]) * (40 if orthographic else 1)
        angle = 0.7
        axes = np.array([[np.cos(angle), 0, np.sin(angle)], [np.sin(angle), 0, -np.cos(angle)], [0, 1, 0]])
        camera = Camera(np.column_stack([axes, [-20, 30, 5]]), frame, orthographic, clip_start=1.0, clip_end=120.0)
        corner = np.stack([bounds[:, (k >> np.arange(3)) & 1, np.arange(3)] for k in range(8)], axis=1).astype(float)
        local = (corner - camera.to_world[:, 3]) @ axes
        depth = -local[..., 2]
        scale = np.ones_like(depth) if orthographic else depth
        left, right, bottom, top = frame
        x, y = local[..., 0], local[..., 1]
        out = [x < left * scale, x > right * scale, y < bottom * scale, y > top * scale, depth < 1.0, depth > 120.0]
        touches = ~np.any([side.all(axis=1) for side in out], axis=0)
        nearest = np.linalg.norm(
            np.clip(camera.to_world[:, 3], bounds[:, 0], bounds[:, 1]) - camera.to_world[:, 3], axis=1
        )
        for share in (0.0, 0.05):
            large = (bounds[:, 1] - bounds[:, 0]).max(axis=1) >= share * (right - left) * (
                1.0 if orthographic else nearest
            )
            found = regions.in_view(View.of(camera), share)
            assert 10 < len(found) < 2000
            np.testing.assert_array_equal(np.sort(found), np.flatnonzero(touches & large))
