"""One set of instances for all frames of a shot, certified on each of them, from as few analyses as that takes.

Every STRIDE-th frame, and the last, proposes a set by few paths; what they propose together is judged in each frame.
Where it does not hold, the middle of each run of such frames has its say, until all hold: first it proposes, then it
is analysed, and in the end all that it shows stays. What is asked of a frame follows from the shot alone, and each
answer from the frame and the set alone. So processes that do parts of a shot find the same set, and use what the others
have found out.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ....core.culling.options import CullOptions, State
from ....core.files.atomic import alone, is_whole
from ....core.files.report import UNREADABLE, Report, States, load_states
from ....core.progress import Progress, part, silent
from ... import roles
from ...extract import Extraction
from ...extract.geometry.coarser import alternatives
from ...keys import Keys
from ..deciding import Decided, decide_layers
from ..job import Cancel, Job, check
from ..session import Decide, Session, of_one_picture, sessions_of
from .shot_set import ShotSet

if TYPE_CHECKING:
    from ....core.arrays import I64
    from ....core.culling.levels.stand_ins import Alternative
    from ....core.culling.loop import Loop
    from ....core.culling.result import CullingResult
    from ....core.culling.shot import How
    from ....core.scene.model import Scene

STRIDE = 8  # frames from one that proposes to the next
# What a frame has to say in a set; analyses of the first two have files of that kind
PROPOSED, DECIDED, WHOLE = 1, 2, 3
_KINDS = {PROPOSED: "proposed", DECIDED: ""}
WORK = ("paths", "rays", "iterations", "calibration_paths", "certificate_paths", "blas_built", "blas_refitted")


def unites(job: Job) -> bool:
    """Whether a job's set can be certified: each frame is a fresh start, by a budget alone."""
    return not job.warm and by_budget_alone(job.options)


def by_budget_alone(options: CullOptions) -> bool:
    """Whether light paths decide by an error budget, and nothing else limits what is built."""
    return not (options.by_counts or options.blas_budget_bytes or options.blas_budget_ms or options.memory)


def middles(failing: Sequence[int], frames: Sequence[int], level: dict[int, int]) -> list[int]:
    """Of each run of frames that follow each other the one that has said least, of these the one nearest its
    middle."""
    place = {frame: k for k, frame in enumerate(frames)}
    runs: list[list[int]] = []
    for frame in sorted(failing, key=place.__getitem__):
        if runs and place[frame] == place[runs[-1][-1]] + 1:
            runs[-1].append(frame)
        else:
            runs.append([frame])
    return [min(run, key=lambda frame: (level.get(frame, 0), abs(run.index(frame) - len(run) // 2))) for run in runs]


def deciding(how: How) -> Decide:
    """A decision of the frame that was extracted, by how."""

    def decide(session: Session, extraction: Extraction, within: Progress, cancelled: Cancel) -> CullingResult:
        return session.decide(extraction, None, within, cancelled, how)

    return decide


def judging(together: ShotSet, earlier: int, held: list[bool], own: bool) -> Decide:
    """A decision that judges a set in the frame that was extracted, as `judgement`."""

    def judge(session: Session, extraction: Extraction, within: Progress, cancelled: Cancel) -> CullingResult:
        scene = of_one_picture(extraction, session.alone)
        how = judgement(together, scene, extraction.keys, earlier, held, own)
        return session.decide(extraction, None, within, cancelled, how)

    return judge


def judgement(together: ShotSet, scene: Scene, keys: Keys, earlier: int, held: list[bool], own: bool) -> How:
    """Judge a set in a frame with these keys, and append to held whether it keeps the budget there. scene: of the
    frame, in Blender; earlier: how many sets the frame has judged before; own: whether the frame itself has had its say
    in this one."""
    from ....core.culling import union

    active, met = together.found(keys)
    faces = together.faces_of(keys, active)
    levels: Sequence[tuple[I64, Alternative]] | None = None
    with suppress(ValueError):  # other meshes than in the frames that chose them
        levels = alternatives(scene, keys, active, together.levels) if together.levels else ()

    def how(loop: Loop, progress: Progress) -> CullingResult:
        found = None
        if levels is not None:
            with suppress(ValueError):  # the same
                found = union.check(loop, active, met, faces, earlier, progress, levels)
        if found is None:
            found = replace(union.check(loop, active, met, {}, earlier, progress), holds=False)
        # a picture without anything is no picture, whatever the paths say, until the frame itself has said so
        held.append(found.holds and (bool(active.any()) or own))
        return found.result

    return how


class Uniting:
    """The search for a shot's set. level: what each frame has to say in it; found: the last check of each."""

    def __init__(self, job: Job, report: Report, cancelled: Cancel) -> None:
        self.job, self._report, self._cancelled = job, report, cancelled
        self.frames = job.shot or job.frames
        self.level: dict[int, int] = dict.fromkeys((*self.frames[::STRIDE], self.frames[-1]), PROPOSED)
        self.found: dict[int, Path] = {}
        self._sessions: Sequence[Session] = ()
        self._set = ShotSet(), ""  # that was judged last, and its digest
        self._checks: Counter[int] = Counter()
        self._counted: set[Path] = set()
        self._work: dict[int, dict[str, float]] = {}  # of each frame, sums over its analyses and checks

    def run(self, progress: Progress) -> ShotSet:
        """Find the set. Raises InputError, Cancelled."""
        (self.job.folder / "analysis").mkdir(exist_ok=True)
        own = set(self.job.frames)
        # one's own first, then, from the last one on, those that no other process has done by then
        order = (*self.job.frames, *(frame for frame in reversed(self.frames) if frame not in own))
        certified: dict[int, str] = {}
        suspects: Sequence[int] = order
        with ExitStack() as stack:
            self._sessions = [stack.enter_context(session) for session in sessions_of(self.job)]
            for session in self._sessions:  # nothing is rendered until they are closed
                session.keep = len(self._sessions) == 1 and not self.job.options.levels
            while True:
                done = len(certified) / len(order)
                self._set = together, digest = self._together(part(progress, 0.8 * done, 0.8 * done + 0.1))
                failing = []
                pending = [frame for frame in suspects if certified.get(frame) != digest]
                for k, frame in enumerate(pending):
                    low, high = (0.1 + 0.9 * x / len(pending) for x in (k, k + 1))
                    if self._holds(frame, together, digest, part(progress, low, high, f"frame {frame}: ")):
                        certified[frame] = digest
                    else:
                        failing.append(frame)
                for frame in middles(failing, self.frames, self.level):
                    self.level[frame] = self.level.get(frame, 0) + 1
                if not failing and suspects is order:
                    break
                # the others were judged by a set that has grown since
                suspects = failing or order
        for frame in self.frames:
            together.add(self.checked(frame))  # what frames show that no other frame does
        return together

    def states(self, frame: int) -> States:
        """What was found out about a frame, with its entry for the report as its note."""
        states = self.checked(frame)
        entry: dict[str, Any] = {**json.loads(states.note)["entry"], **self._work[frame]}
        if frame in self.level:
            own = self._own(frame, silent)
            entry["needed"] = int((own.state != State.CULLED).sum())
            if len(own.state) == len(states.state):
                states = replace(states, score=own.score, hits=own.hits)
        return replace(states, note=json.dumps(entry))

    @property
    def digest(self) -> str:
        """Of the set that was judged last."""
        return self._set[1]

    def checked(self, frame: int) -> States:
        """The last check of a frame. Another process that begins anew in the same folder may have removed it, or a
        fault have damaged it."""
        states = _read(self.found[frame])
        if states is None:
            self._checks[frame] -= 1
            self._holds(frame, *self._set, silent)
            for session in self._sessions:
                session.close()
            states = load_states(self.found[frame])
        return states

    def _together(self, progress: Progress) -> tuple[ShotSet, str]:
        together = ShotSet()
        for frame in (frame for frame in self.frames if frame in self.level):
            together.add(self._own(frame, part(progress, 0.0, 1.0, f"frame {frame}: ")))
        return together, together.digest

    def _own(self, frame: int, progress: Progress) -> States:
        """What a frame brings into the set."""
        level = self.level[frame]
        if level == WHOLE:
            line = f"frame {frame}: of nothing it is sure that the picture may go without it: all stays"
            self._report.note(self._report.warnings, [line])
            states = self.checked(frame)
            return replace(states, state=np.full(len(states.state), State.ACTIVE, np.uint8), faces={}, levels={})
        from ....core.culling import union

        decide = deciding(union.propose if level == PROPOSED else union.decide_closer)
        path = self.job.analysis(frame, _KINDS[level])
        return self._kept(path, frame, lambda: self._decided(frame, decide, progress), lambda _note: True)

    def _holds(self, frame: int, together: ShotSet, digest: str, progress: Progress) -> bool:
        """Whether a set keeps the budget in a frame; what else was found out is then at `found`."""
        earlier = self._checks[frame]
        self._checks[frame] += 1
        self.found[frame] = path = self.job.analysis(frame, f"checked{earlier}")

        def made() -> Decided:
            held: list[bool] = []
            decided = self._decided(frame, judging(together, earlier, held, frame in self.level), progress)
            active, _ = together.found(decided.keys)
            untouched = roles.untouched(decided.keys)
            active |= False if untouched is None else untouched
            shown = set(np.array(decided.names)[np.unique(decided.records["object"][active])].tolist())
            rows = together.faces_of(decided.keys, active)
            faces = {decided.names[decided.records["object"][row]]: mask for row, mask in rows.items()}
            levels = {name: level for name, level in together.levels.items() if name in shown}
            state = np.where(active, State.ACTIVE, State.CULLED).astype(np.uint8)
            entry = {"entry": decided.entry, "set": digest, "holds": all(held)}
            return replace(decided, state=state, faces=faces, levels=levels, entry=entry)

        states = self._kept(path, frame, made, lambda note: note.get("set") == digest)
        return bool(json.loads(states.note)["holds"])

    def _decided(self, frame: int, decide: Decide, progress: Progress) -> Decided:
        check(self._cancelled)
        decided = decide_layers(self._sessions, frame, False, progress, self._cancelled, decide)
        self._report.add_memory(decided.memory())
        self._report.note(self._report.approximated, decided.approximated)
        self._report.note(self._report.warnings, decided.warnings)
        self._report.write(self.job.folder)
        return decided

    def _kept(
        self, path: Path, frame: int, made: Callable[[], Decided], fits: Callable[[dict[str, Any]], bool]
    ) -> States:
        """What a file holds that this process or another has written, where it fits; else it is made, and kept."""
        states = _read(path)
        if states is None or not fits(json.loads(states.note)):
            decided = made()
            with alone(self.job.folder):
                if not is_whole(path) or states is not None:
                    decided.save(path, json.dumps(decided.entry, default=float))
            states = load_states(path)
        entry = json.loads(states.note)
        self._add_work(path, frame, entry.get("entry", entry))
        return states

    def _add_work(self, path: Path, frame: int, entry: dict[str, Any]) -> None:
        if path in self._counted:
            return
        self._counted.add(path)
        sums = self._work.setdefault(frame, {})
        for name, value in entry.items():
            if name in WORK or name.endswith("_s"):
                sums[name] = sums.get(name, 0) + value


def _read(path: Path) -> States | None:
    try:
        return load_states(path) if is_whole(path) else None
    except UNREADABLE:
        return None
