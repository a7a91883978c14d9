"""Which of the measured instances to cull: sets are tried, by tracing what they change with the same random numbers, until a budget is used up.

Weights say what each instance is worth by itself, at most. What many are worth together, and what lies behind them, is known when the scene has been traced
without them. Of all paths only those can differ that met something culled (`path_log`), so a trial costs a small part of the measurement.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numba import njit

from .budget import Budget, Savings, Selection, select
from .path_log import RECORD, PathLog
from .progress import Progress, silent
from .scene import F32, F64, I32
from .tiles import DARK, TILES, tiles_of

SELECTIONS = 14  # trials of selections
GROUPS = 12  # trials of groups
CONFIDENCE = 2.0  # standard deviations of its measurement that are added to the change of a tile
AIM = 0.95  # of the budget: what the next selection is to use up
PATHS = 1.0  # traced by all trials together at most, to those of the measurement: a calibration costs no more than what it calibrates


@dataclass(frozen=True)
class Trial:
    """The change of the picture by culling some entries, relative to the luminance of each of T coarse tiles.

    change: (T,) float64, signed. deviation: (T,) float64, its standard deviation, from the differences of single paths.
    entries: (A, T) float64 signed change by the paths that met a culled entry before any other culled one.
    """

    change: F64
    deviation: F64
    entries: F64

    @property
    def mean(self) -> float:
        """Mean relative change of the tiles."""
        return float(np.abs(self.change).mean())

    @property
    def worst(self) -> float:
        """Relative change of the worst tile, with CONFIDENCE standard deviations of its measurement on top."""
        return float((np.abs(self.change) + CONFIDENCE * self.deviation).max())


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

    def compare(self, culled: np.ndarray, only: np.ndarray, luminance: F32) -> Trial:
        """culled: (A,) bool entries; only: `PathLog.affected` of them; luminance: (H, W, S) float32 of the paths marked there, traced without them."""
        paths = np.flatnonzero(only.reshape(-1))
        difference = luminance.reshape(-1)[paths].astype(np.float64) - self.log.luminance.reshape(-1)[paths]
        tile = self.tile[paths]
        difference /= self.light[tile]
        change = np.bincount(tile, difference, TILES)
        deviation = np.sqrt(np.bincount(tile, difference**2, TILES))
        entries = np.zeros((len(culled), TILES))
        _attribute(self.log.records.reshape(-1, RECORD), paths, culled, tile, difference, entries)
        return Trial(change, deviation, entries)


@njit(cache=True, nogil=True, error_model="numpy")
def _attribute(records, paths, culled, tile, difference, entries):
    """Add each path's difference to the culled entry that it met first."""
    for i in range(len(paths)):
        p = paths[i]
        for k in range(1, min(records[p, 0] + 1, RECORD)):
            entry = records[p, k]
            if culled[entry]:
                entries[entry, tile[i]] += difference[i]
                break


@dataclass(frozen=True)
class Choice:
    """A set that was tried: what its selection predicted, and what was measured."""

    selection: Selection
    trial: Trial

    @property
    def cull(self) -> np.ndarray:
        """(A,) bool."""
        return self.selection.cull


class Search:
    """The search for the set of entries that saves most within a budget."""

    def __init__(
        self,
        base: Base,
        without: Callable[[np.ndarray, np.ndarray], F32],
        worth: F64,
        savings: Savings,
        budget: Budget,
        unseen: float = 0.0,
        before: np.ndarray | None = None,
        hysteresis: float = 1.0,
    ) -> None:
        """without: luminance of the paths (H, W, S) that its second argument marks, without the entries that its first, (A,) bool, culls.

        worth: (A, T) relative change of each tile that culling an entry is expected to make, infinite for what must stay. unseen: change already owed to what
        no path met. before: (A,) bool, what was culled in the last frame: it is so again if that uses up the budget, or all but a factor of hysteresis.
        """
        self.base, self.without, self.worth, self.savings, self.budget = base, without, worth.copy(), savings, budget
        self.unseen = min(unseen, 0.5 * budget.mean)
        self.before, self.hysteresis = before, hysteresis
        self.allowed = int(PATHS * base.log.luminance.size)
        self.traced = 0

    def run(self, progress: Progress = silent) -> Choice:
        """The best set found: selections first, each from what the ones before have found out, then groups of what is still kept."""
        settled = self._as_before()
        if settled is not None:
            return settled
        best = self._try(select(self.worth, self.savings.share, 0.0, 0.0)) or self._keep_all()
        scale = 1.0
        for k in range(SELECTIONS):
            progress(k / (SELECTIONS + GROUPS), f"{len(self.worth) - best.cull.sum():,} instances stay")
            mean = self.budget.mean * scale
            choice = self._try(select(self.worth, self.savings.share, mean, self.budget.worst * scale, min(self.unseen, 0.5 * mean)))
            if choice is None:
                scale *= 0.5
                continue
            excess = self._excess(choice)
            if excess <= 1 and self.savings.of(choice.cull) > self.savings.of(best.cull):
                best = choice
            # What is measured is known better than what was predicted.
            self.worth[choice.cull] = np.abs(choice.trial.entries[choice.cull])
            if best.cull.all():
                break
            scale *= min(max(AIM / max(excess, 0.1), 0.5), 2.0)
        return self._thin_out(best, progress)

    def _as_before(self) -> Choice | None:
        """What was culled in the last frame, and what no path meets; None where that breaks the budget or leaves much of it."""
        if self.before is None:
            return None
        cull = (self.before | (self.worth.sum(axis=1) == 0)) & np.isfinite(self.worth).all(axis=1)
        change = self.worth[cull].sum(axis=0)
        choice = self._try(Selection(cull, float(change.mean()), float(change.max())))
        if choice is None or not 1 / self.hysteresis <= self._excess(choice) <= 1:
            return None
        return choice

    def _thin_out(self, best: Choice, progress: Progress) -> Choice:
        """Cull groups of what is still kept too, least worth for what they save first; those that break the budget are halved and tried again."""
        kept = np.flatnonzero(~best.cull & np.isfinite(self.worth).all(axis=1))
        order = kept[np.argsort(self.worth[kept].sum(axis=1) / self.savings.share[kept], kind="stable")]
        groups = [group for group in np.array_split(order, 4) if len(group)]
        for k in range(GROUPS):
            if not groups:
                break
            progress((SELECTIONS + k) / (SELECTIONS + GROUPS), f"{len(self.worth) - best.cull.sum():,} instances stay")
            group = groups.pop(0)
            cull = best.cull.copy()
            cull[group] = True
            choice = self._try(Selection(cull, best.selection.mean, best.selection.worst))
            if choice is not None and self._excess(choice) <= 1:
                best = choice
            elif len(group) > 1:
                groups += [half for half in np.array_split(group, 2) if len(half)]
        return best

    def _try(self, selection: Selection) -> Choice | None:
        """Trace without what a selection culls; None where that would take more paths than are left."""
        only = self.base.log.affected(selection.cull)
        paths = int(np.count_nonzero(only))
        if self.traced + paths > self.allowed:
            return None
        self.traced += paths
        luminance = self.without(selection.cull, only) if paths else self.base.log.luminance
        return Choice(selection, self.base.compare(selection.cull, only, luminance))

    def _keep_all(self) -> Choice:
        nothing = np.zeros(TILES)
        return Choice(Selection(np.zeros(len(self.worth), bool), 0.0, 0.0), Trial(nothing, nothing, np.zeros_like(self.worth)))

    def _excess(self, choice: Choice) -> float:
        """The change over what the budget allows, of the bound that is nearer to being broken."""
        trial, budget = choice.trial, self.budget
        changes = ((trial.mean + (self.unseen if trial.mean else 0.0), budget.mean), (trial.worst, budget.worst))
        return max(change / max(bound, 1e-30) if change else 0.0 for change, bound in changes)
