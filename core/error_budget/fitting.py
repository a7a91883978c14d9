"""The least of a sequence of sets to cull that has what is left fit."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from .budget import Savings
from .units import Units

Fits = Callable[[np.ndarray], bool]


def least_that_fits(sets: Sequence[np.ndarray], units: Units, savings: Savings, fits: Fits) -> np.ndarray | None:
    """Of the first set, (U,) bool, with which what is left fits, the units that change least per byte that they save,
    no more of them than it takes. None where it fits with none of the sets.

    fits: whether what is left without a set, (U,) bool, fits. A set that culls more than one that fits does, too.
    """
    nothing = np.zeros(len(units), bool)
    if fits(nothing):
        return nothing
    cull = next((cull for cull in sets if fits(cull)), None)
    if cull is None:
        return None
    saved = units.saved(savings, ~nothing)
    order = np.flatnonzero(cull)
    order = order[np.argsort(units.worth[order].sum(axis=1) / saved[order], kind="stable")]
    low, high = 0, len(order)  # with so many of them it does not fit, and does
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if fits(_only(nothing, order[:middle])) else (middle, high)
    return _only(nothing, order[:high])


def _only(nothing: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    out = nothing.copy()
    out[chosen] = True
    return out
