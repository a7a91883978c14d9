"""The change between two pictures is the budget's: every channel counts, by block; noise is not taken for a change."""

from __future__ import annotations

import numpy as np
import pytest

from lipac.core.arrays import F32
from lipac.core.feedback.picture_change import change_of, tile_changes
from lipac.core.feedback.tiles import COLUMNS, ROWS, TILES
from lipac.core.scene.film import LUMINANCE

SIDE = 4  # pixels of a block, in pictures of 5 x 5 blocks to a tile
SIZE = ROWS * 5 * SIDE, COLUMNS * 5 * SIDE


def grey() -> F32:
    return np.ones((*SIZE, 3), np.float32)


def test_a_shade_is_its_share_of_the_light() -> None:
    darker = grey()
    darker[: SIZE[0] // ROWS, : SIZE[1] // COLUMNS] = 0.75  # the first tile
    expected = np.zeros(TILES)
    expected[0] = 0.25
    np.testing.assert_allclose(tile_changes(grey(), darker), expected, atol=1e-6)


def test_colours_of_equal_luminance_count() -> None:
    """Red and green for grey: nothing by luminance, the distance of the colours by the definition; surely, too."""
    other = grey()
    other[..., 0], other[..., 1] = 1 + 0.5 / LUMINANCE[0], 1 - 0.5 / LUMINANCE[1]
    distance = np.sqrt(((0.5 / LUMINANCE[:2]) ** 2).sum() / 3)
    found = change_of([grey()], [other])
    assert found.luminance.max() < 1e-6
    np.testing.assert_allclose(found.tiles, distance, rtol=1e-5)
    assert found.least_mean(3.0) == pytest.approx(distance, rel=1e-5) == found.least_worst(4.0)


def test_light_that_moves_within_a_tile_counts() -> None:
    """A chequerboard of blocks for its mean, both ways round; tiles keep their light."""
    y, x = (np.arange(n) // SIDE for n in SIZE)
    pattern = 1 + 0.2 * (-1.0) ** (y[:, None] + x[None, :])
    found = change_of([grey()], [np.repeat(pattern[..., None], 3, axis=2).astype(np.float32)])
    assert np.delete(found.colour, 0).max() < 0.2 / 25 + 1e-6  # 13 of one to 12 of the other
    np.testing.assert_allclose(found.tiles, 0.2, rtol=1e-5)


def test_finer_detail_than_a_block_does_not() -> None:
    y, x = (np.arange(n) for n in SIZE)
    pattern = 1 + 0.2 * (-1.0) ** (y[:, None] + x[None, :])
    assert tile_changes(grey(), np.repeat(pattern[..., None], 3, axis=2).astype(np.float32)).max() < 1e-6


def test_noise_alone_is_surely_nothing() -> None:
    """Of 40 pairs with independent noise of 30 % by pixel none changes surely by even 0.1 % (a block's mean is off by
    10 %), and the figure is far below that."""
    for seed in range(40):
        rng = np.random.default_rng(seed)
        full, other = (grey() * (1 + 0.3 * rng.standard_normal((*SIZE, 3))).astype(np.float32) for _ in range(2))
        found = change_of([full], [other])
        assert found.least_mean(3.0) < 0.001 and found.least_worst(4.1) < 0.01
        assert found.detail.mean() > 0.09
        assert found.tiles.mean() < 0.06


def test_a_change_of_colour_is_found_in_noise() -> None:
    """A tenth of red to green in every tile, in noise of 30 % by pixel. Tolerance: what noise may hide."""
    rng = np.random.default_rng(0)
    turned = grey()
    turned[..., 0], turned[..., 1] = 1 + 0.1 / LUMINANCE[0], 1 - 0.1 / LUMINANCE[1]
    full, other = (
        (picture * (1 + 0.3 * rng.standard_normal((*SIZE, 3)))).astype(np.float32) for picture in (grey(), turned)
    )
    found, distance = change_of([full], [other]), np.sqrt(((0.1 / LUMINANCE[:2]) ** 2).sum() / 3)
    assert found.luminance.mean() < 0.03
    assert 0.5 * distance < found.least_mean(3.0) <= distance
    assert found.tiles.mean() == pytest.approx(distance, rel=0.1)


def test_crops_are_judged_by_the_light_of_all() -> None:
    """Of two, the dark one is judged against a hundredth of the mean of both; with it alone, against its own."""
    bright, dark = grey(), grey() * np.float32(1e-4)
    both = change_of([bright, dark], [bright, 2 * dark], 3, 4, SIDE)
    assert both.tiles[:12].max() == 0.0
    np.testing.assert_allclose(both.tiles[12:], 1e-4 / (0.01 * 0.5 * (1 + 1e-4)), rtol=1e-4)
    np.testing.assert_allclose(change_of([dark], [2 * dark], 3, 4, SIDE).tiles, 1.0, rtol=1e-4)


def test_pictures_of_few_pixels_are_unsure_of_their_blocks() -> None:
    """Where no block has two pixels, nothing tells their noise: all of it may be that. Tiles' luminance still says."""
    rng = np.random.default_rng(0)
    full = np.ones((ROWS, COLUMNS, 3), np.float32)
    other = full.copy()
    other[..., rng.integers(3)] *= 1.01
    assert change_of([full], [other]).detail.max() > 0
    assert change_of([full], [other]).block_noise.min() >= change_of([full], [other]).detail.max()


def test_alpha_counts_as_light_of_the_mean_of_what_is_there() -> None:
    """Of a transparent picture half is grey; in the first tile something black stands, and vanishes."""
    full = np.zeros((*SIZE, 4), np.float32)
    full[SIZE[0] // 3 :] = 1.0
    full[: SIZE[0] // ROWS, : SIZE[1] // COLUMNS, 3] = 1.0
    other = full.copy()
    other[: SIZE[0] // ROWS, : SIZE[1] // COLUMNS, 3] = 0.0
    backdrop = full[..., 0].mean() / full[..., 3].mean()  # of the tile's light nothing is left to be judged against
    expected = np.zeros(TILES)
    expected[0] = backdrop / (0.01 * full[..., 0].mean())
    np.testing.assert_allclose(tile_changes(full, other), expected, rtol=1e-5)
    assert tile_changes(full[..., :3], other[..., :3]).max() == 0.0
    appears = tile_changes(full, np.ones_like(full)).reshape(ROWS, COLUMNS)
    assert appears[: ROWS // 3].min() > 1.0
    assert appears[ROWS // 3 :].max() == 0.0


def test_alpha_that_is_one_changes_nothing() -> None:
    full, other = (np.random.default_rng(seed).random((*SIZE, 4)).astype(np.float32) for seed in range(2))
    full[..., 3] = other[..., 3] = 1.0
    np.testing.assert_array_equal(tile_changes(full, other), tile_changes(full[..., :3], other[..., :3]))
