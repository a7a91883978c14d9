"""The change between two pictures as the budget counts it, tile by tile, and what of it noise may have made.

Of a tile the larger of the relative changes of its mean luminance, of its mean colour, and of its colour block by block
(the mean over blocks; docs/error.md). Of transparent pictures lost or added alpha counts as light, as bright as what is
in them in the mean. A block of few samples is noisy, and the absolute value of noise is no change. So
noise is told by what differs between the pixels of a block, which takes detail within it for noise, too, and so errs
towards less noise-free change; the noise of pixels is taken to be independent.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..arrays import F32, F64
from ..scene.film import LUMINANCE
from .tiles import BLOCK, COLUMNS, DARK, ROWS

WIDTH = 240  # pixels of an analysis picture, unless it has others
LEAST = 2  # pixels of a block's side: of fewer none tells its noise
_TINY = 1e-30


@dataclass(frozen=True)
class Change:
    """Relative change of (T,) tiles by each measure. luminance, colour: of the means, noise included; detail: of the
    colour block by block, as it is; noise, block_noise: standard error of the luminance and, in the mean, of a block's
    colour; detail_noise: that of detail; squares: the mean square over the blocks, less noise."""

    luminance: F64
    colour: F64
    detail: F64
    noise: F64
    block_noise: F64
    detail_noise: F64
    squares: F64

    @property
    def tiles(self) -> F64:
        """(T,) the largest of the three. Of detail the smaller of two figures that are not too small: as it is, and the
        root of the mean square without noise."""
        detail = np.minimum(self.detail, np.sqrt(np.maximum(self.squares, 0.0)))
        return np.asarray(np.maximum(np.maximum(self.luminance, self.colour), detail))

    def least_mean(self, deviations: float) -> float:
        """A lower bound of the mean over the tiles: by luminance or by detail, less the size that noise alone has, and
        so many standard errors."""
        sizes = self.luminance - np.sqrt(2 / np.pi) * self.noise, self.detail - self.block_noise
        errors = self.noise, self.detail_noise
        least = [
            size.mean() - deviations * np.sqrt((error**2).sum()) / len(error)
            for size, error in zip(sizes, errors, strict=True)
        ]
        return max(float(max(least)), 0.0)

    def least_worst(self, deviations: float) -> float:
        """A lower bound of the worst tile: so many standard errors are to be as rare for the worst of all as they are
        for one (`deviations` of two measures of all tiles)."""
        least = [
            (self.luminance - deviations * self.noise).max(),
            (self.detail - self.block_noise - deviations * self.detail_noise).max(),
        ]
        return max(float(max(least)), 0.0)


def change_of(
    full: Sequence[F32], other: Sequence[F32], rows: int = ROWS, columns: int = COLUMNS, block: float | None = None
) -> Change:
    """The change between pictures, (h, w, 3 or 4) float32 linear Rec. 709 each, with premultiplied alpha or opaque, and
    others of the same sizes.

    rows, columns: tiles of each picture; their tiles come one picture after the other, in rows as the pixels' are.
    block: pixels of a block's side (default: those of BLOCK pixels in a picture WIDTH pixels wide). Tiles that are
    darker than DARK of the mean of all are judged against that.
    """
    parts, count = [], 0
    backdrop = _backdrop(full)
    for k, (a, b) in enumerate(zip(full, other, strict=True)):
        side = max(block or a.shape[1] * BLOCK / WIDTH, LEAST)
        tile, number, owner = _cells(a.shape[0], a.shape[1], rows, columns, side)
        first, second = (_before(x, backdrop) for x in (a, b))
        cells = tile + k * rows * columns, number + count, owner + k * rows * columns
        parts.append((np.maximum(first, 0.0), second - first, *cells))
        count += len(owner)
    light, change, tile, number, owner = (np.concatenate(x) for x in zip(*parts, strict=True))
    return _change(light, change, tile, number, owner, rows * columns * len(full))


def _change(
    light: F64, change: F64, tile: NDArray[np.int64], block: NDArray[np.int64], owner: NDArray[np.int64], tiles: int
) -> Change:
    """light, change: (P, 3) of the pixels; tile, block: (P,) theirs; owner: (B,) the tile of each block."""
    count = np.maximum(np.bincount(tile, minlength=tiles), 1)
    mean = _sums(light, tile, tiles) / count[:, None]
    luminance = _lit(mean @ LUMINANCE)
    brightness = _lit(np.sqrt((mean**2).mean(axis=1)))

    relative = change @ LUMINANCE / luminance[tile]
    first, second = (np.bincount(tile, relative**power, tiles) / count for power in (1, 2))
    colour = change / brightness[tile][:, None]
    whole = np.sqrt(((_sums(colour, tile, tiles) / count[:, None]) ** 2).mean(axis=1))

    held = np.bincount(block, minlength=len(owner))
    share = held / count[owner]  # of its tile
    square = ((_sums(colour, block, len(owner)) / held[:, None]) ** 2).mean(axis=1)  # of a block's mean change
    all_squares = np.bincount(tile, (colour**2).mean(axis=1), tiles)
    free = count - np.bincount(owner, minlength=tiles)
    within = np.maximum(all_squares - np.bincount(owner, held * square, tiles), 0.0)
    pixel = np.where(free > 0, within / np.maximum(free, 1), all_squares)  # where nothing tells it, all may be noise
    variance = pixel[owner] / held

    def by_tile(of_blocks: F64) -> F64:
        return np.bincount(owner, of_blocks, tiles)

    return Change(
        np.abs(first),
        whole,
        by_tile(share * np.sqrt(square)),
        np.sqrt(np.maximum(second - first**2, 0.0) / count),
        by_tile(share * np.sqrt(variance)),
        np.sqrt(by_tile(share**2 * variance)),
        by_tile(share * (square - variance)),
    )


def _backdrop(pictures: Sequence[F32]) -> float:
    """Mean luminance of what is in pictures, by their alpha, as of `PathLog.backdrop`; of opaque ones 0."""
    transparent = [x for x in pictures if x.shape[2] > 3]
    alpha = sum(float(x[..., 3].sum(dtype=np.float64)) for x in transparent)
    if len(transparent) < len(pictures) or alpha >= sum(x[..., 3].size for x in transparent):
        return 0.0
    return sum(float((x[..., :3] @ LUMINANCE).sum()) for x in transparent) / max(alpha, _TINY)


def _before(picture: F32, backdrop: float) -> F64:
    """(P, 3) light of the pixels of a picture, less the backdrop where it is transparent."""
    color = picture[..., :3].reshape(-1, 3).astype(np.float64)
    return color - (1 - picture[..., 3].reshape(-1, 1).astype(np.float64)) * backdrop if backdrop else color


def _lit(light: F64) -> F64:
    return np.maximum(light, max(DARK * float(light.mean()), _TINY))


def _sums(values: F64, cell: NDArray[np.int64], count: int) -> F64:
    """Sums of (P, 3) over cells: (count, 3)."""
    return np.stack([np.bincount(cell, values[:, c], count) for c in range(3)], axis=1)


def _cells(height: int, width: int, rows: int, columns: int, side: float) -> tuple[NDArray[np.int64], ...]:
    """The tile and the block of each pixel, (P,), and the tile of each block. What lies in two tiles is two blocks."""
    y, x = np.arange(height), np.arange(width)
    tile = ((y * rows // height)[:, None] * columns + (x * columns // width)[None, :]).ravel()
    across = int(width / side) + 1
    square = ((y / side).astype(np.int64)[:, None] * across + (x / side).astype(np.int64)[None, :]).ravel()
    _, first, number = np.unique(square * (rows * columns) + tile, return_index=True, return_inverse=True)
    return tile, number.ravel(), tile[first]


def tile_changes(full: F32, other: F32) -> F64:
    """(TILES,) float64: relative change of the tiles between two pictures, (H, W, 3 or 4) float32, linear, as
    `Change.tiles`."""
    return change_of([full], [other]).tiles
