"""Which instances of a frame stay: by heuristics, by how many paths meet them, or by what the picture would lose."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from .budget import Budget, Selection, change, saved_cost, select, unseen_share
from .culling import CullOptions, heuristic
from .feedback import COLUMNS, ROWS
from .loop import CullingResult, Loop
from .progress import Progress, part, silent
from .scene import RAY_TYPES, Scene

CALIBRATIONS = 3  # traces of the culled scene at most


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
        return loop.result(heuristic(scene, options) & loop.exists, np.zeros(n, np.float32), np.zeros((n, RAY_TYPES), np.int64))
    loop.run(part(progress, 0.0, 0.5, "light paths ask for geometry, "))
    if options.min_share is not None:
        return by_counts(loop, options.min_share, part(progress, 0.5, 1.0, "measuring, "))
    return by_budget(loop, options.max_error, part(progress, 0.5, 1.0))


def by_counts(loop: Loop, min_share: float, progress: Progress = silent) -> CullingResult:
    """Keep what at least min_share of the paths meet; the score is that share."""
    feedback = (loop.measured or loop.measure(progress=progress)).feedback
    met = feedback.hits.sum(axis=1)
    keep = loop.pinned | (loop.active & (met > 0) & (met >= min_share * feedback.paths))
    return loop.result(keep, (met / max(feedback.paths, 1)).astype(np.float32), feedback.hits)


@dataclass(frozen=True)
class _Choice:
    """A selection, tried: keep (N,) bool, and the change of the picture that it makes."""

    keep: np.ndarray
    selection: Selection
    mean: float
    worst: float

    def excess(self, budget: Budget) -> float:
        """The change over what the budget allows, of the bound that is nearer to being broken."""
        return max((change / max(bound, 1e-30) for change, bound in ((self.mean, budget.mean), (self.worst, budget.worst)) if change), default=0.0)


def by_budget(loop: Loop, budget: Budget, progress: Progress = silent) -> CullingResult:
    """Cull what saves most while the picture changes by no more than the budget; the score is the share of the picture that an instance is worth.

    What each instance is worth alone does not say what many are worth together, nor what lies behind them. So the culled scene is traced with the same random
    numbers and compared, and the selection is tightened until both bounds hold, or loosened where they hold by far.
    """
    measured = loop.settle(part(progress, 0.0, 0.3, "measuring, "))
    start = time.perf_counter()
    ids, hits = measured.tlas.ids, measured.feedback.hits
    worth = measured.weights.relative()
    bound_worth = np.where(loop.pinned[ids, None], np.inf, worth)
    saved = saved_cost(loop.scene.instances.mesh[ids], loop.blas.bytes_of)
    unseen = unseen_share(hits.sum(axis=1), measured.feedback.paths)
    loop.timer.add("feedback_s", start)

    def attempt(scale: float, progress: Progress) -> _Choice:
        start = time.perf_counter()
        mean = budget.mean * scale
        selection = select(bound_worth, saved, mean, budget.worst * scale, min(unseen, 0.5 * mean))
        keep = loop.pinned.copy()
        keep[ids[~selection.cull]] = True
        loop.timer.add("feedback_s", start)
        if not selection.cull.any():
            return _Choice(keep, selection, 0.0, 0.0)
        picture = loop.trace_again(keep, measured.first_sample, loop.options.paths, progress)
        return _Choice(keep, selection, *change(measured.picture, picture, COLUMNS, ROWS))

    chosen, scale, low, high = None, 1.0, 0.0, np.inf  # the largest scale known to hold, the smallest known not to
    for i in range(CALIBRATIONS):
        choice = attempt(scale, part(progress, 0.3 + 0.7 * i / CALIBRATIONS, 0.3 + 0.7 * (i + 1) / CALIBRATIONS, "calibrating, "))
        excess = choice.excess(budget)
        if excess > 1.0:
            high = scale
        else:
            chosen, low = choice, scale
            if excess > 0.7 or choice.selection.cull.all():
                break
        wanted = scale * min(max(0.8 / max(excess, 0.1), 0.1), 4.0)
        scale = wanted if low < wanted < high else float(np.sqrt(low * high))
    chosen = chosen or attempt(0.0, progress)  # nothing that was tried holds: keep everything that was met
    score = np.zeros(len(loop.active), np.float32)
    score[ids] = worth.mean(axis=1)
    error = {
        "predicted_mean": chosen.selection.mean,
        "predicted_worst": chosen.selection.worst,
        "calibrated_mean": chosen.mean,
        "calibrated_worst": chosen.worst,
    }
    return loop.result(chosen.keep, score, hits, **error)
