"""What stays of a set for the paths of a witness, as far as they need it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..accel.hitboxes import Hitboxes
from ..feedback.path_log import PathLog
from .loop import Loop, Witness


def first_part(loop: Loop) -> int:
    """Row of the first part of a divided mesh."""
    return loop.division.first if loop.division else len(loop.activation)


class Staying:
    """A set that stays, as far as paths need it: parts of meshes that none has asked for yet are boxes."""

    def __init__(self, loop: Loop, keep: np.ndarray) -> None:
        """keep: (N,) bool."""
        self._loop, self.keep = loop, keep
        self._build()

    def _build(self) -> None:
        loop, there = self._loop, self.keep.copy()
        there[first_part(loop) :] &= loop.activation.active[first_part(loop) :]
        self._waiting = np.flatnonzero(self.keep & ~there)
        self.tlas = loop.tracer.build(there)
        self._boxes = Hitboxes(loop.scene.instances.bounds[self._waiting], loop.device) if len(self._waiting) else None

    def trace(self, witness: Witness, only: NDArray[np.uint8], log: PathLog) -> None:
        """Trace again paths of a witness, those that only, (H, W, S), marks, with nothing else in the scene, as
        `FrameTracer.trace_without`; parts whose boxes they cross are there from then on."""
        while True:
            self._loop.tracer.trace_without(
                witness.tlas, witness.first_sample, self.keep, self.tlas, only, log, self._boxes
            )
            crossed = np.zeros(0, bool) if self._boxes is None else self._boxes.counters.any(axis=1)
            if not crossed.any():
                return
            opened = np.zeros_like(self.keep)
            opened[self._waiting[crossed]] = True
            self._loop.include(opened)
            only = log.affected(np.zeros(len(witness.tlas), bool), only)
            self._build()
