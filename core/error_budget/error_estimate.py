"""How much a picture changes by culling, estimated from pairs of paths with the same random numbers, and how sure that
is.

The error of a coarse tile is the larger of two relative changes: that of its mean luminance, and the mean absolute
change of colour over its blocks of BLOCK x BLOCK pixels of the analysis picture. The second sees what the first does
not: red for green of equal luminance, a pattern for its mean.

Absolute values of noisy figures are too large, above all of many small blocks. So there signs, and directions of
colour, are taken from one half of the paths and applied to the other half, whose noise is independent (cross-fitting);
that shrinks what is below the noise, which the deviation covers for one tile of few blocks. For the mean of all tiles,
where it would add up, squares are estimated by products of the two halves. A change that but one half of a block's
paths shows has no product: it is taken as it is.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from statistics import NormalDist

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ..arrays import F32, F64, I32, I64
from ..feedback.hits import sparse_zeros
from ..feedback.path_log import RECORD, PathLog, attribute_to_first_hit, numbers
from ..feedback.tiles import BLOCK, DARK, TILES, tiles_of
from ..scene.film import LUMINANCE
from .budget import Budget

CONFIDENCE = 0.95  # that both bounds hold, of what is certified
NEAR = 4.0  # deviations: a tile that is nearer than this to its bound may break it
# deviations of a tile, times the root of its number of blocks, by which noise shrinks its detail at most: rare changes
# of which half a block's paths show half of one, N x 2 x 0.5 exp(-0.5) of sqrt(N x 2 x 0.5)
SHRINKAGE = 0.6
FEW_BLOCKS = 25  # of a tile, at the defaults: what noise shrinks there the bound's own deviations cover
_TINY = 1e-30


@dataclass(frozen=True)
class ErrorEstimate:
    """Relative change of the coarse tiles of a picture.

    error: (T,) float64, estimate of each tile's, for the worst of them. average: (T,) the same for the mean of them:
    what noise may have shrunk in one tile must not add up over all. deviation: (T,) float64 standard deviation of the
    tiles' light. owed: (T,) float64, charged on top without having been measured.
    """

    error: F64
    average: F64
    deviation: F64
    owed: F64

    @property
    def tiles(self) -> F64:
        """(T,) error of each tile, with what is owed."""
        return np.asarray(self.error + self.owed)

    @property
    def mean(self) -> float:
        """Over the tiles."""
        return float((self.average + self.owed).mean())

    @property
    def worst(self) -> float:
        """Of the worst tile."""
        return max(float(self.tiles.max()), 0.0)

    @property
    def mean_deviation(self) -> float:
        """Of `mean`."""
        return float(np.sqrt((self.deviation**2).sum()) / len(self.deviation))

    @property
    def worst_deviation(self) -> float:
        """Of `worst`, were that tile picked beforehand."""
        return float(self.deviation[self.tiles.argmax()])

    def upper_mean(self, confidence: float = CONFIDENCE) -> float:
        """Upper confidence bound of the mean."""
        return self.mean + _quantile(confidence) * self.mean_deviation

    def upper_worst(self, confidence: float = CONFIDENCE) -> float:
        """Upper confidence bound of the worst tile, for all tiles together: those far below it cost nothing (normal
        errors, independent by tile)."""
        return float(_upper_worst(self.tiles, self.deviation, confidence))

    def upper_tiles(self, confidence: float = CONFIDENCE) -> F64:
        """(T,) float64, upper confidence bound of each tile by itself."""
        return np.asarray(np.maximum(self.tiles + _quantile(confidence) * self.deviation, 0.0))

    def holds(self, budget: Budget) -> bool:
        """Whether the estimates are within both bounds."""
        return self.mean <= budget.mean and self.worst <= budget.worst

    def surely_holds(self, budget: Budget, confidence: float = CONFIDENCE) -> bool:
        """Whether both bounds hold with this confidence, each taking half of the doubt."""
        return self.excess(budget, confidence) <= 1

    def excess(self, budget: Budget, confidence: float = CONFIDENCE) -> float:
        """Budget utilisation: the upper confidence bounds over those of the budget, the larger of both; feasible where
        it is at most 1."""
        each = 0.5 * (1 + confidence)
        changes = ((self.upper_mean(each), budget.mean), (self.upper_worst(each), budget.worst))
        return max(change / max(bound, _TINY) if change else 0.0 for change, bound in changes)

    def doubtful(self, budget: Budget, confidence: float = CONFIDENCE) -> NDArray[np.bool_]:
        """(T,) tiles in which more paths may decide whether a bound holds: those whose estimate is within NEAR
        deviations of the worst tile's bound, and where it is the mean's that may not hold, the noisiest."""
        tiles = (self.deviation > 0) & (self.tiles + NEAR * self.deviation > budget.worst)
        if self.upper_mean(0.5 * (1 + confidence)) > budget.mean:
            tiles |= self.deviation**2 > (self.deviation**2).mean()
        return np.asarray(tiles)

    def exceeded(self, budget: Budget, confidence: float = CONFIDENCE) -> NDArray[np.bool_]:
        """(T,) tiles that may change by more than a set is allowed to: the worst of them, until the others surely hold.
        None, where the mean may be exceeded.
        """
        each = 0.5 * (1 + confidence)
        out = np.zeros(len(self.error), bool)
        if self.upper_mean(each) > budget.mean:
            return out
        room = (budget.worst - self.tiles) / np.maximum(self.deviation, _TINY)
        for tile in np.argsort(room, kind="stable"):
            if _upper_worst(self.tiles[~out], self.deviation[~out], each) <= budget.worst:
                break
            out[tile] = True
        return out

    def may_hold(self, budget: Budget, confidence: float, factor: F64) -> bool:
        """Whether factor, (T,), times the paths in the doubtful tiles might show that both bounds hold, were each of
        these better by one deviation than is estimated."""
        tiles = self.doubtful(budget, confidence)
        less = np.where(tiles, self.deviation, 0.0)
        fewer = np.where(tiles, self.deviation / np.sqrt(factor), self.deviation)
        better = ErrorEstimate(self.error - less, np.maximum(self.average - less, 0.0), fewer, self.owed)
        return better.surely_holds(budget, confidence)


NOTHING = ErrorEstimate(*np.zeros((4, TILES)))


def _quantile(confidence: float) -> float:
    return NormalDist().inv_cdf(confidence)


@njit(cache=True, nogil=True, error_model="numpy")
def _upper_worst(tiles, deviation, confidence):
    """The smallest x with a probability of at least confidence that x is above all of independent normal variables, by
    bisection."""
    low, high = np.max(tiles), np.max(tiles + 40.0 * deviation)
    if high <= low:
        return max(low, 0.0)
    low = min(low, 0.0)
    for _ in range(60):
        x = 0.5 * (low + high)
        below = 1.0
        for t in range(len(tiles)):
            if deviation[t] > 0.0:
                below *= 0.5 * math.erfc((tiles[t] - x) / (deviation[t] * math.sqrt(2.0)))
            elif tiles[t] > x:
                below = 0.0
        if below >= confidence:
            high = x
        else:
            low = x
    return max(high, 0.0)


@dataclass(frozen=True)
class Difference:
    """Sums of what paths differ by: colour by half of the samples and pixel, (2, P, 3) float64, linear; squares by
    tile, (2, T) float64, of luminance and of colour.
    """

    pixels: F64
    squares: F64

    @staticmethod
    def nothing(pixels: int) -> Difference:
        """Where nothing is culled, in a picture of so many pixels."""
        return Difference(np.zeros((2, pixels, 3)), np.zeros((2, TILES)))

    def __add__(self, other: Difference) -> Difference:
        return Difference(self.pixels + other.pixels, self.squares + other.squares)


class Reference:
    """Paths of the full scene: what each brought, and the light of tiles that changes are relative to.

    paths: (T,) float64, how many lie in each tile.
    """

    def __init__(
        self, log: PathLog, only: np.ndarray | None = None, light: F64 | None = None, known: F64 | None = None
    ) -> None:
        """only: (H, W, S), marks the paths that there are, where those are not all: of a tile all or none. light: (T,)
        luminance of all paths of each tile, where the log leaves some of it out. known: (T,) what share of the light is
        surely there, where that is not all: changes are relative to that.
        """
        self.height, self.width, self.samples = log.shape
        marked = np.ones(log.shape, bool) if only is None else only.astype(bool)
        color = sparse_zeros(log.color.shape, np.float32)
        color[marked] = log.color[marked]
        self.color: F32 = color.reshape(-1, 3)
        self.tile: I32 = tiles_of(self.height, self.width).ravel().astype(np.int32)  # of each pixel
        # halves in a checkerboard of pixels: there are two with one sample per pixel, too
        self._parity = (np.arange(self.height)[:, None] + np.arange(self.width)[None, :]).ravel() % 2
        by_pixel = (
            np.full(len(self.tile), self.samples)
            if only is None
            else only.reshape(len(self.tile), -1).astype(bool).sum(axis=1)
        )
        self.paths: F64 = np.bincount(self.tile, by_pixel, TILES)
        # of a tile's light no backdrop is taken away; of paths that half pass what is there, some of their light is
        bright = np.maximum(self.color, 0.0) if log.backdrop else self.color
        self._sums = np.stack(
            [
                np.bincount(self.tile, bright[:, c].reshape(-1, self.samples).sum(axis=1, dtype=np.float64), TILES)
                for c in range(3)
            ]
        )
        self._light, self.known = light, np.ones(TILES) if known is None else known

    @property
    def nothing(self) -> Difference:
        """Where nothing is culled."""
        return Difference.nothing(len(self.tile))

    def compare(self, only: np.ndarray, color: F32, before: PathLog, already: Difference) -> Difference:
        """What paths differ by where some entries are culled, and others perhaps were already.

        before, already: the log, and the difference, without those others; only: `PathLog.affected` of that log by
        those that are new; color: (H, W, S, 3) float32 of the paths marked there, traced without any of them.
        """
        paths = numbers(only)
        then, now = ((x.reshape(-1, 3)[paths] - self.color[paths]).astype(np.float64) for x in (before.color, color))
        pixel = paths // self.samples
        place = (self._parity[pixel] + paths % self.samples) % 2 * len(self.tile) + pixel
        step = now - then
        pixels = np.stack([np.bincount(place, step[:, c], 2 * len(self.tile)) for c in range(3)], axis=-1).reshape(
            already.pixels.shape
        )
        squares = [(now @ LUMINANCE) ** 2 - (then @ LUMINANCE) ** 2, (now**2 - then**2).mean(axis=1)]
        return already + Difference(
            pixels, np.stack([np.bincount(self.tile[pixel], square, TILES) for square in squares])
        )

    def changes_by_unit(
        self, unit: I32, culled: np.ndarray, only: np.ndarray, color: F32, before: PathLog, light: Light
    ) -> tuple[F64, F64]:
        """What each of the culled units, (U,) bool with C of them, changed alone, by the paths that met an entry of it
        before any other of them: sums, and of squares, (C, T) float64, relative to a light. unit: (A,) of each TLAS
        entry. The rest as in `compare`.
        """
        paths = numbers(only)
        tile = self.tile[paths // self.samples]
        number = np.where(culled, np.cumsum(culled) - 1, -1)
        change, squares = np.zeros((2, int(culled.sum()), TILES))
        step = (color.reshape(-1, 3)[paths] - before.color.reshape(-1, 3)[paths]).astype(np.float64)
        luminance, colored = (
            step @ LUMINANCE / light.luminance[tile],
            np.sqrt((step**2).mean(axis=1)) / light.brightness[tile],
        )
        size = np.where(np.abs(luminance) >= colored, luminance, colored)
        attribute_to_first_hit(
            before.records.reshape(-1, RECORD), paths, np.append(number[unit], -1), tile, size, change, squares
        )
        return change, squares


@dataclass(frozen=True)
class Light:
    """What changes of the tiles are relative to, of one reference or several that are looked at together.

    paths: (T,) float64, how many lie in each tile. luminance, brightness: (T,) float64 sums over these: the latter the
    root of the mean square of the channels.
    """

    paths: F64
    luminance: F64
    brightness: F64
    height: int
    width: int

    @staticmethod
    def of(*references: Reference) -> Light:
        """Tiles darker than DARK of the mean are judged against that."""
        paths = np.maximum(np.sum([r.paths for r in references], axis=0), 1.0)
        sums = np.sum([r._sums for r in references], axis=0)
        luminance, brightness = LUMINANCE @ sums, np.sqrt((sums**2).mean(axis=0))
        known = [r._light for r in references if r._light is not None]
        if known:
            luminance = brightness = np.sum(known, axis=0)
        luminance, brightness = luminance * references[0].known, brightness * references[0].known
        lit = [
            paths * np.maximum(x / paths, max(DARK * float((x / paths).mean()), _TINY)) for x in (luminance, brightness)
        ]
        return Light(paths, lit[0], lit[1], references[0].height, references[0].width)

    def share(self, tile: I32, color: F64) -> F64:
        """(S,) what mean radiance (S, 3) is of the light of tiles (S,): the larger of its luminance and its colour."""
        paths = self.paths[tile]
        return np.asarray(
            np.maximum(
                color @ LUMINANCE * paths / self.luminance[tile],
                np.sqrt((color**2).mean(axis=1)) * paths / self.brightness[tile],
            )
        )

    def estimate(self, difference: Difference, owed: F64 | None = None) -> ErrorEstimate:
        """The error that paths show. owed: (T,) to be charged on top.

        The deviation is that of a stratified sample, by pixel; an event that none of n paths showed is taken to be one
        as bright as the tile in n.
        """
        owed = np.zeros(TILES) if owed is None else owed
        if not difference.pixels.any():
            return ErrorEstimate(np.zeros(TILES), np.zeros(TILES), np.zeros(TILES), owed)
        tile = tiles_of(self.height, self.width).ravel()
        luminance = difference.pixels @ LUMINANCE / self.luminance[tile]  # (2, P)
        color = difference.pixels / self.brightness[tile][None, :, None]
        whole = np.stack([np.bincount(tile, color[:, :, c].sum(axis=0), TILES) for c in range(3)])
        error = np.maximum(np.abs(np.bincount(tile, luminance.sum(axis=0), TILES)), np.sqrt((whole**2).mean(axis=0)))
        sure, average, blocks = self._detail(color)
        strata = np.stack(
            [np.bincount(tile, x, TILES) for x in (luminance.sum(axis=0) ** 2, (color.sum(axis=0) ** 2).mean(axis=1))]
        )
        # samples per pixel of each tile
        samples = np.maximum(self.paths / np.maximum(np.bincount(tile, minlength=TILES), 1), 1.0)
        variance = difference.squares / np.stack([self.luminance, self.brightness]) ** 2
        several = samples > 1
        variance = np.where(several, (variance - strata / samples) * (samples / np.maximum(samples - 1, 1)), variance)
        deviation = np.sqrt(np.maximum(variance.max(axis=0), 0.0) + self.paths**-2.0)
        shrunk = SHRINKAGE * np.maximum(np.sqrt(blocks) - math.sqrt(FEW_BLOCKS), 0.0) * deviation
        sure = sure + np.clip(average - sure, 0.0, shrunk)
        return ErrorEstimate(np.maximum(error, sure), np.maximum(error, average), deviation, owed)

    def _detail(self, color: F64) -> tuple[F64, F64, I64]:
        """Mean absolute change of colour over the blocks of each tile: color is (2, P, 3), relative change by halves of
        the samples.

        Twice (T,): by cross-fitting, which noise shrinks; and one that it does not. Of blocks of which both halves show
        a change that is the smaller of two figures that are too large: the absolute values as they are, and the root of
        the mean square by products of the halves, free of noise; of other blocks the absolute values. Then how many
        blocks each tile has.
        """
        block, tile = _blocks(self.height, self.width)
        sums = np.stack([[np.bincount(block, half[:, c], len(tile)) for c in range(3)] for half in color])  # (2, 3, B)
        size = np.sqrt((sums**2).mean(axis=1))
        product = (sums[0] * sums[1]).mean(axis=0)
        inverse = np.divide(1.0, size, out=np.zeros_like(size), where=size > 0).sum(axis=0)
        both = (size > 0).all(axis=0)
        fitted = np.bincount(tile, np.where(both, product * inverse, 0.0), TILES)
        absolute = np.sqrt((sums.sum(axis=0) ** 2).mean(axis=0))
        by_half, alone = (np.bincount(tile, np.where(which, absolute, 0.0), TILES) for which in (both, ~both))
        squares = 4 * np.bincount(tile, product, TILES) * np.bincount(tile[both], minlength=TILES)
        average = alone + np.minimum(by_half, np.sqrt(np.maximum(squares, 0.0)))
        return fitted, average, np.bincount(tile, minlength=TILES)


@lru_cache(maxsize=8)
def _blocks(height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """The block of each pixel, (P,), and the tile of each block. What lies in two tiles is two blocks."""
    y, x = np.arange(height) // BLOCK, np.arange(width) // BLOCK
    block = (y[:, None] * (x[-1] + 1) + x[None, :]).ravel()
    tile = tiles_of(height, width).ravel()
    _, first, number = np.unique(block.astype(np.int64) * TILES + tile, return_index=True, return_inverse=True)
    return number, tile[first]
