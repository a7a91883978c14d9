"""The method's loop: build TLAS, trace rays, process hit feedback, until the states settle.

A cold start: everything is culled and grouped, nothing is built but boxes. Light paths ask for geometry through the nearest boxes that they cross: a region
asked for often is split, an instance asked for often is activated and built. When no path asks for more, the active set is measured by real hits, and what
few paths meet is culled again.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from .blas import BlasCache, Work
from .change import Change
from .culling import CullOptions, State
from .embree import Device, shared_device
from .errors import Cancelled
from .feedback import Feedback, Weights
from .film import LUMINANCE, Picture
from .hitboxes import Hitboxes
from .placing import LARGEST
from .progress import Progress, silent
from .regions import Cut, Regions
from .scene import F32, I64, U8, Scene
from .tlas import Tlas
from .tracer import Prepared, prepare, trace

COLD_HITS = 4  # segments of one round that must cross a box before it is opened: fewer is chance
SETTLED = 0.02  # segments per path that still ask for a box when the cold start ends
ROUND_PATHS = 1 << 14  # of a coarse round of the cold start, about


@dataclass(frozen=True)
class CullingResult:
    """What a frame's culling decided.

    state: (N,) uint8 of `State`; score: (N,) float32 share of paths that met the instance; hits: (N, RAY_TYPES) int64 paths that met it, by type.
    boxes: (H, 2, 3) float32 world boxes that stand in for what is culled. stats: the frame's figures, named as in report.json.
    """

    state: U8
    score: F32
    hits: I64
    boxes: F32
    stats: dict[str, float | int]

    @property
    def active(self) -> np.ndarray:
        """(N,) bool."""
        return self.state == State.ACTIVE


@dataclass
class _Timer:
    """Seconds per step of the loop."""

    seconds: dict[str, float] = field(default_factory=lambda: {"build_s": 0.0, "trace_s": 0.0, "feedback_s": 0.0})

    def add(self, step: str, start: float) -> None:
        self.seconds[step] += time.perf_counter() - start


@dataclass(frozen=True)
class Measurement:
    """Feedback of a trace of candidates, its mean picture (H, W, 4) float32, and the number of its first sample."""

    tlas: Tlas
    feedback: Feedback
    weights: Weights
    picture: F32
    first_sample: int


class Loop:
    """The loop over one scene: what exists between its rounds."""

    def __init__(
        self,
        scene: Scene,
        options: CullOptions,
        cancelled: Callable[[], bool] | None = None,
        device: Device | None = None,
        pinned: np.ndarray | None = None,
    ) -> None:
        """cancelled: polled during long work; where it says True, `Cancelled` is raised. device: Embree's, shared by default. pinned: as in `analyze`."""
        self.options = options
        self.device = device or shared_device(options.threads)
        self.active = np.zeros(len(scene.instances), bool)
        self.kept = np.zeros(len(scene.instances), bool)  # what the frame before kept
        self.ambient = 0.0  # mean luminance of the picture, as the last round saw it
        self.blas = BlasCache(scene.meshes, self.device)
        self._enter(scene, cancelled, pinned)

    def advance(self, scene: Scene, change: Change, cancelled: Callable[[], bool] | None = None, pinned: np.ndarray | None = None) -> None:
        """Go on to the next frame: what was active and kept is so again, whatever has changed is read and built anew when it is needed."""
        if change.previous is not None:
            known = change.previous >= 0
            self.active = known & self.active[change.previous]
            self.kept = known & self.kept[change.previous]
        self.blas.advance(scene.meshes, change.deformed, change.replaced)
        self._enter(scene, cancelled, pinned)

    def _enter(self, scene: Scene, cancelled: Callable[[], bool] | None, pinned: np.ndarray | None) -> None:
        """Begin a frame."""
        self.scene = scene
        self.cancelled = cancelled or (lambda: False)
        self.timer = _Timer()
        start = time.perf_counter()
        self.blas.work = Work()
        instances = scene.instances
        # What has no extent to meet takes no part: no triangles, or a transform that is not finite.
        self.exists = (instances.bounds[:, 0] <= instances.bounds[:, 1]).all(axis=1) & np.isfinite(instances.bounds).all(axis=(1, 2))
        self.pinned = np.zeros(len(instances), bool) if pinned is None else pinned & self.exists
        self.active = (self.active & self.exists) | self.pinned
        self.rounds = self.paths = self.rays = 0
        self.next_sample = self.options.paths  # a measurement has the first ones, in every frame the same: what did not change measures the same
        self.measured: Measurement | None = None
        height = max(1, round(self.options.width * scene.film.height / scene.film.width))
        self.size = (min(self.options.width, scene.film.width), min(height, scene.film.height))
        self.regions = Regions(instances.bounds, np.flatnonzero(self.exists))
        self.prepared = prepare(scene, self.blas)
        self.timer.add("build_s", start)

    def build(self, active: np.ndarray, progress: Progress = silent) -> Tlas:
        """The TLAS over active instances, their BLASes built first."""
        start = time.perf_counter()

        def step(done: int, of: int) -> None:
            progress(done / of, f"building {of:,} meshes")
            if self.cancelled():
                raise Cancelled

        self.blas.need(self.scene.instances.mesh[active], step)
        tlas = Tlas(self.scene.instances, self.blas, active)
        self.timer.add("build_s", start)
        return tlas

    def trace(
        self,
        tlas: Tlas,
        samples: int,
        boxes: Hitboxes | None = None,
        weights: Weights | None = None,
        progress: Progress = silent,
        size: tuple[int, int] | None = None,
    ) -> tuple[Feedback, F32]:
        """Trace samples paths per pixel of a picture of size (the analysis' own by default), with random numbers that no earlier round used.

        Returns feedback and the mean picture.
        """
        first_sample, self.next_sample = self.next_sample, self.next_sample + samples
        return self._counted(tlas, samples, first_sample, boxes, weights, progress, size or self.size)

    def _counted(
        self, tlas: Tlas, samples: int, first_sample: int, boxes: Hitboxes | None, weights: Weights | None, progress: Progress, size: tuple[int, int]
    ) -> tuple[Feedback, F32]:
        """Feedback and mean picture of the samples from first_sample on."""
        start = time.perf_counter()
        feedback = Feedback.zeros(len(self.scene.instances), boxes, weights)
        picture = self._trace(self.prepared, tlas, samples, first_sample, feedback, progress, size)
        self.paths += picture.paths
        self.rays += picture.rays
        feedback.paths = picture.paths
        self.timer.add("trace_s", start)
        return feedback, picture.mean

    def measure(self, tlas: Tlas | None = None, boxes: Hitboxes | None = None, progress: Progress = silent) -> Measurement:
        """Hits and weights of the instances in tlas (default: the active ones), by the number of paths per pixel that the options ask for."""
        tlas = tlas or self.build(self.active)
        weights = Weights.zeros(len(self.active), tlas.ids, self.ambient)
        feedback, picture = self._counted(tlas, self.options.paths, 0, boxes, weights, progress, self.size)
        return Measurement(tlas, feedback, weights, picture, 0)

    def trace_again(self, keep: np.ndarray, first_sample: int, samples: int, progress: Progress = silent) -> F32:
        """The mean picture with only keep (N,) bool in the scene, by the same random numbers as a trace that began at first_sample.

        Culled emitters are still picked by light sampling, and give nothing: other picks would be other random numbers.
        """
        tlas = self.build(keep)
        start = time.perf_counter()
        picture = self._trace(self._dark_but(keep), tlas, samples, first_sample, None, progress, self.size)
        self.rays += picture.rays
        self.timer.add("trace_s", start)
        return picture.mean

    def _dark_but(self, keep: np.ndarray) -> Prepared:
        """The scene where no emitter outside keep (N,) bool gives light: by default all do, also those that are not built, so that they are noticed."""
        flags = np.where(keep, self.scene.instances.flags, np.uint8(0))
        return self.prepared.with_instances(dataclasses.replace(self.scene.instances, flags=flags))

    def settle(self, progress: Progress = silent) -> Measurement:
        """A measurement of what is built: the cold start's last, or one more where that met emitters that were not.

        Emitters that are not built shine through walls that are not built either; a picture with their light is none to compare others with.
        """
        if self.measured is not None:
            built = np.zeros(len(self.active), bool)
            built[self.measured.tlas.ids] = True
            unbuilt = self.exists & ~built & (self.measured.feedback.hits.sum(axis=1) > 0)
            if not unbuilt.any():
                return self.measured
            self.active |= unbuilt
        lit, self.prepared = self.prepared, self._dark_but(self.active)
        try:
            self.measured = self.measure(progress=progress)
        finally:
            self.prepared = lit
        return self.measured

    def _trace(
        self, prepared: Prepared, tlas: Tlas, samples: int, first_sample: int, feedback: Feedback | None, progress: Progress, size: tuple[int, int]
    ) -> Picture:
        picture = trace(
            prepared,
            tlas,
            samples=samples,
            first_sample=first_sample,
            seed=self.options.seed,
            feedback=feedback,
            hitbox_every=self.options.hitbox_every,
            nearest=self.options.nearest,
            size=size,
            threads=self.options.threads,
            progress=progress,
            cancelled=self.cancelled,
        )
        if self.cancelled():
            raise Cancelled
        return picture

    def run(self, progress: Progress = silent) -> None:
        """Rounds until no box is asked for any more, the last of which leaves `measured`. Where nothing is known yet coarse ones, of few paths, come first."""
        coarse_size = (max(self.size[0] // 2, 1), max(self.size[1] // 2, 1))
        coarse = self.ambient == 0.0
        while self.rounds < self.options.max_iterations:
            self.rounds += 1
            progress(1 - 0.7**self.rounds, f"round {self.rounds}: {int(self.active.sum()):,} of {len(self.active):,} instances active")
            tlas = self.build(self.active)
            start = time.perf_counter()
            cut = self.regions.cut(self.active)
            boxes = Hitboxes(cut.bounds, self.device)
            self.timer.add("build_s", start)
            if coarse:
                samples = max(1, round(ROUND_PATHS / (coarse_size[0] * coarse_size[1])))
                feedback, picture = self.trace(tlas, samples, boxes, size=coarse_size)
                self.ambient = float((picture[..., :3] @ LUMINANCE.astype(np.float32)).mean())
                coarse = self._ask(cut, feedback) >= SETTLED
            else:
                self.measured = self.measure(tlas, boxes)
                if self._ask(cut, self.measured.feedback) < SETTLED:
                    return

    def _ask(self, cut: Cut, feedback: Feedback) -> float:
        """Open the boxes that paths asked for, activate instances met before they were active. Returns how many segments per path asked."""
        start = time.perf_counter()
        crossings = feedback.boxes.sum(axis=1)
        asked = np.flatnonzero(crossings >= COLD_HITS)
        self.regions.split_nodes(cut, asked, crossings[asked] // COLD_HITS)
        self.active[self.regions.instances_of(cut, asked)] = True
        self.active |= (feedback.hits.sum(axis=1) >= COLD_HITS) & self.exists  # emitters that lit a path are known before their boxes are crossed
        self.timer.add("feedback_s", start)
        return float(crossings[asked].sum()) / max(feedback.paths, 1)

    def result(self, keep: np.ndarray, score: F32, hits: I64, **figures: float | int) -> CullingResult:
        """States for keep (N,) bool, with the final structures built and counted; figures go into the stats."""
        keep = self.kept = keep | self.pinned
        tlas = self.build(keep)
        self.blas.keep_only(self.scene.instances.mesh[keep])
        start = time.perf_counter()
        self.regions.merge()
        cut = self.regions.cut(keep)
        boxes = Hitboxes(cut.bounds, self.device)
        self.timer.add("build_s", start)
        state = np.where(keep, np.uint8(State.ACTIVE), np.uint8(State.CULLED))
        stats: dict[str, float | int] = {
            "instances": len(keep),
            "active": int(keep.sum()),
            "pending": 0,
            "culled": int((~keep).sum()),
            "hitboxes": len(boxes),
            "meshes": len(self.blas),
            "blas_built": self.blas.work.built,
            "blas_refitted": self.blas.work.refitted,
            "blas_s": self.blas.work.build_s,
            "refit_s": self.blas.work.refit_s,
            "blas_bytes": self.blas.bytes,
            "tlas_bytes": tlas.bytes + boxes.bytes,
            **self.timer.seconds,
            "paths": self.paths,
            "rays": self.rays,
            "iterations": self.rounds,
            **figures,
        }
        return CullingResult(state, score, hits, cut.bounds, stats)
