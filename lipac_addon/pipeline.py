"""The steps of a command for each frame: Blender in, analysis, states, Blender out, render, report."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import bpy
import numpy as np

from ..core.culling import CullOptions, State
from ..core.errors import Cancelled
from ..core.progress import Progress, part, silent
from ..core.report import Report, save_states
from ..core.scene import RAY_TYPES
from . import writeback
from .console import muted
from .engines import BLENDER_ENGINES, render_blender, render_path, samples_of
from .extract import Extraction, extract_frame
from .hybrid import HybridOptions, render_hybrid
from .keys import Keys

if TYPE_CHECKING:
    from ..core.loop import CullingResult

ANALYSIS_SHARE = 0.2  # of a frame's progress, where it is rendered too


def never() -> bool:
    """The `cancelled` of work that goes on to its end."""
    return False


def check(cancelled: Callable[[], bool]) -> None:
    """Raise Cancelled where it says so."""
    if cancelled():
        raise Cancelled


@dataclass(frozen=True)
class Job:
    """What to do with the open file. engine: one of `engines.ENGINES`, or "" to analyse only; samples: None as in the scene; threads: 0 for all.

    hybrid: for the engine of that name.
    """

    folder: Path
    frames: tuple[int, ...]
    options: CullOptions
    engine: str = ""
    samples: int | None = None
    seed: int = 0
    threads: int = 0
    hybrid: HybridOptions = field(default_factory=HybridOptions)


def run(job: Job, report: Report, progress: Progress = silent, cancelled: Callable[[], bool] = never) -> None:
    """Work through the frames of a job; the report on disk is valid after each. Visibility in the open file is put back at the end, whatever happens.

    Raises Cancelled soon after cancelled() says so.
    """
    (job.folder / "states").mkdir(parents=True, exist_ok=True)
    report.write(job.folder)
    try:
        for k, frame in enumerate(job.frames):
            name = f"frame {frame}: " if len(job.frames) > 1 else ""
            run_frame(job, frame, report, part(progress, k / len(job.frames), (k + 1) / len(job.frames), name), cancelled)
            report.write(job.folder)
    finally:
        writeback.restore()


def run_frame(job: Job, frame: int, report: Report, progress: Progress = silent, cancelled: Callable[[], bool] = never) -> None:
    """One frame of a job, added to the report. Raises Cancelled."""
    stem = job.folder / f"frame_{frame:04}"
    states = job.folder / "states" / f"{stem.name}.npz"
    rest = part(progress, ANALYSIS_SHARE, 1.0, "rendering, ")
    extraction, entry = sync(frame)
    check(cancelled)
    approximated, warnings = extraction.scene.approximated, extraction.warnings
    if job.engine == "hybrid":
        samples = job.samples or samples_of(bpy.context.scene, job.engine)
        result, figures = render_hybrid(extraction.scene, job.hybrid, job.options, stem, samples, job.seed, job.threads, progress, cancelled)
        entry |= result.stats | figures
        save_states(states, result.state, result.score, result.hits, extraction.keys.records, extraction.keys.names)
    elif job.options.policy == "none" and job.engine in BLENDER_ENGINES:  # as Blender would render it: nothing to analyse
        entry |= keep_all(extraction, states)
        del extraction
    else:
        result = cull(extraction, job.options, states, entry, part(progress, 0.0, ANALYSIS_SHARE if job.engine else 1.0), cancelled)
        check(cancelled)
        if job.engine == "path":
            entry["render_s"] = render_path(extraction.scene, result.active, stem, job.samples, job.seed, job.threads, rest, cancelled)
        elif job.engine:
            write_back(result, extraction.keys, entry)
            kept = entry["writeback"]["kept"]
            warnings = (*warnings, *(f"{count:,} culled instances stay in the render: {why}" for why, count in kept.items()))
        del extraction, result
    if job.engine in BLENDER_ENGINES:
        gc.collect()  # the render needs the memory
        entry["render_s"] = render_blender(job.engine, stem, job.samples, job.seed, job.threads, rest)
    report.add_frame(entry, approximated, warnings)


def sync(frame: int) -> tuple[Extraction, dict[str, Any]]:
    """Extract a frame of the open file with nothing culled; the second value is the frame's entry for the report so far."""
    start = time.perf_counter()
    with muted():
        writeback.restore()
        extraction = extract_frame(bpy.context.scene, frame)
    return extraction, {"frame": frame, "sync_s": time.perf_counter() - start}


def cull(
    extraction: Extraction,
    options: CullOptions,
    states: Path,
    entry: dict[str, Any],
    progress: Progress = silent,
    cancelled: Callable[[], bool] = never,
) -> CullingResult:
    """Decide the states of an extracted frame, save them to the file `states`, and add the figures to the frame's entry."""
    from ..core.analysis import analyze

    result = analyze(extraction.scene, options, progress, cancelled)
    entry |= result.stats
    save_states(states, result.state, result.score, result.hits, extraction.keys.records, extraction.keys.names)
    return result


def keep_all(extraction: Extraction, states: Path) -> dict[str, int]:
    """Save every instance of an extracted frame as active; the counts for its entry."""
    n = len(extraction.scene.instances)
    nothing = np.zeros((n, RAY_TYPES), np.int64)
    save_states(states, np.full(n, State.ACTIVE, np.uint8), np.zeros(n, np.float32), nothing, extraction.keys.records, extraction.keys.names)
    return {"instances": n, "active": n, "meshes": len(extraction.scene.meshes)}


def write_back(result: CullingResult, keys: Keys, entry: dict[str, Any]) -> None:
    """Take what is culled out of renders of the open file; what that came to goes into the frame's entry."""
    start = time.perf_counter()
    with muted():
        applied = writeback.apply(np.asarray(result.state == State.CULLED), keys)
    entry["writeback_s"] = time.perf_counter() - start
    entry["writeback"] = applied.summary()
