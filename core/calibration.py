"""Which of the measured instances to cull: sets are tried, by tracing what they change with the same random numbers, until a budget is used up.

Weights say what each instance is worth by itself, at most. What many are worth together, and what lies behind them, is known when the scene has been traced
without them. Of all paths only those can differ that met something culled (`path_log`), so a trial costs a small part of the measurement.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from .budget import Budget, Savings, select
from .path_log import RECORD, PathLog
from .progress import Progress, silent
from .scene import F32, F64, I32
from .tiles import DARK, TILES, tiles_of

TRIALS = 64  # at most
PATIENCE = 5  # trials in a row that break the budget, after which none is expected to keep it
WIDER, WIDENINGS = 1.5, 20  # factor and number of steps by which bounds are widened, where what they allow has been tried
CONFIDENCE = 4.0  # standard deviations of its measurement that are added to the change of a tile, the worst of many in the best of many trials
AIM = 0.95  # of the budget: what selections are to use up. The rest of it is always taken to be left, for what they are worth is but predicted
PATHS = 1.4  # traced by all trials together at most, to those of the measurement


@dataclass(frozen=True)
class Trial:
    """The change of the picture by culling some entries, relative to the luminance of each of T coarse tiles.

    change: (T,) float64, signed. deviation: (T,) float64, its standard deviation, from the differences of single paths.
    entries: (A, T) float64 signed change by the paths that met an entry before any other of those that the trial culled; spread: its standard deviation.
    """

    change: F64
    deviation: F64
    entries: F64
    spread: F64

    @property
    def mean(self) -> float:
        """Mean relative change of the tiles."""
        return float(np.abs(self.change).mean())

    @property
    def worst(self) -> float:
        """The largest `bound` of a tile."""
        return float(self.bound.max())

    @property
    def bound(self) -> F64:
        """(T,) relative change of each tile, with CONFIDENCE standard deviations of its measurement on top."""
        return np.abs(self.change) + CONFIDENCE * self.deviation


class Base:
    """The measured picture by tiles, and what each of its paths met."""

    def __init__(self, log: PathLog, light: F64 | None = None) -> None:
        """light: (TILES,) luminance of all paths of each tile, where the log leaves some of it out."""
        height, width, samples = log.luminance.shape
        self.log = log
        self.tile: I32 = np.repeat(tiles_of(height, width).ravel(), samples).astype(np.int32)
        sums = np.bincount(self.tile, log.luminance.ravel(), TILES) if light is None else light
        counts = np.maximum(np.bincount(self.tile, minlength=TILES), 1)
        means = sums / counts
        self.light = counts * np.maximum(means, max(DARK * means.mean(), 1e-30))

    def compare(self, culled: np.ndarray, only: np.ndarray, luminance: F32, before: PathLog | None = None) -> Trial:
        """The change by culling some entries, (A,) bool, where others are perhaps culled already.

        before: the log without those others (default: the measured one); only: `PathLog.affected` of it; luminance: (H, W, S) float32 of the paths marked
        there, traced without any of them.
        """
        before = before or self.log
        paths = np.flatnonzero(only.reshape(-1))
        now = luminance.reshape(-1)[paths].astype(np.float64)
        tile = self.tile[paths]
        entries, squares = np.zeros((len(culled), TILES)), np.zeros((len(culled), TILES))
        step = (now - before.luminance.reshape(-1)[paths]) / self.light[tile]
        _attribute(before.records.reshape(-1, RECORD), paths, culled, tile, step, entries, squares)
        difference = before.luminance.reshape(-1).astype(np.float64) - self.log.luminance.reshape(-1)
        difference[paths] = now - self.log.luminance.reshape(-1)[paths]
        difference /= self.light[self.tile]
        change = np.bincount(self.tile, difference, TILES)
        deviation = np.sqrt(np.bincount(self.tile, difference**2, TILES))
        return Trial(change, deviation, entries, np.sqrt(squares))


@njit(cache=True, nogil=True, error_model="numpy")
def _attribute(records, paths, culled, tile, difference, entries, squares):
    """Add each path's difference, and its square, to the culled entry that it met first."""
    for i in range(len(paths)):
        p = paths[i]
        for k in range(1, min(records[p, 0] + 1, RECORD)):
            entry = records[p, k]
            if culled[entry]:
                entries[entry, tile[i]] += difference[i]
                squares[entry, tile[i]] += difference[i] ** 2
                break


@dataclass(frozen=True)
class Choice:
    """A set that was tried, (A,) bool, and what was measured."""

    cull: np.ndarray
    trial: Trial


class Search:
    """The search for the set of entries that saves most within a budget."""

    def __init__(
        self,
        base: Base,
        without: Callable[[np.ndarray, NDArray[np.uint8]], PathLog],
        worth: F64,
        savings: Savings,
        budget: Budget,
        unseen: float = 0.0,
        before: np.ndarray | None = None,
        hysteresis: float = 1.0,
    ) -> None:
        """without: log of the paths (H, W, S) that its second argument marks, without the entries that its first, (A,) bool, culls.

        worth: (A, T) relative change of each tile that culling an entry is expected to make, infinite for what must stay. unseen: change already owed to what
        no path met. before: (A,) bool, what was culled in the last frame: it is so again if that uses up the budget, or all but a factor of hysteresis.
        """
        self.base, self.without, self.worth, self.savings, self.budget = base, without, worth.copy(), savings, budget
        self.unseen = min(unseen, 0.5 * budget.mean)
        self.before, self.hysteresis = before, hysteresis
        self.allowed = int(PATHS * base.log.luminance.size)
        self.traced = 0

    def run(self, progress: Progress = silent) -> Choice:
        """The largest set found. Beginning with what no path meets, more and more is culled: what is predicted to fit the rest of the budget."""
        settled = self._as_before()
        if settled is not None:
            return settled
        log, share, failed = self.base.log.copy(), 1.0, 0
        best = self._unmet(log)
        tried = {best.cull.tobytes()}
        for k in range(TRIALS):
            progress(k / TRIALS, f"{len(self.worth) - best.cull.sum():,} instances stay")
            more = None if failed >= PATIENCE or best.cull.all() else self._more(best, share, tried)
            if more is None:
                break
            tried.add(more.tobytes())
            choice = self._try(more, best.cull, log)
            if choice is not None and self._excess(choice) <= 1:
                best, share, failed = choice, min(2 * share, 1.0), 0
                continue
            share, failed = share / 2, failed + 1
            if choice is not None:
                self._learn(choice, choice.cull & ~best.cull)
        return best

    def _learn(self, choice: Choice, new: np.ndarray) -> None:
        """What is measured is known better than what was predicted. new: (A,) bool, what the choice culls beyond the set that it began with."""
        self.worth[new] = np.abs(choice.trial.entries[new]) + CONFIDENCE * choice.trial.spread[new]

    def _more(self, best: Choice, share: float, tried: set[bytes]) -> np.ndarray | None:
        """A larger set to cull, (A,) bool, within a share of what one leaves of the budget; None where nothing is left to try."""
        stay = ~best.cull
        savings = self.savings.among_these(stay).share
        mean = share * max(AIM * self.budget.mean - max(self._mean(best), self.unseen), (1 - AIM) * self.budget.mean)
        tiles = share * np.maximum(AIM * self.budget.worst - best.trial.bound, (1 - AIM) * self.budget.worst)
        for _ in range(WIDENINGS):
            cull = best.cull.copy()
            cull[stay] = select(self.worth[stay], savings, mean, tiles).cull
            if cull.tobytes() not in tried:  # nor is the set itself
                return cull
            mean, tiles = WIDER * mean, WIDER * tiles
        return None

    def _as_before(self) -> Choice | None:
        """What was culled in the last frame, and what no path meets; None where that breaks the budget or leaves much of it."""
        if self.before is None:
            return None
        cull = (self.before | (self.worth.sum(axis=1) == 0)) & np.isfinite(self.worth).all(axis=1)
        choice = self._try(cull, np.zeros(len(cull), bool), self.base.log.copy())
        if choice is None or not 1 / self.hysteresis <= self._excess(choice) <= 1:
            return None
        return choice

    def _try(self, cull: np.ndarray, already: np.ndarray, log: PathLog) -> Choice | None:
        """Trace without cull, (A,) bool; None where that would take more paths than are left.

        already: (A,) bool, a part of it, without which log was traced: only paths that met what else is culled can differ from that. Where the whole keeps to
        the budget, the log becomes that of it.
        """
        new = cull & ~already
        only = log.affected(new)
        paths = int(np.count_nonzero(only))
        if self.traced + paths > self.allowed:
            return None
        self.traced += paths
        after = self.without(cull, only) if paths else log
        choice = Choice(cull, self.base.compare(new, only, after.luminance, log))
        if self._excess(choice) <= 1:
            log.update(only, after)
        return choice

    def _unmet(self, log: PathLog) -> Choice:
        """The set of what is worth nothing, which no path met; or nothing at all, where that breaks the budget all the same. log: the measured one."""
        nothing = np.zeros(len(self.worth), bool)
        choice = self._try(self.worth.sum(axis=1) == 0, nothing, log)
        if choice is not None and self._excess(choice) <= 1:
            return choice
        return Choice(nothing, Trial(np.zeros(TILES), np.zeros(TILES), *np.zeros((2, *self.worth.shape))))

    def _mean(self, choice: Choice) -> float:
        """The mean change, with what is owed to instances that no path met."""
        return choice.trial.mean + (self.unseen if choice.trial.mean else 0.0)

    def _excess(self, choice: Choice) -> float:
        """The change over what the budget allows, of the bound that is nearer to being broken."""
        changes = ((self._mean(choice), self.budget.mean), (choice.trial.worst, self.budget.worst))
        return max(change / max(bound, 1e-30) if change else 0.0 for change, bound in changes)
