"""An error budget instead of a threshold: cull the set that saves most while the picture changes by no more than was allowed.

Every path knows what it gathered behind each instance that it met, and every shadow ray what light its blocker denied. Summed per instance and coarse tile
of the picture, relative to the tile's brightness, that is what the instance is worth there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from .errors import InputError
from .scene import F64, I32, I64

COLUMNS, ROWS = 16, 9  # coarse tiles of the picture, over which the worst is bounded
TILES = COLUMNS * ROWS


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


def relative_weights(light: I64, brightness: F64, scale: float) -> F64:
    """What each instance is worth in each tile, relative to the tile: (A, T) float64.

    light: (A, T) int64 fixed-point luminance of `scale` units to one, gathered behind or denied by each instance; brightness: (T,) float64 luminance of each
    tile, summed over the same paths. Dark tiles are judged against a hundredth of the mean, below which no display shows a change.
    """
    floor = 0.01 * brightness.mean()
    return light / scale / np.maximum(brightness, max(floor, 1e-30))[None, :]


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
