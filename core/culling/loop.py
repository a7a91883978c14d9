"""The method's loop: build the TLAS, trace paths, process hit feedback, until the states settle.

A cold start: everything is culled and grouped, nothing is built but boxes. Light paths ask for geometry through the
nearest boxes that they cross: a region asked for often is split, an instance asked for often is activated and built.
When no path asks for more, the active set is measured by real hits, and what few paths meet is culled again.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..accel.blas import BlasCache, Work
from ..accel.embree import Device, shared_device
from ..accel.hitboxes import Hitboxes
from ..accel.region_tree import Cut
from ..accel.residency import Residency
from ..accel.tlas import Tlas
from ..arrays import F32, F64, I64
from ..error_budget.budget import Budget
from ..feedback.hits import Feedback, Weights
from ..feedback.path_log import RECORD, PathLog, renumber
from ..feedback.tiles import TILES, marks, tile_means, tiles_of
from ..progress import Progress, part, silent
from ..scene.change import Change
from ..scene.film import LUMINANCE
from ..scene.model import RAY_TYPES, Film, Scene
from ..threads import limit
from ..tracing.seen_emitters import NONE_SEEN, SeenEmitters
from .activation import SETTLED, Activation
from .division import Division
from .frame_tracer import FrameTracer, light_known, places, twins_met, with_twins
from .measurement import Measurement, Traced
from .options import CullOptions
from .result import Built, CullingResult, states, structure_figures

UNKNOWN = 0.2  # requests per path from which on coarse rounds are worth while
OPENINGS = 16  # rounds of opening boxes at most, each a level or two deeper
ROUND_PATHS = 1 << 14  # of a coarse round of the cold start, about, at least
ENTRIES_PER_PATH = 8  # of a TLAS, or boxes, that are built in the time in which a path is traced


@dataclass(frozen=True)
class Witness:
    """Paths that chose nothing, through the full scene as far as they need it: what each met, and the number of its
    first sample.

    light: (T,) float64 luminance of all paths of each tile. unknown: (T,) float64, that of what they carry through
    boxes that were not opened: it may be lost, or other light in its place.
    """

    tlas: Tlas
    log: PathLog
    first_sample: int
    light: F64
    unknown: F64


class Loop:
    """The loop over a scene, and on to its next frames: build, trace, and what feedback does to the activation of
    instances.

    scene: the frame. tracer: traces sets of its instances. activation: which instances are active. blas: what is built.
    rounds: of this frame so far. measured: the last measurement of this frame. seen: what the camera sees of small
    emitters. first_samples: paths per pixel of a first measurement.
    """

    def __init__(
        self,
        scene: Scene,
        options: CullOptions,
        cancelled: Callable[[], bool] | None = None,
        device: Device | None = None,
        pinned: np.ndarray | None = None,
        blas: BlasCache | None = None,
    ) -> None:
        """cancelled: polled during long work; where it says True, `Cancelled` is raised. device: Embree's, shared by
        default. pinned: as in `analyze`. blas: of the scene's meshes, what is built already."""
        limit(options.threads)
        self.options = options
        self.device = device or shared_device(options.threads)
        self.blas = BlasCache(scene.meshes, self.device) if blas is None else blas
        budgets = options.blas_budget_ms / 1000, options.blas_budget_bytes
        self.residency = Residency(self.blas, *budgets, options.hysteresis)
        self.cold = True  # nothing is known yet of what paths need
        self.division = Division.of(scene, options, self.limited)
        self.light, self.ambient, self.backdrop = np.zeros(TILES), 0.0, 0.0  # `brightness` of the last round
        self.known = np.ones(TILES)  # share of the light of each tile that is surely there, by the last measurement
        self.tracer = FrameTracer(scene, options, self.residency, cancelled)
        self._enter(scene)
        with self.timer.step("build_s"):
            self.activation = Activation(scene, pinned)

    def advance(
        self,
        scene: Scene,
        change: Change,
        cancelled: Callable[[], bool] | None = None,
        pinned: np.ndarray | None = None,
    ) -> None:
        """Go on to the next frame: what was active and kept is so again; only what has changed is looked at."""
        self.blas.work = Work()
        self.blas.advance(scene.meshes, change.deformed, change.replaced)
        self.tracer.advance(scene, change, cancelled)
        self._enter(scene)
        with self.timer.step("build_s"):
            self.activation.advance(scene, change, pinned)

    def _enter(self, scene: Scene) -> None:
        """Begin a frame."""
        self.scene, self.timer = scene, self.tracer.timer
        self.rounds, self.size = 0, self.tracer.size
        self.measured: Measurement | None = None
        self.seen: SeenEmitters = NONE_SEEN
        self.first_samples = self.options.first_paths_per_pixel(scene.film)

    @property
    def limited(self) -> bool:
        """Whether builds are limited, so that some active instance may not be in the TLAS."""
        return self.residency.limited

    def run(self, progress: Progress = silent, sparser: int = 1) -> Measurement:
        """Rounds until no box is asked for any more, then a measurement. Where much is unknown coarse rounds, of few
        paths, come first. sparser: by how much fewer paths the others take."""
        if self.options.mitigation:
            with self.timer.step("build_s"):
                self.activation.activate_newly_visible(self.scene, self.cold)
        coarse, emissive = self.cold, self.tracer.prepared.emissive
        self.cold, by_chance = False, False
        samples = max(1, self.first_samples // sparser)
        tlas = None
        while self.rounds < self.options.max_iterations:
            self.rounds += 1
            self._divide()
            active = f"{int(self.activation.active.sum()):,} of {len(self.activation):,} instances active"
            progress(1 - 0.7**self.rounds, f"round {self.rounds}: {active}")
            self._schedule_builds(progress)
            tlas = self.tracer.build(self.activation.active)
            cut, boxes = self.boxes(tlas)
            feedback, picture = _traced_round(self, tlas, boxes, coarse, sparser)
            self.light, self.ambient, self.backdrop = brightness(picture, self.scene.film)
            with self.timer.step("feedback_s"):
                asked, by_chance = self.activation.open_requested_boxes(cut, feedback, emissive)
            if by_chance and self.tracer.paths >= samples * self.size[0] * self.size[1]:
                break
            if coarse:
                coarse = asked > max(self.options.settled, SETTLED)
                continue
            self.activation.activate_contributing_emitters(cut, feedback, emissive)
            coarse = asked >= UNKNOWN
            if asked <= self.options.settled and self.rounds < self.options.max_iterations:
                tlas = None  # measure with the few that the last round requested, too
                break
        if self.options.min_share is None and len(emissive):
            self.seen = self.tracer.seen_emitters(self.tracer.build(self.activation.active))
            if self.activation.activate_seen_emitters(self.seen, self.light, self.options.max_error):
                tlas = None
        if by_chance and not self.limited and self.options.max_iterations > 1:
            # other paths tell little of what these will meet, so these open what they cross
            only = np.ones((self.size[1], self.size[0], samples), np.uint8)
            tlas = trace_witness(self, 0, only, Budget(self.options.settled, np.inf), progress).tlas
        return self.measure(tlas, samples, part(progress, 0.5, 1.0))

    def _divide(self) -> None:
        """Replace large meshes that paths have asked for by their parts."""
        with self.timer.step("build_s"):
            if self.division and self.division.divide(self.activation.active & ~self.activation.pinned):
                self.enter_division(self.division)

    def enter_division(self, division: Division) -> None:
        """Go on with a scene of which meshes are divided."""
        self.division, self.scene = division, division.scene
        self.blas.advance(self.scene.meshes, *np.zeros((2, 0), np.int32))
        self.activation.divide(self.scene)
        self.tracer.divide(self.scene)
        self.tracer.twins.divide(division.first, division.owner)

    def _schedule_builds(self, progress: Progress = silent) -> None:
        """Where builds are limited: have the BLASes of active instances built, the most valuable first. A time budget
        is spent once per frame."""
        if not self.limited or (self.residency.deferred and self.rounds > 1):
            return
        with self.timer.step("build_s"):
            self.residency.schedule(
                self.scene.instances.mesh, self.activation.active, self.activation.value, self.tracer.step(progress)
            )

    def boxes(self, tlas: Tlas) -> tuple[Cut, Hitboxes]:
        """The cut through the region tree that stands in for all that is not in a TLAS over the active instances, and
        its hitboxes."""
        with self.timer.step("build_s"):
            active = self.activation.active
            waiting = self.residency.waiting(self.scene.instances.mesh, active) if self.limited else None
            cut = self.activation.regions.cut(np.flatnonzero(active) if waiting is None else tlas.ids, waiting)
            return cut, Hitboxes(cut.bounds, self.device)

    def measure(self, tlas: Tlas | None = None, samples: int = 0, progress: Progress = silent) -> Measurement:
        """Hits and weights of the instances in tlas (default: the active ones). samples: paths per pixel (default: as
        many as a first measurement takes).

        Emitters that are not built give no light: it would come through walls that are not built either.
        """
        if tlas is None:
            self._divide()
            tlas = self.tracer.build(self.activation.active, progress)
        built = np.bincount(tlas.ids, minlength=len(self.activation)) > 0
        weights, count = Weights.zeros(len(tlas), self.ambient), samples or self.first_samples
        log = PathLog.zeros(self.size[1], self.size[0], count, backdrop=self.backdrop)
        prepared = self.tracer.with_only_emitters(built)
        feedback, picture = self.tracer.count(prepared, tlas, count, 0, weights=weights, progress=progress, log=log)
        self.known = light_known(self.tracer, tlas, built, count, picture)
        weights, traced = replace(weights, known=self.known), Traced(log, 0, np.full(TILES, count))
        self.measured = Measurement(tlas, feedback, weights, (traced,), prepared.emissive)
        return self.measured

    def measure_denser(self, measured: Measurement, samples: I64, progress: Progress = silent) -> Measurement:
        """A measurement with so many more paths per pixel of each tile, (T,); the old one's weights become its own."""
        only = marks(samples, self.size[1], self.size[0])
        log, first = PathLog.zeros(*only.shape, backdrop=self.backdrop), measured.next_sample
        built = np.bincount(measured.tlas.ids, minlength=len(self.activation)) > 0
        prepared = self.tracer.with_only_emitters(built)
        feedback, _ = self.tracer.count(
            prepared, measured.tlas, only.shape[2], first, None, measured.weights, progress, log=log, only=only
        )
        self.measured = measured.with_more(feedback, Traced(log, first, samples))
        return self.measured

    def include(self, instances: np.ndarray) -> None:
        """Have a set of instances, (N,) bool, in the TLAS until the frame is decided, as far as no budget of BLASes
        forbids."""
        self.activation.activate_for_witness(instances)
        self._schedule_builds()

    def result(
        self, keep: np.ndarray, score: F32, hits: I64, warnings: tuple[str, ...] = (), **figures: float | int
    ) -> CullingResult:
        """States for keep (N,) bool, with the final structures built and counted; figures go into the stats.

        What the last measurement does not need is freed; where there was none, all that is active stays built.
        """
        self.activation.kept = keep = with_twins(self.tracer, keep | self.activation.pinned)
        self.activation.activate(keep)
        self._schedule_builds()
        tlas = self.tracer.build(keep)
        if self.measured is not None:
            with self.timer.step("feedback_s"):
                self.activation.release(self.measured)
        with self.timer.step("build_s"):
            self.blas.keep_only(self.scene.instances.mesh[self.activation.active])
            cut = self.activation.regions.cut(np.flatnonzero(keep))
            boxes = Hitboxes(cut.bounds, self.device)
            state = states(keep, self.residency, self.scene.instances.mesh, self.activation.active)
        stats = structure_figures(state, self.scene.instances.mesh[tlas.ids], self.blas, tlas.bytes + boxes.bytes)
        stats |= self.timer.seconds | {"paths": self.tracer.paths, "rays": self.tracer.rays}
        stats |= {"iterations": self.rounds, "hitboxes": len(boxes), **figures}
        built = Built(self.blas, tlas, self.tracer.prepared)
        result = CullingResult(state, score, hits, cut.bounds, stats, warnings, built=built)
        return self.division.joined(result) if self.division else result


def _traced_round(loop: Loop, tlas: Tlas, boxes: Hitboxes, coarse: bool, sparser: int) -> tuple[Feedback, F32]:
    """Feedback and mean picture of a round."""
    options, film = loop.options, loop.scene.film
    if not coarse:
        return loop.tracer.trace(tlas, max(1, options.round_paths_per_pixel(film) // sparser), boxes)
    width, height = options.coarse_size(film)
    paths = max(ROUND_PATHS, (len(tlas) + len(boxes)) // ENTRIES_PER_PATH)
    return loop.tracer.trace(tlas, max(1, round(paths / (width * height))), boxes, size=(width, height))


def trace_witness(
    loop: Loop, first_sample: int, only: NDArray[np.uint8], tolerated: Budget, progress: Progress = silent
) -> Witness:
    """Trace through the full scene those of S paths per pixel that only, (H, W, S), marks. first_sample: the number of
    the first; no path that chose a set may have one of these numbers.

    Boxes that paths cross are opened, and these paths traced again, until the light that is carried through boxes that
    are not opened is within tolerated; where builds are limited, none is opened.
    """
    log, prepared = PathLog.zeros(*only.shape, backdrop=loop.backdrop), loop.tracer.prepared
    tile = tiles_of(*only.shape[:2]).ravel()
    samples = np.maximum(
        np.bincount(tile, only.sum(axis=2).ravel(), TILES) / np.maximum(np.bincount(tile, minlength=TILES), 1), 1.0
    )
    records = log.records.reshape(-1, RECORD)
    before: Tlas | None = None
    light: I64 = np.zeros(0, np.int64)
    for k in range(OPENINGS):
        progress(1 - 0.6**k, "paths that chose nothing")
        tlas = loop.tracer.build(loop.activation.active)
        if before is not None:
            renumber(records, 1 - only.reshape(-1), places(tlas.ids, before.ids))
        cut, boxes = loop.boxes(tlas)
        log.clear(only)
        weights = replace(Weights.zeros(1, loop.ambient, first=len(tlas)), known=loop.known)
        feedback, _ = loop.tracer.count(prepared, tlas, only.shape[2], first_sample, boxes, weights, log=log, only=only)
        if not k:
            light = weights.total
            twins_met(loop.tracer, feedback.hits)
        unknown = replace(weights, total=light).relative(samples)[0]  # of tiles without paths 0
        within = unknown.mean() <= tolerated.mean and unknown.max() <= tolerated.worst
        if within or loop.limited or not loop.activation.open_crossed_boxes(cut, feedback, prepared.emissive):
            break
        only, before = log.affected(np.zeros(len(tlas), bool)), tlas
    return Witness(
        tlas,
        log,
        first_sample,
        np.asarray(light * weights.unit, np.float64),
        np.asarray(weights.light[0] * weights.unit, np.float64),
    )


def all_stay(loop: Loop, why: str) -> CullingResult:
    """The result where nothing is culled, with a warning that says why."""
    n = len(loop.activation)
    loop.activation.activate_alone(loop.activation.exists)
    hits = np.zeros((n, RAY_TYPES), np.int64)
    return loop.result(loop.activation.exists, np.zeros(n, np.float32), hits, (why,))


def brightness(picture: F32, film: Film) -> tuple[F64, float, float]:
    """How bright a picture, (H, W, 4), of a round is, before exposure: mean luminance of each tile, (T,); of all; and
    of what is in it, by its alpha (`PathLog.backdrop`)."""
    exposure = max(film.exposure, 1e-6)
    mean = float((picture[..., :3] @ LUMINANCE.astype(np.float32)).mean()) / exposure
    return tile_means(picture) / exposure, mean, mean / max(float(picture[..., 3].mean()), 1e-6)
