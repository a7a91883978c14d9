"""Which BLASes are in memory where bytes, or milliseconds per frame, are limited: those of the most valuable
instances."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..arrays import F32, I32, I64
from .blas import BlasCache


class Residency:
    """The BLASes of instances, within a budget. seconds: of building per frame; limit: bytes of all BLASes; 0: not
    limited."""

    def __init__(self, blas: BlasCache, seconds: float, limit: int, hysteresis: float) -> None:
        """hysteresis: a BLAS is freed only for one that is worth more than so many times as much."""
        self.blas, self._seconds, self._limit, self._hysteresis = blas, seconds, limit, hysteresis

    @property
    def limited(self) -> bool:
        """Whether some active instance may be without a BLAS."""
        return bool(self._seconds or self._limit)

    @property
    def deferred(self) -> bool:
        """Whether what is not built now may be in a later frame."""
        return bool(self._seconds)

    def schedule(self, mesh: I32, active: np.ndarray, value: F32, step: Callable[[int, int], None]) -> None:
        """Have the BLASes of active instances, (N,) bool, built or scheduled, the most valuable first. mesh: (N,) of
        each; value: (N,)."""
        rows = np.flatnonzero(active)
        meshes, users = np.unique(mesh[rows], return_inverse=True)
        worth = np.bincount(users, value[rows], len(meshes)).astype(np.float64)
        worth[self.blas.scenes[meshes] != 0] *= self._hysteresis  # nothing is freed for what is worth hardly more
        order = np.argsort(-worth, kind="stable")
        self.blas.provide(meshes[order], self._seconds, self._limit, step)

    def waiting(self, mesh: I32, active: np.ndarray) -> I64:
        """Active instances without a BLAS: it is being built, or does not fit the budget."""
        rows = np.flatnonzero(active)
        return rows[self.blas.scenes[mesh[rows]] == 0]
