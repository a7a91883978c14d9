"""An error budget instead of a threshold: cull the set that saves most while the picture changes by no more than was allowed.

Feedback says what each instance is worth in each coarse tile of the picture (`feedback.Weights`). Selection culls what is cheap under both bounds; calibration
traces what is left with the same random numbers, measures what really changed, and selects again until the bounds hold.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from .errors import InputError
from .film import LUMINANCE
from .scene import F32, F64, I32, I64


@dataclass(frozen=True)
class Budget:
    """mean: bound of the mean relative change of the picture; worst: of its worst tile, 5 times the mean unless given."""

    mean: float
    worst: float

    @staticmethod
    def parse(text: str) -> Budget:
        """'E' or 'E,T', shares of 1: '0.01' or '0.01,0.05'. Raises InputError."""
        try:
            numbers = [float(part) for part in text.split(",")]
        except ValueError:
            numbers = []
        if not 1 <= len(numbers) <= 2 or not all(0 <= x <= 1 for x in numbers):
            raise InputError(f"--max-error {text}: give E or E,T, each a share between 0 and 1, for example 0.01 or 0.01,0.05")
        return Budget(numbers[0], numbers[1] if len(numbers) == 2 else min(5 * numbers[0], 1.0))


@dataclass(frozen=True)
class Selection:
    """cull: (A,) bool. mean, worst: predicted relative change of the picture and of its worst tile."""

    cull: np.ndarray
    mean: float
    worst: float


@njit(cache=True, nogil=True, error_model="numpy")
def _greedy(order, weights, mean_bound, tile_bound):
    """Cull in order while the mean of the tiles' sums and every tile's sum stay within bounds. order: (A,) int64; weights: (A, T) float64."""
    count, tiles = weights.shape
    cull = np.zeros(count, np.bool_)
    sums = np.zeros(tiles)
    total = 0.0
    for i in order:
        own = 0.0
        fits = True
        for t in range(tiles):
            own += weights[i, t]
            if sums[t] + weights[i, t] > tile_bound:
                fits = False
                break
        if not fits or total + own > mean_bound * tiles:
            continue
        cull[i] = True
        total += own
        for t in range(tiles):
            sums[t] += weights[i, t]
    return cull, sums


def saved_cost(mesh: I32, bytes_of: I64) -> F64:
    """Bytes that culling each of A instances saves: its TLAS entry, and its share of the BLAS that it shares with the others of the A. (A,) float64."""
    users = np.bincount(mesh, minlength=len(bytes_of))
    return 150.0 + bytes_of[mesh] / users[mesh]  # a TLAS entry: 64 bytes of Embree's leaf, 52 of ours, and its share of the inner nodes


def select(weights: F64, saved: F64, mean_bound: float, tile_bound: float, unseen: float = 0.0) -> Selection:
    """The instances to cull: cheapest change per saved byte first, while both bounds hold.

    weights: (A, T) relative change of each tile where instance a is missing; saved: (A,) bytes. unseen: change already owed to instances that no path met.
    Greedy for a knapsack of two kinds of bound (Dantzig 1957 for one): within one instance's worth of the best.
    """
    order = np.argsort(weights.sum(axis=1) / saved, kind="stable")
    cull, sums = _greedy(order, weights, max(mean_bound - unseen, 0.0), tile_bound)
    return Selection(cull, float(sums.mean()) + unseen, float(sums.max(initial=0.0)))


def unseen_share(hits: I64, paths: int) -> float:
    """Share of all paths that meet something which none of the traced ones met: expected from how much was met just once (Good 1953, Turing's estimate).

    hits: (N,) int64 rays that met each instance; paths: how many were traced. A path that meets such an instance is taken to be wholly wrong.
    """
    return float((hits == 1).sum()) / max(paths, 1)


def tile_means(picture: F32, columns: int, rows: int) -> F64:
    """Mean luminance of the tiles of a picture (H, W, 3 or 4): (rows * columns,) float64, in rows from the first."""
    height, width = picture.shape[:2]
    luminance = picture[..., :3].astype(np.float64) @ LUMINANCE
    y, x = np.arange(height) * rows // height, np.arange(width) * columns // width
    tile = y[:, None] * columns + x[None, :]
    sums = np.bincount(tile.ravel(), luminance.ravel(), rows * columns)
    return sums / np.maximum(np.bincount(tile.ravel(), minlength=rows * columns), 1)


def change(full: F32, culled: F32, columns: int, rows: int) -> tuple[float, float]:
    """Relative change of a picture against the full one, traced with the same random numbers: mean over tiles, and of the worst tile.

    Dark tiles are judged against a hundredth of the mean, as the weights are.
    """
    a, b = tile_means(full, columns, rows), tile_means(culled, columns, rows)
    relative = np.abs(b - a) / np.maximum(a, max(0.01 * a.mean(), 1e-30))
    return float(relative.mean()), float(relative.max())
