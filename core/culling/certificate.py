"""A certificate: how much culling changes a picture, by paths that chose nothing of what is culled.

A search proposes a sequence of sets, each culling more than the one before. Fresh paths, through the full scene as far
as they need it, walk down that sequence, step by step. Tested in a fixed order, no set needs a correction for the
others (hierarchical testing, Maurer et al. 1995); a step that fails is walked in pieces, which is a second such test,
and both share the doubt. Where only chance stands between a set and the budget, more paths are traced in the tiles that
doubt it, at most LOOKS times; each look has its share of the doubt. A tile that a set may change too much is full:
nothing else is culled that is worth anything to it, and the walk goes on for the others.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..accel.tlas import Tlas
from ..arrays import F64, I64
from ..error_budget.budget import Budget
from ..error_budget.error_estimate import CONFIDENCE, NOTHING, Difference, ErrorEstimate, Light, Reference
from ..error_budget.search import LEAST_GAIN, WORTH_WHILE, pieces
from ..error_budget.trial import Trial
from ..error_budget.units import Seen, Units
from ..feedback.path_log import PathLog
from ..feedback.tiles import DARK, TILES, marks, tiles_of
from ..progress import Progress, part, silent
from ..tracing.seen_emitters import SeenEmitters
from .frame_tracer import FrameTracer
from .loop import ENTRIES_PER_PATH, Loop, Witness, trace_witness
from .staying import Staying, first_part

LOOKS = 6  # in all, each doubles the paths of the tiles in doubt
DENSEST = 16  # times the paths of a first look, in a tile at most
MORE = 1.0  # paths in doubtful tiles in all, to those that were traced everywhere
STEEPEST = 4  # times the paths per pixel of a first look that are traced at once, at most
FAILURES = 12  # sets that may break the budget before the walk ends
LEVELS = 2  # sets in steps, and pieces of a step that fails: two tests of what may be too much
TOLERATED = 0.05  # of the budget, in the mean and in every tile: what may stay unknown
# times that an instance is built here in the time in which a render reads it and builds it, at most
RENDERED = 10
NEGLIGIBLE = 0.01  # of the bound of a tile: units worth less to a full one may still go

NOTHING_SURE = "of nothing it is sure that the picture may go without it, at this error budget: everything is kept"


Gain = Callable[[np.ndarray, np.ndarray], float]


def _all_of_it(_cull: np.ndarray, _more: np.ndarray) -> float:
    """A gain that is always worth while."""
    return 1.0


@dataclass(frozen=True)
class Accepted:
    """A set of units, (U,) bool; the instances that it leaves, (N,) bool; the change by it."""

    cull: np.ndarray
    keep: np.ndarray
    estimate: ErrorEstimate


@dataclass(frozen=True)
class Verdict:
    """What surely keeps the budget.

    cull: (U,) bool units, None where no set of the sequence does, nor that nothing is culled, for builds are limited;
    keep: (N,) bool instances that stay. estimate: the change by that, or by the first set.
    confidence: of each of its bounds. unknown: (T,) float64, what of it is charged for boxes that were not opened.
    paths: how many were traced. why: no set was judged, where none was.
    """

    cull: np.ndarray | None
    keep: np.ndarray
    estimate: ErrorEstimate
    confidence: float
    unknown: F64
    paths: int
    why: str = ""


class Certificate:
    """Paths that judge the sets of a sequence: they took no part in choosing them."""

    def __init__(
        self,
        loop: Loop,
        first_sample: int,
        samples: I64,
        budget: Budget,
        confidence: float = CONFIDENCE,
        more: int = 0,
    ) -> None:
        """first_sample, samples: of the first paths, so many per pixel of each tile, (T,); the numbers behind these are
        taken too. confidence: that both bounds hold. more: sets that are judged beside those of the walk.
        """
        self.loop, self.next_sample, self.samples, self.budget = loop, first_sample, samples, budget
        self.each, self._levels = 1 - (1 - confidence) / (LOOKS * (LEVELS + more)), more > 0
        self.paths = self._again = self._looks = 0  # paths traced in all; of those in doubtful tiles; looks so far
        self._layers: list[_Layer] = []

    def walk(
        self,
        sets: Sequence[np.ndarray],
        units: Units,
        keep_of: Callable[[np.ndarray], np.ndarray],
        gains: tuple[Gain, Gain] = (_all_of_it, _all_of_it),
        progress: Progress = silent,
    ) -> Verdict:
        """Judge sets of units, (U,) bool, each a part of the next. keep_of: the instances that a set leaves, (N,) bool.
        gains: what a larger set gains on another, `gain` and `gain_of_all` of `error_budget.search`: where the last
        one gains little on what is certified, doubts about a set are not looked into.

        Raises Cancelled.
        """
        full, failed = np.zeros(TILES, bool), 0
        gain, gain_of_all = gains
        # the empty set: it needs neither paths nor builds
        nothing = Accepted(np.zeros(len(units), bool), self.loop.activation.exists.copy(), NOTHING)
        accepted = None if self.loop.limited else nothing
        if sets and (why := self._too_dear(keep_of(sets[-1]), len(sets) + 1)):
            return replace(self._verdict(nothing, nothing.keep, NOTHING), why=why)
        for k, cull in enumerate(sets):
            within = part(progress, 1 - 0.9**k, 1 - 0.9 ** (k + 1), "certifying, ")
            while True:
                before = np.zeros(len(units), bool) if accepted is None else accepted.cull
                new = cull & ~before
                new[new] = (units.worth[new][:, full] <= NEGLIGIBLE * self.budget.worst).all(axis=1)
                whole = before | new
                if (before.any() and gain(before, whole) < LEAST_GAIN) or (accepted is not None and not new.any()):
                    break
                doubts = not before.any() or gain_of_all(before, sets[-1]) >= WORTH_WHILE
                for proposed in (whole, *pieces(before, whole, units)):
                    keep = keep_of(proposed)
                    estimate = self.judge(keep, within, doubts)
                    holds = estimate.surely_holds(self.budget, self.each)
                    if holds:
                        self._accept()
                        accepted = Accepted(proposed, keep, estimate)
                    else:
                        failing = estimate
                    if holds == (proposed is whole):  # all of it, or the first piece too many
                        break
                if accepted is not None and accepted.cull is whole:
                    break
                failed += 1
                exceeded = failing.exceeded(self.budget, self.each) & ~full
                if accepted is None or failed > FAILURES or not exceeded.any():
                    return self._verdict(accepted, keep, estimate)
                full |= exceeded
        return self._verdict(accepted, np.zeros(0, bool), NOTHING)

    def _too_dear(self, least: np.ndarray, builds: int) -> str:
        """Why sets are not judged, "" where they are. least: (N,) bool, what the largest leaves; builds: of that."""
        stay, of = (int(np.count_nonzero(some)) for some in (least, self.loop.activation.exists))
        paths = int(self.samples[tiles_of(self.loop.size[1], self.loop.size[0])].sum())
        if self._levels or builds * stay <= ENTRIES_PER_PATH * paths or pays(self.loop, least, builds * stay):
            return ""
        return (
            f"everything is kept: of {of:,} instances {stay:,} would stay at this error budget, and building them "
            f"{builds} times, to be sure of it, takes longer than a render takes for the others"
        )

    def verdict(self, cull: np.ndarray, keep: np.ndarray, progress: Progress = silent) -> Verdict:
        """The change by a set of units, (U,) bool, whatever the budget. keep: the instances that it leaves, (N,)
        bool."""
        return self._verdict(Accepted(cull, keep, self.judge(keep, progress)), keep, NOTHING)

    def _verdict(self, accepted: Accepted | None, keep: np.ndarray, estimate: ErrorEstimate) -> Verdict:
        """keep, estimate: of the set that was judged last, where none was accepted."""
        cull, keep, estimate = (
            (None, keep, estimate) if accepted is None else (accepted.cull, accepted.keep, accepted.estimate)
        )
        unknown = self.unknown if cull is None or cull.any() else np.zeros(TILES)
        return Verdict(cull, keep, estimate, 0.5 * (1 + self.each), unknown, self.paths)

    @property
    def unknown(self) -> F64:
        """(T,) float64, what is charged for boxes that are not opened: light that may not be there in the full picture,
        so that it is not what changes are relative to, either."""
        if not self._layers:
            return np.zeros(TILES)
        unknown = np.sum([layer.witness.unknown for layer in self._layers], axis=0)
        light = self._light.luminance
        return np.asarray(unknown / np.maximum(light - unknown, DARK * light))

    @property
    def _light(self) -> Light:
        return Light.of(*(layer.reference for layer in self._layers))

    def judge(self, keep: np.ndarray, progress: Progress = silent, doubts: bool = True) -> ErrorEstimate:
        """The error of a set, (N,) bool of what stays; doubts: by as many looks as it takes to be sure, or as are
        left."""
        # less of the scene is left to build
        self.loop.include(keep & (np.arange(len(keep)) < first_part(self.loop)))
        if not self._layers:
            self._add(self.samples, progress)
        staying = Staying(self.loop, keep)
        estimate = self._estimate(staying)
        while doubts and not estimate.surely_holds(self.budget, self.each) and self._look_again(estimate, progress):
            estimate = self._estimate(staying)
        return estimate

    def _revealed(self, tracer: FrameTracer, keep: np.ndarray, tlas: Tlas) -> F64:
        """(T, 3) mean radiance of small emitters that the camera sees because of all that hid them nothing is in tlas
        any more. That none was seen before says nothing: several instances may have hidden all of them."""
        more = tracer.seen_emitters(tlas).shown(keep) - self._layers[0].emitters.shown(keep)
        return np.asarray(np.maximum(more, 0.0))

    def judge_exchanged(
        self, tracer: FrameTracer, keep: np.ndarray, tlas: Tlas, budget: Budget, progress: Progress = silent
    ) -> ErrorEstimate:
        """The error where instances of what stays have other meshes, too. tracer: of that scene; keep: (N,) bool, what
        there is of it, a part of the set that was judged last; tlas: over that.

        A path may meet what has another shape where it passed before, so all paths are traced. By as many looks as it
        takes to be sure, or as are left.
        """
        difference: Difference | None = None
        revealed, traced = self._revealed(tracer, keep, tlas), 0
        while True:
            for layer in self._layers[traced:]:
                found = layer.exchanged(tracer, keep, tlas)
                difference = found if difference is None else difference + found
                self.paths += int(np.count_nonzero(layer.only))
            traced = len(self._layers)
            assert difference is not None
            estimate = self._estimated(difference, keep, revealed)
            if estimate.surely_holds(budget, self.each) or not self._look_again(estimate, progress, budget):
                return estimate

    def _estimate(self, staying: Staying) -> ErrorEstimate:
        for layer in self._layers:
            self.paths += layer.propose(staying)
        difference = sum((layer.trial.trace() for layer in self._layers[1:]), self._layers[0].trial.trace())
        revealed = self._revealed(self.loop.tracer, staying.keep, staying.tlas)
        return self._estimated(difference, staying.keep, revealed)

    def _estimated(self, difference: Difference, keep: np.ndarray, revealed: F64) -> ErrorEstimate:
        """By what paths differ by, and what is charged where keep, (N,) bool, stays. revealed: as of `_revealed`."""
        seen, light = self.loop.seen, self._light
        unmet = Seen(seen.instance, seen.tile, light.share(seen.tile, seen.color)).without(keep)
        return light.estimate(
            difference, self.unknown + unmet + light.share(np.arange(TILES, dtype=np.int32), revealed)
        )

    def _accept(self) -> None:
        for layer in self._layers:
            layer.trial.accept()

    def _add(self, samples: I64, progress: Progress) -> None:
        """Trace so many more paths per pixel, (T,), in each tile."""
        width, height = self.loop.size
        only = marks(samples, height, width)
        tolerated = Budget(TOLERATED * self.budget.mean, TOLERATED * self.budget.worst)
        witness = trace_witness(self.loop, self.next_sample, only, tolerated, progress)
        self.next_sample += only.shape[2]
        self.paths += int(np.count_nonzero(only))
        self._looks += 1
        self._layers.append(_Layer(self.loop, witness, only))

    def _look_again(self, estimate: ErrorEstimate, progress: Progress, budget: Budget | None = None) -> bool:
        """More paths in the tiles that doubt a set; False where they would not do."""
        budget = budget or self.budget
        if self._looks >= LOOKS:
            return False
        first, paths = self._layers[0].reference.paths, self._light.paths
        tiles = estimate.doubtful(budget, self.each) & (paths < DENSEST * first)
        samples = np.where(
            tiles, (np.minimum(paths / np.maximum(first, 1), STEEPEST) * self.samples).astype(np.int64), 0
        )
        cost = int((first / self.samples * samples).sum())
        if (
            not tiles.any()
            or self._again + cost > MORE * first.sum()
            or not estimate.may_hold(budget, self.each, DENSEST * first / paths)
        ):
            return False
        self._again += cost
        self._add(samples, progress)
        return True


def pays(loop: Loop, least: np.ndarray, entries: int) -> bool:
    """Whether to judge sets may win as much as building so many TLAS entries takes. least: what the largest set leaves,
    (N,) bool.

    Where it leaves instances of all meshes, a render has no less to do but for those that go.
    """
    mesh, go = loop.scene.instances.mesh, loop.activation.exists & ~least
    if loop.limited or loop.options.memory or len(np.setdiff1d(mesh[go], mesh[least])):
        return True
    return entries <= RENDERED * int(np.count_nonzero(go))


class _Layer:
    """Paths of one look."""

    def __init__(self, loop: Loop, witness: Witness, only: NDArray[np.uint8]) -> None:
        self._loop, self.witness, self.only = loop, witness, only
        light = witness.light if any(hits.lamps_known for hits in loop.scene.first_hits.values()) else None
        self.reference = Reference(witness.log, only, light, loop.known)
        self.trial = Trial(self.reference, witness.log, self._without, only)
        self._buffer = PathLog.zeros(*only.shape, backdrop=loop.backdrop)

    @cached_property
    def emitters(self) -> SeenEmitters:
        """What the camera sees of small emitters with nothing culled."""
        return self._loop.tracer.seen_emitters(self.witness.tlas)

    def propose(self, staying: Staying) -> int:
        """A set that culls what was accepted and more. Returns how many paths are traced for it."""
        self._staying = staying
        return self.trial.propose(~staying.keep[self.witness.tlas.ids])

    def exchanged(self, tracer: FrameTracer, keep: np.ndarray, tlas: Tlas) -> Difference:
        """What all of its paths differ by in another scene, as of `Certificate.judge_exchanged`."""
        tracer.trace_without(self.witness.tlas, self.witness.first_sample, keep, tlas, self.only, self._buffer)
        full = PathLog(self._buffer.records, self.reference.color.reshape(self._buffer.color.shape))
        return self.reference.compare(self.only, self._buffer.color, full, self.reference.nothing)

    def _without(self, cull: np.ndarray, only: NDArray[np.uint8]) -> PathLog:
        self._staying.trace(self.witness, only, self._buffer)
        return self._buffer
