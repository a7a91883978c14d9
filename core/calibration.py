"""Which of the measured instances to cull: sets are tried, by tracing what they change with the same random numbers, until a budget is used up.

Weights say what each instance is worth by itself, at most. What many are worth together, and what lies behind them, is known when the scene has been traced
without them. Of all paths only those can differ that met something culled (`path_log`), so a trial costs a small part of the measurement.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .budget import Budget, Savings, select
from .path_log import RECORD, PathLog, put_down
from .progress import Progress, silent
from .scene import F32, F64, I32
from .tiles import DARK, TILES, tiles_of

TRIALS = 64  # at most
PATIENCE = 5  # trials in a row that break the budget, after which none is expected to keep it
WIDER, WIDENINGS = 1.5, 20  # factor and number of steps by which bounds are widened, where what they allow has been tried
CONFIDENCE = 3.5  # standard deviations of its measurement that are added to the change of a tile, the worst of many in the best of many trials
AIM = 0.95  # of the budget: what selections are to use up. The rest of it is always taken to be left, for what they are worth is but predicted
PATHS = 1.4  # traced by all trials together at most, to those of the measurement


@dataclass(frozen=True)
class Trial:
    """The change of the picture by culling some entries, relative to the luminance of each of T coarse tiles.

    change: (T,) float64, signed. deviation: (T,) float64, its standard deviation, from the differences of single paths. confidence: so many of these are added.
    """

    change: F64
    deviation: F64
    confidence: float

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
        """(T,) relative change of each tile, with what its measurement may be wrong by on top."""
        return np.abs(self.change) + self.confidence * self.deviation


class Base:
    """The measured picture by tiles and paths."""

    def __init__(self, log: PathLog, light: F64 | None = None, confidence: float = CONFIDENCE) -> None:
        """light: (TILES,) luminance of all paths of each tile, where the log leaves some of it out. confidence: of what is compared, see `Trial`."""
        height, width, samples = log.luminance.shape
        self.luminance, self.confidence = log.luminance.copy(), confidence
        self.tile: I32 = np.repeat(tiles_of(height, width).ravel(), samples).astype(np.int32)
        sums = np.bincount(self.tile, log.luminance.ravel(), TILES) if light is None else light
        counts = np.maximum(np.bincount(self.tile, minlength=TILES), 1)
        means = sums / counts
        self.light = counts * np.maximum(means, max(DARK * means.mean(), 1e-30))

    def nothing(self) -> Trial:
        """Where nothing is culled."""
        return Trial(np.zeros(TILES), np.zeros(TILES), self.confidence)

    def compare(self, only: np.ndarray, luminance: F32, before: PathLog, already: Trial) -> Trial:
        """The change by culling some entries, where others are perhaps culled already.

        before, already: the log, and the trial, without those others; only: `PathLog.affected` of that log by those that are new; luminance: (H, W, S) float32
        of the paths marked there, traced without any of them.
        """
        paths = np.flatnonzero(only.reshape(-1))
        tile = self.tile[paths]
        measured, light = self.luminance.reshape(-1)[paths].astype(np.float64), self.light[tile]
        then, now = ((x.reshape(-1)[paths] - measured) / light for x in (before.luminance, luminance))
        change = already.change + np.bincount(tile, now - then, TILES)
        squares = already.deviation**2 + np.bincount(tile, now**2 - then**2, TILES)
        return Trial(change, np.sqrt(np.maximum(squares, 0.0)), self.confidence)

    def bound_by_entry(self, culled: np.ndarray, only: np.ndarray, luminance: F32, before: PathLog) -> F64:
        """The bound of what each of the culled entries, (A,) bool with C of them, changed alone: (C, T) float64, by the paths that met it before any other of
        them. The rest as in `compare`.
        """
        paths = np.flatnonzero(only.reshape(-1))
        row = np.where(culled, np.cumsum(culled) - 1, -1)
        change, squares = np.zeros((2, int(culled.sum()), TILES))
        step = (luminance.reshape(-1)[paths].astype(np.float64) - before.luminance.reshape(-1)[paths]) / self.light[self.tile[paths]]
        put_down(before.records.reshape(-1, RECORD), paths, row, self.tile[paths], step, change, squares)
        return np.abs(change) + self.confidence * np.sqrt(squares)


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
        log: PathLog,
        without: Callable[[np.ndarray, NDArray[np.uint8]], PathLog],
        worth: F64,
        savings: Savings,
        budget: Budget,
        unseen: float = 0.0,
        before: np.ndarray | None = None,
        hysteresis: float = 1.0,
        paths: float = PATHS,
    ) -> None:
        """log: of the base; becomes that of what is chosen. without: log of the paths (H, W, S) that its second argument marks, without the entries that its
        first, (A,) bool, culls; valid there, and until it is called again.

        worth: (A, T) relative change of each tile that culling an entry is expected to make, infinite for what must stay. unseen: change already owed to what
        no path met. before: (A,) bool, what was culled in the last frame: where that keeps to the budget no less is culled, and no more either where it uses
        up all but a factor of hysteresis. paths: traced by all trials together at most, to those of the log.
        """
        self.base, self.log, self.without, self.worth, self.savings, self.budget = base, log, without, worth.copy(), savings, budget
        self.unseen = min(unseen, 0.5 * budget.mean)
        self.before, self.hysteresis = before, hysteresis
        self.allowed = int(paths * log.luminance.size)
        self.traced = 0

    def run(self, progress: Progress = silent) -> Choice:
        """The largest set found. Beginning with what no path meets, more and more is culled: what is predicted to fit the rest of the budget."""
        (best, again), share, failed = self._first(), 1.0, 0
        if again and self.hysteresis * self._excess(best) >= 1:
            return best
        tried = {best.cull.tobytes()}
        for k in range(TRIALS):
            progress(k / TRIALS, f"{len(self.worth) - best.cull.sum():,} instances stay")
            more = None if failed >= PATIENCE or best.cull.all() else self._more(best, share, tried)
            if more is None:
                break
            tried.add(more.tobytes())
            choice = self._try(more, best)
            if choice is None:
                share, failed = share / 2, failed + 1
            else:
                best, share, failed = choice, min(2 * share, 1.0), 0
        return best

    def _first(self) -> tuple[Choice, bool]:
        """What was culled in the last frame, and what is worth nothing, which no path met; that alone where the whole breaks the budget, or nothing at all.

        Whether it is the first of these.
        """
        nothing, unmet = Choice(np.zeros(len(self.worth), bool), self.base.nothing()), self.worth.sum(axis=1) == 0
        if self.before is not None:
            choice = self._try((self.before | unmet) & np.isfinite(self.worth).all(axis=1), nothing)
            if choice is not None:
                return choice, True
        return self._try(unmet, nothing) or nothing, False

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

    def _try(self, cull: np.ndarray, already: Choice) -> Choice | None:
        """Trace without cull, (A,) bool; None where that breaks the budget, or would take more paths than are left.

        already: a part of it, whose log there is: only paths that met what else is culled can differ from that. What breaks the budget is measured all the
        same, and known better than it was predicted.
        """
        new = cull & ~already.cull
        only = self.log.affected(new)
        paths = int(np.count_nonzero(only))
        if self.traced + paths > self.allowed:
            return None
        self.traced += paths
        after = self.without(cull, only) if paths else self.log
        choice = Choice(cull, self.base.compare(only, after.luminance, self.log, already.trial))
        if self._excess(choice) <= 1:
            self.log.update(only, after)
            return choice
        self.worth[new] = self.base.bound_by_entry(new, only, after.luminance, self.log)
        return None

    def _mean(self, choice: Choice) -> float:
        """The mean change, with what is owed to instances that no path met."""
        return choice.trial.mean + (self.unseen if choice.trial.mean else 0.0)

    def _excess(self, choice: Choice) -> float:
        """The change over what the budget allows, of the bound that is nearer to being broken."""
        changes = ((self._mean(choice), self.budget.mean), (choice.trial.worst, self.budget.worst))
        return max(change / max(bound, 1e-30) if change else 0.0 for change, bound in changes)
