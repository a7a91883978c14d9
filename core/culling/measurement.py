"""Measurements: what traces of the active set found out, from which sets are chosen."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..accel.tlas import Tlas
from ..arrays import F32, F64, I64
from ..error_budget.budget import Budget
from ..error_budget.error_estimate import CONFIDENCE
from ..feedback.hits import Feedback, Weights
from ..feedback.path_log import PathLog
from ..feedback.tiles import DARK, TILES, tile_means, tiles_of
from ..scene.model import RayType, Scene
from ..tracing.lights.lights import brightest
from ..tracing.seen_emitters import polished


@dataclass(frozen=True)
class Traced:
    """A trace: what its paths met, the number of their first sample, and how many there are per pixel of each tile,
    (T,)."""

    log: PathLog
    first_sample: int
    samples: I64


LIT = 100  # paths that bring light: fewer tell a picture's brightness to no better than a tenth
DARKNESS = "next to no light path brings light to the picture: all stays, for no change is small beside nothing"


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
    def is_dark(self) -> bool:
        """Whether so few paths of the whole picture bring light that nobody knows how bright it is: then what opens to
        the light by culling may be any share of that."""
        lit = np.count_nonzero((self.log.color > 0).any(axis=-1))
        return bool(lit < min(LIT, self.log.color[..., 0].size // 10))

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
    # what lamps and materials take away is no more than all that is not known
    if (scene.lights["unsure"] & 2).any() or (scene.materials["unsure_emission"] & 2).any():
        share = 2 * share - 1
    return np.asarray(np.clip(share, 0.0, 1.0))


def evidence(measured: Measurement, scene: Scene, size: tuple[int, int], budget: Budget) -> tuple[I64, I64]:
    """(A,) how many paths say what each TLAS entry is worth: those that met it; and instances that stay: those that no
    path met where some such may well be seen, and those that may hide such.

    What mirrors and glass show of an emitter, light sampling does not find. Where one path that meets it there would
    break the budget of a typical tile, and paths meet such emitters there, those alone are evidence.

    size: (width, height) of the picture in pixels.
    """
    met, ids = measured.paths_met(), measured.tlas.ids
    nothing = np.zeros(0, np.int64)
    if not polished(scene):
        return met, nothing
    rows = measured.tlas.entry_of(len(scene.instances))[measured.emissive]
    rows = rows[rows >= 0]
    if not len(rows):
        return met, nothing
    paths = np.bincount(tiles_of(size[1], size[0]).ravel(), minlength=TILES) * measured.samples
    total = measured.weights.total * measured.weights.known * measured.weights.unit
    light = total / np.maximum(paths, 1)  # mean of each tile's paths
    typical = float(np.median((np.maximum(light, DARK * light.mean()) * paths)[paths > 0]))
    rows = rows[brightest(scene)[ids[rows]] > budget.worst * typical]
    seen = measured.feedback.hits[ids[rows]][:, [RayType.GLOSSY, RayType.TRANSMISSION]].sum(axis=1)
    if not seen.any():
        return met, nothing
    met[rows] = np.minimum(met[rows], seen)
    missed = ids[rows[seen == 0]] if likely_missed(seen) > 1 - CONFIDENCE else nothing
    # what else mirrors show may hide such an emitter there
    shown = measured.feedback.hits[ids][:, [RayType.GLOSSY, RayType.TRANSMISSION]].any(axis=1)
    shown[rows] = False
    return met, np.union1d(missed, ids[shown]).astype(np.int64)


def likely_missed(counts: I64) -> float:
    """How many things are likely there that were met 0 times, by how often others were, (n,): Chao's lower bound in its
    bias-corrected form (Chao, "Nonparametric estimation of the number of classes in a population", 1984; Chao 1987)."""
    once, twice = int((counts == 1).sum()), int((counts == 2).sum())
    return once * (once - 1) / (2 * (twice + 1))
