"""Which instances of a frame stay: by heuristics, by how many paths meet them, or by what the picture would lose."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ..accel.region_tree import FANOUT
from ..accel.tlas import Tlas
from ..arrays import F64, I32
from ..error_budget.budget import Budget, Savings, Shared
from ..error_budget.error_estimate import CONFIDENCE, Light, Reference
from ..error_budget.fitting import least_that_fits
from ..error_budget.search import DENSER, TRIALS, WORTH_WHILE, Choice, Search, gain, gain_of_all
from ..error_budget.trial import Trial
from ..error_budget.units import Seen, Units, units_of
from ..feedback.path_log import PathLog
from ..feedback.tiles import DARK, marks
from ..files.figures import percent
from ..progress import Progress, part, silent
from ..scene.model import RAY_TYPES, Scene
from .certificate import LEVELS, MORE, NOTHING_SURE, STEEPEST, Certificate, Verdict, pays
from .frame_tracer import as_rendered, twins_met, with_twins, without_bound
from .levels.levelled import CULLING, PROPOSALS, Levelled, has_levels, levelled
from .loop import ENTRIES_PER_PATH, Loop, all_stay, trace_witness
from .measurement import DARKNESS, Measurement, Traced, evidence
from .options import CullOptions
from .policies import LIGHT_PATHS
from .result import CullingResult

# times a tile's light: what stands behind a surface of which nobody knows how much it lets through is credited with
# more than that
PRICELESS = 50.0
DENSER_TIMES = 2  # how often at most a measurement gets more paths in some tiles
DOUBTS = 2  # sets that a search gives up for noise before that
# of the doubt, what a first certificate has, nearly always the only one, and another after a measurement of twice the
# paths
ATTEMPTS = (0.8, 0.2)
# paths per TLAS entry below which a second attempt has to pay: of what so few meet, twice as many tell little more
CROWDED = 8
# Where memory is limited: by how much the budget is widened at a time, from a least one on, up to which mean
WIDER, LEAST_BOUND, WIDEST = 4.0, 0.002, 2.0


def analyze(
    scene: Scene,
    options: CullOptions,
    progress: Progress = silent,
    cancelled: Callable[[], bool] | None = None,
    pinned: np.ndarray | None = None,
) -> CullingResult:
    """Decide which instances of a frame stay; those of pinned, (N,) bool, always do.

    Raises Cancelled where cancelled() says so, MemoryError where Embree runs out.
    """
    return decide(Loop(scene, options, cancelled, pinned=pinned), progress)


def decide(loop: Loop, progress: Progress = silent) -> CullingResult:
    """Decide the frame that a loop stands at, cold or advanced to."""
    scene, options = loop.scene, loop.options
    if options.policy != LIGHT_PATHS:
        n = len(scene.instances)
        keep = options.rule(scene) & loop.activation.exists
        loop.activation.activate_alone(keep)
        return loop.result(keep, np.zeros(n, np.float32), np.zeros((n, RAY_TYPES), np.int64))
    if scene.whole:
        return all_stay(loop, scene.whole)
    measured = loop.run(part(progress, 0.0, 0.7, "light paths ask for geometry, "))
    if options.min_share is not None:
        return by_counts(loop, measured, options.min_share)
    if measured.is_dark and not (options.memory or scene.first_hits):
        return all_stay(loop, DARKNESS)
    within = part(progress, 0.7, 1.0, "calibrating, ")
    if options.memory and scene.render_costs is not None:
        return by_memory(loop, measured, options.max_error, options.memory, within)
    return by_budget(loop, measured, options.max_error, within)


def reaches(met: np.ndarray, paths: int, share: np.ndarray | float) -> np.ndarray:
    """Whether met of paths, (N,) int64, is at least a share.

    As quotients: k / n rounds to the number that its decimals are read as, share x n need not be k.
    """
    return np.asarray((met > 0) & (met / max(paths, 1) >= share))


def by_counts(loop: Loop, measured: Measurement, min_share: float) -> CullingResult:
    """Keep what at least min_share of the paths meet; the score is that share.

    Which share of the light is not known, for it passes boxes that too few paths asked for, is reported
    (`unknown_mean`, `unknown_worst`).

    Hysteresis over frames: what the last frame kept stays while it is met by min_share / options.hysteresis of them.
    """
    feedback, met = measured.feedback, measured.met
    share = np.where(loop.activation.kept, min_share / loop.options.hysteresis, min_share)
    keep = loop.activation.pinned | (loop.activation.active & reaches(met, feedback.paths, share))
    figures: dict[str, float | int] = {}
    if loop.options.max_iterations > 1:  # else in real time, where each path counts
        unknown = _unknown(loop, measured.next_sample, 1)
        figures = {"unknown_mean": float(unknown.mean()), "unknown_worst": float(unknown.max())}
    return loop.result(keep, (met / max(feedback.paths, 1)).astype(np.float32), feedback.hits, (), **figures)


def _unknown(loop: Loop, first_sample: int, samples: int) -> F64:
    """(T,) share of each tile's light that fresh paths carry through unopened boxes. samples: of them per pixel."""
    only: NDArray[np.uint8] = np.ones((loop.size[1], loop.size[0], samples), np.uint8)
    witness = trace_witness(loop, first_sample, only, Budget(np.inf, np.inf))
    return np.asarray(witness.unknown / np.maximum(witness.light, max(DARK * float(witness.light.mean()), 1e-30)))


def by_budget(loop: Loop, measured: Measurement, budget: Budget, progress: Progress = silent) -> CullingResult:
    """Cull what saves most while the picture surely changes by no more than the budget; the score is the share of the
    picture that an instance is worth.

    What each instance is worth alone does not say what many are worth together, nor what lies behind them: `Search`
    traces without them and finds out. The sets that it finds are then judged by paths that chose none of them. Where
    even the smallest of them may break the budget, these paths have met what the others did not: all is measured again,
    by twice as many. In the end what is not certified stays.

    Hysteresis over frames: what the last frame culled is culled again, and nothing else that paths meet, while that
    uses at least 1 / options.hysteresis of the budget; else bytes that go with what it kept count for less by that
    factor.
    """
    judged, found = _within(loop, measured, budget, progress)
    return _decided(loop, *judged, found)


def _within(
    loop: Loop, measured: Measurement, budget: Budget, progress: Progress
) -> tuple[tuple[Measurement, Units, list[Choice], Verdict, int], Levelled | None]:
    """What surely keeps a budget, as of `_judged`, and what is exchanged, where anything is."""
    if not has_levels(loop):
        return _judged(loop, measured, budget, progress)[:-1], None
    tighter = Budget(CULLING * budget.mean, CULLING * budget.worst)
    judged = _judged(loop, measured, tighter, part(progress, 0.0, 0.4), PROPOSALS + LEVELS)
    measured, units, steps, verdict, searched, certificate = judged
    if verdict.cull is not None:
        keep = with_twins(loop.tracer, verdict.keep | loop.activation.pinned)
        estimate = certificate.judge(keep, doubts=False)
        found = levelled(loop, measured, certificate, keep, estimate, budget, part(progress, 0.4, 0.8))
        if found is not None:
            return (measured, units, steps, found.verdict(verdict, certificate), searched), found
    # all of the budget is culling's, but for the doubt that was spent on levels
    within = part(progress, 0.8, 1.0)
    measured, units, steps, verdict, more, _ = _judged(loop, measured, budget, within, PROPOSALS + LEVELS)
    return (measured, units, steps, verdict, searched + more), None


def by_memory(
    loop: Loop, measured: Measurement, budget: Budget, limit: int, progress: Progress = silent
) -> CullingResult:
    """Cull as `by_budget` does, and where the render would take more bytes than a limit, go on with what changes the
    picture least per byte, until it does not: the certified change is then larger than the budget.

    Raises InputError where that cannot be.
    """
    _check_memory(loop, loop.activation.pinned, limit)
    (measured, units, steps, verdict, searched), found = _within(loop, measured, budget, part(progress, 0.0, 0.5))
    bound, ids = budget, measured.tlas.ids
    if found is not None and (whole := loop.scene.render_costs) is not None:
        loop.scene = replace(loop.scene, render_costs=found.costs(whole))
        if not _fits(loop, verdict.keep, limit):
            found = found.of_whole_meshes()
            loop.scene = replace(loop.scene, render_costs=found.costs(whole))
    while not _fits(loop, verdict.keep, limit):
        if bound.mean > WIDEST:
            _check_memory(loop, kept_of(loop, units, np.isfinite(units.worth).all(axis=1), ids), limit)
        bound = Budget(*(WIDER * max(x, LEAST_BOUND) for x in (bound.mean, bound.worst)))
        measured, search, steps, traced = _searched(loop, measured, bound, silent)
        searched, ids, units = searched + traced, measured.tlas.ids, search.units
        sets = [step.cull for step in steps]
        if bound.mean > WIDEST:
            sets.append(np.isfinite(units.worth).all(axis=1))

        def fits(cull: np.ndarray, units: Units = units, ids: I32 = ids) -> bool:
            return _fits(loop, kept_of(loop, units, cull, ids), limit)

        cull = least_that_fits(sets, units, search.savings, fits)
        if cull is not None:
            keep, samples = kept_of(loop, units, cull, ids), measured.samples
            judge = Certificate(loop, measured.next_sample, samples, bound)
            verdict = judge.verdict(cull, keep, part(progress, 0.5, 1.0))
            if found is not None:
                found = found.again(judge, with_twins(loop.tracer, keep), bound)
                verdict = found.verdict(verdict, judge)
    result = _decided(loop, measured, units, steps, verdict, searched, found)
    return replace(result, stats=result.stats | {"memory_limit_bytes": limit})


def _fits(loop: Loop, keep: np.ndarray, limit: int) -> bool:
    """Whether a render with the instances of keep, (N,) bool, surely takes no more than a limit."""
    return _at_most(loop, keep) <= limit


def _at_most(loop: Loop, keep: np.ndarray) -> int:
    costs, instances = loop.scene.render_costs, loop.scene.instances
    assert costs is not None
    return costs.at_most(costs.total(instances.mesh, instances.slots, keep & loop.activation.exists))


def _check_memory(loop: Loop, least: np.ndarray, limit: int) -> None:
    """Raise InputError where not even the instances of least, (N,) bool, fit into a limit."""
    needed, costs = _at_most(loop, least), loop.scene.render_costs
    if costs is not None and needed > limit:
        raise costs.too_little(needed, limit)


def _judged(
    loop: Loop, measured: Measurement, budget: Budget, progress: Progress, more: int = 0
) -> tuple[Measurement, Units, list[Choice], Verdict, int, Certificate]:
    """What surely keeps a budget, with the measurement, the units and the sets that it is of, how many paths were
    traced for these, and the certificate. more: as of `Certificate`."""
    shares = (1.0,) if loop.limited else ATTEMPTS
    attempts = len(shares)
    for attempt, share in enumerate(shares):
        within = part(progress, attempt / attempts, (attempt + 1) / attempts)
        measured, search, steps, searched = _searched(loop, measured, budget, part(within, 0.0, 0.5))
        ids, units = measured.tlas.ids, search.units

        def keep_of(cull: np.ndarray, units: Units = units, ids: I32 = ids) -> np.ndarray:
            return kept_of(loop, units, cull, ids)

        sets = [step.cull for step in steps if loop.limited or step.cull.any()]
        fresh = measured.next_sample, measured.samples
        certificate = Certificate(loop, *fresh, budget, 1 - share * (1 - CONFIDENCE), more)
        gains = partial(gain, units, search.savings), partial(gain_of_all, units, search.savings)
        verdict = certificate.walk(sets, units, keep_of, gains, part(within, 0.5, 0.9))
        if attempt == attempts - 1 or not sets or verdict.cull is None or verdict.cull.any() or verdict.why:
            break
        # a measurement and a certificate of twice as many paths
        paths = measured.log.luminance.size
        if CROWDED * len(ids) > paths and not (more or pays(loop, keep_of(sets[-1]), 4 * ENTRIES_PER_PATH * paths)):
            break
        measured = loop.measure(None, 2 * measured.log.shape[2], part(within, 0.9, 1.0))
    return measured, units, steps, verdict, searched, certificate


def _decided(
    loop: Loop,
    measured: Measurement,
    units: Units,
    steps: list[Choice],
    verdict: Verdict,
    searched: int,
    found: Levelled | None = None,
) -> CullingResult:
    """States and figures by what is certified; where nothing is, all that can be built stays, and a warning says so.
    searched: paths of the search; found: what is exchanged."""
    warnings = []
    cull, keep, estimate, unknown = verdict.cull, verdict.keep, verdict.estimate, verdict.unknown
    if cull is None:
        cull = steps[0].cull
        warnings.append(
            "not within the error budget: what is left out for want of bytes or milliseconds, or was not looked at, "
            "may change the picture by "
            f"{percent(estimate.upper_mean(verdict.confidence))} in the mean, "
            f"{percent(estimate.upper_worst(verdict.confidence))} in the worst tile"
        )
    elif len(steps) > 1 and not cull.any():
        warnings.append(verdict.why or NOTHING_SURE)
    warnings += without_bound(loop.tracer, measured.tlas, measured.emissive, keep, loop.options.max_error.mean)
    ids, worth = measured.tlas.ids, measured.worth
    score = np.zeros(len(loop.activation), np.float32)
    score[ids] = worth.mean(axis=1)
    predicted = units.worth[cull].sum(axis=0)
    chosen = max(
        (step for step in steps if not (step.cull & ~cull).any()), key=lambda step: step.cull.sum(), default=steps[0]
    )
    error = {
        "predicted_mean": float(predicted.mean()),
        "predicted_worst": float(predicted.max(initial=0.0)),
        "calibrated_mean": chosen.estimate.mean,
        "calibrated_worst": chosen.estimate.worst,
        "calibration_paths": searched,
        "certified_mean": estimate.upper_mean(verdict.confidence),
        "certified_worst": estimate.upper_worst(verdict.confidence),
        "confidence": CONFIDENCE,
        "unknown_mean": float(unknown.mean()),
        "unknown_worst": float(unknown.max(initial=0.0)),
        "certificate_paths": verdict.paths,
    }
    tiles = estimate.upper_tiles(verdict.confidence).astype(np.float32)
    result = replace(loop.result(keep, score, measured.feedback.hits, tuple(warnings), **error), tiles=tiles)
    if found is None:
        return result
    return replace(result, stats=result.stats | found.figures, stand_ins=found.stand_ins)


def _searched(
    loop: Loop, measured: Measurement, budget: Budget, progress: Progress
) -> tuple[Measurement, Search, list[Choice], int]:
    """What was measured last; the search among its units, sets of them that keep to the budget by the paths of the
    measurement, and how many were traced.

    Where noise alone stands between the budget and a set that is worth while, all is measured by more paths in the
    tiles in question, and the search begins anew.
    """
    traced, first, times = 0, float(measured.samples.sum()), 0
    last = loop.limited  # no more paths are to be had: the search goes on in spite of doubts
    while True:
        search = _search(loop, measured, budget)
        steps = search.run(part(progress, 1 - 0.5**times, 1 - 0.5 ** (times + 1)), TRIALS if last else DOUBTS)
        traced += search.traced
        if last or search.promise < WORTH_WHILE:
            return measured, search, steps, traced
        samples = measured.samples
        more = np.where(search.doubted, np.minimum((DENSER - 1) * samples, STEEPEST * samples.min()), 0)
        more = (more * min(((1 + MORE) * first - samples.sum()) / more.sum(), 1.0)).astype(np.int64)
        times += 1
        last = times == DENSER_TIMES or not more.any()
        if more.any():
            measured = loop.measure_denser(measured, more)


def _search(loop: Loop, measured: Measurement, budget: Budget) -> Search:
    """A search among the units of a measurement."""
    ids = measured.tlas.ids
    built: list[tuple[np.ndarray, np.ndarray, Tlas]] = []  # the set that is tried: all trials share it

    def trial(traced: Traced, light: F64 | None) -> Trial:
        height, width, _ = traced.log.shape
        only, buffer = marks(traced.samples, height, width), PathLog.zeros(*traced.log.shape, backdrop=loop.backdrop)

        def without(cull: np.ndarray, paths: NDArray[np.uint8]) -> PathLog:
            if not built or (built[0][0] != cull).any():
                keep = np.zeros(len(loop.activation), bool)
                keep[ids[~cull]] = True
                built[:] = [(cull, keep, loop.tracer.build(keep))]
            _, keep, tlas = built[0]
            loop.tracer.trace_without(measured.tlas, traced.first_sample, keep, tlas, paths, buffer)
            return buffer

        return Trial(Reference(traced.log, only, light, loop.known), traced.log.copy(only), without, only)

    light = _light(loop, np.asarray(measured.weights.total * measured.weights.unit, np.float64))
    trials = [trial(traced, None if k else light) for k, traced in enumerate(measured.traced)]
    units, savings = units_measured(loop, measured, budget, Light.of(*(trial.reference for trial in trials)))
    return Search(trials, units, savings, budget, _culled_before(loop, units, ids), loop.options.hysteresis)


def units_measured(loop: Loop, measured: Measurement, budget: Budget, light: Light) -> tuple[Units, Savings]:
    """What is decided together, by a measurement, and what culling saves of its TLAS entries. light: of its paths."""
    ids = measured.tlas.ids
    with loop.timer.step("feedback_s"):
        worth = measured.worth
        savings = _savings(loop, ids)
        must = loop.activation.pinned.copy()
        must[ids[measured.weights.unbounded | (worth > PRICELESS).any(axis=1)]] = True
        must[twins_met(loop.tracer, measured.feedback.hits)] = True
        emitters = loop.seen
        share = light.share(emitters.tile, emitters.color)
        seen = Seen(measured.tlas.entry_of(len(loop.activation))[emitters.instance], emitters.tile, share)
        built_ones = seen.of >= 0
        place = seen.of[built_ones], seen.tile[built_ones]
        worth[place] = np.maximum(worth[place], share[built_ones])
        met, missed = evidence(measured, loop.scene, loop.size, budget)
        must[missed] = True
        return units_of(loop.activation.regions, ids, met, worth, must, seen), savings


def _savings(loop: Loop, ids: I32) -> Savings:
    """Of TLAS entries of instances ids: bytes of the analysis' own structures, or, where memory is limited, of the
    render's."""
    instances, costs = loop.scene.instances, loop.scene.render_costs
    reluctance = np.where(loop.activation.kept[ids], loop.options.hysteresis, 1.0)
    if not loop.options.memory or costs is None:
        return Savings.among(instances.mesh[ids], loop.blas.counted_bytes, reluctance)
    shared = Shared(instances.slots[ids], costs.uses, costs.image)
    return Savings.among(instances.mesh[ids], costs.mesh, reluctance, costs.instance[ids].astype(np.float64), shared)


def kept_of(loop: Loop, units: Units, cull: np.ndarray, ids: I32) -> np.ndarray:
    """(N,) bool, the instances that stay where the units of cull, (U,) bool, do not. ids: of the TLAS entries."""
    keep = np.zeros(len(loop.activation), bool)
    keep[units.unmet_kept(cull, loop.activation.regions)] = True
    keep[ids] = ~units.entries(cull)
    return as_rendered(loop.tracer, keep | loop.activation.pinned)


def _culled_before(loop: Loop, units: Units, ids: I32) -> np.ndarray | None:
    """(U,) bool, units of which the last frame kept nothing; None where it measured nothing."""
    if loop.activation.known is None:
        return None
    before = np.ones(len(units), bool)
    before[units.of_entry[~loop.activation.known[ids] | loop.activation.kept[ids]]] = False
    places = loop.activation.regions.place[np.setdiff1d(np.flatnonzero(loop.activation.kept), ids)]
    pools = units.pool_of[places[places >= 0] // FANOUT]
    before[units.with_entries + pools] = False
    return before


def _light(loop: Loop, total: F64) -> F64 | None:
    """Luminance of all paths of each tile, where logs leave some of it out."""
    return total if any(hits.lamps_known for hits in loop.scene.first_hits.values()) else None
