"""Section 7 of docs/method.md in plain NumPy, written from that page: the walk through the sets of a search."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from .numpy_search import Array, Change, Paths, T, Trials, Units

GAMMA = 1 - 0.05 / 12


@dataclass
class Look:
    """Fresh paths through the full scene. ids: (A,) instances of its entries; unknown: (T,) light through boxes."""

    trials: Trials
    ids: Array
    unknown: Array


class Walk:
    """look: paths per pixel of each tile, (T,) -> fresh paths; include: instances (N,) to be in their full scene."""

    def __init__(
        self,
        units: Units,
        budget: tuple[float, float],
        samples: Array,
        look: Callable[[Array], Look],
        include: Callable[[Array], None],
    ) -> None:
        self.units, self.budget, self.samples, self.look, self.include = units, budget, samples, look, include
        self.looks: list[Look] = []
        self.paths = self.again = self.count = 0

    def more(self, samples: Array) -> None:
        self.looks.append(self.look(samples))
        self.count += 1
        self.paths += len(self.looks[-1].trials.full.pixel)

    def estimate(self, keep: Array) -> Change:
        each = [look.trials for look in self.looks]
        self.paths += sum(trials.propose(~keep[look.ids]) for trials, look in zip(each, self.looks, strict=True))
        differences = []
        for trials in each:
            trials.trace(np.zeros(T))
            differences.append((trials.after.light - trials.full.light).astype(float))
        self.all = self.joined([trials.full for trials in each])
        unknown = sum(look.unknown for look in self.looks)
        owed = unknown / np.maximum(self.all.lum - unknown, 0.01 * self.all.lum)
        return self.all.change(np.concatenate(differences), owed)

    @staticmethod
    def joined(parts: list[Paths]) -> Paths:
        joined = [np.concatenate([getattr(p, name) for p in parts]) for name in ("pixel", "k", "light", "record")]
        return Paths(parts[0].size, *joined)

    def look_again(self, change: Change) -> bool:
        first, paths = self.looks[0].trials.full.n, self.all.n
        tiles = change.doubtful(self.budget, GAMMA) & (paths < 16 * first)
        samples = np.where(tiles, (np.minimum(paths / first, 4) * self.samples).astype(int), 0)
        cost = int((first / self.samples * samples).sum())
        too_many = self.count >= 6 or self.again + cost > first.sum()
        if too_many or not tiles.any() or not change.may_hold(self.budget, GAMMA, 16 * first / paths):
            return False
        self.again += cost
        self.more(samples)
        return True

    def judge(self, keep: Array) -> Change:
        self.include(keep)
        if not self.looks:
            self.more(self.samples)
        change = self.estimate(keep)
        while change.excess(self.budget, GAMMA) > 1 and self.look_again(change):
            change = self.estimate(keep)
        return change

    def pieces(self, before: Array, whole: Array) -> list[Array]:
        new = np.flatnonzero(whole & ~before)
        worth = self.units.worth.sum(axis=1)
        new = new[np.argsort(worth[new] / np.maximum(self.units.members[new], 1), kind="stable")]
        out, upto = [before], np.cumsum(worth[new])
        for quarter in (1, 2, 3):
            piece = before.copy()
            piece[new[upto <= upto[-1] * quarter / 4]] = True
            if (piece != out[-1]).any() and (piece != whole).any():
                out.append(piece)
        return out[1:]

    def run(self, sets: Iterable[Array]) -> tuple[Array, Change | None]:
        """The units that are culled, (U,) bool, and the change by that; None where nothing is."""
        accepted: tuple[Array, Any] = (np.zeros(len(self.units.worth), bool), None)
        full, failures = np.zeros(T, bool), 0
        for cull in sets:
            while True:
                before = accepted[0]
                new = cull & ~before
                new[new] = (self.units.worth[new][:, full] <= 0.01 * self.budget[1]).all(axis=1)
                if not new.any():
                    break
                whole = before | new
                for proposed in (whole, *self.pieces(before, whole)):
                    change = self.judge(self.units.kept(proposed))
                    if change.excess(self.budget, GAMMA) <= 1:
                        accepted = proposed, change
                        for look in self.looks:
                            look.trials.accept()
                        if proposed is whole:
                            break
                    else:
                        failing = change
                        if proposed is not whole:
                            break
                if accepted[0] is whole:
                    break
                failures += 1
                exceeded = failing.exceeded(self.budget, GAMMA) & ~full
                if failures > 12 or not exceeded.any():
                    return accepted
                full |= exceeded
        return accepted
