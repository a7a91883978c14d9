"""Which instances of a frame stay: by heuristics, by how many paths meet them, or by what the picture would lose."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from .budget import Budget, Savings, unseen_share
from .calibration import Base, Choice, Search
from .culling import CullOptions, heuristic
from .loop import CullingResult, Loop, Measurement
from .path_log import PathLog
from .progress import Progress, part, silent
from .scene import RAY_TYPES, Scene

REFINED = 1e-3  # share of all instances


def analyze(
    scene: Scene, options: CullOptions, progress: Progress = silent, cancelled: Callable[[], bool] | None = None, pinned: np.ndarray | None = None
) -> CullingResult:
    """Decide which instances of a frame stay; those of pinned, (N,) bool, always do.

    Raises Cancelled where cancelled() says so, MemoryError where Embree runs out.
    """
    return decide(Loop(scene, options, cancelled, pinned=pinned), progress)


def decide(loop: Loop, progress: Progress = silent) -> CullingResult:
    """Decide the frame that a loop stands at, cold or advanced to."""
    scene, options = loop.scene, loop.options
    if options.policy != "light-paths":
        n = len(scene.instances)
        loop.active = heuristic(scene, options) & loop.exists  # nothing else asks for what stays of the last frame
        return loop.result(loop.active, np.zeros(n, np.float32), np.zeros((n, RAY_TYPES), np.int64))
    loop.run(part(progress, 0.0, 0.7, "light paths ask for geometry, "))
    if options.min_share is not None:
        return by_counts(loop, options.min_share)
    return by_budget(loop, options.max_error, part(progress, 0.7, 1.0, "calibrating, "))


def reaches(met: np.ndarray, paths: int, share: np.ndarray | float) -> np.ndarray:
    """Whether met of paths, (N,) int64, is at least a share.

    As quotients: k / n rounds to the number that its decimals are read as, share x n need not be k.
    """
    return np.asarray((met > 0) & (met / max(paths, 1) >= share))


def by_counts(loop: Loop, min_share: float) -> CullingResult:
    """Keep what at least min_share of the paths meet; the score is that share.

    Hysteresis over frames: what the last frame kept stays while it is met by min_share / options.hysteresis of them.
    """
    measured = loop.measured or loop.measure()
    feedback, met = measured.feedback, measured.met
    share = np.where(loop.kept, min_share / loop.options.hysteresis, min_share)
    keep = loop.pinned | (loop.active & reaches(met, feedback.paths, share))
    return loop.result(keep, (met / max(feedback.paths, 1)).astype(np.float32), feedback.hits)


def by_budget(loop: Loop, budget: Budget, progress: Progress = silent) -> CullingResult:
    """Cull what saves most while the picture changes by no more than the budget; the score is the share of the picture that an instance is worth.

    What each instance is worth alone does not say what many are worth together, nor what lies behind them: `calibration` traces without them and finds out.
    More paths tell more exactly what can go: they are measured where what stays is more than REFINED of the scene, for else little is left to win.

    Hysteresis over frames: what the last frame culled is culled again, and nothing else that paths meet, while that uses up the budget or all but a factor of
    options.hysteresis; else what it kept goes only where others would save so many times less for the same change.
    """
    little = REFINED * np.count_nonzero(loop.exists)
    measured = loop.measured = loop.measured or loop.measure()
    chosen, unseen, paths = _searched(loop, measured, budget, part(progress, 0.0, 0.4))
    if measured.log.luminance.shape[2] < loop.samples and np.count_nonzero(~chosen.cull) > little:
        measured = loop.measured = loop.measure_on(measured, part(progress, 0.4, 0.7))
        chosen, unseen, more = _searched(loop, measured, budget, part(progress, 0.7, 1.0))
        paths += more
    loop.thorough = bool(np.count_nonzero(~chosen.cull) > little)
    ids, worth = measured.tlas.ids, measured.weights.relative()
    keep = loop.pinned.copy()
    keep[ids[~chosen.cull]] = True
    score = np.zeros(len(loop.active), np.float32)
    score[ids] = worth.mean(axis=1)
    predicted = worth[chosen.cull].sum(axis=0)
    error = {
        "predicted_mean": float(predicted.mean()) + unseen,
        "predicted_worst": float(predicted.max()),
        "calibrated_mean": chosen.trial.mean,
        "calibrated_worst": chosen.trial.worst,
        "calibration_paths": paths,
    }
    return loop.result(keep, score, measured.feedback.hits, **error)


def _searched(loop: Loop, measured: Measurement, budget: Budget, progress: Progress) -> tuple[Choice, float, int]:
    """What a search among the measured instances chose, the change that is owed to what no path met, and how many paths were traced."""
    start = time.perf_counter()
    ids = measured.tlas.ids
    reluctance = np.where(loop.kept[ids], loop.options.hysteresis, 1.0)
    savings = Savings.among(loop.scene.instances.mesh[ids], loop.blas.counted_bytes, reluctance)
    unseen = unseen_share(measured.met, measured.feedback.paths)
    known = any(hits.lamps_known for hits in loop.scene.first_hits.values())
    base = Base(measured.log, measured.weights.total.astype(np.float64) * measured.weights.unit if known else None)
    log, trial = measured.log.copy(), PathLog.zeros(*measured.log.luminance.shape)
    loop.timer.add("feedback_s", start)

    def without(cull: np.ndarray, only: np.ndarray) -> PathLog:
        keep = np.zeros(len(loop.active), bool)
        keep[ids[~cull]] = True
        loop.trace_without(measured.tlas, measured.first_sample, keep, only, trial)
        return trial

    before = None if loop.known is None else loop.known[ids] & ~loop.kept[ids]
    worth = np.where(loop.pinned[ids, None], np.inf, measured.weights.relative())
    search = Search(base, log, without, worth, savings, budget, unseen, before, loop.options.hysteresis)
    return search.run(progress), search.unseen, search.traced
