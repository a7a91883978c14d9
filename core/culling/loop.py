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
from numpy.typing import NDArray

from ..accel.blas import BlasCache, Work
from ..accel.embree import Device, shared_device
from ..accel.hitboxes import Hitboxes
from ..accel.region_tree import FANOUT, Cut, Regions
from ..accel.tlas import Tlas
from ..arrays import F32, F64, I32, I64, U8
from ..error_budget.budget import Budget
from ..errors import Cancelled
from ..feedback.hits import Feedback, Weights
from ..feedback.path_log import RECORD, PathLog, renumber
from ..feedback.tiles import DARK
from ..progress import Progress, part, silent
from ..scene.bounds import existing
from ..scene.change import Change
from ..scene.film import LUMINANCE, Picture
from ..scene.frustum import View
from ..scene.model import RayType, Scene
from ..tracing.tracer import Prepared, advanced, prepare, trace
from .options import CullOptions, State
from .twins import Twins

COLD_HITS = 7  # segments of one round that must cross a box before it is opened: fewer is chance
SETTLED = 0.02  # segments per path that still ask for a box when coarse rounds end
UNKNOWN = 0.2  # segments per path that ask for a box where coarse rounds are worth while
ROUND_PATHS = 1 << 14  # of a coarse round of the cold start, about
ROUNDS_FROM = 1 << 20  # number of the first sample of rounds: what they choose is judged by others
OPENINGS = 16  # of a witness at most, each a level or two deeper
GROWTH = 1.05  # per round, of what an instance is worth that waits for its BLAS
LARGE = 0.05  # of the picture's width: what comes into view this large is activated before it is asked for


@dataclass(frozen=True)
class CullingResult:
    """What a frame's culling decided.

    state: (N,) uint8 of `State`; score: (N,) float32 share of paths that met the instance; hits: (N, RAY_TYPES) int64 paths that met it, by type.
    boxes: (H, 2, 3) float32 world boxes that stand in for what is culled. stats: the frame's figures, named as in report.json.
    warnings: what could not be kept to.
    """

    state: U8
    score: F32
    hits: I64
    boxes: F32
    stats: dict[str, float | int]
    warnings: tuple[str, ...] = ()

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


class Loop:
    """The loop over a scene, and on to its next frames: what exists between rounds.

    exists, pinned: (N,) bool. active: (N,) bool, instances that are, or are to be, in the TLAS. kept: (N,) bool, what the last decision kept.
    known: (N,) bool, what it measured, None where there was none.
    value: (N,) float32, share of the paths that met an instance, or asked for it, when that was last known. measured: the last measurement of this frame.
    """

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
        count = len(scene.instances)
        self.active, self.kept, self.value = np.zeros(count, bool), np.zeros(count, bool), np.zeros(count, np.float32)
        self.known: np.ndarray | None = None
        self.cold = True  # nothing is known yet of what paths need
        self.ambient = 0.0  # mean luminance of the picture, as the last round saw it
        self._shown = np.zeros(0, np.int32)  # large instances in view
        self._twins = Twins()
        self._enter(scene, cancelled)
        start = time.perf_counter()
        self.exists = existing(scene.instances.bounds)
        self.regions = Regions(scene.instances.bounds, np.flatnonzero(self.exists))
        self.blas = BlasCache(scene.meshes, self.device)
        self.prepared = prepare(scene, self.blas)
        self._pin(pinned)
        self.timer.add("build_s", start)

    def advance(self, scene: Scene, change: Change, cancelled: Callable[[], bool] | None = None, pinned: np.ndarray | None = None) -> None:
        """Go on to the next frame: what was active and kept is so again; only what has changed is looked at."""
        self._enter(scene, cancelled)
        start = time.perf_counter()
        self.blas.work = Work()
        self.blas.advance(scene.meshes, change.deformed, change.replaced)
        if not change.still:
            self.regions.pass_frame()
        if change.previous is None:
            self._move(change.moved)
        else:
            self._carry(change.previous)
        self.prepared = advanced(self.prepared, scene, change)
        self._pin(pinned)
        self.timer.add("build_s", start)

    def _enter(self, scene: Scene, cancelled: Callable[[], bool] | None) -> None:
        """Begin a frame."""
        self.scene = scene
        self.cancelled = cancelled or (lambda: False)
        self.timer = _Timer()
        self.rounds = self.paths = self.rays = 0
        self.measured: Measurement | None = None
        self._asked: tuple[Cut, I64] | None = None  # boxes of the last round, and how often they were crossed
        self.size = self.options.picture_size(scene.film)
        self.samples = self.options.paths_per_pixel(scene.film)
        self.first_samples = self.options.first_paths_per_pixel(scene.film)
        self.next_sample = ROUNDS_FROM  # a measurement has the first ones, in every frame the same: what did not change measures the same
        self._opened: list[np.ndarray] = []  # instances that are active for a witness alone

    def _pin(self, pinned: np.ndarray | None) -> None:
        self.pinned = np.zeros(len(self.active), bool) if pinned is None else pinned & self.exists
        self.active |= self.pinned

    def _move(self, moved: np.ndarray | None) -> None:
        """Follow motion, (N,) bool, of the same instances."""
        bounds = self.scene.instances.bounds
        rows = np.zeros(0, np.int64) if moved is None else np.flatnonzero(moved)
        exist = existing(bounds[rows])
        if (exist != self.exists[rows]).any():
            self.exists = self.exists.copy()
            self.exists[rows] = exist
            self.active &= self.exists
            self.regions = self.regions.renewed(bounds, np.flatnonzero(self.exists))
            return
        self.regions.move(rows[exist], bounds)
        if len(rows) and self.regions.decayed:
            self.regions = self.regions.renewed(bounds, np.flatnonzero(self.exists))

    def _carry(self, previous: I32) -> None:
        """Follow instances to their new rows: (N,) int32 row of the frame before, -1 for new ones."""
        bounds = self.scene.instances.bounds
        self.exists = existing(bounds)
        shown = np.zeros(len(self.active), bool)
        shown[self._shown] = True
        known = np.flatnonzero(previous >= 0)

        def carried(old: np.ndarray) -> np.ndarray:
            new = np.zeros(len(previous), old.dtype)
            new[known] = old[previous[known]]
            return new

        self.active, self.kept, self.value = carried(self.active) & self.exists, carried(self.kept), carried(self.value)
        self.known = None if self.known is None else carried(self.known)
        self._shown = np.flatnonzero(carried(shown)).astype(np.int32)
        self.regions = self.regions.renewed(bounds, np.flatnonzero(self.exists), previous)

    def build(self, active: np.ndarray, progress: Progress = silent) -> Tlas:
        """The TLAS over active (N,) bool instances; within a budget over those whose BLAS is there, else their BLASes are built first."""
        start = time.perf_counter()
        if not self.limited:
            self.blas.need(self.scene.instances.mesh[active], self._step(progress))
        tlas = Tlas(self.scene.instances, self.blas, active)
        self.timer.add("build_s", start)
        return tlas

    @property
    def limited(self) -> bool:
        return bool(self.options.blas_budget_ms or self.options.blas_budget_bytes)

    def _step(self, progress: Progress) -> Callable[[int, int], None]:
        def step(done: int, of: int) -> None:
            progress(done / of, f"building {of:,} meshes")
            if self.cancelled():
                raise Cancelled

        return step

    def _provide(self, progress: Progress) -> None:
        """Within a budget: have the BLASes of active instances built, the most valuable first. A time budget is spent once per frame."""
        if not self.limited or (self.options.blas_budget_ms and self.rounds > 1):
            return
        start = time.perf_counter()
        rows = np.flatnonzero(self.active)
        meshes, users = np.unique(self.scene.instances.mesh[rows], return_inverse=True)
        value = np.bincount(users, self.value[rows], len(meshes)).astype(np.float64)
        value[self.blas.scenes[meshes] != 0] *= self.options.hysteresis  # nothing is freed for what is worth hardly more
        order = np.argsort(-value, kind="stable")
        self.blas.provide(meshes[order], self.options.blas_budget_ms / 1000, self.options.blas_budget_bytes, self._step(progress))
        self.timer.add("build_s", start)

    def _waiting(self) -> I64:
        """Active instances without a BLAS: it is being built, or does not fit the budget."""
        rows = np.flatnonzero(self.active)
        return rows[self.blas.scenes[self.scene.instances.mesh[rows]] == 0]

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
        """Trace samples paths per pixel of a picture of size (the analysis' own by default), with random numbers that no earlier round used.

        Returns feedback and the mean picture.
        """
        first_sample, self.next_sample = self.next_sample, self.next_sample + samples
        return self._counted(self.prepared, tlas, samples, first_sample, boxes, weights, progress, size or self.size, log)

    def _counted(
        self,
        prepared: Prepared,
        tlas: Tlas,
        samples: int,
        first_sample: int,
        boxes: Hitboxes | None,
        weights: Weights | None,
        progress: Progress,
        size: tuple[int, int],
        log: PathLog | None = None,
        only: NDArray[np.uint8] | None = None,
    ) -> tuple[Feedback, F32]:
        """Feedback and mean picture of the samples from first_sample on."""
        start = time.perf_counter()
        feedback = Feedback.zeros(len(self.scene.instances), boxes, weights)
        picture = self._trace(prepared, tlas, samples, first_sample, feedback, progress, size, log, only)
        self.paths += picture.paths
        self.rays += picture.rays
        feedback.paths = picture.paths
        self.timer.add("trace_s", start)
        return feedback, picture.mean

    def measure(self, tlas: Tlas | None = None, progress: Progress = silent) -> Measurement:
        """Hits and weights of the instances in tlas (default: the active ones), by as many paths per pixel as a first measurement takes.

        Emitters that are not built give no light: it would come through walls that are not built either.
        """
        return self._measured(self.build(self.active, progress) if tlas is None else tlas, 0, self.first_samples, progress)

    def measure_more(self, measured: Measurement, progress: Progress = silent) -> Measurement:
        """A measurement of all that is active now, by twice the paths per pixel of another."""
        return self._measured(self.build(self.active, progress), 0, 2 * measured.samples, progress)

    def witness(self, first_sample: int, only: NDArray[np.uint8], tolerated: Budget, progress: Progress = silent) -> Witness:
        """Trace those of S paths per pixel that only, (H, W, S), marks through the full scene, by random numbers that chose nothing.

        Boxes that paths cross are opened, and these paths traced again, until what is carried through the others is tolerated; none is where builds are
        limited.
        """
        log = PathLog.zeros(*only.shape)
        records = log.records.reshape(-1, RECORD)
        before: Tlas | None = None
        light: I64 = np.zeros(0, np.int64)
        for k in range(OPENINGS):
            progress(1 - 0.6**k, "paths that chose nothing")
            tlas = self.build(self.active)
            if before is not None:
                renumber(records, 1 - only.reshape(-1), _places(tlas.ids, before.ids))
            start = time.perf_counter()
            waiting = self._waiting() if self.limited else None
            cut = self.regions.cut(np.flatnonzero(self.active) if waiting is None else tlas.ids, waiting)
            boxes = Hitboxes(cut.bounds, self.device)
            self.timer.add("build_s", start)
            records[np.flatnonzero(only), 0] = 0
            weights = Weights.zeros(1, self.ambient, first=len(tlas))
            feedback, _ = self._counted(self.prepared, tlas, only.shape[2], first_sample, boxes, weights, silent, self.size, log, only)
            light = light if k else weights.total
            unknown = dataclasses.replace(weights, total=light).relative()[0]  # of tiles without paths 0
            within = unknown.mean() <= tolerated.mean and unknown.max() <= tolerated.worst
            if within or self.limited or not self._open(cut, feedback):
                break
            only, before = log.affected(np.zeros(len(tlas), bool)), tlas
        return Witness(tlas, log, first_sample, np.asarray(light * weights.unit, np.float64), np.asarray(weights.light[0] * weights.unit, np.float64))

    def unknown(self, first_sample: int, samples: int) -> F64:
        """(T,) share of each tile's light that so many fresh paths per pixel carry through boxes that are not opened."""
        only: NDArray[np.uint8] = np.ones((self.size[1], self.size[0], samples), np.uint8)
        witness = self.witness(first_sample, only, Budget(np.inf, np.inf))
        return np.asarray(witness.unknown / np.maximum(witness.light, max(DARK * float(witness.light.mean()), 1e-30)))

    def _open(self, cut: Cut, feedback: Feedback) -> bool:
        """Open every box of a cut that a path crossed, and activate emitters that lit one. Returns whether there was any."""
        crossings = feedback.boxes.sum(axis=1)
        asked = np.flatnonzero(crossings)
        emissive = self.prepared.emissive
        rows = np.concatenate([self.regions.order[cut.index[asked[cut.level[asked] == 0]]], emissive[feedback.hits[emissive].any(axis=1)]])
        rows = rows[~self.active[rows]]
        self._opened.append(rows)
        self.active[rows] = True
        self.regions.split_nodes(cut, asked, np.maximum(crossings[asked], FANOUT))
        return bool(len(asked) or len(rows))

    def _measured(self, tlas: Tlas, first_sample: int, samples: int, progress: Progress) -> Measurement:
        built = np.zeros(len(self.active), bool)
        built[tlas.ids] = True
        weights = Weights.zeros(len(tlas), self.ambient)
        log = PathLog.zeros(self.size[1], self.size[0], samples)
        feedback, _ = self._counted(self._dark_but(built), tlas, samples, first_sample, None, weights, progress, self.size, log)
        return Measurement(tlas, feedback, weights, log, first_sample, self.prepared.emissive)

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

    def trace_paths(self, keep: np.ndarray, first_sample: int, only: NDArray[np.uint8], progress: Progress = silent) -> tuple[F32, F32]:
        """Again the paths that only, (H, W, S) uint8, marks of a trace that began at first_sample, with only keep (N,) bool in the scene.

        Returns their part of the mean picture, (H, W, 4) float32, and the light of each, (H, W, S, 3) float32.
        """
        tlas = self.build(keep)
        start = time.perf_counter()
        log = PathLog(np.zeros((0, RECORD), np.int32), np.zeros((*only.shape, 3), np.float32))
        picture = self._trace(self._dark_but(keep), tlas, only.shape[2], first_sample, None, progress, self.size, log, only)
        self.rays += picture.rays
        self.timer.add("trace_s", start)
        return picture.mean, log.color

    def trace_without(self, full: Tlas, first_sample: int, keep: np.ndarray, only: NDArray[np.uint8], log: PathLog, progress: Progress = silent) -> None:
        """Into log what those paths that only, (H, W, S), marks of a trace of full, begun at first_sample, meet with only keep (N,) bool in the scene, by the
        numbers of the entries of full.

        The other paths of the log stay as they are.
        """
        tlas = self.build(keep)
        start = time.perf_counter()
        records = log.records.reshape(-1, RECORD)
        records[np.flatnonzero(only), 0] = 0
        feedback = Feedback.zeros(len(self.active))  # without which paths are not recorded
        picture = self._trace(self._dark_but(keep), tlas, only.shape[2], first_sample, feedback, progress, self.size, log, only)
        renumber(records, only.reshape(-1), _places(full.ids, tlas.ids))
        self.rays += picture.rays
        self.timer.add("trace_s", start)

    def _dark_but(self, keep: np.ndarray) -> Prepared:
        """The scene where no emitter outside keep (N,) bool gives light: by default all do, also those that are not built, so that they are noticed."""
        emissive, flags = self.prepared.emissive, self.scene.instances.flags
        if keep[emissive].all():
            return self.prepared
        flags = flags.copy()
        flags[emissive[~keep[emissive]]] = 0
        return self.prepared.with_instances(dataclasses.replace(self.scene.instances, flags=flags))

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
        only: NDArray[np.uint8] | None = None,
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
            log=log,
            only=only,
        )
        if self.cancelled():
            raise Cancelled
        return picture

    def run(self, progress: Progress = silent) -> None:
        """Rounds until no box is asked for any more, then a measurement. Where much is unknown coarse rounds, of few paths, come first."""
        self._notice()
        coarse_size = self.options.coarse_size(self.scene.film)
        coarse = self.cold
        self.cold = False
        tlas = None
        while self.rounds < self.options.max_iterations:
            self.rounds += 1
            progress(1 - 0.7**self.rounds, f"round {self.rounds}: {int(self.active.sum()):,} of {len(self.active):,} instances active")
            self._provide(progress)
            tlas = self.build(self.active)
            start = time.perf_counter()
            waiting = self._waiting() if self.limited else None
            cut = self.regions.cut(np.flatnonzero(self.active) if waiting is None else tlas.ids, waiting)
            boxes = Hitboxes(cut.bounds, self.device)
            self.timer.add("build_s", start)
            if coarse:
                samples = max(1, round(ROUND_PATHS / (coarse_size[0] * coarse_size[1])))
                feedback, picture = self.trace(tlas, samples, boxes, size=coarse_size)
                self.ambient = _mean_luminance(picture)
                coarse = self._ask(cut, feedback) > max(self.options.settled, SETTLED)
            else:
                feedback, picture = self.trace(tlas, self.options.round_paths_per_pixel(self.scene.film), boxes)
                self.ambient = _mean_luminance(picture)
                asked = self._ask(cut, feedback)
                self._light_up(cut, feedback)
                coarse = asked >= UNKNOWN
                if asked <= self.options.settled and self.rounds < self.options.max_iterations:
                    tlas = None  # with the few that were asked for at last
                    break
        self.measured = self.measure(tlas, part(progress, 0.5, 1.0))

    def _notice(self) -> None:
        """Activate large instances that have come into view since the last frame: the first frame with them is to show them (latency mitigation)."""
        if not self.options.mitigation:
            return
        start = time.perf_counter()
        shown = self.regions.in_view(View.of(self.scene.camera), LARGE)
        shown = np.sort(shown[(self.scene.instances.flags[shown] & (1 << RayType.CAMERA)) != 0])
        if not self.cold:
            new = np.setdiff1d(shown, self._shown, assume_unique=True)
            new = new[~self.active[new]]
            self.active[new], self.value[new] = True, LARGE**2
        self._shown = shown
        self.timer.add("build_s", start)

    def _ask(self, cut: Cut, feedback: Feedback) -> float:
        """Open the boxes that paths asked for, activate instances met before they were active. Returns how many segments per path asked."""
        start = time.perf_counter()
        crossings = feedback.boxes.sum(axis=1)
        enough = self._detected(crossings, feedback.paths)
        asked = np.flatnonzero(crossings >= enough)
        leaves = asked[cut.level[asked] == 0]
        single = self.regions.order[cut.index[leaves]]
        crossed = (crossings[leaves] / max(feedback.paths, 1)).astype(np.float32)
        waits = self.active[single]  # for its BLAS: what paths met of it before says more than what crosses its box now
        self.value[single] = np.where(waits, np.minimum(GROWTH * self.value[single], crossed), crossed)
        asked = np.setdiff1d(asked, leaves[waits], assume_unique=True)
        self.regions.split_nodes(cut, asked, crossings[asked] // enough)
        self.active[self.regions.instances_of(cut, asked)] = True
        emissive = self.prepared.emissive  # emitters that lit a path are known before their boxes are crossed
        self.active[emissive[feedback.hits[emissive].sum(axis=1) >= COLD_HITS]] = True
        self._asked = (cut, crossings)
        self.timer.add("feedback_s", start)
        return float(crossings[asked].sum()) / max(feedback.paths, 1)

    @staticmethod
    def _detected(crossings: I64, paths: int) -> int:
        """How often a box must be crossed to be opened: where most of what paths cross are boxes that few of them cross, once is enough, for chance is the
        rule.
        """
        often = int(crossings[crossings >= COLD_HITS].sum())
        seldom = int(crossings.sum()) - often
        return 1 if seldom > often and seldom > SETTLED * paths else COLD_HITS

    def _light_up(self, cut: Cut, feedback: Feedback) -> None:
        """Activate every emitter that lit a path, or whose box one crossed: few paths may carry much of a tile's light."""
        emissive = self.prepared.emissive
        if len(emissive):
            crossed = np.flatnonzero((cut.level == 0) & feedback.boxes.any(axis=1))
            lit = feedback.hits[emissive].any(axis=1) | np.isin(emissive, self.regions.order[cut.index[crossed]])
            self.active[emissive[lit]] = True

    def include(self, rows: np.ndarray) -> None:
        """Have a set of instances, (N,) bool, in the TLAS, as far as no budget of BLASes forbids."""
        self._opened.append(np.flatnonzero(rows & ~self.active))
        self.active |= rows
        self._provide(silent)

    def result(self, keep: np.ndarray, score: F32, hits: I64, warnings: tuple[str, ...] = (), **figures: float | int) -> CullingResult:
        """States for keep (N,) bool, with the final structures built and counted; figures go into the stats. What the next frame need not have is freed."""
        keep = self.kept = self._twins.joined(self.scene.instances.bounds, keep | self.pinned)
        self.active |= keep
        self._provide(silent)
        tlas = self.build(keep)
        self._release()
        start = time.perf_counter()
        mesh = self.scene.instances.mesh
        self.blas.keep_only(mesh[self.active])
        cut = self.regions.cut(np.flatnonzero(keep))
        boxes = Hitboxes(cut.bounds, self.device)
        state = np.where(keep, np.uint8(State.ACTIVE), np.uint8(State.CULLED))
        if self.limited:
            waiting = self._waiting()
            comes = bool(self.options.blas_budget_ms) & ~np.isin(mesh[waiting], self.blas.refused)
            state[waiting] = np.where(comes, np.uint8(State.PENDING), np.uint8(State.CULLED))
        self.timer.add("build_s", start)
        counts = np.bincount(state, minlength=len(State))
        stats: dict[str, float | int] = {
            "instances": len(keep),
            "active": int(counts[State.ACTIVE]),
            "pending": int(counts[State.PENDING]),
            "culled": int(counts[State.CULLED]),
            "hitboxes": len(boxes),
            "meshes": len(np.unique(mesh[tlas.ids])),
            "blas_built": self.blas.work.built,
            "blas_refitted": self.blas.work.refitted,
            "blas_bytes": int(self.blas.bytes_of[np.unique(mesh[tlas.ids])].sum()),
            "blas_held_bytes": self.blas.bytes,
            "tlas_bytes": tlas.bytes + boxes.bytes,
            **self.timer.seconds,
            "blas_s": self.blas.work.build_s,
            "refit_s": self.blas.work.refit_s,
            "paths": self.paths,
            "rays": self.rays,
            "iterations": self.rounds,
            **figures,
        }
        return CullingResult(state, score, hits, cut.bounds, stats, warnings)

    def _release(self) -> None:
        """Let go of what paths do not need any more: instances that none met, regions whose parts none asked for."""
        if self.measured is None:
            return
        start = time.perf_counter()
        ids, met = self.measured.tlas.ids, self.measured.met
        for opened in self._opened:  # unless a measurement has found out about them since
            self.active[np.setdiff1d(opened[~self.kept[opened]], ids)] = False
        self.known = np.zeros(len(self.active), bool)
        self.known[ids] = True
        self.value[ids] = met[ids] / max(self.measured.feedback.paths, 1)
        unmet = ids[(met[ids] == 0) & ~self.kept[ids]]
        self.active[self.regions.release(unmet)] = False
        if self._asked is not None:
            self.regions.close(np.flatnonzero(self.active), *self._asked)
        self.timer.add("feedback_s", start)


def _mean_luminance(picture: F32) -> float:
    return float((picture[..., :3] @ LUMINANCE.astype(np.float32)).mean())


def _places(ids: I32, some: I32) -> np.ndarray:
    """The place in ids (A,) of each of some (B,) of them, and behind these A, the number that stands for what is not built."""
    order = np.argsort(ids)
    return np.append(order[np.searchsorted(ids[order], some)], len(ids))
