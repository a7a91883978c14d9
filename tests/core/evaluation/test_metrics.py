"""Picture metrics against known answers."""

from __future__ import annotations

import numpy as np
import pytest

from lipac.core.errors import InputError
from lipac.core.evaluation.metrics import error, flicker, flip, flip_hdr, linear_error, relative_mse, tile_rmse

RNG = np.random.default_rng(5)
PICTURE = RNG.uniform(0.2, 0.8, (40, 56, 3)).astype(np.float32)


def test_equal_pictures_do_not_differ() -> None:
    assert error(PICTURE, PICTURE, PICTURE, PICTURE) == {"flip": 0.0, "relmse": 0.0, "rmse": 0.0, "rmse_p99": 0.0}


def test_flip_of_black_and_white_is_near_one_and_finds_the_place() -> None:
    black, white = np.zeros((64, 64, 3)), np.ones((64, 64, 3))
    assert flip(black, white)[1] > 0.9
    spot = PICTURE.copy()
    spot[8:16, 40:50] = 1.0 - spot[8:16, 40:50]
    difference, mean = flip(PICTURE, spot)
    assert difference.shape == PICTURE.shape[:2]
    assert difference[8:16, 40:50].mean() > 10 * difference[:, :30].mean()
    assert mean == pytest.approx(difference.mean(), rel=1e-4)  # float32 sums


def test_relative_mse_by_hand() -> None:
    assert relative_mse(np.full((3, 3, 3), 2.0), np.full((3, 3, 3), 2.5)) == pytest.approx(0.25 / 4.01)


def test_tiles_by_hand_with_partial_ones_at_the_edge() -> None:
    test = PICTURE.astype(float).copy()
    test[32:, 48:] += 0.5  # the 8 x 8 pixels of the last tile
    tiles = tile_rmse(PICTURE, test)
    assert tiles.shape == (3, 4)
    assert tiles[-1, -1] == pytest.approx(0.5)
    assert np.count_nonzero(tiles) == 1


def test_alpha_is_ignored_and_sizes_must_agree() -> None:
    rgba = np.dstack([PICTURE, RNG.uniform(size=PICTURE.shape[:2])])
    assert relative_mse(PICTURE, rgba) == 0.0
    with pytest.raises(InputError, match="resolution"):
        relative_mse(PICTURE, PICTURE[:-1])


def test_hdr_flip_sees_what_a_display_clips() -> None:
    bright = PICTURE * 50
    brighter = bright.copy()
    brighter[8:16, 40:50] *= 4
    assert flip(bright, brighter)[1] == 0.0
    difference, mean = flip_hdr(bright, brighter)
    assert mean > 0.0
    assert difference[8:16, 40:50].mean() > 10 * difference[:, :30].mean()


def test_hdr_flip_of_black_pictures() -> None:
    black = np.zeros((16, 16, 3))
    assert flip_hdr(black, black)[1] == 0.0
    assert flip_hdr(black, black + 0.5)[1] > 0.0


def test_a_local_error_shows_in_the_percentile_over_tiles() -> None:
    spot = PICTURE.copy()
    spot[:16, :16] += 0.5
    measured = linear_error(PICTURE, spot)
    assert measured["rmse_p99"] > 5 * measured["rmse"]
    assert measured["relmse_p99"] > 5 * measured["relmse"]
    assert measured["flip_p99"] > 5 * measured["flip"]
    assert set(linear_error(PICTURE, PICTURE).values()) == {0.0}


def test_flicker_is_of_the_difference_that_changes() -> None:
    """A third picture off by 0.1 of a mean of 0.5: two of three steps change by that."""
    frames = [np.full((4, 4, 3), 0.5)] * 4
    assert flicker(frames, [f + 0.2 for f in frames]) == pytest.approx(0.0, abs=1e-12)
    assert flicker(frames, [frames[0], frames[1], frames[2] + 0.1, frames[3]]) == pytest.approx(0.1 * 2 / 3 / 0.5)
    assert flicker(frames[:1], frames[:1]) == 0.0
