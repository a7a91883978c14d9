"""What traces of a frame found out: measurements, by which sets are chosen, and witnesses, by which they are judged."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..accel.tlas import Tlas
from ..arrays import F64, I64
from ..feedback.hits import Feedback, Weights
from ..feedback.path_log import PathLog


@dataclass(frozen=True)
class Measurement:
    """Feedback of a trace of candidates, what each of its paths met, and the number of its first sample. emissive: (E,) emitters, built or not."""

    tlas: Tlas
    feedback: Feedback
    weights: Weights
    log: PathLog
    first_sample: int
    emissive: I64

    @property
    def samples(self) -> int:
        """Paths per pixel."""
        return self.log.shape[2]

    @property
    def met(self) -> I64:
        """(N,) int64: rays that met each instance. Only built ones and emitters can have been met."""
        hits = self.feedback.hits
        out = np.zeros(len(hits), np.int64)
        for rows in (self.tlas.ids, self.emissive):
            out[rows] = hits[rows].sum(axis=1)
        return out


@dataclass(frozen=True)
class Witness:
    """Paths that chose nothing, through the full scene as far as they need it: what each met, and the number of its first sample.

    light: (T,) float64 luminance of all paths of each tile. unknown: (T,) float64, that of what they carry through boxes that were not opened: it may be
    lost, or other light in its place.
    """

    tlas: Tlas
    log: PathLog
    first_sample: int
    light: F64
    unknown: F64
