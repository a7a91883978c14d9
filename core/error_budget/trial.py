"""Trials: what the paths of a trace differ by where more and more is culled.

Of all paths only those can differ that met something culled (`path_log`), so that a set costs a small part of a trace,
and a set that adds to another a part of that.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ..arrays import F64
from ..feedback.path_log import PathLog
from .error_estimate import Difference, Light, Reference

Without = Callable[[np.ndarray, NDArray[np.uint8]], PathLog]


class Trial:
    """Paths of one trace of the full scene: the set that was accepted last, and one that is proposed."""

    def __init__(
        self, reference: Reference, log: PathLog, without: Without, only: NDArray[np.uint8] | None = None
    ) -> None:
        """log: of the reference; becomes that of the accepted set. without: log of the paths (H, W, S) that its second
        argument marks, without the entries that its first, (A,) bool, culls; valid there, and until it is called again.
        only: (H, W, S) marks the paths that there are, where those are not all.
        """
        self.reference, self.log = reference, log
        self._without, self._only = without, only
        self._accepted, self.proposed = reference.nothing, reference.nothing
        self._culled = self._cull = np.zeros(0, bool)
        self._changed, self._after, self._due = np.zeros(log.shape, np.uint8), log, False

    def propose(self, cull: np.ndarray) -> int:
        """Propose a set, (A,) bool, that culls what was accepted and more. Returns how many paths must be traced for
        it."""
        if len(self._cull) and (cull == self._cull).all():
            return 0
        self._cull = cull
        self._changed = self.log.affected(cull & ~self._culled if len(self._culled) else cull, self._only)
        self._due = True
        return int(np.count_nonzero(self._changed != 0))

    def trace(self) -> Difference:
        """What paths differ by at the proposed set."""
        if self._due:
            self._due, self.proposed = False, self._accepted
            if self._changed.any():
                self._after = self._without(self._cull, self._changed)
                self.proposed = self.reference.compare(self._changed, self._after.color, self.log, self._accepted)
        return self.proposed

    def accept(self) -> None:
        """Make the set that was proposed, and traced, the accepted one."""
        if self._culled is not self._cull:
            self.log.update(self._changed, self._after)
            self._culled, self._accepted = self._cull, self.proposed

    def changes_by_unit(self, unit: np.ndarray, culled: np.ndarray, light: Light) -> tuple[F64, F64]:
        """What each of the units culled, (U,) bool with C of them, changed alone at the proposed set, by the paths that
        met an entry of it before any other of them: sums, and of squares, (C, T) float64, relative to a light. unit:
        (A,) of each TLAS entry.
        """
        if not self._changed.any():
            return np.zeros((int(culled.sum()), len(light.paths))), np.zeros((int(culled.sum()), len(light.paths)))
        return self.reference.changes_by_unit(unit, culled, self._changed, self._after.color, self.log, light)
