"""How much two versions of a scene differ, judged by pairs of pictures and by nothing else: what a judge from outside
can know.

Each pair was rendered with the same random numbers, each with others than the pairs before. Three relative changes are
judged, per coarse tile:

    luminance   of the tile's mean
    colour      of the tile's mean, root mean square over the channels
    detail      mean over blocks of BLOCKS x BLOCKS to a tile, each taken like colour

Pairs tell their noise: a pixel's difference varies from pair to pair by noise alone, and what differs between
neighbouring pixels is none. A change that may be noise is not counted where a lower end is asked for: its direction is
taken from the other pairs, so that noise averages out (cross-fitting).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

F64 = NDArray[np.float64]

COLUMNS, ROWS = 16, 9
BLOCKS = 5  # to a tile, in each direction: 4 x 4 pixels at 320 x 180
DARKEST = 0.01  # of the picture's mean: darker tiles are judged against that
SURE = 3.0  # standard errors
WEIGHTS = np.array([0.2126, 0.7152, 0.0722])  # luminance of linear Rec.709
MEASURES = ("luminance", "colour", "detail")


@dataclass(frozen=True)
class Range:
    """Where a change surely lies; low 0 where it may be noise. value: the estimate."""

    low: float
    value: float
    high: float


@dataclass(frozen=True)
class Change:
    """Of the mean over the tiles, and of the worst tile."""

    mean: Range
    worst: Range

    def times(self, mean: float, worst: float) -> Range:
        """How many times a budget, that of the two bounds which is the more exceeded."""
        by_end = [
            [getattr(change, end) / max(bound, 1e-12) for end in ("low", "value", "high")]
            for change, bound in ((self.mean, mean), (self.worst, worst))
        ]
        low, value, high = np.max(by_end, axis=0)
        return Range(float(low), float(value), float(high))


class Pairs:
    """Pairs of pictures of a full scene and of another version of it."""

    def __init__(self) -> None:
        self._samples: list[int] = []
        self._full: list[F64] = []
        self._difference: list[F64] = []

    def add(self, full: ArrayLike, other: ArrayLike, samples: int) -> None:
        """Add a pair, (H, W, 3 or more) linear Rec.709, by so many samples per pixel. Raises ValueError where sizes
        differ or a value is not finite."""
        a, b = (np.asarray(x, np.float64)[..., :3] for x in (full, other))
        if a.shape != b.shape or (self._full and a.shape != self._full[0].shape):
            raise ValueError("pictures of different sizes cannot be compared")
        if not (np.isfinite(a).all() and np.isfinite(b).all()):
            raise ValueError("a picture has values that are not finite")
        self._samples.append(samples)
        self._full.append(a)
        self._difference.append(b - a)

    @property
    def samples(self) -> int:
        """Per pixel, in all."""
        return sum(self._samples)

    def changes(self) -> dict[str, Change]:
        """The change by each of MEASURES. Raises ValueError for fewer than two pairs: one does not tell its noise."""
        if len(self._full) < 2:
            raise ValueError("one pair of pictures does not tell its noise: add another")
        return {name: self._change(name) for name in MEASURES}

    def _change(self, measure: str) -> Change:
        weight = np.array(self._samples, np.float64)
        difference, full = np.stack(self._difference), np.average(self._full, axis=0, weights=weight)
        if measure == "luminance":
            difference, full = (x @ WEIGHTS[:, None] for x in (difference, full))
        fine = BLOCKS if measure == "detail" else 1
        height, width, channels = full.shape
        cell, of = _cells(height, width, fine)
        light = _sums(full, cell, len(of))  # (C, channels)
        pixels = np.bincount(cell.ravel(), minlength=len(of))
        tile = np.bincount(of, minlength=ROWS * COLUMNS)  # cells in each
        area = np.bincount(of, pixels, ROWS * COLUMNS)
        brightness = np.sqrt((_by_tile(light, of) ** 2).mean(axis=1)) / area
        # (C,) of a cell of a tile of that brightness
        brightness = np.maximum(brightness, max(DARKEST * brightness.mean(), 1e-30))[of] * pixels

        # (K, C, channels)
        by_pair = np.stack([_sums(x, cell, len(of)) for x in difference]) / brightness[None, :, None]
        together = np.average(by_pair, axis=0, weights=weight)
        # the mean without that pair
        rest = (weight.sum() * together - weight[:, None, None] * by_pair) / (weight.sum() - weight)[:, None, None]
        length = np.linalg.norm(rest, axis=2)
        along = np.divide((by_pair * rest).sum(axis=2), length, out=np.zeros_like(length), where=length > 0)
        least, most = np.average(along, axis=0, weights=weight) / np.sqrt(channels), np.sqrt((together**2).mean(axis=1))

        spread = (weight[:, None, None, None] * (difference - np.average(difference, axis=0, weights=weight)) ** 2).sum(
            axis=0
        )
        variance = _sums(spread, cell, len(of)).mean(axis=1) / ((len(weight) - 1) * weight.sum() * brightness**2)
        least, most = (np.bincount(of, x, ROWS * COLUMNS) / tile for x in (least, most))
        error = np.sqrt(np.bincount(of, variance, ROWS * COLUMNS)) / tile
        margin = SURE * float(np.sqrt((error**2).sum())) / len(error)
        mean = Range(max(float(least.mean()) - margin, 0.0), float(most.mean()), float(most.mean()) + margin)
        worst = Range(
            max(float((least - SURE * error).max()), 0.0), float(most.max()), float((most + SURE * error).max())
        )
        return Change(mean, worst)


def _cells(height: int, width: int, fine: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The cell of each pixel, (height, width), of fine x fine to a tile, less where pixels are larger; and the tile of
    each cell."""
    y, x = (np.arange(n) * (tiles * fine) // n for n, tiles in ((height, ROWS), (width, COLUMNS)))
    number = y[:, None] * (COLUMNS * fine) + x[None, :]
    used, cell = np.unique(number, return_inverse=True)
    row, column = used // (COLUMNS * fine) // fine, used % (COLUMNS * fine) // fine
    return cell.reshape(height, width), row * COLUMNS + column


def _sums(values: F64, cell: NDArray[np.int64], count: int) -> F64:
    """Sums of (H, W, channels) over cells: (count, channels)."""
    return np.stack([np.bincount(cell.ravel(), values[..., c].ravel(), count) for c in range(values.shape[-1])], axis=1)


def _by_tile(values: F64, of: NDArray[np.int64]) -> F64:
    """Sums of (C, channels) over the cells of tiles: (T, channels)."""
    return np.stack([np.bincount(of, values[:, c], ROWS * COLUMNS) for c in range(values.shape[1])], axis=1)
