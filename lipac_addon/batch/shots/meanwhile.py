"""Frames of a shot that are rendered while another process still looks for the shot's set.

That process judges its set in one frame after the other. A frame in which it holds is rendered at once; where the set
has to grow for the sake of another frame, the picture is made again. So what comes out is what comes out one after the
other.
"""

from __future__ import annotations

import json
import math
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ....core.culling.options import State
from ....core.files.atomic import alone, replacing
from ....core.files.report import Report, States, load_states
from ....core.progress import Progress, clock, part
from ....core.warmup import waiting
from ...depsgraph import show_frame
from ..ahead import Ahead
from ..frame import WAITING, render
from ..job import Cancel, Job
from .shot_set import ShotSet
from .written import Written


@dataclass(frozen=True)
class Drawn:
    """A picture that was rendered meanwhile. digest: of the set that was judged in its frame; active: (n,) bool, which
    of the frame's instances it has; entry: for the report."""

    digest: str
    active: NDArray[np.bool_]
    entry: dict[str, Any]


@dataclass(frozen=True)
class Meanwhile:
    """What was done while another process looked for a set: by frame, what was rendered; figures of that process for
    the report, of each frame."""

    drawn: Mapping[int, Drawn]
    figures: Mapping[str, Any]

    def of(self, digest: str, shot: ShotSet, checked: Callable[[int], States]) -> Meanwhile:
        """Only the pictures of a set with a digest. checked: what was judged of a frame."""
        drawn = {
            frame: one
            for frame, one in self.drawn.items()
            if one.digest == digest and np.array_equal(one.active, shot.of(checked(frame)))
        }
        return replace(self, drawn=drawn)


NOTHING = Meanwhile({}, {})


class Judged:
    """What is known of the set that was judged last. digest: as the process calls it; set: of the frames in which it
    was judged, as far as they show it; held: by frame in which it holds, instances of it that stay, and how many frames
    were judged by then; fails: it does not hold in some frame, so another follows; began: `time.perf_counter()` when
    the first was judged."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._seen: set[str] = set()
        self._begin("")

    def _begin(self, digest: str) -> None:
        self.digest, self.set, self.count, self.fails = digest, ShotSet(), 0, False
        self.began = time.perf_counter()
        self.held: dict[int, tuple[NDArray[np.bool_], int]] = {}

    def look(self) -> None:
        """Take in what has been judged since."""
        new = [path for path in self._folder.glob("frame_*_checked*.npz") if path.name not in self._seen]
        for path in sorted(new, key=lambda path: (path.stat().st_mtime_ns, path.name)):
            self._seen.add(path.name)
            states = load_states(path)
            note = json.loads(states.note)
            if note["set"] != self.digest:
                self._begin(note["set"])
            self.set.add(states)
            self.count += 1
            if note["holds"]:
                frame = int(path.name.split("_")[1])
                self.held[frame] = states.state == State.ACTIVE, self.count
            self.fails |= not note["holds"]

    def waited_for(self, grown: bool, frames: int, now: float) -> str:
        """What is waited for once pictures are there, and the time left where it is known: not before a second frame of
        so many was judged. grown: the set has, since they were rendered; now: `time.perf_counter()`."""
        if self.fails:
            return f"{WAITING}: the shot's set has to grow"
        left = (now - self.began) / (self.count - 1) * (frames - self.count) if 1 < self.count <= frames else math.nan
        why = "the shot's set has grown, " if grown else ""
        known = "" if math.isnan(left) else f", about {clock(left)} left"
        return f"{WAITING}: {why}judged in {min(self.count, frames)} of {frames} frames{known}"

    def is_complete(self, frames: Sequence[int]) -> bool:
        """Whether the set holds in all frames."""
        return all(frame in self.held for frame in frames)


def render_meanwhile(job: Job, written: Written, report: Report, progress: Progress, cancelled: Cancel) -> Meanwhile:
    """Render frames of a job until the set of its shot is found; what was found out is then in the job's folder, where
    `Uniting` begins with it. Raises InputError, Cancelled."""
    drawn: dict[int, Drawn] = {}
    frames, since, written_for = job.frames, time.perf_counter(), ("", 0)
    with job.analysing(frames) as ahead:
        judged, tell = Judged(ahead.folder / "analysis"), waiting(progress, WAITING)
        while True:
            ended = ahead.has_ended()
            judged.look()
            if judged.is_complete(frames):
                break
            left = [k for k in judged.held if k not in drawn or drawn[k].digest != judged.digest]
            if judged.fails or not left:
                if drawn:
                    grown = any(one.digest != judged.digest for one in drawn.values())
                    progress(math.nan, judged.waited_for(grown, len(frames), time.perf_counter()))
                else:
                    tell()
                ahead.go_on(ended, "the shot", cancelled)
                continue
            frame = left[0]
            active, count = judged.held[frame]
            if written_for[0] != judged.digest or written_for[1] < count:
                written.use(judged.set, judged.set.levels)
                written_for = judged.digest, judged.count
            waited = time.perf_counter() - since
            show_frame(bpy.context.scene, frame)
            k = frames.index(frame)
            within = part(progress, k / len(frames), (k + 1) / len(frames), f"frame {frame}: rendering, ")
            entry = render(job, frame, within).entry() | {"wait_s": waited}
            drawn[frame] = Drawn(judged.digest, active, entry)
            since = time.perf_counter()
        return Meanwhile(drawn, _taken_over(ahead, job, report))


def _taken_over(ahead: Ahead, job: Job, report: Report) -> dict[str, Any]:
    """Copy what the process has found out into a job's folder, and say what it says; returns its figures."""
    folder = job.folder / "analysis"
    folder.mkdir(exist_ok=True)
    with alone(job.folder):
        for path in sorted((ahead.folder / "analysis").glob("frame_*.npz")):
            with replacing(folder / path.name) as part_of_it:
                shutil.copyfile(path, part_of_it)
    said = ahead.said()
    if said is None:
        return {}
    report.add_memory(said.memory)
    report.note(report.approximated, said.approximated)
    report.note(report.warnings, said.warnings)
    return {"analysis_peak_bytes": said.peak}
