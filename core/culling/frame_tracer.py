"""Traces of one frame through any set of its instances, with the same random numbers where they are to be compared."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from copy import copy

import numpy as np
from numpy.typing import NDArray

from ..accel.blas import BlasCache
from ..accel.hitboxes import Hitboxes
from ..accel.residency import Residency
from ..accel.tlas import Tlas
from ..arrays import F32, F64, I32, I64, U8
from ..errors import Cancelled
from ..feedback.hits import Feedback, Weights
from ..feedback.path_log import RECORD, PathLog, renumber
from ..feedback.tiles import TILES, tile_means
from ..files.figures import percent
from ..progress import Progress, silent
from ..scene.change import Change
from ..scene.film import Picture
from ..scene.known_light import known_light
from ..scene.model import Scene
from ..scene.together import Twins
from ..tracing.seen_emitters import SeenEmitters, seen_emitters
from ..tracing.tracer import Prepared, advanced, prepare, trace
from .measurement import known_share
from .options import CullOptions
from .result import Timer

COINCIDENT = 1e-3  # share of places with coincident surfaces from which on a warning tells of them
ROUNDS_FROM = 1 << 20  # number of the first sample of rounds: none of those that measure and certify what they choose
BOXES_PER_SEGMENT = 4  # nearest boxes that a ray segment asks for
# where most of what there is are parts of meshes: each has a BLAS of its own, and around a surface the boxes of many
# overlap, so that with four of them two and a half times as many are built, in no fewer rounds
BOXES_AMONG_PARTS = 1


class FrameTracer:
    """Paths through sets of a frame's instances; what they need is built first.

    size: width and height of the analysis picture. paths, rays: traced so far in this frame. shared: the
    largest share of a trace's hits that was on twins. timer: seconds of its steps, of those of its callers too.
    """

    def __init__(
        self, scene: Scene, options: CullOptions, residency: Residency, cancelled: Callable[[], bool] | None
    ) -> None:
        self._options, self.residency, self.twins = options, residency, Twins()
        self._enter(scene, cancelled)
        with self.timer.step("build_s"):
            self.prepared = prepare(scene, residency.blas)

    def advance(self, scene: Scene, change: Change, cancelled: Callable[[], bool] | None) -> None:
        """Go on to the next frame."""
        self._enter(scene, cancelled)
        with self.timer.step("build_s"):
            self.prepared = advanced(self.prepared, scene, change)

    def divide(self, scene: Scene) -> None:
        """Go on with parts of meshes behind the instances that there were, none of which emits."""
        self.scene = scene
        self.prepared = self.prepared.divided(scene)

    def _enter(self, scene: Scene, cancelled: Callable[[], bool] | None) -> None:
        self.scene, self._cancelled = scene, cancelled or (lambda: False)
        self._whole = len(scene.instances)
        self.timer = Timer()
        self.paths = self.rays = self.looks = self.coincident = 0  # as of Picture, in all traces
        self.size, self.shared = self._options.picture_size(scene.film), 0.0
        # measurements take samples from 0 on, in every frame the same: what did not change measures the same
        self.next_sample = ROUNDS_FROM

    @property
    def blas(self) -> BlasCache:
        """The BLASes of the frame's meshes."""
        return self.residency.blas

    def step(self, progress: Progress) -> Callable[[int, int], None]:
        """Called after each of many builds; raises Cancelled."""

        def step(done: int, of: int) -> None:
            progress(done / of, f"building {of:,} meshes")
            if self._cancelled():
                raise Cancelled

        return step

    def build(self, active: np.ndarray, progress: Progress = silent) -> Tlas:
        """The TLAS over active (N,) bool instances; within a budget over those whose BLAS is there, else their BLASes
        are built first."""
        with self.timer.step("build_s"):
            if not self.residency.limited:
                self.blas.need(self.scene.instances.mesh[active], self.step(progress))
            return Tlas(self.scene.instances, self.blas, active)

    def seen_emitters(self, tlas: Tlas) -> SeenEmitters:
        """What the camera sees of small emitters past what is in a TLAS."""
        with self.timer.step("trace_s"):
            return seen_emitters(self.prepared, tlas, self.size, self._options.seed)

    def trace(
        self,
        tlas: Tlas,
        samples: int,
        boxes: Hitboxes | None = None,
        weights: Weights | None = None,
        progress: Progress = silent,
        size: tuple[int, int] | None = None,
        log: PathLog | None = None,
    ) -> tuple[Feedback, F32]:
        """Trace samples paths per pixel of a picture of size (the analysis' own by default), with random numbers that
        no earlier round used.

        Returns feedback and the mean picture.
        """
        first_sample, self.next_sample = self.next_sample, self.next_sample + samples
        return self.count(self.prepared, tlas, samples, first_sample, boxes, weights, progress, size, log)

    def count(
        self,
        prepared: Prepared,
        tlas: Tlas,
        samples: int,
        first_sample: int,
        boxes: Hitboxes | None = None,
        weights: Weights | None = None,
        progress: Progress = silent,
        size: tuple[int, int] | None = None,
        log: PathLog | None = None,
        only: U8 | None = None,
    ) -> tuple[Feedback, F32]:
        """Feedback and mean picture of the samples from first_sample on."""
        with self.timer.step("trace_s"):
            feedback = Feedback.zeros(len(self.scene.instances), boxes, weights)
            picture = self._trace(
                prepared, tlas, samples, first_sample, feedback, progress, size or self.size, log, only
            )
            self.paths += picture.paths
            feedback.paths = picture.paths
        return feedback, picture.mean

    def trace_again(self, keep: np.ndarray, first_sample: int, samples: int, progress: Progress = silent) -> F32:
        """The mean picture with only keep (N,) bool in the scene, by the same random numbers as a trace that began at
        first_sample.

        Culled emitters are still picked by light sampling, and give nothing: other picks would be other random numbers.
        """
        tlas = self.build(keep)
        with self.timer.step("trace_s"):
            picture = self._trace(self.with_only_emitters(keep), tlas, samples, first_sample, None, progress, self.size)
            return picture.mean

    def trace_paths(
        self, keep: np.ndarray, first_sample: int, only: U8, progress: Progress = silent, backdrop: float = 0.0
    ) -> tuple[F32, F32]:
        """Trace again, with only keep (N,) bool in the scene, the paths that only, (H, W, S) uint8, marks of a trace
        that began at first_sample.

        Returns their part of the mean picture, (H, W, 4) float32, and the light of each, (H, W, S, 3) float32, less a
        backdrop as of `PathLog`.
        """
        tlas, prepared = self.build(keep), self.with_only_emitters(keep)
        with self.timer.step("trace_s"):
            log = PathLog(np.zeros((0, RECORD), np.int32), np.zeros((*only.shape, 3), np.float32), backdrop)
            picture = self._trace(prepared, tlas, only.shape[2], first_sample, None, progress, self.size, log, only)
        return picture.mean, log.color

    def trace_without(
        self,
        full: Tlas,
        first_sample: int,
        keep: np.ndarray,
        tlas: Tlas,
        only: U8,
        log: PathLog,
        boxes: Hitboxes | None = None,
    ) -> None:
        """Trace again paths of a trace of full that began at first_sample, those that only, (H, W, S), marks, with only
        keep (N,) bool in the scene, which tlas holds, or boxes. What they meet goes into log, as entries of full, but
        boxes, and what full has not, as what is not built. The other paths of the log stay as they are.
        """
        with self.timer.step("trace_s"):
            log.clear(only)
            # without feedback paths are not recorded, nor boxes without weights
            weights = None if boxes is None else Weights.zeros(1, 1.0, first=len(tlas))
            feedback = Feedback.zeros(len(self.scene.instances), boxes, weights)
            prepared = self.with_only_emitters(keep)
            self._trace(prepared, tlas, only.shape[2], first_sample, feedback, silent, self.size, log, only, full)
            renumber(log.records.reshape(-1, RECORD), only.reshape(-1), places(full.ids, tlas.ids))

    def with_only_emitters(self, keep: np.ndarray, prepared: Prepared | None = None) -> Prepared:
        """The scene where no emitter outside keep (N,) bool gives light: by default all do, also those that are not
        built, so that they are noticed. prepared: the scene with other lights."""
        prepared = prepared or self.prepared
        emissive, instances = prepared.emissive, prepared.scene.instances
        if keep[emissive].all():
            return prepared
        flags = instances.flags.copy()
        flags[emissive[~keep[emissive]]] = 0
        return prepared.with_instances(dataclasses.replace(instances, flags=flags))

    def _trace(
        self,
        prepared: Prepared,
        tlas: Tlas,
        samples: int,
        first_sample: int,
        feedback: Feedback | None,
        progress: Progress,
        size: tuple[int, int],
        log: PathLog | None = None,
        only: U8 | None = None,
        full: Tlas | None = None,
    ) -> Picture:
        picture = trace(
            prepared,
            tlas,
            samples=samples,
            first_sample=first_sample,
            seed=self._options.seed,
            feedback=feedback,
            hitbox_every=self._options.hitbox_every if log is None else 1,  # what is logged is to be complete
            nearest=BOXES_AMONG_PARTS if len(self.scene.instances) > 2 * self._whole else BOXES_PER_SEGMENT,
            size=size,
            threads=self._options.threads,
            progress=progress,
            cancelled=self._cancelled,
            log=log,
            only=only,
            full=full,
        )
        if self._cancelled():
            raise Cancelled
        self.rays += picture.rays
        self.looks, self.coincident = self.looks + picture.looks, self.coincident + picture.coincident
        return picture


def with_twins(tracer: FrameTracer, keep: np.ndarray) -> np.ndarray:
    """keep, (N,) bool, with all that lie exactly where one of them does, and what cannot go without these."""
    return as_rendered(tracer, tracer.twins.joined(tracer.scene.instances.bounds, keep))


def as_rendered(tracer: FrameTracer, keep: np.ndarray) -> np.ndarray:
    """keep, (N,) bool, with what cannot be taken out of the picture without it."""
    if tracer.scene.removal is None:
        return keep
    some = tracer.twins.whole(keep)
    more = tracer.scene.removal.staying(some) & ~some
    return tracer.twins.with_parts(keep, more) if more.any() else keep


def twins_met(tracer: FrameTracer, hits: I64) -> NDArray[np.intp]:
    """Instances that lie exactly where another one does, and that rays met: nobody knows what such show. hits: as of
    `Feedback`; which share of them is on such is noted."""
    twins = tracer.twins.rows(tracer.scene.instances.bounds, tracer.scene.instances.transform)
    if not len(twins):
        return twins
    met = hits[twins].sum(axis=1)
    tracer.shared = max(tracer.shared, int(met.sum()) / max(int(hits.sum()), 1))
    return twins[met > 0]


def light_known(tracer: FrameTracer, tlas: Tlas, keep: np.ndarray, samples: int, picture: F32) -> F64:
    """(T,) `known_share` of a picture of keep, (N,) bool, which tlas holds, by the samples from 0 on."""
    if (scene := known_light(tracer.scene)) is None:
        return np.ones(TILES)
    prepared = tracer.with_only_emitters(keep, tracer.prepared.relit(scene))
    with tracer.timer.step("trace_s"):
        known = tracer._trace(prepared, tlas, samples, 0, None, silent, tracer.size).mean
        return known_share(tracer.scene, known, picture)


def without_bound(tracer: FrameTracer, tlas: Tlas, emissive: I64, keep: np.ndarray, mean: float) -> list[str]:
    """Lines for what no error bound holds, where keep, (N,) bool, stays of a frame that tlas holds: the same in all
    frames of a budget. mean: the budget of the mean. emissive: indices of what emits."""
    lines = []
    if max(tracer.coincident / max(tracer.looks, 1), tracer.shared) > COINCIDENT:
        lines.append(
            f"surfaces of several objects lie in one place, on more than {percent(COINCIDENT)} of what paths met: "
            "which of them a renderer shows there is chance, and no error bound holds for it; they stay"
        )
    if not keep[emissive].all() and clamped(tracer, tlas) > mean:
        lines.append(
            f"clamping takes more than {percent(mean)} of the light: how much depends on how a renderer picks among "
            "the emitters that are there, of which some are culled, and no error bound holds for it; Clamp Direct and "
            "Indirect of 0 turn it off"
        )
    return lines


def clamped(tracer: FrameTracer, tlas: Tlas) -> float:
    """What share of its light a picture of what tlas holds loses by the scene's clamps."""
    limits = tracer.scene.limits
    if limits.clamp_direct <= 0 and limits.clamp_indirect <= 0:
        return 0.0
    prepared = tracer.with_only_emitters(np.isin(np.arange(len(tracer.scene.instances)), tlas.ids))
    whole = dataclasses.replace(limits, clamp_direct=0.0, clamp_indirect=0.0)
    free = dataclasses.replace(prepared, scene=dataclasses.replace(prepared.scene, limits=whole))
    with tracer.timer.step("trace_s"):
        less, all_of_it = (
            tile_means(tracer._trace(p, tlas, 1, 0, None, silent, tracer.size).mean).mean() for p in (prepared, free)
        )
    return float(1 - less / all_of_it) if all_of_it > 0 else 0.0


def exchanged(tracer: FrameTracer, scene: Scene) -> FrameTracer:
    """What traces the same frame where instances that do not emit have other meshes, which the cache of BLASes knows.
    What it traces is not counted by the other."""
    out = copy(tracer)
    out.scene, out.prepared = scene, tracer.prepared.exchanged(scene)
    return out


def places(ids: I32, some: I32) -> np.ndarray:
    """(B + 1,) the place in ids (A,) of each of some (B,), then A, the number that stands for what is not built, as for
    those that are not among ids."""
    order = np.argsort(ids)
    found = np.append(order, len(ids))[np.searchsorted(ids[order], some)]
    found[np.append(ids, -1)[found] != some] = len(ids)
    return np.append(found, len(ids))
