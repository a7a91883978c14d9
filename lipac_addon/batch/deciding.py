"""What is decided on a frame, for all its view layers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import bpy
import numpy as np

from ...core.arrays import F32, F64, I64, U8, Records
from ...core.culling.options import State
from ...core.errors import NothingToAnalyse
from ...core.files.level import AnyLevel
from ...core.files.memory_table import MemoryRow
from ...core.files.report import States, save_states
from ...core.progress import Progress, part, silent
from ...core.scene.model import RAY_TYPES
from ..extract import Extraction
from ..extract.graph import GEOMETRY_TYPES
from ..keys import KEY, Keys
from ..memory.rows import NOTHING_KEPT, Weighed
from ..writeback.levels import levels_of
from .enforcing import verified
from .job import Cancel, check, never
from .session import Decide, Session
from .shots.shot_set import ShotSet

if TYPE_CHECKING:
    from ...core.culling.result import CullingResult

# figures that are summed over view layers, as all that end in _s are
SUMS = ("hitboxes", "tlas_bytes", "blas_built", "blas_refitted", "paths", "rays", "iterations", "calibration_paths")


@dataclass(frozen=True)
class Decided:
    """What was decided on a frame, for all its view layers. state (N,), score (N,), hits (N, RAY_TYPES), boxes (H, 2,
    3): as of `CullingResult`, boxes in the world; records, names: its keys; entry: for the report; faces, levels: as of
    `States`; tiles: as of `CullingResult`; weighed: of each view layer."""

    state: U8
    score: F32
    hits: I64
    boxes: F64
    records: Records
    names: tuple[str, ...]
    entry: dict[str, Any]
    approximated: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    faces: Mapping[str, np.ndarray] = field(default_factory=dict)
    tiles: F32 | None = None
    weighed: tuple[Weighed, ...] = ()
    levels: Mapping[str, AnyLevel] = field(default_factory=dict)

    @property
    def keys(self) -> Keys:
        """Of the N instances."""
        return Keys(self.records, self.names)

    def memory(self, removed: np.ndarray | None = None, reasons: Mapping[str, str] = NOTHING_KEPT) -> list[MemoryRow]:
        """Who takes the memory of a render. removed: (N,) bool, what it has not, where that is known; reasons: why
        other things stay although they are culled. Of several view layers each by itself, as it was decided."""
        one = len(self.weighed) == 1
        return [row for layer in self.weighed for row in layer.rows(removed if one else None, reasons)]

    def figures(self, process: int, removed: np.ndarray | None = None) -> dict[str, int]:
        """What the process that renders is predicted to take, for the report; of several view layers the one that takes
        most. process: what it takes before it renders; removed: as of `memory`."""
        one = len(self.weighed) == 1
        found = [layer.figures(process, removed if one else None) for layer in self.weighed]
        return max(found, key=lambda figures: figures["memory_bytes"], default={})

    def save(self, path: Path, note: str = "") -> None:
        """As a file of states."""
        save_states(
            path,
            self.state,
            self.score,
            self.hits,
            self.records,
            self.names,
            note,
            self.boxes,
            self.faces,
            self.tiles,
            self.levels,
        )

    @property
    def states(self) -> States:
        """As they would be read again."""
        keys = {name: self.records[name] for name in ("kind", "host", "object", "path")}
        return States(self.state, self.score, self.hits, keys, self.names, "", self.faces, self.levels)


def decided_of(extraction: Extraction, result: CullingResult, entry: dict[str, Any]) -> Decided:
    """What a result says of the frame that was extracted. entry: what the report has of it so far."""
    scene, keys = extraction.scene, extraction.keys
    boxes = result.boxes + scene.origin
    lines = scene.approximated, (*extraction.warnings, *result.warnings)
    faces = {keys.names[keys.records["object"][row]]: mask for row, mask in result.faces.items()}
    weighed = (Weighed.of(extraction, result, entry["frame"], bpy.context.scene),)
    entry = entry | result.stats
    return Decided(
        result.state,
        result.score,
        result.hits,
        boxes,
        keys.records,
        keys.names,
        entry,
        *lines,
        faces,
        result.tiles,
        weighed,
        levels_of(extraction, result),
    )


def decide_layers(
    sessions: Sequence[Session],
    frame: int,
    last: bool,
    progress: Progress = silent,
    cancelled: Cancel = never,
    decide: Decide | None = None,
) -> Decided:
    """Decide a frame by what each view layer needs: an instance that one of them needs stays. last: as in `run_frame`;
    decide: what each layer is asked, at all moments of the frame, by default which instances stay.

    Where no layer shows anything that light paths can be traced in, nothing is culled. Raises NothingToAnalyse where
    the scene has nothing that another frame could show, either; Cancelled.
    """
    parts, shown = [], dict[str, None]()
    for k, session in enumerate(sessions):
        within = part(
            progress,
            k / len(sessions),
            (k + 1) / len(sessions),
            f"view layer {session.layer}: " if len(sessions) > 1 else "",
        )
        try:
            extraction, entry = session.sync(frame)
        except NothingToAnalyse as error:
            shown |= dict.fromkeys(error.shown)
            continue
        check(cancelled)
        extraction = session.limit_memory(session.expose(extraction, frame, within, cancelled, decide))
        if last:
            session.end_reading()
        check(cancelled)
        ask = decide or Session.decided
        result = ask(session, extraction, within, cancelled)
        check(cancelled)
        if not session.job.engine:
            entry |= verified(session.job, frame, extraction.scene, result.active, silent, cancelled)
        parts.append(decided_of(extraction, result, entry))
        del result  # and what it has built
        if last:
            session.forget()
    if not parts:
        why = NothingToAnalyse([*shown])
        if not shown and not any(ob.type in GEOMETRY_TYPES or ob.is_instancer for ob in bpy.context.scene.objects):
            raise why
        nothing = (
            np.zeros(0, np.uint8),
            np.zeros(0, np.float32),
            np.zeros((0, RAY_TYPES), np.int64),
            np.zeros((0, 2, 3)),
        )
        return Decided(
            *nothing,
            np.zeros(0, KEY),
            (),
            {"frame": frame},
            tuple(shown),
            (f"frame {frame}: {why}; all is rendered",),
        )
    return parts[0] if len(parts) == 1 else _united(parts)


def _united(parts: Sequence[Decided]) -> Decided:
    """What several view layers need of a frame together; what each needs is decided by its own picture."""
    together = ShotSet()
    for one in parts:
        together.add(one.states)
    n = len(together.active)
    state, score, hits = np.zeros(n, np.uint8), np.zeros(n, np.float32), np.zeros((n, RAY_TYPES), np.int64)
    for one in parts:
        rows = together.rows(one.states)
        state[rows], score[rows] = np.maximum(state[rows], one.state), np.maximum(score[rows], one.score)
        hits[rows] += one.hits
    entry: dict[str, Any] = {}
    for name in dict.fromkeys(name for one in parts for name in one.entry):
        values = [one.entry[name] for one in parts if name in one.entry]
        entry[name] = (
            sum(values)
            if name in SUMS or name.endswith("_s")
            else max(values)
            if isinstance(values[0], int | float)
            else values[0]
        )
    if len(tiles_of := [one.entry["verified_tiles"] for one in parts if "verified_tiles" in one.entry]) > 1:
        entry["verified_tiles"] = np.max(tiles_of, axis=0).tolist()
    counts = np.bincount(state, minlength=len(State)).tolist()
    entry |= {
        "instances": n,
        "active": counts[State.ACTIVE],
        "pending": counts[State.PENDING],
        "culled": counts[State.CULLED],
        "view_layers": len(parts),
    }
    lines = [
        tuple(dict.fromkeys(line for one in parts for line in getattr(one, name)))
        for name in ("approximated", "warnings")
    ]
    by_layer = [one.tiles for one in parts if one.tiles is not None]
    tiles: F32 | None = np.asarray(np.max(by_layer, axis=0)) if len(by_layer) == len(parts) else None
    boxes, keys = np.concatenate([one.boxes for one in parts]), together.keys
    weighed = tuple(layer for one in parts for layer in one.weighed)
    names, faces = keys.names, together.faces
    return Decided(state, score, hits, boxes, keys.records, names, entry, lines[0], lines[1], faces, tiles, weighed)
