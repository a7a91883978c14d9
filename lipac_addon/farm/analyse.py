"""Step `analyze`: what each frame of a chunk wants of the shot's set.

A frame proposes more than it needs, by few paths, as every eighth does for `lipac render --bake shot`: what all have
proposed is judged in each of them (step `judge`), by paths that chose nothing of it.
"""

from __future__ import annotations

import gc
import json
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from ...core.culling.options import CullOptions
from ...core.files.atomic import is_whole, sweep
from ...core.files.report import UNREADABLE
from ...core.files.usage import peak_memory
from ...core.progress import Progress, part, silent
from ..batch.deciding import decide_layers
from ..batch.job import Cancel, Job, check, never
from ..batch.session import Decide, sessions_of
from ..batch.shots.uniting import deciding
from .layout import FarmShot
from .opening import open_shot

Place = Callable[[int], Path]


def analyse(
    shot: FarmShot, frames: Iterable[int], threads: int = 0, progress: Progress = silent, cancelled: Cancel = never
) -> int:
    """Save what frames propose that are not analysed yet; returns how many were. Raises InputError, Cancelled."""
    todo = [frame for frame in frames if note_of(shot.analysis(frame)).get("key") != shot.key]
    if todo:
        from ...core.culling.union import propose

        open_shot(shot)
        decide_frames(shot, todo, shot.options(threads), shot.analysis, progress, cancelled, deciding(propose))
    return len(todo)


def decide_frames(
    shot: FarmShot,
    frames: Sequence[int],
    options: CullOptions,
    place: Place,
    progress: Progress = silent,
    cancelled: Cancel = never,
    decide: Decide | None = None,
) -> None:
    """Decide frames of the open scene, each by itself, and save each where `place` says. decide: by default, what the
    frame needs. Raises InputError, Cancelled."""
    job = Job(shot.folder, tuple(frames), options)
    place(frames[0]).parent.mkdir(parents=True, exist_ok=True)
    sweep(place(frames[0]).parent, {place(frame).stem for frame in frames})
    with ExitStack() as stack:
        sessions = [stack.enter_context(session) for session in sessions_of(job)]
        for k, frame in enumerate(frames):
            check(cancelled)
            begin = time.perf_counter()
            within = part(progress, k / len(frames), (k + 1) / len(frames), f"frame {frame}: ")
            decided = decide_layers(sessions, frame, frame == frames[-1], within, cancelled, decide)
            said = {"approximated": decided.approximated, "warnings": decided.warnings}
            took = {"seconds": time.perf_counter() - begin, "peak_bytes": peak_memory()}
            note = (
                decided.entry
                | said
                | took
                | {"key": shot.key, "max_error": [options.max_error.mean, options.max_error.worst]}
            )
            decided.save(place(frame), json.dumps(note, default=float))
            del decided
            # a frame's arrays are in circles of few objects, for which the collector does not begin by itself for many
            # frames
            gc.collect()


def note_of(path: Path) -> dict[str, Any]:
    """What was noted of an analysis; empty where there is none that can be read."""
    try:
        with np.load(path) as data:  # no more of it is read
            note = json.loads(str(data["note"])) if is_whole(path) else {}
    except UNREADABLE:
        return {}
    return note if isinstance(note, dict) else {}
