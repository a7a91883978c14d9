"""What a change of a picture is, how sure it is, and what luminance alone would not see."""

from __future__ import annotations

from statistics import NormalDist

import numpy as np
import pytest

from lipac.core.error_budget.budget import Budget
from lipac.core.error_budget.error_estimate import ErrorEstimate, Light, Reference
from lipac.core.feedback.path_log import PathLog
from lipac.core.feedback.tiles import BLOCK, COLUMNS, ROWS, TILES, tiles_of
from lipac.core.scene.film import LUMINANCE

HEIGHT, WIDTH = ROWS * 2 * BLOCK, COLUMNS * 2 * BLOCK  # tiles of 2 x 2 blocks


def full(samples: int = 4) -> PathLog:
    """A white picture."""
    log = PathLog.zeros(HEIGHT, WIDTH, samples)
    log.color[:] = 1.0
    return log


def estimate(log: PathLog, color: np.ndarray, owed: np.ndarray | None = None) -> ErrorEstimate:
    """Of paths that bring color, (H, W, S, 3), in place of the log's."""
    reference = Reference(log)
    only = (color != log.color).any(axis=-1).astype(np.uint8)
    return Light.of(reference).estimate(reference.compare(only, color.astype(np.float32), log, reference.nothing), owed)


def certain(error: np.ndarray, deviation: np.ndarray) -> ErrorEstimate:
    """Of tiles with these errors and deviations, nothing owed."""
    return ErrorEstimate(error, error, deviation, np.zeros(TILES))


def test_a_shade_is_its_share_of_the_light() -> None:
    log = full()
    darker = log.color.copy()
    darker[: HEIGHT // ROWS, : WIDTH // COLUMNS] = 0.75  # the first tile
    found = estimate(log, darker)
    expected = np.zeros(TILES)
    expected[0] = 0.25
    np.testing.assert_allclose(found.tiles, expected, atol=1e-6)
    assert found.mean == pytest.approx(0.25 / TILES, rel=1e-5)


def test_colours_of_equal_luminance_count() -> None:
    """Red and green for grey of the same luminance: nothing by luminance, the distance of the colours by the
    definition."""
    log = full()
    other = log.color.copy()
    other[..., 0], other[..., 1] = 1 + 0.5 / LUMINANCE[0], 1 - 0.5 / LUMINANCE[1]
    assert np.abs(other @ LUMINANCE - 1).max() < 1e-6
    distance = np.sqrt(((0.5 / LUMINANCE[:2]) ** 2).sum() / 3)
    np.testing.assert_allclose(estimate(log, other).tiles, distance, rtol=1e-5)


def test_a_pattern_for_its_mean_counts() -> None:
    """A checkerboard of blocks, 40 % up and down: every tile's mean stays, its detail does not."""
    log = full()
    y, x = np.arange(HEIGHT) // BLOCK, np.arange(WIDTH) // BLOCK
    other = log.color * (1 + 0.4 * (-1.0) ** (y[:, None] + x[None, :]))[..., None, None]
    tile = tiles_of(HEIGHT, WIDTH).ravel()
    means = np.bincount(tile, other[..., 0].mean(axis=2).ravel()) / np.bincount(tile)
    np.testing.assert_allclose(means, 1.0, atol=1e-6)
    np.testing.assert_allclose(estimate(log, other).tiles, 0.4, rtol=1e-5)


def test_a_deviation_is_that_of_repetitions() -> None:
    """Paths that differ at random: the deviation that one measurement states is that of the scatter of many, within a
    fifth (40 x 144 tiles: a few per cent).
    """
    rng = np.random.default_rng(3)
    log = full(8)
    stated, scatter = [], []
    tile = tiles_of(HEIGHT, WIDTH).ravel()
    for _ in range(40):
        affected = rng.random(log.shape) < 0.1
        other = log.color + np.where(affected[..., None], rng.normal(0, 1, (*log.shape, 1)), 0)
        stated.append(estimate(log, other).deviation ** 2)
        scatter.append(np.bincount(tile, (other - log.color)[..., 0].sum(axis=2).ravel()) / np.bincount(tile) / 8)
    assert np.mean(stated) == pytest.approx(np.var(scatter, axis=0, ddof=1).mean(), rel=0.2)


@pytest.mark.parametrize("change", [0.0, 0.02, 0.05, 0.1, 0.3])
@pytest.mark.parametrize("share", [1.0, 0.1])
def test_many_changes_below_the_noise_add_up(change: float, share: float) -> None:
    """A share of the blocks change by so much, up or down, under noise of 8 paths a pixel that is as large as the
    light: 12 % of a block, 6 % of a tile. The mean of the tiles is not taken for smaller than it is, whether or not any
    single one shows it; a set without noise is measured exactly."""
    rng = np.random.default_rng(8)
    log = full(8)
    y, x = np.arange(HEIGHT) // BLOCK, np.arange(WIDTH) // BLOCK
    pattern = change * rng.choice([-1.0, 1.0], (y[-1] + 1, x[-1] + 1)) * (rng.random((y[-1] + 1, x[-1] + 1)) < share)
    by_pixel = pattern[y[:, None], x[None, :]][..., None, None]
    truth = np.abs(pattern).mean()
    assert estimate(log, log.color * (1 + by_pixel)).mean == pytest.approx(truth, rel=1e-4, abs=1e-9)
    found = [estimate(log, log.color * (1 + by_pixel) + rng.normal(0, 1, (*log.shape, 1))).mean for _ in range(4)]
    assert np.mean(found) > 0.95 * truth  # the smaller of two noisy figures
    assert np.mean(found) < truth + 0.12


def fine_pattern(log: PathLog, share: float, change: float, seed: int) -> np.ndarray:
    """A checkerboard of blocks, up and down by `change`, that a share of the paths shows: (H, W, S, 3)."""
    height, width, _ = log.shape
    y, x = np.arange(height) // BLOCK, np.arange(width) // BLOCK
    sign = (-1.0) ** (y[:, None] + x[None, :])
    shown = np.random.default_rng(seed).random(log.shape) < share
    return log.color + (shown * change * sign[..., None])[..., None]


@pytest.mark.parametrize("share", [0.001, 0.004, 0.02])
def test_a_change_that_few_paths_show_is_no_smaller(share: float) -> None:
    """Of half a block's paths none or one differs: by products of halves there would be next to no change (0.6 of it).
    Tiles of 25 blocks; the deviation of their mean is a few per cent."""
    log = PathLog.zeros(ROWS * 5 * BLOCK, COLUMNS * 5 * BLOCK, 6)
    log.color[:] = 1.0
    found = estimate(log, fine_pattern(log, share, 0.01 / share, 4))
    assert found.mean > 0.01 - 3 * found.mean_deviation
    assert found.mean < 0.012 + 3 * found.mean_deviation


@pytest.mark.parametrize(("share", "change"), [(0.02, 0.3), (0.1, 0.3)])
def test_a_tile_of_many_blocks_is_bounded_too(share: float, change: float) -> None:
    """One tile of 400 blocks, as of a picture 960 pixels wide with one path per pixel: noise shrinks its detail to less
    than a half, which 3 of its deviations are too few to make up for."""
    log = PathLog.zeros(ROWS * 20 * BLOCK, COLUMNS * 20 * BLOCK, 1)
    log.color[:] = 1.0
    other = log.color.copy()
    tile = np.s_[: 20 * BLOCK, : 20 * BLOCK]
    other[tile] = fine_pattern(PathLog(log.records, log.color[tile]), share, change, 5)
    assert estimate(log, other).upper_worst(0.99) > share * change


def test_a_backdrop_is_no_light() -> None:
    """Half of a picture is transparent: what changes there by its own light is relative to the light that there is."""
    log = PathLog(full().records, full().color, backdrop=0.5)
    log.color[:, ::2] = -0.5
    other = log.color.copy()
    other[:, 1::2] *= 0.9
    np.testing.assert_allclose(estimate(log, other).tiles, 0.1, rtol=1e-5)
    other[:, 1::2] = -0.5  # it vanishes
    np.testing.assert_allclose(estimate(log, other).tiles, 1.5, rtol=1e-5)


def test_what_pixels_share_is_no_noise() -> None:
    """Half of the pixels lose all their light, in every path: by pixel nothing is left to chance, but for what no path
    showed."""
    log = full(4)
    other = log.color.copy()
    other[:, ::2] = 0
    found = estimate(log, other)
    paths = (HEIGHT // ROWS) * (WIDTH // COLUMNS) * 4
    np.testing.assert_allclose(found.tiles, 0.5, rtol=1e-5)
    np.testing.assert_allclose(found.deviation, 1 / paths, rtol=1e-2)


def test_one_sample_has_two_halves_too() -> None:
    log = full(1)
    np.testing.assert_allclose(estimate(log, 0.5 * log.color).tiles, 0.5, rtol=1e-5)


def test_upper_ends_are_those_of_normal_errors() -> None:
    """One uncertain tile among certain ones: its own quantile. All alike: that of the largest of them. Coverage over
    4,000 draws within 3 standard errors."""
    one = certain(np.full(TILES, 0.01), np.where(np.arange(TILES) == 7, 0.002, 0.0))
    assert one.upper_worst(0.95) == pytest.approx(0.01 + NormalDist().inv_cdf(0.95) * 0.002, rel=1e-6)
    assert one.upper_mean(0.95) == pytest.approx(0.01 + NormalDist().inv_cdf(0.95) * 0.002 / TILES, rel=1e-6)
    alike = certain(np.full(TILES, 0.01), np.full(TILES, 0.002))
    assert alike.upper_worst(0.95) == pytest.approx(0.01 + NormalDist().inv_cdf(0.95 ** (1 / TILES)) * 0.002, rel=1e-6)
    rng = np.random.default_rng(1)
    truth, deviation = rng.uniform(0, 0.05, TILES), rng.uniform(0.001, 0.01, TILES)
    held = [
        certain(truth + deviation * rng.standard_normal(TILES), deviation).upper_worst(0.9) >= truth.max()
        for _ in range(4000)
    ]
    assert np.mean(held) > 0.9 - 3 * np.sqrt(0.09 / 4000)


def test_what_is_owed_counts() -> None:
    owed = np.zeros(TILES)
    owed[3] = 0.02
    found = estimate(full(), full().color, owed)
    assert (found.worst, found.upper_worst()) == (0.02, 0.02)
    assert found.mean == pytest.approx(0.02 / TILES)
    assert (
        found.surely_holds(Budget(0.001, 0.02))
        and not found.surely_holds(Budget(0.001, 0.019))
        and not found.surely_holds(Budget(1e-4, 1.0))
    )


def test_more_paths_are_for_tiles_in_doubt_and_full_ones_are_named() -> None:
    error, deviation = np.full(TILES, 0.001), np.full(TILES, 1e-4)
    error[5], deviation[5] = 0.042, 0.01
    found = certain(error, deviation)
    budget = Budget(0.1, 0.05)
    assert not found.surely_holds(budget)
    assert np.flatnonzero(found.doubtful(budget)).tolist() == [5]
    assert np.flatnonzero(found.exceeded(budget)).tolist() == [5]
    assert found.may_hold(budget, 0.95, np.full(TILES, 16.0)) and not found.may_hold(budget, 0.95, np.ones(TILES))
    assert not found.exceeded(Budget(1e-5, 0.05)).any()  # the mean is exceeded: no tile's fault


def test_several_looks_are_one_sample() -> None:
    """Paths traced in two goes, the second in some tiles only, as all of them in one."""
    rng = np.random.default_rng(6)
    log = full(6)
    log.color[:] = rng.uniform(0.5, 1.5, log.color.shape)
    other = log.color * np.where(rng.random((*log.shape, 1)) < 0.2, 0.6, 1.0).astype(np.float32)
    both = PathLog(log.records[:, :, :4], log.color[:, :, :4]), PathLog(log.records[:, :, 4:], log.color[:, :, 4:])
    references = [Reference(part) for part in both]
    total = sum(
        (
            r.compare(np.ones(part.shape, np.uint8), color, part, r.nothing)
            for r, part, color in zip(references[1:], both[1:], [other[:, :, 4:]], strict=True)
        ),
        references[0].compare(np.ones(both[0].shape, np.uint8), other[:, :, :4], both[0], references[0].nothing),
    )
    joined, whole = Light.of(*references).estimate(total), estimate(log, other)
    np.testing.assert_allclose(joined.error, whole.error, rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(joined.deviation, whole.deviation, rtol=1e-5, atol=1e-7)
    tiles = np.arange(TILES) < 10
    only = np.repeat(tiles[tiles_of(HEIGHT, WIDTH)][..., None], 2, axis=2).astype(np.uint8)
    partly = Light.of(references[0], Reference(PathLog(both[1].records, both[1].color * only[..., None]), only))
    np.testing.assert_array_equal(partly.paths, np.where(tiles, 6, 4) * (HEIGHT // ROWS) * (WIDTH // COLUMNS))


def test_what_is_half_transparent_takes_no_light_from_its_tile() -> None:
    """Its paths are logged less a share of the backdrop: more than they brought, through clear glass."""
    opaque, clear = PathLog.zeros(9, 16, 2), PathLog.zeros(9, 16, 2, backdrop=2.0)
    opaque.color[:, :, 0] = clear.color[:, :, 0] = 1.0
    clear.color[:, :, 1] = -0.9 * 2.0
    np.testing.assert_array_equal(Light.of(Reference(clear)).luminance, Light.of(Reference(opaque)).luminance)
