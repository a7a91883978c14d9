"""One frame of a job: decide, write back or render by an engine of ours, verify; once more with a tighter budget where
that is broken."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import bpy
import numpy as np

from ...core.culling.options import State
from ...core.error_budget.budget import Budget
from ...core.files.level import AnyLevel
from ...core.files.memory_table import MemoryRow
from ...core.files.report import Report, save_states
from ...core.files.usage import resident_memory
from ...core.progress import Progress, part, silent
from ...core.scene.model import RAY_TYPES, Scene
from ...core.warmup import waiting
from .. import writeback
from ..console import muted
from ..depsgraph import show_frame
from ..extract import Extraction
from ..keys import Keys
from ..memory.limit import PROCESS
from ..memory.stakes import NothingToWin
from ..writeback import WritebackResult
from ..writeback.plan import NO_LEVELS
from .ahead import Ahead
from .deciding import Decided, decide_layers, decided_of
from .enforcing import ENFORCED, broken, measured, tightened, verified
from .engines.as_scene import render_as_scene
from .engines.blender import Rendered, render_blender
from .engines.choices import BLENDER_ENGINES
from .engines.counting import counting
from .engines.hybrid_frame import render_hybrid
from .engines.path import render_path
from .engines.wishes import samples_of
from .job import Cancel, Job, check, never
from .session import Session, sessions_of
from .shots.shot_set import ShotSet

if TYPE_CHECKING:
    from ...core.culling.result import CullingResult

WAITING = "waiting for the analysis"
ANALYSIS_SHARE = 0.2  # of a frame's progress, where it is rendered too


def run_frame_ahead(
    job: Job, ahead: Ahead, frame: int, report: Report, progress: Progress = silent, cancelled: Cancel = never
) -> None:
    """One frame of a job for one of Blender's engines, whose analysis is another process's; added to the report. Raises
    InputError, Cancelled."""
    found = ahead.take(frame, job.states(frame), cancelled, waiting(progress, WAITING))
    if job.options.memory:
        ahead.wait(cancelled)
    with muted():
        writeback.restore()
    show_frame(bpy.context.scene, frame)
    kept = ShotSet()
    kept.add(found.states)
    lines, _ = write_back(~kept.active, kept.keys, found.entry, kept.faces, levels=kept.levels)
    said = found.said
    outcome = Outcome(found.entry, said.approximated, (*said.warnings, *lines), said.memory)
    rest = part(progress, ANALYSIS_SHARE, 1.0, "rendering, ")
    outcome.entry.update(render(job, frame, rest).entry())
    outcome.entry.update(verified(job, frame, None, None, rest, cancelled))
    _report(job, outcome, report)


def run_frame(
    sessions: Sequence[Session],
    frame: int,
    report: Report,
    progress: Progress = silent,
    cancelled: Cancel = never,
    last: bool = True,
) -> None:
    """One frame of a job, added to the report. last: nothing follows, so nothing need be kept for it. Raises
    InputError, Cancelled."""
    job = sessions[0].job
    budget = _verified_budget(job)
    outcome = _done(sessions, frame, progress, cancelled, last)
    for attempt in range(ENFORCED if job.enforce else 0):
        if budget is None or not broken(outcome.entry, budget):
            break
        tighter = tightened(job, outcome.entry, attempt)
        with ExitStack() as stack:
            outcome = _done(
                [stack.enter_context(session) for session in sessions_of(tighter)], frame, progress, cancelled, True
            )
        outcome.entry["enforced"] = attempt + 1
    _report(job, outcome, report)


def _verified_budget(job: Job) -> Budget | None:
    """What a verification of the job compares with."""
    return job.options.max_error if job.verify and not job.options.by_counts else None


def _report(job: Job, outcome: Outcome, report: Report) -> None:
    """Add a frame to the report, and say so where its budget was found broken."""
    budget = _verified_budget(job)
    if budget is not None and broken(outcome.entry, budget):
        report.broken = True
        outcome = outcome.warned(measured(outcome.entry).warning(budget))
    report.add_frame(outcome.entry, outcome.approximated, outcome.warnings, outcome.memory)


@dataclass(frozen=True)
class Outcome:
    """What a frame's work came to: its entry for the report, lines for the user, and rows of memory.csv."""

    entry: dict[str, Any]
    approximated: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    memory: Sequence[MemoryRow] = ()

    def warned(self, line: str) -> Outcome:
        """With one line more."""
        return replace(self, warnings=(*self.warnings, line))


def _done(sessions: Sequence[Session], frame: int, progress: Progress, cancelled: Cancel, last: bool) -> Outcome:
    """Decide, render and verify a frame."""
    job = sessions[0].job
    if job.whole:
        return _render_whole(job, frame, progress)
    if job.engine in ("", *BLENDER_ENGINES):
        within = part(progress, 0.0, ANALYSIS_SHARE if job.engine else 1.0)
        try:
            decided = decide_layers(sessions, frame, last, within, cancelled)
        except NothingToWin as found:
            sessions[0].close()
            return _render_whole(job, frame, progress, found)
        decided.save(job.states(frame))
        entry, warnings = decided.entry, decided.warnings
        if job.engine:
            culled = np.asarray(decided.state == State.CULLED)
            lines, applied = write_back(culled, decided.keys, entry, decided.faces, levels=decided.levels)
            warnings, approximated = (*warnings, *lines), decided.approximated
            memory = decided.memory(applied.removed, applied.reasons)
            figures = decided.figures(0, applied.removed)
            del decided, applied
            for session in sessions if last else ():
                session.close()  # the render needs the memory
            gc.collect()
            rest = part(progress, ANALYSIS_SHARE, 1.0, "rendering, ")
            entry |= _beside(figures)
            entry |= render(job, frame, rest).entry()
            entry |= verified(job, frame, None, None, rest, cancelled)
            return Outcome(entry, approximated, warnings, memory)
        entry |= decided.figures(job.process or PROCESS)
        return Outcome(entry, decided.approximated, warnings, decided.memory())
    decided = _by_ours(sessions[0], frame, progress, cancelled, last)
    return Outcome(decided.entry, decided.approximated, decided.warnings, decided.memory())


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

        result = hybrid(job, extraction, entry, progress, cancelled, choose)
    else:
        result = session.decide(extraction, None, part(progress, 0.0, ANALYSIS_SHARE), cancelled)
        check(cancelled)
    if last:
        session.forget()
    decided = decided_of(extraction, result, entry)
    decided.save(job.states(frame))
    if job.engine == "path":
        entry, scene, rest = decided.entry, extraction.scene, part(progress, ANALYSIS_SHARE, 1.0, "rendering, ")
        entry["render_s"] = render_path(
            scene, result.active, job.stem(frame), job.samples, job.seed, job.threads, rest, cancelled, result.built
        )
        entry |= verified(job, frame, scene, result.active, rest, cancelled)
    return decided


def hybrid(
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
    result, figures = render_hybrid(
        extraction.scene, job.hybrid, job.options, stem, samples, job.seed, job.threads, progress, cancelled, decide
    )
    entry |= result.stats | figures
    return result


def render(job: Job, frame: int, progress: Progress) -> Rendered:
    """Have Blender render the open file's current frame, as it is now."""
    if job.as_scene:
        return render_as_scene(job.engine, frame, job.samples, job.threads, progress, job.device)
    return render_blender(job.engine, job.stem(frame), job.samples, job.seed, job.threads, progress, device=job.device)


def _render_whole(job: Job, frame: int, progress: Progress, because: NothingToWin | None = None) -> Outcome:
    """Render a frame as Blender does, and count in passing: nothing is culled, so nothing is analysed. because: of what
    was found instead."""
    show_frame(bpy.context.scene, frame)
    before = resident_memory()
    with counting() as counted:
        rendered = render(job, frame, part(progress, 0.0, 1.0, "rendering, "))
    n = len(counted.keys.records)
    nothing = np.zeros((n, RAY_TYPES), np.int64)
    save_states(
        job.states(frame),
        np.full(n, State.ACTIVE, np.uint8),
        np.zeros(n, np.float32),
        nothing,
        counted.keys.records,
        counted.keys.names,
    )
    counts = {"instances": n, "active": n, "meshes": counted.meshes}
    spent = counted.seconds + (because.seconds if because else 0.0)
    seconds = {"sync_s": spent, **rendered.entry(), "render_s": rendered.seconds - counted.seconds}
    why = {"not_analysed": str(because)} if because else {}
    entry = {"frame": frame, **why, **seconds, **counts, **counted.figures(before)}
    return Outcome(entry, memory=counted.memory(frame))


def _beside(figures: dict[str, int]) -> dict[str, int]:
    """What a render is predicted to take beside what the process takes already."""
    return figures and figures | {"memory_bytes": figures["memory_bytes"] + resident_memory()}


def write_back(
    culled: np.ndarray,
    keys: Keys,
    entry: dict[str, Any],
    faces: Mapping[str, np.ndarray],
    lasting: bool = False,
    levels: Mapping[str, AnyLevel] = NO_LEVELS,
) -> tuple[list[str], WritebackResult]:
    """Take culled (N,) bool out of renders of the open file; what that came to goes into the frame's entry, what could
    not be is said in the lines returned.

    faces, levels: as of `States`. lasting: the file is to be saved so.
    """
    start = time.perf_counter()
    with muted():
        applied = writeback.apply(culled, keys, lasting=lasting, faces=faces, free=True, levels=levels)
    entry["writeback_s"] = time.perf_counter() - start
    entry["writeback"] = applied.summary()
    whole = [f"{count:,} objects keep all faces in the render: {why}" for why, count in applied.whole.items()]
    kept = [f"{count:,} culled instances stay in the render: {why}" for why, count in applied.kept.items()]
    return kept + whole, applied
