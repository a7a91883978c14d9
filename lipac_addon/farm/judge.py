"""Step `judge`: whether the shot's set keeps the budget in each frame, by paths that chose nothing of it.

What a frame proposes is not certified, and a union of sets is not by its parts: what an instance adds is not always
towards the full picture. So the set is judged in every frame as it is rendered there. Where it does not hold, step
`verify` mends the frames around.
"""

from __future__ import annotations

import gc
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack
from typing import Any

from ...core.errors import InputError
from ...core.files.shell import quoted
from ...core.files.usage import peak_memory
from ...core.progress import Progress, part, silent
from ..batch.deciding import decide_layers
from ..batch.job import Cancel, Job, check, never
from ..batch.session import sessions_of
from ..batch.shots.shot_set import ShotSet
from ..batch.shots.uniting import judging
from .layout import FarmShot, read_json, write_json
from .opening import open_shot
from .unite import chosen_of, set_of

FIGURES = ("certified_mean", "certified_worst", "unknown_mean", "unknown_worst", "certificate_paths")


def judge(
    shot: FarmShot, frames: Iterable[int], threads: int = 0, progress: Progress = silent, cancelled: Cancel = never
) -> list[dict[str, Any]]:
    """What paths say of the shot's set in frames, which is kept. Raises InputError where there is no set, Cancelled."""
    chosen, wanted = chosen_of(shot), list(frames)
    todo = [frame for frame in wanted if read_json(shot.judged(frame), key=shot.key, set=chosen) is None]
    if todo:
        together = set_of(shot)
        open_shot(shot)
        for found in judged(shot, together, todo, 0, threads, progress, cancelled):
            write_json(shot.judged(found["frame"]), {"key": shot.key, "set": chosen, **found})
    return of_frames(shot, wanted)


def judged(
    shot: FarmShot,
    together: ShotSet,
    frames: Sequence[int],
    earlier: int,
    threads: int = 0,
    progress: Progress = silent,
    cancelled: Cancel = never,
) -> Iterator[dict[str, Any]]:
    """What paths say of a set in frames of the open scene, one after the other. earlier: how many sets these frames
    have judged before. Raises InputError, Cancelled."""
    job = Job(shot.folder, tuple(frames), shot.options(threads))
    with ExitStack() as stack:
        sessions = [stack.enter_context(session) for session in sessions_of(job)]
        for k, frame in enumerate(frames):
            check(cancelled)
            begin, held = time.perf_counter(), list[bool]()
            within = part(progress, k / len(frames), (k + 1) / len(frames), f"frame {frame}: ")
            decide = judging(together, earlier, held, own=True)
            entry = decide_layers(sessions, frame, frame == frames[-1], within, cancelled, decide).entry
            yield {
                "frame": frame,
                "holds": bool(held) and all(held),  # what was not asked does not hold
                **{name: entry.get(name) for name in FIGURES},  # None where a frame has nothing to trace
                "seconds": time.perf_counter() - begin,
                "peak_bytes": peak_memory(),
            }
            gc.collect()  # as in `decide_frames`


def of_frames(shot: FarmShot, frames: Iterable[int]) -> list[dict[str, Any]]:
    """What paths said of the set that is there, in frames. Raises InputError where one was not asked."""
    chosen, wanted = chosen_of(shot), list(frames)
    found = {frame: read_json(shot.judged(frame), key=shot.key, set=chosen) for frame in wanted}
    missing = [frame for frame, one in found.items() if one is None]
    if missing:
        few = ", ".join(map(str, missing[:8])) + (f" and {len(missing) - 8} more" if len(missing) > 8 else "")
        raise InputError(
            f"the set was not judged in frames {few}; run lipac shot judge {quoted(shot.folder)} for these"
        )
    return [one for one in found.values() if one is not None]
