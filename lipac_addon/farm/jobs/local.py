"""A shot on this machine: its steps one after the other, the tasks of each by so many processes at a time.

Steps wait for all of those before, so a pool of threads that wait for processes (`concurrent.futures`) is all that it
takes.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from threading import Event

from ....core.progress import Progress, silent
from ....core.threads import processors
from ...batch.pipeline import Cancel, never
from ..children import run
from ..layout import FarmShot
from .graph import BLENDER, FOLDER, ITEMS, LIPAC, SCENE, Programs, Step

CORES_TO_A_PROCESS = 8
DONE = (0, 3)  # exit statuses: 3 says that a frame is above the budget in the end


def processes() -> int:
    """At a time, by default: what a process does alone keeps several cores busy, but not all of the time."""
    return max(1, processors() // CORES_TO_A_PROCESS)


def run_here(
    shot: FarmShot,
    steps: Sequence[Step],
    programs: Programs,
    workers: int,
    progress: Progress = silent,
    cancelled: Cancel = never,
) -> tuple[int, str]:
    """Do all steps; the exit status of the last one, and what it printed. Raises InputError where a task fails, which
    ends the others; Cancelled.

    What is done stays, so the same call goes on where one ended.
    """
    values = {FOLDER: str(shot.folder), SCENE: str(shot.scene), BLENDER: programs.blender[0]}
    count, done, ended = sum(len(step.chunks()) for step in steps), 0, Event()
    last = (0, "")
    for step in steps:
        program = programs.lipac if step.program == LIPAC else programs.blender
        commands = [[program[0], *step.filled(values | {ITEMS: items})] for items in step.chunks()]
        with ThreadPoolExecutor(workers) as pool:
            futures = [pool.submit(run, command, lambda: ended.is_set() or cancelled(), DONE) for command in commands]
            try:
                for future in as_completed(futures):
                    last = future.result()
                    done += 1
                    progress(done / count, f"{step.name}: {done} of {count} tasks done")
            except BaseException:
                ended.set()
                pool.shutdown(cancel_futures=True)
                raise
    return last
