"""Levels of detail for what stays: meshes that matter little are exchanged for simplified stand-ins.

Each mesh that may be (`Scene.simplifiable`) has stand-ins for a few sizes of error, in pixels at its nearest instance;
others can be had coarser, step by step (`Scene.coarser`). That says little of what they do to the picture: reflections
and shadows count, too. So the scene is traced with all of them at each level, by paths and random numbers of the
measurement, and what changes is charged to the first exchanged mesh that a path met. Those levels are chosen that
change the picture least per byte saved, as far as the budget goes that culling has left; and the paths of the
certificate, which chose nothing, judge the whole: the full scene against the one that is culled and exchanged.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...accel.blas import TRIANGLE_BYTES
from ...arrays import F64, I64
from ...error_budget.budget import Budget, select
from ...error_budget.error_estimate import ErrorEstimate, Light, Reference
from ...feedback.path_log import PathLog
from ...feedback.tiles import TILES
from ...progress import Progress, part, silent
from ...scene.render_costs import RenderCosts
from ..certificate import NEGLIGIBLE, Certificate, Verdict
from ..loop import Loop
from ..measurement import Measurement
from .candidates import candidates, may_be_levelled
from .exchange import Exchange, Exchanged
from .stand_ins import Coarser, StandIn

CULLING = 0.8  # of the budget: what culling may use up, where levels are to follow
DEVIATIONS = 1.0  # of a change's noise, that are added to it
LESS = 0.4  # of what the budget leaves, after a proposal that breaks it, where no tile is known to be too much
PROPOSALS = 3  # that are judged at most
SMALL = 0.2  # pixels: larger errors are for meshes that are met by
EVIDENCE = 64  # paths: what fewer meet may change tiles that none of them was in


@dataclass(frozen=True)
class Levelled:
    """What is exchanged. stand_ins: for what, by mesh of the scene as it was given. estimate: the change by this and by
    culling together. figures: of the meshes that are left, as in `CullingResult.stats`."""

    stand_ins: dict[int, StandIn | Coarser]
    estimate: ErrorEstimate
    figures: dict[str, float | int]
    _levels: _Levels
    _chosen: I64

    def verdict(self, culling: Verdict, certificate: Certificate) -> Verdict:
        """The verdict on this and on culling together, by the certificate that judged both."""
        unknown, paths = certificate.unknown, certificate.paths
        return dataclasses.replace(culling, estimate=self.estimate, unknown=unknown, paths=paths)

    def again(self, certificate: Certificate, keep: NDArray[np.bool_], budget: Budget) -> Levelled:
        """The same where less stays, keep (N,) bool, whatever the budget. certificate: which judged keep."""
        return self._levels.judged(self._chosen, keep, certificate, budget)

    def of_whole_meshes(self) -> Levelled:
        """Without what takes the place of parts, none of which could go by itself then."""
        parts = np.array([c.chosen is not None for c in self._levels.candidates], bool)
        return dataclasses.replace(self, _chosen=np.where(parts, -1, self._chosen))

    def costs(self, costs: RenderCosts) -> RenderCosts:
        """What a render takes then: of a divided mesh what takes its place is there whatever is culled."""
        return costs.with_levels(self._levels.shares(self._chosen))


def has_levels(loop: Loop) -> bool:
    """Whether meshes of what stays may be exchanged for others with fewer triangles: where nothing that is built is
    limited, and each camera ray is traced."""
    free = not loop.limited and not loop.scene.first_hits
    return bool(loop.options.levels and free and any(may.any() for may in may_be_levelled(loop.scene)))


def levelled(
    loop: Loop,
    measured: Measurement,
    certificate: Certificate,
    keep: NDArray[np.bool_],
    estimate: ErrorEstimate,
    budget: Budget,
    progress: Progress = silent,
) -> Levelled | None:
    """Exchange meshes of what stays, keep (N,) bool, as far as a budget allows; None where nothing surely may be.
    certificate: which judged keep; estimate: the change by culling alone."""
    levels = _Levels(loop, keep, progress)
    if not levels.candidates:
        return None
    worth = levels.worth(measured, part(progress, 0.1, 0.5))
    left = budget.mean - estimate.mean, budget.worst - (estimate.tiles + DEVIATIONS * estimate.deviation)
    share, full = 1.0, np.zeros(TILES, bool)
    for k in range(PROPOSALS):
        tiles = np.where(full, NEGLIGIBLE * budget.worst, share * np.maximum(left[1], 0.0))
        chosen = levels.choose(worth, share * left[0], tiles)
        if not (chosen >= 0).any():
            break
        progress(0.5 + 0.5 * k / PROPOSALS, f"certifying {int((chosen >= 0).sum()):,} simplified meshes")
        found = levels.judged(chosen, keep, certificate, budget)
        change = found.estimate
        if change.surely_holds(budget, certificate.each):
            return found
        exceeded = change.exceeded(budget, certificate.each) & ~full
        full |= exceeded
        if not exceeded.any():
            share *= LESS
    levels.forget()
    return None


def proposed_levels(
    loop: Loop, measured: Measurement, keep: NDArray[np.bool_], mean: float, worst: float
) -> tuple[dict[int, StandIn | Coarser], dict[str, float | int]]:
    """What may take the place of meshes of what stays, keep (N,) bool, as far as both bounds allow by what is predicted
    alone; and figures as of `Levelled`."""
    levels = _Levels(loop, keep, silent)
    if not levels.candidates:
        return {}, {}
    chosen = levels.choose(levels.worth(measured, silent), mean, np.full(TILES, worst))
    return levels.chosen(chosen), levels.figures(chosen, levels.exchanged(chosen, keep))


class _Levels:
    """The levels of what stays, as meshes behind those of the loop's scene."""

    def __init__(self, loop: Loop, keep: NDArray[np.bool_], progress: Progress) -> None:
        self._loop, self._keep = loop, keep
        self.candidates = list(candidates(loop, keep, progress))
        self._exchange = Exchange(loop, [level.mesh for c in self.candidates for level in c.levels])
        # (C + 1,) number of the first level's mesh of each, and behind the last
        self._first = self._exchange.first + np.cumsum([0, *(len(c.levels) for c in self.candidates)])

    def forget(self) -> None:
        """Free what was built of them."""
        self._exchange.forget()

    def exchanged(self, chosen: I64, keep: NDArray[np.bool_]) -> Exchanged:
        """With a level of each candidate, (C,), -1 for none, where keep, (N,) bool, stays. Of parts the first stands
        for all."""
        mesh, rows = self._loop.scene.instances.mesh.copy(), keep.copy()
        for c, level, first in zip(self.candidates, chosen.tolist(), self._first.tolist(), strict=False):
            if level >= 0:
                mesh[c.rows] = first + level
                if c.chosen is not None:
                    rows[c.rows], rows[c.rows[0]] = False, keep[c.rows].any()
        return self._exchange.with_meshes(mesh, rows)

    def judged(self, chosen: I64, keep: NDArray[np.bool_], certificate: Certificate, budget: Budget) -> Levelled:
        """By a certificate that judged keep, (N,) bool; of candidates of which nothing stays nothing is exchanged."""
        stays = np.array([keep[c.rows].any() for c in self.candidates], bool)
        left = np.where(stays, chosen, -1)
        exchange = self.exchanged(left, keep)
        change = certificate.judge_exchanged(exchange.tracer, exchange.rows, exchange.tlas, budget)
        return Levelled(self.chosen(left), change, self.figures(left, exchange), self, chosen)

    def shares(self, chosen: I64) -> list[tuple[NDArray[np.int32], float]]:
        """Meshes, parts of one or one by itself, and the share that is left of their bytes."""
        mesh, pairs = self._loop.scene.instances.mesh, zip(self.candidates, chosen.tolist(), strict=True)
        return [(np.unique(mesh[c.rows]), len(c.levels[n]) / c.triangles) for c, n in pairs if n >= 0]

    def worth(self, measured: Measurement, progress: Progress) -> list[F64]:
        """(L, T) for each candidate: by how much each of its levels, or the first L, may change the tiles."""
        samples = max(1, measured.log.shape[2] // 2)
        height, width = measured.log.shape[:2]
        only: NDArray[np.uint8] = np.ones((height, width, samples), np.uint8)
        first, tracer = measured.traced[0].first_sample, self._loop.tracer
        tlas, before = tracer.build(self._keep), PathLog.zeros(*only.shape, backdrop=self._loop.backdrop)
        tracer.trace_without(tlas, first, self._keep, tlas, only, before)
        reference = Reference(before, only, None, self._loop.known)
        log = PathLog.zeros(*only.shape, backdrop=before.backdrop)
        light, count = Light.of(reference), len(self.candidates)
        unit = np.full(len(self._keep), count, np.int32)
        for c, candidate in enumerate(self.candidates):
            unit[candidate.rows] = c
        exchanged = np.arange(count + 1) < count
        met = np.bincount(unit[tlas.ids], before.paths_met(len(tlas)), count + 1)
        counts = [
            len(c.levels) if n >= EVIDENCE else sum(error <= SMALL for error in c.errors)
            for c, n in zip(self.candidates, met.tolist(), strict=False)
        ]
        out: list[list[F64]] = [[] for _ in self.candidates]
        levels = max(counts)
        for level in range(levels):
            progress(level / levels, "trying simplified meshes")
            chosen = np.minimum(level, np.array(counts) - 1)
            other = self.exchanged(chosen, self._keep)
            other.tracer.trace_without(tlas, first, other.rows, other.tlas, only, log)
            change, squares = reference.changes_by_unit(unit[tlas.ids], exchanged, only, log.color, before, light)
            for c in range(count):
                if level < counts[c]:
                    out[c].append(np.abs(change[c]) + DEVIATIONS * np.sqrt(squares[c]))
        return [np.array(rows).reshape(-1, TILES) for rows in out]

    def choose(self, worth: list[F64], mean: float, tiles: F64) -> I64:
        """(C,) the level of each candidate, -1 for none, that change the picture least per byte, as far as both bounds
        allow. worth: as of `worth`."""
        weights, saved = [], []
        for c, of in zip(self.candidates, worth, strict=True):
            sizes = np.array([c.triangles, *map(len, c.levels[: len(of)])], np.float64)
            weights.append(np.maximum(np.diff(of, axis=0, prepend=0.0), 0.0))  # on top of the level before
            saved.append(TRIANGLE_BYTES * np.maximum(-np.diff(sizes), 1.0))
        go = select(np.concatenate(weights), np.concatenate(saved), max(mean, 0.0), tiles).cull
        ends = np.cumsum([len(of) for of in worth])[:-1]
        return np.array([int(np.logical_and.accumulate(x).sum()) - 1 for x in np.split(go, ends)], np.int64)

    def chosen(self, levels: I64) -> dict[int, StandIn | Coarser]:
        """What is chosen, by the number of the mesh in the scene as it was given."""
        out: dict[int, StandIn | Coarser] = {}
        for c, level in zip(self.candidates, levels.tolist(), strict=True):
            if level >= 0:
                found = c.levels[level].what
                out[c.number] = found if c.chosen is None or isinstance(found, Coarser) else found.within(c.chosen)
        return out

    def figures(self, levels: I64, exchange: Exchanged) -> dict[str, float | int]:
        """Of the meshes that are left, and how many triangles those that are exchanged had before."""
        pairs = [(c, level) for c, level in zip(self.candidates, levels.tolist(), strict=True) if level >= 0]
        less = sum(c.triangles - len(c.levels[level]) for c, level in pairs)
        return exchange.figures | {"levels": len(pairs), "levels_triangles": less}
