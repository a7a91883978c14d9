"""One set of instances for all frames of a shot: what each needs by itself, and the job's frames with what any of them
does."""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

import bpy
import numpy as np

from ....core.culling.options import State
from ....core.files.atomic import alone, is_whole
from ....core.files.report import UNREADABLE, Report, States, load_states, save_states
from ....core.progress import Progress, part, silent
from ....core.scene.model import RAY_TYPES
from ...depsgraph import show_frame
from ...writeback.plan import NO_LEVELS
from ..baked import save_baked
from ..deciding import decide_layers
from ..engines.choices import BLENDER_ENGINES
from ..engines.path import render_path
from ..frame import ANALYSIS_SHARE, hybrid, render
from ..job import Cancel, Job, check
from ..session import Session, sessions_of
from .meanwhile import NOTHING, Meanwhile, render_meanwhile
from .shot_set import ShotSet
from .uniting import Uniting, unites
from .written import Written

TRIES = 3


def run_shot(job: Job, finished: set[int], report: Report, progress: Progress, cancelled: Cancel) -> None:
    """Find out what each frame of the shot needs; then do the job's with what any of them does."""
    share, written = ANALYSIS_SHARE if job.engine else 0.9, Written(lasting=job.save is not None)
    if unites(job):
        meanwhile = NOTHING
        if job.ahead and not finished and not any((job.folder / "analysis").glob("frame_*")):
            meanwhile = render_meanwhile(job, written, report, progress, cancelled)
        uniting = Uniting(job, report, cancelled)
        shot = uniting.run(silent if meanwhile.drawn else part(progress, 0.0, share))
        meanwhile = meanwhile.of(uniting.digest, shot, uniting.checked)
        _use(job, shot, uniting.states, share, finished, report, progress, cancelled, written, meanwhile)
        return
    _analyse(job, report, part(progress, 0.0, share), cancelled)

    def needed(frame: int) -> States:
        """What a frame needs by itself. Another process that begins anew in the same folder may have removed it, or a
        fault have damaged it."""
        for _ in range(TRIES):
            try:
                return load_states(job.analysis(frame))
            except UNREADABLE:
                _analyse(job, report, silent, cancelled)
        return load_states(job.analysis(frame))

    shot = ShotSet()
    for frame in job.shot or job.frames:
        shot.add(needed(frame))
    _use(job, shot, needed, share, finished, report, progress, cancelled, written)


def _use(
    job: Job,
    shot: ShotSet,
    needed: Callable[[int], States],
    share: float,
    finished: set[int],
    report: Report,
    progress: Progress,
    cancelled: Cancel,
    written: Written,
    meanwhile: Meanwhile = NOTHING,
) -> None:
    """Do a job's frames with a set. needed: what is known of a frame by itself, with its entry for the report as its
    note; share: of the progress that is done; meanwhile: of the set."""
    levels = shot.levels if unites(job) else NO_LEVELS  # else they are not certified
    if job.save is not None:
        written.use(shot, levels)
        save_baked(job.save)
    with Session(job) as session:
        for k, frame in enumerate(job.frames):
            check(cancelled)
            if frame in finished:
                continue
            within = part(
                progress,
                share + (1 - share) * k / len(job.frames),
                share + (1 - share) * (k + 1) / len(job.frames),
                f"frame {frame}: ",
            )
            states = needed(frame)
            active = shot.of(states)
            entry: dict[str, Any] = json.loads(states.note)
            entry |= {
                **({} if unites(job) else {"needed": entry["active"]}),
                "active": int(active.sum()),
                "culled": int((~active).sum()),
                "pending": 0,
            }
            if job.engine in BLENDER_ENGINES:
                there = meanwhile.drawn.get(frame)
                if there is None:
                    written.use(shot, levels)
                    show_frame(bpy.context.scene, frame)
                entry |= render(job, frame, within).entry() if there is None else there.entry
                entry |= {**written.entry(len(job.frames)), **meanwhile.figures}
            elif job.engine:
                _render_kept(session, frame, active, entry, within, cancelled)
            state = np.where(active, State.ACTIVE, State.CULLED).astype(np.uint8)
            save_states(
                job.states(frame),
                state,
                states.score,
                states.hits,
                shot.records_of(states),
                shot.keys.names,
                faces=shot.faces,
                levels=levels,
            )
            report.add_frame(entry, warnings=written.lines)
            report.write(job.folder)


def _render_kept(
    session: Session, frame: int, active: np.ndarray, entry: dict[str, Any], progress: Progress, cancelled: Cancel
) -> None:
    """Render a frame by one of our engines with the instances that are active, (N,) bool."""
    job = session.job
    extraction, synced = session.sync(frame)
    check(cancelled)
    entry["sync_s"] += synced["sync_s"]
    if job.engine == "path":
        entry["render_s"] = render_path(
            extraction.scene, active, job.stem(frame), job.samples, job.seed, job.threads, progress, cancelled
        )
        return
    from ....core.culling.loop import Loop

    n, before = len(active), dict(entry)
    nothing = np.zeros(n, np.float32), np.zeros((n, RAY_TYPES), np.int64)
    changes = {name: before[name] for name in ("certified_mean",) if name in before}
    hybrid(
        job,
        extraction,
        entry,
        progress,
        cancelled,
        lambda scene: Loop(scene, job.options, cancelled).result(active, *nothing, **changes),
    )
    entry |= {name: before[name] for name in ("paths", "rays", "iterations", "trace_s", "feedback_s")}


def _analyse(job: Job, report: Report, progress: Progress, cancelled: Cancel) -> None:
    """Save what each frame of the shot needs by itself, for those that have not been looked at yet.

    The job's own come first, then, from the last one on, those that no other process has done by then: so two that
    share a shot meet in the middle.
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
            report.add_memory(decided.memory())
            report.note(report.approximated, decided.approximated)
            report.note(report.warnings, decided.warnings)
            report.write(job.folder)
