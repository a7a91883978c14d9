"""The steps of a command for each frame: Blender in, analysis, states, Blender out, render, report."""

from __future__ import annotations

import re
from contextlib import ExitStack
from dataclasses import dataclass, replace

import bpy

from ...core.culling.policies import NOTHING
from ...core.files.atomic import alone, sweep
from ...core.files.report import Report
from ...core.files.usage import resident_memory
from ...core.progress import Progress, part, silent
from .. import writeback
from ..console import muted
from .ahead import Ahead
from .deciding import decide_layers
from .engines.devices import find_device
from .engines.texture_cache import texture_cache
from .engines.wishes import left_out
from .frame import run_frame, run_frame_ahead
from .job import SHOT, Cancel, Job, check, never
from .session import sessions_of
from .shots.shot import run_shot

REGION = "render region: the bounds are those of the whole picture; what is rendered of it alone may change by more"
STEREO = "stereo: each view sees something else, and one camera is analysed: nothing is culled"
_NAME = re.compile(r"frame_(-?\d+)(?:_[a-z]+)?")


def run(job: Job, report: Report, progress: Progress = silent, cancelled: Cancel = never) -> None:
    """Work through the frames of a job; the report on disk is valid after each. Visibility in the open file is put back
    at the end, whatever happens.

    Raises Cancelled soon after cancelled() says so.
    """
    (job.folder / "states").mkdir(parents=True, exist_ok=True)
    reported = report.finished(job.folder)
    finished = {frame for frame in reported or () if job.resume and job.is_finished(frame)}
    _sweep(job, keep_analyses=reported is not None and (job.resume or bool(job.shot)))
    report.note(report.approximated, left_out(bpy.context.scene, job.engine, job.as_scene))
    render, by_scene = bpy.context.scene.render, (job.as_scene or not job.engine) and not job.whole
    if render.use_border and by_scene:
        report.note(report.warnings, [REGION])
    if render.use_multiview and by_scene:
        job = replace(job, options=replace(job.options, policy=NOTHING))
        report.note(report.warnings, [STEREO])
    if job.engine == "cycles" and (note := find_device(bpy.context.scene, job.device).note):
        report.note(report.warnings, [note])
    # else the report of an earlier run stays until a frame is finished
    if reported is not None or not (job.folder / "report.json").exists():
        report.write(job.folder)
    with muted():
        writeback.restore()
    try:
        with texture_cache(bpy.context.scene, job.texture_cache) as lines:
            report.note(report.warnings, lines)
            if job.bake == SHOT and not job.whole:
                run_shot(job, finished, report, progress, cancelled)
            else:
                _run_frames(job, finished, report, progress, cancelled)
    finally:
        with muted():
            writeback.restore()


def _sweep(job: Job, keep_analyses: bool) -> None:
    """Remove what a command that was killed left of files of these frames, and of reports, that it had begun to write;
    analyses for shots too, where they are not to be kept."""
    names = _NamesOfFrames(frozenset(job.frames))
    for folder in (".", "states", "analysis", "verified"):
        sweep(job.folder / folder, names)
    sweep(job.folder, {"report", "memory"})
    unwanted = _NamesOfFrames(frozenset(() if keep_analyses else job.shot or job.frames))
    with alone(job.folder):
        for path in (job.folder / "analysis").glob("frame_*.npz"):
            if "_".join(path.stem.split("_")[:2]) in unwanted:
                path.unlink(missing_ok=True)


@dataclass(frozen=True)
class _NamesOfFrames:
    """Names of files of frames without their endings. There may be a million frames, so the names are not made."""

    frames: frozenset[int]

    def __contains__(self, stem: object) -> bool:
        found = _NAME.fullmatch(str(stem))
        return found is not None and int(found[1]) in self.frames


def _run_frames(job: Job, finished: set[int], report: Report, progress: Progress, cancelled: Cancel) -> None:
    todo = [frame for frame in job.frames if job.warm or frame not in finished]
    if job.options.memory and job.engine:
        _run_in_little_memory(job, todo, report, progress, cancelled)
        return
    if job.ahead and not job.whole and not finished:
        with job.analysing(todo) as ahead:
            for k, frame in enumerate(todo):
                run_frame_ahead(
                    job,
                    ahead,
                    frame,
                    report,
                    part(progress, k / len(todo), (k + 1) / len(todo), f"frame {frame}: "),
                    cancelled,
                )
                report.write(job.folder)
        return
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


def _run_in_little_memory(job: Job, todo: list[int], report: Report, progress: Progress, cancelled: Cancel) -> None:
    """Frames whose renders are not to take more than so much: each is decided by another process before it, so that the
    one that renders holds nothing of the analysis, and both are not there at a time."""
    for k, frame in enumerate(todo):
        check(cancelled)
        within = part(progress, k / len(todo), (k + 1) / len(todo), f"frame {frame}: ")
        with Ahead((*job.ahead, "--process", str(resident_memory())), [frame]) as ahead:
            run_frame_ahead(job, ahead, frame, report, within, cancelled)
        report.write(job.folder)
