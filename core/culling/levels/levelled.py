"""Levels of detail for what stays: meshes that matter little are exchanged for simplified stand-ins.

Each mesh that may be (`Scene.simplifiable`) has stand-ins for a few sizes of error, in pixels at its nearest instance.
That says little of what they do to the picture: reflections and shadows count, too. So the scene is traced with all of
them at each level, by paths and random numbers of the measurement, and what changes is charged to the first exchanged
mesh that a path met. Those levels are chosen that change the picture least per byte saved, as far as the budget goes
that culling has left; and the paths of the certificate, which chose nothing, judge the whole: the full scene against
the one that is culled and exchanged.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...accel.blas import TRIANGLE_BYTES
from ...accel.tlas import Tlas
from ...arrays import F64, I64
from ...error_budget.budget import Budget, select
from ...error_budget.error_estimate import ErrorEstimate, Light, Reference
from ...feedback.path_log import PathLog
from ...feedback.tiles import TILES
from ...progress import Progress, part, silent
from ...scene.mesh import Mesh, MeshSequence
from ..certificate import NEGLIGIBLE, Certificate
from ..frame_tracer import FrameTracer, exchanged
from ..loop import Loop
from ..measurement import Measurement
from .candidates import candidates
from .stand_ins import StandIn

CULLING = 0.8  # of the budget: what culling may use up, where levels are to follow
DEVIATIONS = 1.0  # of a change's noise, that are added to it
LESS = 0.4  # of what the budget leaves, after a proposal that breaks it, where no tile is known to be too much
PROPOSALS = 3  # that are judged at most
SMALL = 0.2  # pixels: larger errors are for meshes that are met by
EVIDENCE = 64  # paths: what fewer meet may change tiles that none of them was in


@dataclass(frozen=True)
class Levelled:
    """What is exchanged. stand_ins: by mesh of the scene as it was given. estimate: the change by this and by culling
    together. figures: of the meshes that are left, as in `CullingResult.stats`."""

    stand_ins: dict[int, StandIn]
    estimate: ErrorEstimate
    figures: dict[str, float | int]


class _Meshes(MeshSequence):
    """Meshes of a scene, and more behind them."""

    def __init__(self, meshes: Sequence[Mesh], more: Sequence[Mesh]) -> None:
        self._meshes, self._more = meshes, more

    def __len__(self) -> int:
        return len(self._meshes) + len(self._more)

    def mesh(self, index: int) -> Mesh:
        """Of the scene, or of what is behind."""
        return self._meshes[index] if index < len(self._meshes) else self._more[index - len(self._meshes)]


def has_levels(loop: Loop) -> bool:
    """Whether meshes of what stays may be exchanged for simplified ones: where nothing that is built is limited, and
    each camera ray is traced."""
    may = loop.scene.simplifiable
    free = not loop.limited and not loop.scene.first_hits
    return bool(loop.options.levels and free and may is not None and may.any())


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
        tracer, rows, tlas = levels.exchanged(chosen)
        change = certificate.judge_exchanged(tracer, rows, tlas, budget)
        if change.surely_holds(budget, certificate.each):
            return Levelled(levels.chosen(chosen), change, levels.figures(chosen, tracer, tlas))
        exceeded = change.exceeded(budget, certificate.each) & ~full
        full |= exceeded
        if not exceeded.any():
            share *= LESS
    return None


class _Levels:
    """The levels of what stays, as meshes behind those of the loop's scene."""

    def __init__(self, loop: Loop, keep: NDArray[np.bool_], progress: Progress) -> None:
        self._loop, self._keep = loop, keep
        self.candidates = list(candidates(loop, keep, progress))
        first = len(loop.scene.meshes)
        meshes = [level.of(c.mesh) for c in self.candidates for level in c.levels]
        # (C + 1,) number of the first level's mesh of each, and behind the last
        self._first = first + np.cumsum([0, *(len(c.levels) for c in self.candidates)])
        boxes = [np.stack((mesh.positions.min(axis=0), mesh.positions.max(axis=0))) for mesh in meshes]
        self._scene = dataclasses.replace(
            loop.scene,
            meshes=_Meshes(loop.scene.meshes, meshes),
            mesh_bounds=np.concatenate([loop.scene.mesh_bounds, *(box[None] for box in boxes)]).astype(np.float32),
        )
        loop.blas.advance(self._scene.meshes, *np.zeros((2, 0), np.int32))

    def exchanged(self, chosen: I64) -> tuple[FrameTracer, NDArray[np.bool_], Tlas]:
        """With a level of each candidate, (C,), -1 for none: what traces it, the instances that there are, (N,) bool,
        and the TLAS over these. Of parts the first stands for all."""
        mesh, rows = self._scene.instances.mesh.copy(), self._keep.copy()
        for c, level, first in zip(self.candidates, chosen.tolist(), self._first.tolist(), strict=False):
            if level >= 0:
                mesh[c.rows] = first + level
                if c.chosen is not None:
                    rows[c.rows[1:]] = False
        instances = dataclasses.replace(self._scene.instances, mesh=mesh)
        tracer = exchanged(self._loop.tracer, dataclasses.replace(self._scene, instances=instances))
        return tracer, rows, tracer.build(rows)

    def worth(self, measured: Measurement, progress: Progress) -> list[F64]:
        """(L, T) for each candidate: by how much each of its levels, or the first L, may change the tiles."""
        samples = max(1, measured.log.shape[2] // 2)
        height, width = measured.log.shape[:2]
        only: NDArray[np.uint8] = np.ones((height, width, samples), np.uint8)
        first, tracer = measured.traced[0].first_sample, self._loop.tracer
        tlas, before = tracer.build(self._keep), PathLog.zeros(*only.shape)
        tracer.trace_without(tlas, first, self._keep, tlas, only, before)
        reference, log = Reference(before, only, None, self._loop.known), PathLog.zeros(*only.shape)
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
            other, rows, with_levels = self.exchanged(chosen)
            other.trace_without(tlas, first, rows, with_levels, only, log)
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
            sizes = np.array([len(c.mesh.triangles), *map(len, c.levels[: len(of)])], np.float64)
            weights.append(np.maximum(np.diff(of, axis=0, prepend=0.0), 0.0))  # on top of the level before
            saved.append(TRIANGLE_BYTES * np.maximum(-np.diff(sizes), 1.0))
        go = select(np.concatenate(weights), np.concatenate(saved), max(mean, 0.0), tiles).cull
        ends = np.cumsum([len(of) for of in worth])[:-1]
        return np.array([int(np.logical_and.accumulate(x).sum()) - 1 for x in np.split(go, ends)], np.int64)

    def chosen(self, levels: I64) -> dict[int, StandIn]:
        """Stand-ins by the number of the mesh in the scene as it was given."""
        out = {}
        for c, level in zip(self.candidates, levels.tolist(), strict=True):
            if level >= 0:
                out[c.number] = c.levels[level] if c.chosen is None else c.levels[level].within(c.chosen)
        return out

    def figures(self, levels: I64, tracer: FrameTracer, tlas: Tlas) -> dict[str, float | int]:
        """Of the meshes that are left, and how many triangles those that are exchanged had before."""
        meshes, blas = np.unique(tracer.scene.instances.mesh[tlas.ids]), self._loop.blas
        pairs = [(c, level) for c, level in zip(self.candidates, levels.tolist(), strict=True) if level >= 0]
        return {
            "meshes": len(meshes),
            "triangles": int(blas.table["triangle_count"][meshes].sum()),
            "blas_bytes": int(blas.bytes_of[meshes].sum()),
            "levels": len(pairs),
            "levels_triangles": sum(len(c.mesh.triangles) - len(c.levels[level]) for c, level in pairs),
        }
