"""The least of a sequence of sets with which what is left fits, and what things that entries have in common save."""

from itertools import pairwise

import numpy as np
import pytest

from lipac.core.error_budget.budget import Savings, Shared
from lipac.core.error_budget.fitting import least_that_fits
from lipac.core.error_budget.units import Units
from lipac.core.feedback.tiles import TILES

SIZES = np.array([100, 100, 100, 100, 1000, 10])
WORTH = np.array([0.0, 0.1, 0.2, 0.4, 5.0, 9.0])


def units(worth=WORTH):
    return Units.single(np.repeat(worth[:, None], TILES, axis=1))


def savings(sizes=SIZES):
    return Savings.among(np.arange(len(sizes), dtype=np.int32), np.asarray(sizes), own=0.0)


def culls(*numbers):
    out = np.zeros(len(SIZES), bool)
    out[list(numbers)] = True
    return out


def left(limit):
    return lambda cull: SIZES[~cull].sum() <= limit


SETS = [culls(0), culls(0, 1, 2, 3), culls(0, 1, 2, 3, 4)]


@pytest.mark.parametrize(
    ("limit", "gone"),
    [
        (5000, ()),
        (SIZES.sum(), ()),
        (1400, (0,)),
        (1300, (0, 1)),
        (1110, (0, 1, 2)),
        (1010, (0, 1, 2, 3)),
        (300, (0, 1, 2, 3, 4)),
    ],
)
def test_no_more_goes_than_it_takes_and_what_changes_least_first(limit, gone):
    found = least_that_fits(SETS, units(), savings(), left(limit))
    assert found.tolist() == culls(*gone).tolist()


def test_what_saves_little_for_much_change_comes_back():
    """A search fills its budget, also with what saves next to nothing."""
    sets = [culls(0, 5), culls(0, 1, 2, 3, 5)]
    assert least_that_fits(sets, units(), savings(), left(1210)).tolist() == culls(0, 1).tolist()


def test_none_where_it_does_not_fit():
    assert least_that_fits(SETS, units(), savings(), left(5)) is None


def test_the_smaller_the_limit_the_more_goes():
    found = [least_that_fits(SETS, units(), savings(), left(limit)) for limit in range(1500, 10, -70)]
    assert all(not (a & ~b).any() for a, b in pairwise(found))


def test_an_image_is_saved_by_all_that_use_it_together():
    """Entries 0 and 1 have image 0; 1 and 2 image 1; entry 3 none."""
    uses = np.array([[10, 0], [20, 0], [20, 1], [30, 1]], np.int32)
    shared = Shared(np.array([10, 20, 30, 40], np.int32), uses, np.array([600, 1000]))
    assert shared.shares().tolist() == [300, 800, 500, 0]
    mesh = np.arange(4, dtype=np.int32)
    together = Savings.among(mesh, np.full(4, 7), own=np.array([1.0, 2.0, 3.0, 4.0]), shared=shared)
    assert together.share.tolist() == [308, 809, 510, 11]
    assert together.among_these(np.array([False, True, True, True])).share.tolist() == [1109, 510, 11]
    assert together.among_these(np.array([False, False, True, True])).share.tolist() == [1010, 11]
    assert together.typical == 2.5


def test_without_images_nothing_is_shared():
    shared = Shared(np.zeros(2, np.int32), np.zeros((0, 2), np.int32), np.zeros(0, np.int64))
    assert shared.shares().tolist() == [0, 0]
