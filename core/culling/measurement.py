"""Measurements: what traces of the active set found out, from which sets are chosen."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..accel.tlas import Tlas
from ..arrays import F32, F64, I64
from ..feedback.hits import Feedback, Weights
from ..feedback.path_log import PathLog
from ..feedback.tiles import tile_means
from ..scene.model import Scene


@dataclass(frozen=True)
class Traced:
    """A trace: what its paths met, the number of their first sample, and how many there are per pixel of each tile,
    (T,)."""

    log: PathLog
    first_sample: int
    samples: I64


@dataclass(frozen=True)
class Measurement:
    """A trace of the active set alone. feedback, weights: of all its paths. traced: first those of the whole picture,
    then more of some tiles. emissive: (E,) emitters, built or not."""

    tlas: Tlas
    feedback: Feedback
    weights: Weights
    traced: tuple[Traced, ...]
    emissive: I64

    @property
    def log(self) -> PathLog:
        """Of the paths of the whole picture."""
        return self.traced[0].log

    @property
    def next_sample(self) -> int:
        """The first sample number that it did not use."""
        return self.traced[-1].first_sample + self.traced[-1].log.shape[2]

    @property
    def samples(self) -> I64:
        """(T,) paths per pixel of each tile."""
        return np.asarray(np.sum([t.samples for t in self.traced], axis=0))

    @property
    def worth(self) -> F64:
        """(A, T) of each TLAS entry, relative to each tile's light."""
        return self.weights.relative(self.samples)

    def with_more(self, feedback: Feedback, traced: Traced) -> Measurement:
        """With another trace of the same TLAS, whose weights were added to these; feedback of its own paths is that of
        all from then on."""
        met = np.flatnonzero(self.feedback.hits.any(axis=1))
        feedback.hits[met] += self.feedback.hits[met]
        feedback.paths += self.feedback.paths
        return replace(self, feedback=feedback, traced=(*self.traced, traced))

    def paths_met(self) -> I64:
        """(A,) how many paths met each TLAS entry."""
        return np.asarray(np.sum([t.log.paths_met(len(self.tlas)) for t in self.traced], axis=0))

    @property
    def met(self) -> I64:
        """(N,) int64: rays that met each instance. Only built ones and emitters can have been met."""
        hits = self.feedback.hits
        out = np.zeros(len(hits), np.int64)
        for rows in (self.tlas.ids, self.emissive):
            out[rows] = hits[rows].sum(axis=1)
        return out


def known_share(scene: Scene, known: F32, picture: F32) -> F64:
    """(T,) what share of the light of each tile of a picture is surely there. known: the same picture, without light of
    which nobody knows whether it is (`core.scene.known_light`)."""
    share = tile_means(known) / np.maximum(tile_means(picture), 1e-30)
    if (scene.lights["unsure"] & 2).any():  # what lamps take away is no more than all that is not known
        share = 2 * share - 1
    return np.asarray(np.clip(share, 0.0, 1.0))
