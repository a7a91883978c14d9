"""The judge by pairs of pictures: known changes are found, noise is not taken for one, what luminance does not see
colour and detail do."""

from __future__ import annotations

import numpy as np
import pytest

from lipac.core.evaluation.paired import Change, Pairs, Range

HEIGHT, WIDTH = 90, 160


def judged(
    full: np.ndarray, other: np.ndarray, noise: float = 0.0, shared: float = 0.0, pairs: int = 2, seed: int = 0
) -> dict[str, Change]:
    """Of pairs with noise in each picture, and noise that both of a pair share."""
    rng = np.random.default_rng(seed)
    out = Pairs()
    for _ in range(pairs):
        common = rng.normal(0, shared, full.shape)
        out.add(full + common + rng.normal(0, noise, full.shape), other + common + rng.normal(0, noise, full.shape), 64)
    return out.changes()


@pytest.fixture
def grey() -> np.ndarray:
    return np.full((HEIGHT, WIDTH, 3), 0.5)


def test_what_is_equal_has_not_changed(grey: np.ndarray) -> None:
    for change in judged(grey, grey, shared=0.2).values():
        assert change == Change(Range(0, 0, 0), Range(0, 0, 0))


def test_a_known_change_of_one_tile_is_found(grey: np.ndarray) -> None:
    other = grey.copy()
    other[:10, :10] *= 1.2
    for change in judged(grey, other, shared=0.1).values():
        assert change.worst.low == pytest.approx(0.2, rel=1e-2)
        assert change.mean.low == pytest.approx(0.2 / 144, rel=1e-2)
    for change in judged(grey, other, noise=0.1).values():
        assert 0.1 < change.worst.low < 0.2 < change.worst.high < 0.4


def test_noise_is_no_change_and_does_not_hide_one(grey: np.ndarray) -> None:
    """Over many seeds: of pictures that differ by noise alone none is surely changed by more than a trifle; of a change
    by a tenth the range holds it."""
    for seed in range(40):
        for change in judged(grey, grey, noise=0.3, seed=seed).values():
            assert change.mean.low < 1e-3
            assert change.worst.low < 0.08  # of 0.045 standard errors, in the worst of 144 tiles
        luminance = judged(grey, grey * 1.1, noise=0.3, seed=seed)["luminance"]
        assert luminance.mean.low < 0.1 < luminance.mean.high
        assert luminance.mean.high - luminance.mean.low < 0.05


def test_more_pairs_narrow_the_range(grey: np.ndarray) -> None:
    few, many = (judged(grey, grey * 1.05, noise=0.3, pairs=n)["luminance"].worst for n in (2, 8))
    assert many.high - many.low < 0.7 * (few.high - few.low)


def test_structure_of_a_change_is_no_noise(grey: np.ndarray) -> None:
    """A thing that is gone from one pixel of a tile: a large spread between neighbours, the same in each pair."""
    other = grey.copy()
    other[5, 5] += 10.0
    assert judged(grey, other)["luminance"].worst.low == pytest.approx(0.2, rel=1e-6)


def test_equal_luminance_is_seen_by_colour(grey: np.ndarray) -> None:
    other = grey.copy()
    other[20:40, 30:60] = (0.5 * 0.5, 0.5 + 0.25 * 0.2126 / 0.7152, 0.5)
    changes = judged(grey, other)
    assert changes["luminance"].worst.value < 1e-9
    assert changes["colour"].worst.low > 0.1


def test_a_pattern_for_its_mean_is_seen_by_detail(grey: np.ndarray) -> None:
    other = grey.copy()
    y, x = np.mgrid[:HEIGHT, :WIDTH] // 2
    other[..., :] = np.where((y + x) % 2, 0.8, 0.2)[..., None]
    changes = judged(grey, other)
    assert changes["colour"].worst.value < 0.13  # tiles of 10 pixels hold 12.5 squares more of one or the other at most
    assert changes["detail"].mean.low > 0.5


def test_dark_tiles_are_judged_against_the_picture(grey: np.ndarray) -> None:
    grey[:10, :10] = 1e-6
    other = grey.copy()
    other[:10, :10] = 1e-4
    assert judged(grey, other)["luminance"].worst.value == pytest.approx(1e-4 / (0.01 * 0.5 * 143 / 144), rel=0.02)


def test_pairs_count_by_their_samples(grey: np.ndarray) -> None:
    pairs = Pairs()
    pairs.add(grey, grey * 1.1, 300)
    pairs.add(grey, grey * 1.3, 100)
    assert pairs.samples == 400
    assert pairs.changes()["luminance"].mean.value == pytest.approx(0.15)


def test_a_budget_is_compared_by_the_bound_that_is_more_exceeded() -> None:
    change = Change(Range(0.01, 0.02, 0.03), Range(0.1, 0.1, 0.2))
    assert change.times(0.01, 0.1) == Range(1.0, 2.0, 3.0)
    assert change.times(0.02, 0.05) == Range(2.0, 2.0, 4.0)


def test_what_cannot_be_judged_is_refused(grey: np.ndarray) -> None:
    pairs = Pairs()
    with pytest.raises(ValueError, match="noise"):
        pairs.changes()
    pairs.add(grey, grey, 1)
    with pytest.raises(ValueError, match="sizes"):
        pairs.add(grey[1:], grey[1:], 1)
    with pytest.raises(ValueError, match="finite"):
        pairs.add(grey, grey * np.nan, 1)
