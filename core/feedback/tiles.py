"""Coarse tiles of the picture: a change is bounded in the mean of all and in the worst of them, for a lost shadow is
local."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..arrays import F32, F64, I64
from ..scene.film import LUMINANCE

COLUMNS, ROWS = 16, 9
TILES = COLUMNS * ROWS
BLOCK = 3  # pixels of the analysis picture: what is finer is averaged
DARK = 0.01  # of the mean luminance: darker tiles are judged against this, below which no display shows a change


def tiles_of(height: int, width: int) -> NDArray[np.int64]:
    """(height, width) tile of every pixel, numbered in rows from the first."""
    y, x = np.arange(height) * ROWS // height, np.arange(width) * COLUMNS // width
    return y[:, None] * COLUMNS + x[None, :]


def tile_means(picture: F32) -> F64:
    """Mean luminance of the tiles of a picture (H, W, 3 or 4): (TILES,) float64."""
    luminance = picture[..., :3].astype(np.float64) @ LUMINANCE
    tile = tiles_of(*luminance.shape).ravel()
    return np.bincount(tile, luminance.ravel(), TILES) / np.maximum(np.bincount(tile, minlength=TILES), 1)


def marks(samples: I64, height: int, width: int) -> NDArray[np.uint8]:
    """(height, width, S) 1 for each of so many paths per pixel, (TILES,), in each tile: the first ones of S, the most
    that a tile has."""
    return (np.arange(int(samples.max())) < samples[tiles_of(height, width)][..., None]).astype(np.uint8)
