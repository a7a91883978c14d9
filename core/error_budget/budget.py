"""An error budget instead of a threshold: cull the set that saves most while the picture's error stays within it.

Feedback says what each instance is worth in each coarse tile of the picture (`feedback.Weights`). Selection culls what
costs least error per byte saved under both bounds; calibration traces what is left with the same random numbers,
measures what really changed, and selects again until the bounds hold.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from ..arrays import F64, I32, I64
from ..errors import InputError

SPREAD = 5.0  # default ratio of the worst tile's bound to the mean's
ENTRY_BYTES = 150.0  # of a TLAS entry: 64 bytes of Embree's leaf, 52 of ours, and its share of the inner nodes


@dataclass(frozen=True)
class Budget:
    """Bounds of the error that docs/error.md defines. mean: of the mean over the tiles; worst: of the worst tile."""

    mean: float
    worst: float

    @staticmethod
    def parse(text: str, spread: float = SPREAD) -> Budget:
        """'E' or 'E,T', in percent or as shares: '1%', '0.01', '1%,5%'; T is spread times E unless given, 1 at most.
        Raises InputError, also where '1' may mean either.
        """
        try:
            numbers = [_share(part) for part in text.split(",")]
        except ValueError:
            numbers = []
        if not 1 <= len(numbers) <= 2 or not all(0 <= x <= 1 for x in numbers):
            raise InputError(f"--max-error {text}: give E or E,T, for example 1% or 1%,5%, or as shares 0.01,0.05")
        return Budget(numbers[0], numbers[1] if len(numbers) == 2 else min(spread * numbers[0], 1.0))


def _share(text: str) -> float:
    """Raises ValueError."""
    number = text.strip()
    if number.endswith("%"):
        return float(number[:-1]) / 100
    if float(number) >= 1:
        raise ValueError
    return float(number)


@dataclass(frozen=True)
class Selection:
    """cull: (A,) bool. mean, worst: predicted relative change of the picture and of its worst tile."""

    cull: np.ndarray
    mean: float
    worst: float


@njit(cache=True, nogil=True, error_model="numpy")
def _greedy(order, weights, mean_bound, tile_bounds):
    """Cull in order while the mean of the tiles' sums and every tile's sum stay within bounds. order: (A,) int64;
    weights: (A, T) and tile_bounds: (T,) float64."""
    count, tiles = weights.shape
    cull = np.zeros(count, np.bool_)
    sums = np.zeros(tiles)
    total = 0.0
    for i in order:
        own = 0.0
        fits = True
        for t in range(tiles):
            own += weights[i, t]
            if sums[t] + weights[i, t] > tile_bounds[t]:
                fits = False
                break
        if not fits or total + own > mean_bound * tiles:
            continue
        cull[i] = True
        total += own
        for t in range(tiles):
            sums[t] += weights[i, t]
    return cull, sums


@dataclass(frozen=True)
class Shared:
    """What A entries have in common beside meshes, such as images.

    group: (A,) int32 of each entry; uses: (U, 2) int32, pairs of a group and a thing; bytes_of: (I,) int64, of each
    thing.
    """

    group: I32
    uses: I32
    bytes_of: I64

    def shares(self) -> F64:
        """(A,) bytes, of each thing in equal parts by the entries that use it."""
        groups = int(max(self.group.max(initial=0), self.uses[:, 0].max(initial=0))) + 1
        entries, (group, thing) = np.bincount(self.group, minlength=groups), self.uses.T
        users = np.bincount(thing, entries[group], len(self.bytes_of))
        return np.asarray(np.bincount(group, self.bytes_of[thing] / np.maximum(users[thing], 1), groups)[self.group])

    def of(self, stay: np.ndarray) -> Shared:
        """Of those of the A that stay, (A,) bool."""
        return Shared(self.group[stay], self.uses, self.bytes_of)


@dataclass(frozen=True)
class Savings:
    """What culling of A TLAS entries saves.

    mesh: (A,) int32; bytes_of: (M,) int64, of each BLAS; share: (A,) float64 bytes that an entry saves: its own and, in
    equal parts among those of the A that share them, of its BLAS and of what else is shared, divided by reluctance:
    (A,) float64. own: (A,) float64 bytes of the entry itself.
    """

    mesh: I32
    bytes_of: I64
    share: F64
    reluctance: F64
    own: F64
    shared: Shared | None = None

    @staticmethod
    def among(
        mesh: I32,
        bytes_of: I64,
        reluctance: F64 | float = 1.0,
        own: F64 | float = ENTRY_BYTES,
        shared: Shared | None = None,
    ) -> Savings:
        """For entries with these meshes. reluctance: (A,), divides the share: above 1 for those that rather stay."""
        users = np.bincount(mesh, minlength=len(bytes_of))
        by, entry = (np.broadcast_to(np.asarray(x, np.float64), len(mesh)) for x in (reluctance, own))
        share = entry + bytes_of[mesh] / users[mesh] + (0.0 if shared is None else shared.shares())
        return Savings(mesh, bytes_of, share / by, by, entry, shared)

    def among_these(self, stay: np.ndarray) -> Savings:
        """For those of the A that stay, (A,) bool, where the others are gone: fewer have a BLAS in common."""
        shared = None if self.shared is None else self.shared.of(stay)
        return Savings.among(self.mesh[stay], self.bytes_of, self.reluctance[stay], self.own[stay], shared)

    @property
    def typical(self) -> float:
        """Bytes of an entry of which nothing is known."""
        return float(self.own.mean()) if len(self.own) else ENTRY_BYTES


def select(weights: F64, saved: F64, mean_bound: float, tile_bounds: F64 | float) -> Selection:
    """The instances to cull: cheapest change per saved byte first, while both bounds hold.

    weights: (A, T) relative change of each tile where instance a is missing; saved: (A,) bytes; tile_bounds: one for
    all tiles, or (T,).
    Greedy for a knapsack of two kinds of bound (Dantzig 1957 for one): within one instance's worth of the best.
    """
    order = np.argsort(weights.sum(axis=1) / saved, kind="stable")
    # a writable copy, so that the kernel is compiled for one type alone
    bounds = np.array(np.broadcast_to(tile_bounds, weights.shape[1]), np.float64)
    cull, sums = _greedy(order, weights, max(mean_bound, 0.0), bounds)
    return Selection(cull, float(sums.mean()), float(sums.max(initial=0.0)))
