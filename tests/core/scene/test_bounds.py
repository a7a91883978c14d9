"""What boxes tell, against numpy's own words for it."""

from __future__ import annotations

import numpy as np
import pytest

from lipac.core.scene.bounds import enclosing, existing, extended_morton_codes, extents


@pytest.fixture
def boxes() -> np.ndarray:
    rng = np.random.default_rng(7)
    low = rng.normal(scale=30.0, size=(1003, 3)).astype(np.float32)
    size = (10 ** rng.uniform(-3, 1, (1003, 1)) * rng.random((1003, 3))).astype(np.float32)
    return np.stack([low, low + size], axis=1)


@pytest.mark.parametrize(
    ("corner", "value", "exists"),
    [
        ((0, 0), np.nan, False),
        ((1, 2), np.nan, False),
        ((0, 1), -np.inf, False),
        ((1, 1), 2e18, False),
        ((0, 2), -2e18, False),
        ((1, 0), 1.7e18, True),
    ],
)
def test_what_has_no_finite_box_does_not_exist(boxes, corner, value, exists):
    boxes[500][corner] = value
    assert existing(boxes).tolist() == [True] * 500 + [exists] + [True] * 502


def test_inside_out_boxes_do_not_exist(boxes):
    boxes[3] = np.array([[np.inf] * 3, [-np.inf] * 3])
    boxes[4] = boxes[4, ::-1]
    assert np.flatnonzero(~existing(boxes)).tolist() == [3, 4]


def test_extents_are_the_longest_sides(boxes):
    assert np.array_equal(extents(boxes), (boxes[:, 1] - boxes[:, 0]).max(axis=1))


@pytest.mark.parametrize("run", [1, 8, 1003, 5000])
def test_a_box_encloses_its_run_and_no_more(boxes, run):
    parts = [boxes[i : i + run] for i in range(0, len(boxes), run)]
    expected = np.array([[part[:, 0].min(axis=0), part[:, 1].max(axis=0)] for part in parts])
    assert np.array_equal(enclosing(boxes, run), expected)


def test_codes_interleave_the_bits_of_the_centre_below_the_size_class(boxes):
    center = (boxes[:, 0] + boxes[:, 1]) * np.float32(0.5)
    low, extent = center.min(axis=0), np.ptp(center, axis=0).max()
    cells = np.minimum((center - low) * (np.float32(16) / extent), np.float32(15)).astype(int)
    largest = (boxes[:, 1] - boxes[:, 0]).max(axis=1)
    ratio = largest.max() / largest
    for code, (x, y, z), r in zip(extended_morton_codes(boxes, 4, 8).tolist(), cells.tolist(), ratio, strict=True):
        assert code & 0xFFF == sum(((x >> k & 1) | (y >> k & 1) << 1 | (z >> k & 1) << 2) << 3 * k for k in range(4))
        assert code >> 12 == min(sum(r >= 4**k for k in range(1, 12)), 7)


def test_no_boxes_and_boxes_at_one_place_have_codes():
    assert len(extended_morton_codes(np.zeros((0, 2, 3), np.float32), 16, 8)) == 0
    assert len(set(extended_morton_codes(np.zeros((5, 2, 3), np.float32), 16, 8).tolist())) == 1
