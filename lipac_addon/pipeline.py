"""The steps of a command for each frame: Blender in, analysis, states, Blender out, render, report."""

from __future__ import annotations

import gc
import json
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import bpy
import numpy as np

from ..core.culling import CullOptions, State
from ..core.errors import Cancelled
from ..core.progress import Progress, part, silent
from ..core.report import Report, alone, load_states, save_states
from ..core.scene import RAY_TYPES, Scene
from . import writeback
from .baked import save_baked
from .console import muted
from .counting import counting
from .engines import BLENDER_ENGINES, left_out, render_blender, render_path, samples_of
from .extract import Extraction, Extractor
from .hybrid import HybridOptions, render_hybrid
from .keys import Keys, any_of
from .shot_set import ShotSet

if TYPE_CHECKING:
    from ..core.frames import Shot
    from ..core.loop import CullingResult

ANALYSIS_SHARE = 0.2  # of a frame's progress, where it is rendered too
FRAME, SHOT = "frame", "shot"
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
    the error that was measured (`verify`).
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
        """Whether the folder has all files of a frame."""
        return all(path.exists() for path in (self.states(frame), *self.pictures(frame)))

    @property
    def whole(self) -> bool:
        """Whether Blender renders its scene as it is, so that there is nothing to analyse."""
        return self.options.policy == "none" and self.engine in BLENDER_ENGINES


def run(job: Job, report: Report, progress: Progress = silent, cancelled: Cancel = never) -> None:
    """Work through the frames of a job; the report on disk is valid after each. Visibility in the open file is put back at the end, whatever happens.

    Raises Cancelled soon after cancelled() says so.
    """
    (job.folder / "states").mkdir(parents=True, exist_ok=True)
    reported = report.finished(job.folder)
    finished = {frame for frame in reported or () if job.resume and job.is_finished(frame)}
    with alone(job.folder):
        _sweep(job, keep_analyses=reported is not None and (job.resume or bool(job.shot)))
    report.note(report.approximated, left_out(bpy.context.scene, job.engine))
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
    for frame in job.frames:
        for path in (job.states(frame), job.analysis(frame), *job.pictures(frame)):
            path.with_name(f".{path.stem}.part{path.suffix}").unlink(missing_ok=True)
    for frame in () if keep_analyses else job.shot or job.frames:
        job.analysis(frame).unlink(missing_ok=True)


class Session:
    """What goes from frame to frame of a job: the extractor, and the loop."""

    def __init__(self, job: Job) -> None:
        self.job = job
        self.keep = job.engine in ("", "path") and len(job.frames) > 1  # other engines make Blender free the graph
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
            self._extractor = self._extractor or Extractor(bpy.context.scene, exposed=self.job.engine in ("", *BLENDER_ENGINES))
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
        from ..core.frames import Shot

        if self._shot is None:
            self._shot = Shot(self.job.options, independent=not self.job.warm)
        return self._shot.advance(scene or extraction.scene, extraction.change, progress, cancelled, self._pinned)


# Each frame by itself


def _run_frames(job: Job, finished: set[int], report: Report, progress: Progress, cancelled: Cancel) -> None:
    todo = [frame for frame in job.frames if job.warm or frame not in finished]
    with Session(job) as session:
        for k, frame in enumerate(todo):
            check(cancelled)
            name = f"frame {frame}: " if len(job.frames) > 1 else ""
            within = part(progress, k / len(todo), (k + 1) / len(todo), name)
            if frame in finished:  # only to know what the next one begins with
                session.decide(session.sync(frame)[0], None, within, cancelled)
                continue
            run_frame(session, frame, report, within, cancelled, last=frame == todo[-1])
            report.write(job.folder)


def run_frame(session: Session, frame: int, report: Report, progress: Progress = silent, cancelled: Cancel = never, last: bool = True) -> None:
    """One frame of a job, added to the report. last: nothing follows, so nothing need be kept for it. Raises Cancelled."""
    job = session.job
    if job.whole:
        report.add_frame(_render_whole(job, frame, progress))
        return
    extraction, entry = session.sync(frame)
    check(cancelled)
    extraction = session.expose(extraction, frame, part(progress, 0.0, ANALYSIS_SHARE), cancelled)
    if last:
        session.end_reading()
    approximated, warnings = extraction.scene.approximated, extraction.warnings
    if job.engine == "hybrid":
        result = _hybrid(job, extraction, entry, progress, cancelled, lambda scene: session.decide(extraction, scene, part(progress, 0.0, 0.3), cancelled))
    else:
        result = session.decide(extraction, None, part(progress, 0.0, ANALYSIS_SHARE if job.engine else 1.0), cancelled)
        check(cancelled)
        entry |= result.stats
    if last:
        session.forget()
    keys = extraction.keys
    boxes = result.boxes + extraction.scene.origin
    save_states(job.states(frame), result.state, result.score, result.hits, keys.records, keys.names, boxes=boxes)
    rest = part(progress, ANALYSIS_SHARE, 1.0, "rendering, ")
    if not job.engine:
        entry |= _verified(job, extraction.scene, result.active, rest, cancelled)
    if job.engine == "path":
        entry["render_s"] = render_path(extraction.scene, result.active, job.stem(frame), job.samples, job.seed, job.threads, rest, cancelled)
        entry |= _verified(job, extraction.scene, result.active, rest, cancelled)
    elif job.engine in BLENDER_ENGINES:
        warnings = (*warnings, *write_back(np.asarray(result.state == State.CULLED), keys, entry))
        del extraction, result, keys
        if last:
            session.close()  # the render needs the memory
        else:
            gc.collect()
        entry["render_s"] = render_blender(job.engine, job.stem(frame), job.samples, job.seed, job.threads, rest)
        entry |= _verified(job, None, None, rest, cancelled)
    report.add_frame(entry, approximated, warnings)


def _verified(job: Job, scene: Scene | None, active: np.ndarray | None, progress: Progress, cancelled: Cancel) -> dict[str, object]:
    """What the frame's entry says of the error that was measured, where the job asks for that. scene, active: for an engine of ours."""
    if not job.verify:
        return {}
    from .verify import verified_blender, verified_path

    if scene is None or active is None:
        return verified_blender(job.engine, job.samples, job.seed, job.threads, job.verify, progress).entry()
    return verified_path(scene, active, job.samples or samples_of(bpy.context.scene, "path"), job.seed, job.threads, job.verify, cancelled).entry()


def _hybrid(
    job: Job, extraction: Extraction, entry: dict[str, Any], progress: Progress, cancelled: Cancel, decide: Callable[[Scene], CullingResult]
) -> CullingResult:
    """Render a frame by the hybrid renderer; its figures go into the entry."""
    samples = job.samples or samples_of(bpy.context.scene, job.engine)
    stem = job.stem(entry["frame"])
    result, figures = render_hybrid(extraction.scene, job.hybrid, job.options, stem, samples, job.seed, job.threads, progress, cancelled, decide)
    entry |= result.stats | figures
    return result


def _render_whole(job: Job, frame: int, progress: Progress) -> dict[str, Any]:
    """Render a frame as Blender does, and count in passing: nothing is culled, so nothing is analysed. Returns the entry for the report."""
    bpy.context.scene.frame_current = frame
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
    shot = ShotSet()
    for frame in job.shot or job.frames:
        shot.add(load_states(job.analysis(frame)))
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
            states = load_states(job.analysis(frame))
            active = shot.of(states)
            entry: dict[str, Any] = json.loads(states.note)
            entry |= {"needed": entry["active"], "active": int(active.sum()), "culled": int((~active).sum()), "pending": 0}
            if job.engine in BLENDER_ENGINES:
                bpy.context.scene.frame_current = frame
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
    from ..core.loop import Loop

    n, before = len(active), dict(entry)
    nothing = np.zeros(n, np.float32), np.zeros((n, RAY_TYPES), np.int64)
    changes = {name: before[name] for name in ("calibrated_mean",) if name in before}  # more is kept than what that was measured without
    _hybrid(job, extraction, entry, progress, cancelled, lambda scene: Loop(scene, job.options, cancelled).result(active, *nothing, **changes))
    entry |= {name: before[name] for name in ("paths", "rays", "iterations", "trace_s", "feedback_s")}


def _analyse(job: Job, report: Report, progress: Progress, cancelled: Cancel) -> None:
    """Save what each frame of the shot needs by itself, for those that have not been looked at yet.

    The job's own come first, then, from the last one on, those that no other process has done by then: so two that share a shot meet in the middle.
    """
    (job.folder / "analysis").mkdir(exist_ok=True)
    others = [frame for frame in reversed(job.shot) if frame not in job.frames]
    todo = [frame for frame in (*job.frames, *others) if job.warm or not job.analysis(frame).exists()]
    with Session(job) as session:
        for k, frame in enumerate(todo):
            if not job.warm and job.analysis(frame).exists():
                continue
            within = part(progress, k / len(todo), (k + 1) / len(todo), f"frame {frame}: ")
            extraction, entry = session.sync(frame)
            check(cancelled)
            extraction = session.expose(extraction, frame, within, cancelled)
            result = session.decide(extraction, None, within, cancelled)
            entry |= result.stats
            keys = extraction.keys
            with alone(job.folder):
                if not job.analysis(frame).exists():
                    note = json.dumps(entry, default=float)
                    save_states(job.analysis(frame), result.state, result.score, result.hits, keys.records, keys.names, note)
            report.note(report.approximated, extraction.scene.approximated)
            report.note(report.warnings, extraction.warnings)
            report.write(job.folder)
