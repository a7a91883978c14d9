"""The steps of a command for each frame: Blender in, analysis, states, Blender out, render, report."""

from __future__ import annotations

import gc
import json
import time
import zipfile
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import bpy
import numpy as np

from ...core.arrays import F32, F64, I64, U8, Records
from ...core.culling.options import CullOptions, State
from ...core.culling.policies import LIGHT_PATHS, NOTHING
from ...core.error_budget.budget import Budget
from ...core.errors import Cancelled, NothingToAnalyse
from ...core.files.atomic import alone, is_whole, sweep
from ...core.files.report import Report, States, load_states, save_states
from ...core.progress import Progress, part, silent
from ...core.scene.bounds import existing
from ...core.scene.model import RAY_TYPES, Scene
from .. import writeback
from ..console import muted
from ..depsgraph import rendered_layers, show_frame
from ..extract import Extraction, Extractor
from ..keys import KEY, Keys, any_of
from .baked import save_baked
from .choices import BLENDER_ENGINES
from .counting import counting
from .engines import left_out, render_blender, render_path, samples_of
from .hybrid_frame import HybridOptions, render_hybrid
from .shot_set import ShotSet

if TYPE_CHECKING:
    from ...core.culling.result import CullingResult
    from ...core.culling.shot import Shot
    from .verify import Verified

ENFORCED = 4  # times that a frame is analysed again where a verification finds the budget broken, the last time with everything kept
ANALYSIS_SHARE = 0.2  # of a frame's progress, where it is rendered too
FRAME, SHOT = "frame", "shot"
SUMS = ("hitboxes", "tlas_bytes", "blas_built", "blas_refitted", "paths", "rays", "iterations", "calibration_paths")  # over view layers, and what ends in _s
TRIES = 3
UNREADABLE = (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile)
Cancel = Callable[[], bool]


def never() -> bool:
    """The `cancelled` of work that goes on to its end."""
    return False


def check(cancelled: Cancel) -> None:
    """Raise Cancelled where it says so."""
    if cancelled():
        raise Cancelled


@dataclass(frozen=True)
class Job:
    """What to do with the open file. engine: one of `engines.ENGINES`, or "" to analyse only; samples: None as in the scene; threads: 0 for all.

    hybrid: for the engine of that name. bake: FRAME, each frame by itself, or SHOT, in all frames what any of them needs. save: where to save the .blend with
    the set of the shot baked in. resume: leave frames alone that the folder has already. warm: a frame begins with what the one before it needed, and keeps
    what that kept as long as it is worth something (hysteresis); else frames decide by themselves, and ranges can be split. shot: the frames that a set is for,
    where `frames` are a part of them; other processes may do other parts into the same folder. verify: how many crops to render full as well, to state
    the error that was measured (`verify`). enforce: where that breaks the budget, analyse again with a tighter one, and in the end keep everything.
    """

    folder: Path
    frames: tuple[int, ...]
    options: CullOptions
    engine: str = ""
    samples: int | None = None
    seed: int = 0
    threads: int = 0
    hybrid: HybridOptions = field(default_factory=HybridOptions)
    bake: str = FRAME
    save: Path | None = None
    resume: bool = False
    warm: bool = False
    shot: tuple[int, ...] = ()
    verify: int = 0
    enforce: bool = False

    def stem(self, frame: int) -> Path:
        """A frame's pictures, without their endings."""
        return self.folder / f"frame_{frame:04}"

    def states(self, frame: int) -> Path:
        """A frame's states."""
        return self.folder / "states" / f"frame_{frame:04}.npz"

    def analysis(self, frame: int) -> Path:
        """What a frame of a shot needs by itself."""
        return self.folder / "analysis" / f"frame_{frame:04}.npz"

    def pictures(self, frame: int) -> list[Path]:
        """All pictures of a frame."""
        stem = self.stem(frame)
        endings = [] if not self.engine else [".exr", ".png"]
        return [stem.with_name(stem.name + end) for end in [*endings, *(["_layers.exr"] if self.engine == "hybrid" else [])]]

    def is_finished(self, frame: int) -> bool:
        """Whether the folder has all files of a frame, each of them whole."""
        return all(is_whole(path) for path in (self.states(frame), *self.pictures(frame)))

    @property
    def whole(self) -> bool:
        """Whether Blender renders its scene as it is, so that there is nothing to analyse."""
        return self.options.policy == NOTHING and self.engine in BLENDER_ENGINES


def run(job: Job, report: Report, progress: Progress = silent, cancelled: Cancel = never) -> None:
    """Work through the frames of a job; the report on disk is valid after each. Visibility in the open file is put back at the end, whatever happens.

    Raises Cancelled soon after cancelled() says so.
    """
    (job.folder / "states").mkdir(parents=True, exist_ok=True)
    reported = report.finished(job.folder)
    finished = {frame for frame in reported or () if job.resume and job.is_finished(frame)}
    _sweep(job, keep_analyses=reported is not None and (job.resume or bool(job.shot)))
    report.note(report.approximated, left_out(bpy.context.scene, job.engine))
    if reported is not None or not (job.folder / "report.json").exists():  # else what is there stays until there is something to say
        report.write(job.folder)
    with muted():
        writeback.restore()
    try:
        if job.bake == SHOT and not job.whole:
            _run_shot(job, finished, report, progress, cancelled)
        else:
            _run_frames(job, finished, report, progress, cancelled)
    finally:
        with muted():
            writeback.restore()


def _sweep(job: Job, keep_analyses: bool) -> None:
    """Remove what a command that was killed left of files of these frames that it had begun to write; analyses for shots too, where they are not to be kept."""
    stems = {f"frame_{frame:04}" for frame in job.frames}
    sweep(job.folder, stems | {f"{stem}_layers" for stem in stems})
    for folder in (job.folder / "states", job.folder / "analysis"):
        sweep(folder, stems)
    unwanted = set() if keep_analyses else {job.analysis(frame).name for frame in job.shot or job.frames}
    with alone(job.folder):
        for path in (job.folder / "analysis").glob("frame_*.npz"):
            if path.name in unwanted:
                path.unlink(missing_ok=True)


class Session:
    """What goes from frame to frame of a job, for one view layer: the extractor, and the loop."""

    def __init__(self, job: Job, layer: str | None = None, keep: bool = True) -> None:
        """layer: name, None takes the first that renders. keep: hold Blender's graph from frame to frame, where that pays: one at a time can."""
        self.job, self.layer = job, layer
        self.keep = keep and job.engine in ("", "path") and len(job.frames) > 1  # other engines make Blender free the graph
        self._extractor: Extractor | None = None
        self._shot: Shot | None = None
        self._pinned: np.ndarray | None = None  # what the frame needs at other moments of its exposure

    def __enter__(self) -> Session:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def forget(self) -> None:
        """Let go of the loop, and what it has built."""
        self._shot = None

    def close(self) -> None:
        """Let go of everything, in Blender too."""
        self.forget()
        if self._extractor is not None:
            with muted():
                self._extractor.release()
            self._extractor = None
        gc.collect()

    def sync(self, frame: int) -> tuple[Extraction, dict[str, Any]]:
        """Extract a frame of the open file with nothing culled; the second value is the frame's entry for the report so far."""
        start = time.perf_counter()
        with muted():
            writeback.restore()
            whole = self.job.engine in ("", *BLENDER_ENGINES)
            self._extractor = self._extractor or Extractor(bpy.context.scene, self.layer, whole=whole)
            extraction = replace(self._extractor.frame(frame, self.keep), scatters={})
        self._pinned = None
        return extraction, {"frame": frame, "sync_s": time.perf_counter() - start}

    def expose(self, extraction: Extraction, frame: int, progress: Progress = silent, cancelled: Cancel = never) -> Extraction:
        """Find out what a frame needs while its shutter is open and things are elsewhere: it stays, whatever the frame's own moment needs. Returns the frame as
        it is, extracted anew where there was anything to find out."""
        if not extraction.moments or self._extractor is None:
            return extraction
        needed = []
        for k, moment in enumerate(extraction.moments):
            with muted():
                other = self._extractor.frame(frame, True, moment)
            within = part(progress, k / len(extraction.moments), (k + 1) / len(extraction.moments), f"{moment:+.2g} frames: ")
            needed.append(other.keys.records[self.decide(other, None, within, cancelled).active])
        with muted():
            extraction = replace(self._extractor.frame(frame, self.keep), scatters={})
        self._pinned = any_of(extraction.keys.records, needed)
        return extraction

    def end_reading(self) -> None:
        """No frame follows: let go of what would tell it from the last one. Meshes of that can still be read."""
        if not self.keep:
            self._extractor = None

    def decide(self, extraction: Extraction, scene: Scene | None = None, progress: Progress = silent, cancelled: Cancel = never) -> CullingResult:
        """Which instances of the frame that was extracted last stay. scene: what to look at in its place, with the same instances and meshes."""
        from ...core.culling.shot import Shot

        if self.job.options.policy != LIGHT_PATHS and self.job.engine in BLENDER_ENGINES:
            return _by_rule(extraction.scene, self.job.options, self._pinned)
        if self._shot is None:
            self._shot = Shot(self.job.options, independent=not self.job.warm)
        return self._shot.advance(scene or extraction.scene, extraction.change, progress, cancelled, self._pinned)


def _by_rule(scene: Scene, options: CullOptions, pinned: np.ndarray | None) -> CullingResult:
    """What a policy without light paths keeps, and pinned, (N,) bool. No mesh need be read for it: the engine builds its own structures."""
    from ...core.culling.result import CullingResult

    start = time.perf_counter()
    keep = options.rule(scene) & existing(scene.instances.bounds)
    keep |= False if pinned is None else pinned
    n, active = len(keep), int(np.count_nonzero(keep))
    meshes = len(np.unique(scene.instances.mesh[keep]))
    stats = {"instances": n, "active": active, "pending": 0, "culled": n - active, "meshes": meshes, "feedback_s": time.perf_counter() - start}
    nothing = np.zeros(n, np.float32), np.zeros((n, RAY_TYPES), np.int64), np.zeros((0, 2, 3), np.float32)
    return CullingResult(np.where(keep, np.uint8(State.ACTIVE), np.uint8(State.CULLED)), *nothing, stats)


def sessions_of(job: Job) -> list[Session]:
    """One for each view layer that the job's engine renders."""
    layers = rendered_layers(bpy.context.scene) if job.engine in ("", *BLENDER_ENGINES) else ()
    return [Session(job, layer, keep=len(layers) == 1) for layer in layers] or [Session(job)]


@dataclass(frozen=True)
class Decided:
    """What was decided on a frame, for all its view layers. state (N,), score (N,), hits (N, RAY_TYPES), boxes (H, 2, 3): as of `CullingResult`, boxes in the
    world; records, names: its keys; entry: for the report."""

    state: U8
    score: F32
    hits: I64
    boxes: F64
    records: Records
    names: tuple[str, ...]
    entry: dict[str, Any]
    approximated: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()

    @property
    def keys(self) -> Keys:
        """Of the N instances."""
        return Keys(self.records, self.names)

    def save(self, path: Path, note: str = "") -> None:
        """As a file of states."""
        save_states(path, self.state, self.score, self.hits, self.records, self.names, note, self.boxes)

    @property
    def states(self) -> States:
        """As they would be read again."""
        return States(self.state, self.score, self.hits, {name: self.records[name] for name in ("kind", "host", "object", "path")}, self.names)


def _decided(extraction: Extraction, result: CullingResult, entry: dict[str, Any]) -> Decided:
    scene, keys = extraction.scene, extraction.keys
    boxes = result.boxes + scene.origin
    lines = scene.approximated, (*extraction.warnings, *result.warnings)
    return Decided(result.state, result.score, result.hits, boxes, keys.records, keys.names, entry | result.stats, *lines)


def decide_layers(sessions: Sequence[Session], frame: int, last: bool, progress: Progress = silent, cancelled: Cancel = never) -> Decided:
    """Decide a frame by what each view layer needs: an instance that one of them needs stays. last: as in `run_frame`.

    Where no layer shows anything that light paths can be traced in, but something all the same, nothing is culled. Raises NothingToAnalyse, Cancelled.
    """
    parts, shown = [], dict[str, None]()
    for k, session in enumerate(sessions):
        within = part(progress, k / len(sessions), (k + 1) / len(sessions), f"view layer {session.layer}: " if len(sessions) > 1 else "")
        try:
            extraction, entry = session.sync(frame)
        except NothingToAnalyse as error:
            shown |= dict.fromkeys(error.shown)
            continue
        check(cancelled)
        extraction = session.expose(extraction, frame, within, cancelled)
        if last:
            session.end_reading()
        check(cancelled)
        result = session.decide(extraction, None, within, cancelled)
        check(cancelled)
        if not session.job.engine:
            entry |= _verified(session.job, extraction.scene, result.active, silent, cancelled)
        parts.append(_decided(extraction, result, entry))
        del result  # and what it has built
        if last:
            session.forget()
    if not parts and not shown:
        raise NothingToAnalyse
    if not parts:
        nothing = np.zeros(0, np.uint8), np.zeros(0, np.float32), np.zeros((0, RAY_TYPES), np.int64), np.zeros((0, 2, 3))
        return Decided(*nothing, np.zeros(0, KEY), (), {"frame": frame}, tuple(shown), (str(NothingToAnalyse([*shown])) + "; all is rendered",))
    return parts[0] if len(parts) == 1 else _united(parts)


def _united(parts: Sequence[Decided]) -> Decided:
    """What several view layers need of a frame together; what each needs is decided by its own picture."""
    together = ShotSet()
    for one in parts:
        together.add(one.states)
    n = len(together.active)
    state, score, hits = np.zeros(n, np.uint8), np.zeros(n, np.float32), np.zeros((n, RAY_TYPES), np.int64)
    for one in parts:
        rows = together.rows(one.states)
        state[rows], score[rows] = np.maximum(state[rows], one.state), np.maximum(score[rows], one.score)
        hits[rows] += one.hits
    entry: dict[str, Any] = {}
    for name in dict.fromkeys(name for one in parts for name in one.entry):
        values = [one.entry[name] for one in parts if name in one.entry]
        entry[name] = sum(values) if name in SUMS or name.endswith("_s") else max(values) if isinstance(values[0], int | float) else values[0]
    counts = np.bincount(state, minlength=len(State)).tolist()
    entry |= {"instances": n, "active": counts[State.ACTIVE], "pending": counts[State.PENDING], "culled": counts[State.CULLED], "view_layers": len(parts)}
    lines = [tuple(dict.fromkeys(line for one in parts for line in getattr(one, name))) for name in ("approximated", "warnings")]
    return Decided(state, score, hits, np.concatenate([one.boxes for one in parts]), together.keys.records, together.keys.names, entry, *lines)


# Each frame by itself


def _run_frames(job: Job, finished: set[int], report: Report, progress: Progress, cancelled: Cancel) -> None:
    todo = [frame for frame in job.frames if job.warm or frame not in finished]
    with ExitStack() as stack:
        sessions = [stack.enter_context(session) for session in sessions_of(job)]
        for k, frame in enumerate(todo):
            check(cancelled)
            name = f"frame {frame}: " if len(job.frames) > 1 else ""
            within = part(progress, k / len(todo), (k + 1) / len(todo), name)
            if frame in finished:  # only to know what the next one begins with
                decide_layers(sessions, frame, False, within, cancelled)
                continue
            run_frame(sessions, frame, report, within, cancelled, last=frame == todo[-1])
            report.write(job.folder)


def run_frame(
    sessions: Sequence[Session], frame: int, report: Report, progress: Progress = silent, cancelled: Cancel = never, last: bool = True
) -> None:
    """One frame of a job, added to the report. last: nothing follows, so nothing need be kept for it. Raises InputError, Cancelled."""
    job = sessions[0].job
    budget = job.options.max_error if job.verify and not job.options.by_counts else None
    outcome = _done(sessions, frame, progress, cancelled, last)
    for attempt in range(ENFORCED if job.enforce else 0):
        if budget is None or not _broken(outcome.entry, budget):
            break
        tighter = _tightened(job, outcome.entry, attempt)
        with ExitStack() as stack:
            outcome = _done([stack.enter_context(session) for session in sessions_of(tighter)], frame, progress, cancelled, True)
        outcome.entry["enforced"] = attempt + 1
    if budget is not None and _broken(outcome.entry, budget):
        report.broken = True
        outcome = outcome.warned(_found(outcome.entry).warning(budget))
    report.add_frame(outcome.entry, outcome.approximated, outcome.warnings)


@dataclass(frozen=True)
class Outcome:
    """What a frame's work came to: its entry for the report, and lines for the user."""

    entry: dict[str, Any]
    approximated: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()

    def warned(self, line: str) -> Outcome:
        """With one line more."""
        return replace(self, warnings=(*self.warnings, line))


def _found(entry: dict[str, Any]) -> Verified:
    from .verify import Verified

    mean, worst, least_mean, least_worst = (float(entry.get(f"verified_{name}", 0.0)) for name in ("mean", "worst", "least_mean", "least_worst"))
    return Verified(mean, worst, least_mean, least_worst, ())


def _broken(entry: dict[str, Any], budget: Budget) -> bool:
    """Whether a verification found that a frame's change is surely above a bound."""
    return _found(entry).breaks(budget)


def _tightened(job: Job, entry: dict[str, Any], attempt: int) -> Job:
    """The job with a budget that is as much smaller as the engine's picture is above it, and by half more; at the last attempt without culling."""
    if attempt == ENFORCED - 1:
        return replace(job, options=replace(job.options, policy=NOTHING))
    found, budget = _found(entry), job.options.max_error
    share = min(budget.mean / max(found.mean, 1e-9), budget.worst / max(found.worst, 1e-9), 1.0) / 2 ** (attempt + 1)
    return replace(job, options=replace(job.options, max_error=Budget(share * budget.mean, share * budget.worst)))


def _done(sessions: Sequence[Session], frame: int, progress: Progress, cancelled: Cancel, last: bool) -> Outcome:
    """Decide, render and verify a frame."""
    job = sessions[0].job
    if job.whole:
        return Outcome(_render_whole(job, frame, progress))
    if job.engine in ("", *BLENDER_ENGINES):
        within = part(progress, 0.0, ANALYSIS_SHARE if job.engine else 1.0)
        decided = decide_layers(sessions, frame, last, within, cancelled)
        decided.save(job.states(frame))
        entry, warnings = decided.entry, decided.warnings
        if job.engine:
            warnings = (*warnings, *write_back(np.asarray(decided.state == State.CULLED), decided.keys, entry))
            approximated = decided.approximated
            del decided
            for session in sessions if last else ():
                session.close()  # the render needs the memory
            gc.collect()
            rest = part(progress, ANALYSIS_SHARE, 1.0, "rendering, ")
            entry["render_s"] = render_blender(job.engine, job.stem(frame), job.samples, job.seed, job.threads, rest)
            entry |= _verified(job, None, None, rest, cancelled)
            return Outcome(entry, approximated, warnings)
        return Outcome(entry, decided.approximated, warnings)
    decided = _by_ours(sessions[0], frame, progress, cancelled, last)
    return Outcome(decided.entry, decided.approximated, decided.warnings)


def _by_ours(session: Session, frame: int, progress: Progress, cancelled: Cancel, last: bool) -> Decided:
    """Decide and render a frame by one of our engines."""
    job = session.job
    extraction, entry = session.sync(frame)
    if last:
        session.end_reading()
    check(cancelled)
    if job.engine == "hybrid":

        def choose(scene: Scene) -> CullingResult:
            return session.decide(extraction, scene, part(progress, 0.0, 0.3), cancelled)

        result = _hybrid(job, extraction, entry, progress, cancelled, choose)
    else:
        result = session.decide(extraction, None, part(progress, 0.0, ANALYSIS_SHARE), cancelled)
        check(cancelled)
    if last:
        session.forget()
    decided = _decided(extraction, result, entry)
    decided.save(job.states(frame))
    if job.engine == "path":
        entry, scene, rest = decided.entry, extraction.scene, part(progress, ANALYSIS_SHARE, 1.0, "rendering, ")
        entry["render_s"] = render_path(scene, result.active, job.stem(frame), job.samples, job.seed, job.threads, rest, cancelled, result.built)
        entry |= _verified(job, scene, result.active, rest, cancelled)
    return decided


def _verified(job: Job, scene: Scene | None, active: np.ndarray | None, progress: Progress, cancelled: Cancel) -> dict[str, object]:
    """What the frame's entry says of the error that was measured, where the job asks for that. scene, active: for an engine of ours."""
    if not job.verify:
        return {}
    from .verify import verified_blender, verified_path

    start = time.perf_counter()
    if scene is None or active is None:
        found = verified_blender(job.engine, job.samples, job.seed, job.threads, job.verify, progress)
    else:
        samples = job.samples or samples_of(bpy.context.scene, "path")
        found = verified_path(scene, active, samples, job.seed, job.threads, job.verify, cancelled)
    return {**found.entry(), "verify_s": time.perf_counter() - start}


def _hybrid(
    job: Job,
    extraction: Extraction,
    entry: dict[str, Any],
    progress: Progress,
    cancelled: Cancel,
    decide: Callable[[Scene], CullingResult],
) -> CullingResult:
    """Render a frame by the hybrid renderer; its figures go into the entry. decide: as of `render_hybrid`."""
    samples = job.samples or samples_of(bpy.context.scene, job.engine)
    stem = job.stem(entry["frame"])
    result, figures = render_hybrid(extraction.scene, job.hybrid, job.options, stem, samples, job.seed, job.threads, progress, cancelled, decide)
    entry |= result.stats | figures
    return result


def _render_whole(job: Job, frame: int, progress: Progress) -> dict[str, Any]:
    """Render a frame as Blender does, and count in passing: nothing is culled, so nothing is analysed. Returns the entry for the report."""
    show_frame(bpy.context.scene, frame)
    with counting() as counted:
        seconds = render_blender(job.engine, job.stem(frame), job.samples, job.seed, job.threads, part(progress, 0.0, 1.0, "rendering, "))
    n = len(counted.keys.records)
    nothing = np.zeros((n, RAY_TYPES), np.int64)
    save_states(job.states(frame), np.full(n, State.ACTIVE, np.uint8), np.zeros(n, np.float32), nothing, counted.keys.records, counted.keys.names)
    counts = {"instances": n, "active": n, "meshes": counted.meshes}
    return {"frame": frame, "sync_s": counted.seconds, "render_s": seconds - counted.seconds, **counts}


def write_back(culled: np.ndarray, keys: Keys, entry: dict[str, Any], lasting: bool = False) -> list[str]:
    """Take culled (N,) bool out of renders of the open file; what that came to goes into the frame's entry, what could not be is said in the lines returned.

    lasting: the file is to be saved so.
    """
    start = time.perf_counter()
    with muted():
        applied = writeback.apply(culled, keys, lasting=lasting)
    entry["writeback_s"] = time.perf_counter() - start
    entry["writeback"] = applied.summary()
    return [f"{count:,} culled instances stay in the render: {why}" for why, count in applied.kept.items()]


# One set for all frames


def _run_shot(job: Job, finished: set[int], report: Report, progress: Progress, cancelled: Cancel) -> None:
    """Find out what each frame of the shot needs; then do the job's with what any of them does."""
    share = ANALYSIS_SHARE if job.engine else 0.9
    _analyse(job, report, part(progress, 0.0, share), cancelled)

    def needed(frame: int) -> States:
        """What a frame needs by itself. Another process that begins anew in the same folder may have removed it, or a fault have damaged it."""
        for _ in range(TRIES):
            try:
                return load_states(job.analysis(frame))
            except UNREADABLE:
                _analyse(job, report, silent, cancelled)
        return load_states(job.analysis(frame))

    shot = ShotSet()
    for frame in job.shot or job.frames:
        shot.add(needed(frame))
    if job.save is not None or job.engine in BLENDER_ENGINES:
        written: dict[str, Any] = {}
        report.note(report.warnings, write_back(~shot.active, shot.keys, written, lasting=job.save is not None))
    if job.save is not None:
        save_baked(job.save)
    with Session(job) as session:
        for k, frame in enumerate(job.frames):
            check(cancelled)
            if frame in finished:
                continue
            within = part(progress, share + (1 - share) * k / len(job.frames), share + (1 - share) * (k + 1) / len(job.frames), f"frame {frame}: ")
            states = needed(frame)
            active = shot.of(states)
            entry: dict[str, Any] = json.loads(states.note)
            entry |= {"needed": entry["active"], "active": int(active.sum()), "culled": int((~active).sum()), "pending": 0}
            if job.engine in BLENDER_ENGINES:
                show_frame(bpy.context.scene, frame)
                entry |= {**written, "writeback_s": written["writeback_s"] / len(job.frames)}
                entry["render_s"] = render_blender(job.engine, job.stem(frame), job.samples, job.seed, job.threads, within)
            elif job.engine:
                _render_kept(session, frame, active, entry, within, cancelled)
            state = np.where(active, State.ACTIVE, State.CULLED).astype(np.uint8)
            save_states(job.states(frame), state, states.score, states.hits, shot.records_of(states), shot.keys.names)
            report.add_frame(entry)
            report.write(job.folder)


def _render_kept(session: Session, frame: int, active: np.ndarray, entry: dict[str, Any], progress: Progress, cancelled: Cancel) -> None:
    """Render a frame by one of our engines with the instances that are active, (N,) bool."""
    job = session.job
    extraction, synced = session.sync(frame)
    check(cancelled)
    entry["sync_s"] += synced["sync_s"]
    if job.engine == "path":
        entry["render_s"] = render_path(extraction.scene, active, job.stem(frame), job.samples, job.seed, job.threads, progress, cancelled)
        return
    from ...core.culling.loop import Loop

    n, before = len(active), dict(entry)
    nothing = np.zeros(n, np.float32), np.zeros((n, RAY_TYPES), np.int64)
    changes = {name: before[name] for name in ("certified_mean",) if name in before}  # more is kept than what that was measured without
    _hybrid(job, extraction, entry, progress, cancelled, lambda scene: Loop(scene, job.options, cancelled).result(active, *nothing, **changes))
    entry |= {name: before[name] for name in ("paths", "rays", "iterations", "trace_s", "feedback_s")}


def _analyse(job: Job, report: Report, progress: Progress, cancelled: Cancel) -> None:
    """Save what each frame of the shot needs by itself, for those that have not been looked at yet.

    The job's own come first, then, from the last one on, those that no other process has done by then: so two that share a shot meet in the middle.
    """
    (job.folder / "analysis").mkdir(exist_ok=True)
    others = [frame for frame in reversed(job.shot) if frame not in job.frames]
    todo = [frame for frame in (*job.frames, *others) if job.warm or not is_whole(job.analysis(frame))]
    with ExitStack() as stack:
        sessions = [stack.enter_context(session) for session in sessions_of(job)]
        for k, frame in enumerate(todo):
            if not job.warm and is_whole(job.analysis(frame)):
                continue
            check(cancelled)
            within = part(progress, k / len(todo), (k + 1) / len(todo), f"frame {frame}: ")
            decided = decide_layers(sessions, frame, False, within, cancelled)
            with alone(job.folder):
                if not is_whole(job.analysis(frame)):
                    decided.save(job.analysis(frame), json.dumps(decided.entry, default=float))
            report.note(report.approximated, decided.approximated)
            report.note(report.warnings, decided.warnings)
            report.write(job.folder)
