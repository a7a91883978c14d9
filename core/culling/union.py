"""One set for many frames: what a frame proposes for it by few paths, and whether it holds in a frame, by paths that
chose nothing of it.

A search for the smallest set of a frame takes longer than a preview of that frame saves. So a frame proposes more than
it needs, by what its measurement predicts alone, and the set that several frames have proposed is judged as it is in
each frame of the shot, by as few paths as say so surely.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..arrays import I64
from ..error_budget.budget import Budget, select
from ..error_budget.error_estimate import CONFIDENCE, NOTHING, Light, Reference
from ..feedback.tiles import TILES
from ..progress import Progress, part, silent
from ..scene.known_light import known_light
from ..scene.model import RAY_TYPES
from .analysis import by_budget, decide, kept_of, units_measured
from .certificate import Certificate
from .division import Division
from .frame_tracer import as_rendered, with_twins, without_bound
from .levels.exchange import with_levels
from .levels.levelled import has_levels, proposed_levels
from .levels.stand_ins import Alternative, Coarser, StandIn
from .loop import Loop, brightness
from .result import CullingResult

# of the budget: what is predicted of a proposal, for predictions are up to three times too small (docs/method.md)
PROPOSED = 0.25
SPARSER = 2  # times fewer paths for a proposal, which is judged anyway
CLOSER = 0.5  # of the budget, for a frame in which a set does not hold although the frame has proposed
# times fewer paths of the first look of a check than of a certificate: by the rule of three what they do not meet may
# be worth a fifth of a tile's bound
FEWER = 4
OPENING_ROUNDS = 3  # of few paths, before the paths that judge: later ones open little
LEAST_PATHS = 2  # per pixel: a deviation needs two
# number of the first sample of checks: none of those that measure or certify a frame's own set, nor of its rounds
CHECKS_FROM = 1 << 19
CHECK_SAMPLES = 1 << 10  # numbers from one check of a frame to its next


def propose(loop: Loop, progress: Progress = silent) -> CullingResult:
    """What a frame wants of a set for many, by what a measurement predicts: its change is not certified."""
    if loop.scene.whole:
        return decide(loop, progress)
    measured, budget = loop.run(part(progress, 0.0, 0.9), SPARSER), loop.options.max_error
    light = Light.of(Reference(measured.log, known=loop.known))
    units, savings = units_measured(loop, measured, budget, light)
    saved = units.saved(savings, np.ones(len(units), bool))
    bounds = PROPOSED * budget.mean, PROPOSED * budget.worst
    selection = select(units.worth, saved, *bounds)
    score = np.zeros(len(loop.activation), np.float32)
    score[measured.tlas.ids] = measured.worth.mean(axis=1)
    predicted = {"predicted_mean": selection.mean, "predicted_worst": selection.worst}
    keep = kept_of(loop, units, selection.cull, measured.tlas.ids)
    levels: dict[int, StandIn | Coarser] = {}
    figures: dict[str, float | int] = {}
    if has_levels(loop):
        kept = with_twins(loop.tracer, keep)
        levels, figures = proposed_levels(loop, measured, kept, *bounds)
    result = loop.result(keep, score, measured.feedback.hits, (), **predicted)
    return replace(result, stats=result.stats | figures, stand_ins=levels)


def decide_closer(loop: Loop, progress: Progress = silent) -> CullingResult:
    """What a frame surely needs at half of the budget: a search ends where the budget does, and whether a set that ends
    there holds takes as many paths to say as the search took."""
    if loop.scene.whole:
        return decide(loop, progress)
    measured, budget = loop.run(part(progress, 0.0, 0.7)), loop.options.max_error
    closer = Budget(CLOSER * budget.mean, CLOSER * budget.worst)
    return by_budget(loop, measured, closer, part(progress, 0.7, 1.0))


@dataclass(frozen=True)
class Check:
    """Whether a set surely keeps the budget in a frame, and its figures there."""

    holds: bool
    result: CullingResult


def doubt_of(earlier: int) -> float:
    """What a check has of a certificate's doubt that comes after so many others: together no more than all of it,
    however many there are, for the reciprocals of the squares sum to pi^2 / 6."""
    return (1 - CONFIDENCE) * 6 / (math.pi * (earlier + 1)) ** 2


def check(
    loop: Loop,
    keep: NDArray[np.bool_],
    met: NDArray[np.bool_],
    faces: Mapping[int, NDArray[np.bool_]],
    earlier: int = 0,
    progress: Progress = silent,
    levels: Sequence[tuple[I64, Alternative]] = (),
) -> Check:
    """Judge a set that other frames chose, in a frame that nothing is known of.

    keep: (N,) bool, what stays; met: (N,) bool, what else paths of other frames met: it spares looking for it. faces:
    by row of what stays, (F,) bool, those faces of it that do, where those are not all. earlier: how many sets this
    frame has judged before: each has other paths, and a smaller share of the doubt, so that all together have that of
    one certificate. levels: rows, and what takes the place of their mesh; of none of these there are faces.

    Raises ValueError where a mesh has other faces, or one that is to be exchanged emits; Cancelled.
    """
    _begin(loop, keep | met, faces)
    stays = (np.append(keep, np.tile([True, False], len(faces))) & loop.activation.exists) | loop.activation.pinned
    stays = as_rendered(loop.tracer, stays)
    confidence = 1 - doubt_of(earlier)
    samples = np.full(TILES, max(-(-loop.first_samples // FEWER), LEAST_PATHS))
    judge = Certificate(loop, CHECKS_FROM + earlier * CHECK_SAMPLES, samples, loop.options.max_error, confidence)
    whole = not levels and bool((stays == loop.activation.exists).all())
    estimate = NOTHING if whole else judge.judge(stays, progress, doubts=not levels)
    exchange = with_levels(loop, stays, levels) if levels else None
    if exchange is not None:
        budget = loop.options.max_error
        estimate = judge.judge_exchanged(exchange.tracer, exchange.rows, exchange.tlas, budget, progress)
    sure, unknown = 0.5 * (1 + judge.each), judge.unknown
    figures = {
        "certified_mean": estimate.upper_mean(sure),
        "certified_worst": estimate.upper_worst(sure),
        "confidence": CONFIDENCE,
        "unknown_mean": float(unknown.mean()),
        "unknown_worst": float(unknown.max(initial=0.0)),
        "certificate_paths": judge.paths,
    }
    lacks = bool((loop.activation.pinned[: len(keep)] & ~keep).any())
    may = whole or not (loop.scene.whole or lacks)
    holds = may and estimate.surely_holds(loop.options.max_error, judge.each)
    warnings: Sequence[str] = ()
    if holds and not whole:
        emissive, mean = loop.tracer.prepared.emissive, loop.options.max_error.mean
        warnings = without_bound(loop.tracer, loop.tracer.build(loop.activation.active), emissive, stays, mean)
    n = len(loop.activation)
    score, hits = np.zeros(n, np.float32), np.zeros((n, RAY_TYPES), np.int64)
    result = loop.result(stays, score, hits, tuple(warnings), **figures)
    result = replace(result, tiles=estimate.upper_tiles(sure).astype(np.float32))
    if exchange is not None:
        stats = result.stats | exchange.figures | {"levels": len(levels)}
        mesh = loop.scene.instances.mesh
        result = replace(result, stats=stats, stand_ins={int(mesh[rows[0]]): level.what for rows, level in levels})
    return Check(holds, result)


def _begin(loop: Loop, active: NDArray[np.bool_], faces: Mapping[int, NDArray[np.bool_]]) -> None:
    """Begin a frame with a set of instances, (N,) bool, in place of rounds, and of rows in it with some of their faces
    alone; what these rows are then comes behind the N, first what stays and then the rest of each.

    Few paths say how bright the picture is, and open the boxes that they cross, so that the many that follow cross few.
    Raises ValueError where a mesh has other faces.
    """
    if faces:
        loop.enter_division(Division.by(loop.scene, faces))
    activation, tracer = loop.activation, loop.tracer
    activation.activate(np.append(active, np.tile([True, False], len(faces))) & activation.exists)
    opened = True
    while opened and loop.rounds < OPENING_ROUNDS:
        loop.rounds += 1
        tlas = tracer.build(activation.active)
        cut, boxes = loop.boxes(tlas)
        feedback, picture = tracer.trace(tlas, 1, boxes, size=loop.options.coarse_size(loop.scene.film))
        loop.light, loop.ambient, loop.backdrop = brightness(picture, loop.scene.film)
        opened = activation.open_crossed_boxes(cut, feedback, tracer.prepared.emissive)
    loop.seen = tracer.seen_emitters(tlas)
    if known_light(loop.scene) is not None:  # a measurement tells what share of the light is
        loop.measure(tlas, LEAST_PATHS)
