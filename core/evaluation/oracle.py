"""The oracle: the cheapest set that any search found for an error, to judge policies by. It may look at everything and
take its time.

It searches as an analysis does (`error_budget.search`), but with what that cannot afford: exhaustive weights
(everything active, many paths per pixel), all the judge's paths, and every set that some policy proposed to begin with.
What it finds keeps both bounds with 95 % confidence in each tile, by those paths: of so many sets, one would always
keep them by chance. So it is the best of a greedy search with verified error: a bound of what is known to be possible,
not a proof of what is not.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from ..arrays import F64, I32
from ..culling.frame_tracer import as_rendered
from ..error_budget.budget import ENTRY_BYTES, Budget, Savings
from ..error_budget.error_estimate import CONFIDENCE
from ..error_budget.search import Search
from ..error_budget.trial import Trial
from ..error_budget.units import Units
from ..feedback.path_log import PathLog
from ..progress import Progress, part, silent
from .judge import Judge

SHARES = (1.0, 0.9, 0.8, 0.6, 0.4)  # of the mean's bound that are tried
PATHS = 4.0  # traced by a search at most, to those of the judge


def retained(judge: Judge, keep: np.ndarray) -> float:
    """Bytes that keep (N,) bool takes: its BLASes, each once, and its TLAS entries."""
    mesh = judge.scene.instances.mesh
    return float(judge.loop.blas.counted_bytes[np.unique(mesh[keep])].sum() + ENTRY_BYTES * keep.sum())


def search(
    judge: Judge,
    worth: F64,
    ids: I32,
    budget: Budget,
    proposals: Iterable[np.ndarray] = (),
    progress: Progress = silent,
) -> np.ndarray:
    """The cheapest keep, (N,) bool, whose measured change surely stays within the budget.

    worth (A, T), ids (A,): `Judge.exhaustive_weights`. proposals: sets (N,) bool to start from too.
    """
    paths_of = judge.passes[0]
    trial = PathLog.zeros(*paths_of.log.luminance.shape)
    savings = Savings.among(judge.scene.instances.mesh[ids], judge.loop.blas.counted_bytes)
    units = Units.single(worth)

    def kept(cull: np.ndarray) -> np.ndarray:
        keep = np.zeros(len(judge.scene.instances), bool)
        keep[ids[~cull]] = True
        return as_rendered(judge.loop.tracer, keep)

    def without(cull: np.ndarray, only: NDArray[np.uint8]) -> PathLog:
        keep = kept(cull)
        judge.loop.tracer.trace_without(
            judge.tlas, paths_of.first_sample, keep, judge.loop.tracer.build(keep), only, trial
        )
        return trial

    def thinned_out(first: np.ndarray | None, progress: Progress) -> np.ndarray:
        for share in SHARES:  # a search adds the confidence of its measurement to the tiles alone, not to their mean
            within = Budget(share * budget.mean, budget.worst)
            paths = Trial(paths_of.reference, paths_of.log.copy(np.ones(paths_of.log.shape, np.uint8)), without)
            found = Search([paths], units, savings, within, first, paths=PATHS, confidence=CONFIDENCE).run(progress)
            keep = kept(found[-1].cull)
            if judge.change(keep).surely_holds(budget):
                return keep
        return kept(np.zeros(len(ids), bool))

    cheapest = sorted(proposals, key=lambda keep: retained(judge, keep))
    proposed = next((keep for keep in cheapest if judge.change(keep).surely_holds(budget)), None)
    found = [thinned_out(None, part(progress, 0.0, 0.5))]
    if proposed is not None:
        found += [proposed, thinned_out(~proposed[ids], part(progress, 0.5, 1.0))]
    return min(found, key=lambda keep: retained(judge, keep))
