"""Which of the measured units to cull: sets are tried, by tracing what they change with the same random numbers, until
a budget is used up.

Weights say what each unit is worth by itself, at most. What many are worth together, and what lies behind them, is
known when the scene has been traced without them. Of all paths only those can differ that met something culled
(`path_log`), so a trial costs a small part of the measurement.

A search finds a sequence of sets, each larger than the one before. How far down that sequence the budget holds is for
other paths to say: `certificate`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..arrays import F64, I64
from ..feedback.tiles import TILES
from ..progress import Progress, silent
from .budget import Budget, Savings, select
from .error_estimate import NOTHING, ErrorEstimate, Light
from .trial import Trial
from .units import Units

TRIALS = 64  # sets that a search tries, at most
PATIENCE = 5  # trials in a row that break the budget, after which none is expected to keep it
# factor by which bounds are widened, and how often at most, where the set that they allow has been tried already
WIDER, WIDENINGS = 1.5, 20
# standard deviations of its measurement that are added to what a unit of a failed trial is worth, and to what a tile
# has used up
DEVIATIONS = 2.0
LIKELY = 0.8  # confidence that sets of a search keep to the budget, by its own paths
# of what is left of the budget: by how much a set may exceed the one before, so that steps are small where the budget
# ends
SHARE = 0.5
PIECES = 4  # that a step of a sequence is judged in, where it breaks the budget as a whole
# fill target of the budget: selections may use up this share, and may always add the rest, for what they are worth is
# but predicted
AIM = 0.95
PATHS = 1.4  # traced by all trials together at most, to those of the measurement
DENSER = 4.0  # times the paths that may be traced in tiles where noise alone stands between a set and the budget
# of all instances that paths met, or of their bytes: what more paths are to let go, at the least, to be traced
WORTH_WHILE = 0.02
# of the instances that stay, or of their bytes: what a trial is to let go, at the least
LEAST_GAIN = 0.001
UNMET = (0.1, 0.3)  # of the budget: what may be owed to units that no path met, at the first sets of a sequence


@dataclass(frozen=True)
class Choice:
    """A set that was tried, (U,) bool, and the error that was measured."""

    cull: np.ndarray
    estimate: ErrorEstimate


class Search:
    """The search for the sets of units that save most within a budget."""

    def __init__(
        self,
        trials: Sequence[Trial],
        units: Units,
        savings: Savings,
        budget: Budget,
        before: np.ndarray | None = None,
        hysteresis: float = 1.0,
        paths: float = PATHS,
        confidence: float = LIKELY,
    ) -> None:
        """trials: paths of the measurement.

        before: (U,) bool, what was culled in the last frame: where that keeps to the budget no less is culled, and no
        more either where it uses at least 1 / hysteresis of it. paths: traced by all trials together at most, to those
        of the measurement. confidence: of each set by these paths.
        """
        self.trials, self.units, self.savings, self.budget = trials, units, savings, budget
        self.worth: F64 = units.worth.copy()
        self.light = Light.of(*(trial.reference for trial in trials))
        self.before, self.hysteresis, self.confidence = before, hysteresis, confidence
        self.allowed = int(paths * self.light.paths.sum())
        self.traced = 0
        self._doubts = 0
        self.doubted = np.zeros(TILES, bool)  # tiles that more paths might show to hold a set that was given up
        self.promise = 0.0  # the most that such a set would have gained, of all

    def run(self, progress: Progress = silent, doubts: int = TRIALS) -> list[Choice]:
        """The sets found, each a part of the next. Beginning with what no path meets, more and more is culled: what is
        predicted to fit the rest of the budget. Ends early after `doubts` sets that broke the budget, though more paths
        might show that they hold it: in tiles `doubted`.
        """
        steps, again = self._first()
        share, failed = SHARE, 0
        if again and self.hysteresis * steps[-1].estimate.excess(self.budget, self.confidence) >= 1:
            return steps
        tried = {step.cull.tobytes() for step in steps}
        for k in range(TRIALS):
            best = steps[-1]
            progress(k / TRIALS, f"{self._staying(best):,} instances stay")
            more = (
                None
                if failed >= PATIENCE or self._doubts >= doubts or best.cull.all()
                else self._more(best, share, tried)
            )
            if more is None:
                break
            tried.add(more.tobytes())
            choice = self._try(more, best)
            if choice is None:
                share, failed = share / 2, failed + 1
            else:
                steps.append(choice)
                share, failed = min(2 * share, SHARE), 0
        return steps

    def _staying(self, choice: Choice) -> int:
        """How many of the instances that paths met stay."""
        n = self.units.with_entries
        return int(self.units.members[:n][~choice.cull[:n]].sum())

    def _first(self) -> tuple[list[Choice], bool]:
        """Sets to begin with, and whether they are the last frame's: what was culled in it, where that keeps to the
        budget; else units that no path met, the cheapest first."""
        nothing = Choice(np.zeros(len(self.units), bool), NOTHING)
        if self.before is not None:
            choice = self._try(self.before & np.isfinite(self.worth).all(axis=1), nothing)
            if choice is not None:
                return [choice], True
        n, steps = self.units.with_entries, [nothing]
        saved = self.units.saved(self.savings, ~nothing.cull)
        # met by paths that carry no light
        free = np.isfinite(self.worth[:n]).all(axis=1) & (self.worth[:n].sum(axis=1) == 0)
        for share in UNMET:
            cull = nothing.cull.copy()
            cull[n:] = select(self.worth[n:], saved[n:], share * self.budget.mean, share * self.budget.worst).cull
            cull[:n] = free
            choice = self._try(cull | steps[-1].cull, steps[-1])
            if choice is not None and (choice.cull != steps[-1].cull).any():
                steps.append(choice)
        return steps, False

    def _more(self, best: Choice, share: float, tried: set[bytes]) -> np.ndarray | None:
        """A larger set to cull, (U,) bool, within a share of what one leaves of the budget; None where nothing is left
        to try."""
        stay = ~best.cull
        saved, members = self.units.saved(self.savings, stay)[stay], self.units.met_members[stay]
        estimate = best.estimate
        used = estimate.tiles + DEVIATIONS * estimate.deviation
        mean = share * max(AIM * self.budget.mean - estimate.mean, (1 - AIM) * self.budget.mean)
        tiles = share * np.maximum(AIM * self.budget.worst - used, (1 - AIM) * self.budget.worst)
        for _ in range(WIDENINGS):
            cull, go = best.cull.copy(), select(self.worth[stay], saved, mean, tiles).cull
            cull[stay] = go
            if _share(go, members, saved) >= LEAST_GAIN and cull.tobytes() not in tried:
                return cull
            mean, tiles = WIDER * mean, WIDER * tiles
        return None

    def _try(self, cull: np.ndarray, already: Choice) -> Choice | None:
        """Trace without cull, (U,) bool; None where that breaks the budget, or would take more paths than are left.

        already: the accepted set, a part of it: only paths that met what else is culled can differ from its log. Units
        of a set that breaks the budget get what was measured in place of what was predicted.
        """
        new = cull & ~already.cull
        entries = self.units.entries(cull)
        paths = sum(trial.propose(entries) for trial in self.trials)
        if self.traced + paths > self.allowed:
            return None
        self.traced += paths
        difference = sum((trial.trace() for trial in self.trials[1:]), self.trials[0].trace())
        choice = Choice(cull, self.light.estimate(difference, self.units.owed(cull)))
        if choice.estimate.excess(self.budget, self.confidence) <= 1:
            for trial in self.trials:
                trial.accept()
            return choice
        if choice.estimate.may_hold(self.budget, self.confidence, np.full(TILES, DENSER)):
            self._doubts += 1
            self.doubted |= choice.estimate.doubtful(self.budget, self.confidence)
            self.promise = max(self.promise, gain_of_all(self.units, self.savings, already.cull, cull))
        new[self.units.with_entries :] = False
        change, squares = (
            np.sum(x, axis=0)
            for x in zip(
                *(trial.changes_by_unit(self.units.of_entry, new, self.light) for trial in self.trials), strict=True
            )
        )
        self.worth[new] = np.abs(change) + DEVIATIONS * np.sqrt(squares)
        return None


def gain(units: Units, savings: Savings, cull: np.ndarray, more: np.ndarray) -> float:
    """What goes with more, (U,) bool, of what stays with cull, a part of it: the larger share of the instances that
    paths met and of the bytes."""
    stay = ~cull
    return _share(more[stay], units.met_members[stay], units.saved(savings, stay)[stay])


def gain_of_all(units: Units, savings: Savings, cull: np.ndarray, more: np.ndarray) -> float:
    """What goes with more, (U,) bool, beyond cull, a part of it, of all that paths met, or its bytes, those of a mesh
    shared among its instances: where next to nothing stays, it is little."""
    n = units.with_entries
    go = (more & ~cull)[:n]
    return _share(go, units.members[:n], units.saved(savings, np.ones(len(units), bool))[:n])


def _share(go: np.ndarray, members: I64, bytes_of: F64) -> float:
    """The larger share that goes, (S,) bool, of members, (S,), and of bytes, (S,)."""
    return max(float(of[go].sum() / max(of.sum(), 1)) for of in (members, bytes_of))


def pieces(before: np.ndarray, cull: np.ndarray, units: Units) -> list[np.ndarray]:
    """Sets between two, (U,) bool, the first a part of the second: each adds a PIECES-th of what lies between them, the
    least worth first."""
    new = np.flatnonzero(cull & ~before)
    new = new[np.argsort(units.worth[new].sum(axis=1) / np.maximum(units.members[new], 1), kind="stable")]
    upto = np.cumsum(units.worth[new].sum(axis=1))
    out: list[np.ndarray] = []
    for piece in range(1, PIECES):
        between = before.copy()
        between[new[upto <= upto[-1] * piece / PIECES] if len(new) else new] = True
        if (between != (out[-1] if out else before)).any() and (between != cull).any():
            out.append(between)
    return out
