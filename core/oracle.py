"""The oracle: the cheapest set that any search found for an error, to judge policies by. It may look at everything and take its time.

No policy knows what a set of instances is worth together before it has traced without it. The oracle starts from exhaustive weights (everything active, many
paths per pixel) and from every set that some policy proposed; it scales its selection until the measured change just keeps both bounds, and then takes further
instances out, in groups, wherever the measured change still keeps them. So it is the best of a greedy search with verified error: a bound of what is known
to be possible, not a proof of what is not.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np

from .budget import ENTRY_BYTES, Budget, Savings, select
from .judge import Judge
from .progress import Progress, silent
from .scene import F64, I32

SCALINGS = 6  # traces that search the scale of the selection
TRIALS = 16  # traces that try to take groups out
SHARE = 0.25  # of the judge's paths, for the search


def retained(judge: Judge, keep: np.ndarray) -> float:
    """Bytes that keep (N,) bool takes: its BLASes, each once, and its TLAS entries."""
    mesh = judge.scene.instances.mesh
    return float(judge.loop.blas.bytes_of[np.unique(mesh[keep])].sum() + ENTRY_BYTES * keep.sum())


def search(
    judge: Judge, worth: F64, ids: I32, budget: Budget, proposals: Iterable[np.ndarray] = (), progress: Progress = silent
) -> np.ndarray:
    """The cheapest keep, (N,) bool, whose measured change stays within the budget.

    worth (A, T), ids (A,): `Judge.exhaustive_weights`. proposals: sets (N,) bool to start from too.
    """
    count = len(judge.scene.instances)
    saved = Savings.among(judge.scene.instances.mesh[ids], judge.loop.blas.bytes_of).share
    met = np.zeros(count, bool)
    met[ids] = True
    found: list[np.ndarray] = [met]

    def holds(keep: np.ndarray) -> bool:
        return judge.change(keep, SHARE).holds(budget)

    def selected(scale: float) -> np.ndarray:
        keep = np.zeros(count, bool)
        keep[ids[~select(worth, saved, budget.mean * scale, budget.worst * scale).cull]] = True
        return keep

    scaled = _widest(selected, holds, progress)
    candidates = sorted([keep for keep in (*proposals, scaled) if keep is not None], key=lambda keep: retained(judge, keep))
    best = next((keep for keep in candidates if holds(keep)), met)
    found.append(best)
    rank = np.full(count, np.inf)
    rank[ids] = worth.sum(axis=1) / saved
    for step, keep in enumerate(_thin_out(best, rank, holds)):
        progress(0.4 + 0.6 * step / TRIALS, "oracle, taking groups out")
        found.append(keep)
    # what the search found with few paths is verified with all of the judge's
    return next((keep for keep in reversed(found) if judge.change(keep).holds(budget)), met)


def _widest(selected: Callable[[float], np.ndarray], holds: Callable[[np.ndarray], bool], progress: Progress) -> np.ndarray | None:
    """The set of the largest scale that holds, by doubling and bisection."""
    low, high, best = None, None, None
    scale = 1.0
    for step in range(SCALINGS):
        progress(0.4 * step / SCALINGS, "oracle, scaling the selection")
        keep = selected(scale)
        if holds(keep):
            low, best = scale, keep
            if not keep.any():
                break
        else:
            high = scale
        if low is None:
            scale /= 4
        elif high is None:
            scale *= 4
        else:
            scale = (low * high) ** 0.5
    return best


def _thin_out(keep: np.ndarray, rank: F64, holds: Callable[[np.ndarray], bool]) -> Iterable[np.ndarray]:
    """Smaller and smaller sets that hold: groups of the kept ones are tried, least rank first, halved where they fail."""
    keep = keep.copy()
    order = np.flatnonzero(keep)[np.argsort(rank[keep], kind="stable")]
    groups = [g for g in np.array_split(order, 4) if len(g)]
    for _ in range(TRIALS):
        if not groups:
            return
        group = groups.pop(0)
        trial = keep.copy()
        trial[group] = False
        if holds(trial):
            keep = trial
            yield keep
        elif len(group) > 1:
            groups += [half for half in np.array_split(group, 2) if len(half)]
