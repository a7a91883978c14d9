"""The method's loop: build TLAS, trace rays, process hit feedback, until the states settle.

A cold start: everything is culled and grouped, nothing is built but boxes. Light paths ask for geometry through the nearest boxes that they cross: a region
asked for often is split, an instance asked for often is activated and built. When no path asks for more, the active set is measured by real hits, and what
few paths meet is culled again.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from .blas import BlasCache
from .culling import CullOptions, State, heuristic
from .embree import Device, shared_device
from .errors import Cancelled
from .feedback import Feedback
from .hitboxes import Hitboxes
from .progress import Progress, part, silent
from .regions import Cut, Regions
from .scene import F32, I64, RAY_TYPES, U8, Scene
from .tlas import Tlas
from .tracer import prepare, trace

COLD_HITS = 4  # segments of one round that must cross a box before it is opened: fewer is chance
SETTLED = 0.005  # segments per path that still ask for a box when the cold start ends


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


class Loop:
    """The loop over one scene: what exists between its rounds."""

    def __init__(self, scene: Scene, options: CullOptions, cancelled: Callable[[], bool] | None = None, device: Device | None = None) -> None:
        """cancelled: polled during long work; where it says True, `Cancelled` is raised. device: Embree's, shared by default."""
        self.scene, self.options = scene, options
        self.cancelled = cancelled or (lambda: False)
        self.device = device or shared_device(options.threads)
        self.timer = _Timer()
        self.blas = BlasCache(scene.meshes, self.device)
        instances = scene.instances
        # What has no extent to meet takes no part: no triangles, or a transform that is not finite.
        self.exists = (instances.bounds[:, 0] <= instances.bounds[:, 1]).all(axis=1) & np.isfinite(instances.bounds).all(axis=(1, 2))
        self.active = np.zeros(len(instances), bool)
        self.rounds = self.paths = self.rays = 0
        height = max(1, round(options.width * scene.film.height / scene.film.width))
        self.size = (min(options.width, scene.film.width), min(height, scene.film.height))
        start = time.perf_counter()
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

    def trace(self, tlas: Tlas, boxes: Hitboxes | None, samples: int, progress: Progress = silent) -> Feedback:
        """Trace samples paths per pixel of the analysis picture, with random numbers that no earlier round used."""
        start = time.perf_counter()
        feedback = Feedback.zeros(len(self.scene.instances), boxes)
        picture = trace(
            self.prepared,
            tlas,
            samples=samples,
            first_sample=self.paths // max(self.size[0] * self.size[1], 1),
            seed=self.options.seed,
            feedback=feedback,
            nearest=self.options.nearest,
            size=self.size,
            threads=self.options.threads,
            progress=progress,
            cancelled=self.cancelled,
        )
        if self.cancelled():
            raise Cancelled
        self.paths += picture.paths
        self.rays += picture.rays
        feedback.paths = picture.paths
        self.timer.add("trace_s", start)
        return feedback

    def cold_start(self, progress: Progress = silent) -> None:
        """Rounds of one path per pixel from nothing built, until no box is asked for any more."""
        while self.rounds < self.options.max_iterations:
            self.rounds += 1
            tlas = self.build(self.active, progress)
            start = time.perf_counter()
            cut = self.regions.cut(self.active)
            boxes = Hitboxes(cut.bounds, self.device)
            self.timer.add("build_s", start)
            feedback = self.trace(tlas, boxes, 1)
            if self._ask(cut, feedback) < SETTLED:
                return
            progress(1 - 0.7**self.rounds, f"round {self.rounds}: {int(self.active.sum()):,} of {len(self.active):,} instances active")

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

    def measure(self, progress: Progress = silent) -> Feedback:
        """Real hits of the active set, by the number of paths per pixel that the options ask for."""
        return self.trace(self.build(self.active), None, self.options.paths, progress)

    def result(self, keep: np.ndarray, hits: I64, paths: int) -> CullingResult:
        """States for keep (N,) bool, with the final structures built and counted."""
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
            "blas_built": self.blas.built_total,
            "blas_bytes": self.blas.bytes,
            "tlas_bytes": tlas.bytes + boxes.bytes,
            **self.timer.seconds,
            "paths": self.paths,
            "rays": self.rays,
            "iterations": self.rounds,
        }
        score = (hits.sum(axis=1) / max(paths, 1)).astype(np.float32)
        return CullingResult(state, score, hits, cut.bounds, stats)


def analyze(scene: Scene, options: CullOptions, progress: Progress = silent, cancelled: Callable[[], bool] | None = None) -> CullingResult:
    """Decide which instances of a frame stay.

    Raises Cancelled where cancelled() says so, MemoryError where Embree runs out.
    """
    loop = Loop(scene, options, cancelled)
    n = len(scene.instances)
    if options.policy != "light-paths":
        keep = heuristic(scene, options) & loop.exists
        return loop.result(keep, np.zeros((n, RAY_TYPES), np.int64), 0)
    loop.cold_start(part(progress, 0.0, 0.7, "light paths ask for geometry, "))
    feedback = loop.measure(part(progress, 0.7, 1.0, "measuring, "))
    start = time.perf_counter()
    met = feedback.hits.sum(axis=1)
    keep = loop.active & (met > 0) & (met >= options.min_share * feedback.paths)
    loop.timer.add("feedback_s", start)
    return loop.result(keep, feedback.hits, feedback.paths)
