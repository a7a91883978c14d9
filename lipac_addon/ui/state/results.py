"""What analyses found, per scene and frame: plain arrays that outlive undo, renaming and deletion in the file."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import bpy
import numpy as np

from ... import roles
from ...keys import Keys, full_name
from ...writeback.levels import levels_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from ....core.arrays import F32, F64, I64, U8
    from ....core.culling.result import CullingResult
    from ....core.files.level import AnyLevel
    from ....core.files.memory_table import MemoryRow
    from ...batch.shots.shot_set import ShotSet
    from ...extract import Extraction

RAYS = ("camera", "diffuse", "glossy", "transmission", "shadow")
CULLED, PENDING, ACTIVE = 0, 1, 2  # core.culling.options.State, without loading the engine


@dataclass(frozen=True)
class Reason:
    """Why an object's instances stay or go.

    instances, kept: how many; paths: (RAY_TYPES,) light paths that met them, by type of ray; worth: share of the
    picture that they may be worth together.
    """

    instances: int
    kept: int
    paths: I64
    worth: float


@dataclass(frozen=True)
class Taken:
    """Bytes that Blender is predicted to take while it renders a frame: in full, culled, and culled at most. process:
    of these, before it renders."""

    full: int
    culled: int
    most: int
    process: int = 0

    def after(self, process: int) -> Taken:
        """Where it takes so many bytes before it renders."""
        more = process - self.process
        return Taken(self.full + more, self.culled + more, self.most + more, process)


@dataclass(frozen=True, eq=False)
class FrameResult:
    """The analysis of a frame.

    keys: of its N instances; uids: (names,) int64, the session uid of each of `keys.names`, -1 for what was none of the
    file's objects.
    state: (N,) uint8; score: (N,) float32; hits: (N, RAY_TYPES) int64; bounds: (N, 2, 3), regions: (H, 2, 3) float32
    boxes, `origin` (3,) float64 to be added. stats: figures as in report.json. warnings: lines for the user. Of objects
    that instance by geometry nodes, by their uids: scatters, (R, 3) float32, where their rows are, in their own space;
    prints: digests of what the viewport showed of them. By the uids of objects that stay in part: faces, (F,) bool,
    those that do; shapes: digests as of `topology`. By the uids of objects: levels, what takes the place of their mesh,
    or of levels of its subdivision; forms: digests as of `topology`. memory: who takes the memory of a render, as of
    memory.csv; taken: bytes of it.
    tiles: (TILES,) float32, by how much each tile of the picture changes at most, where that is certified. futile: why
    culling can save less of a render than the analysis took, "" where it may save more, or that is not known.
    """

    frame: int
    keys: Keys
    uids: I64
    state: U8
    score: F32
    hits: I64
    bounds: F32
    regions: F32
    origin: F64
    stats: dict[str, float | int]
    warnings: tuple[str, ...]
    scatters: dict[int, F32] = field(default_factory=dict)
    prints: dict[int, bytes] = field(default_factory=dict)
    faces: dict[int, NDArray[np.bool_]] = field(default_factory=dict)
    shapes: dict[int, bytes] = field(default_factory=dict)
    levels: dict[int, AnyLevel] = field(default_factory=dict)
    forms: dict[int, bytes] = field(default_factory=dict)
    memory: tuple[MemoryRow, ...] = ()
    taken: Taken | None = None
    tiles: F32 | None = None
    futile: str = ""
    _reasons: dict[str, Reason] = field(default_factory=dict)

    @staticmethod
    def of(
        frame: int, extraction: Extraction, uids: I64, result: CullingResult, pinned: NDArray[np.bool_] | None = None
    ) -> FrameResult:
        """Put together what extraction and analysis gave. pinned: (N,) bool, instances that renders show whatever the
        analysis had no memory for."""
        scene, keys = extraction.scene, extraction.keys
        lines = (*extraction.warnings, *getattr(result, "warnings", ()), *scene.approximated)
        bounds, state, stats = scene.instances.bounds, result.state, result.stats
        if pinned is not None and (state[pinned] == CULLED).any():
            state = np.where(pinned & (state == CULLED), np.uint8(ACTIVE), state)
            stats = stats | {"active": int((state == ACTIVE).sum()), "culled": int((state == CULLED).sum())}
        uid_of = dict(zip(keys.names, uids.tolist(), strict=True))
        scatters = {
            uid_of[name]: rows.copy() for name, rows in extraction.scatters.items() if uid_of.get(name, -1) >= 0
        }
        shown = {row: int(uids[keys.records["object"][row]]) for row in getattr(result, "faces", {})}
        faces = {uid: result.faces[row] for row, uid in shown.items() if uid >= 0}
        named = levels_of(extraction, result) if getattr(result, "stand_ins", None) else {}
        levels = {uid_of[name]: level for name, level in named.items() if uid_of.get(name, -1) >= 0}
        return FrameResult(
            frame,
            keys,
            uids,
            state,
            result.score,
            result.hits,
            bounds,
            result.boxes,
            scene.origin,
            stats,
            lines,
            scatters,
            faces=faces,
            levels=levels,
            tiles=getattr(result, "tiles", None),
        )

    @property
    def culled(self) -> NDArray[np.bool_]:
        """(N,) bool: the instances that go."""
        return np.asarray(self.state == CULLED)

    def find(self, name: str) -> bpy.types.Object | None:
        """The object that had a full name in the analysis; None where it is gone."""
        uid = dict(zip(self.keys.names, self.uids.tolist(), strict=True)).get(name, -1)
        return next((ob for ob in bpy.data.objects if ob.session_uid == uid), None)

    def current_keys(self) -> Keys:
        """The keys with the names that the objects have now; deleted ones get a name that none has."""
        now = {ob.session_uid: full_name(ob) for ob in bpy.data.objects}
        names = tuple(now.get(int(uid), "") for uid in self.uids)
        return replace(self.keys, names=names)

    def of_objects(self, objects: set[bpy.types.Object]) -> NDArray[np.bool_]:
        """(N,) bool: the instances that show one of some objects, or are made by one."""
        return roles.instances_of(self.keys, among(self.uids, objects))

    def reason(self, ob: bpy.types.Object) -> Reason:
        """What was found about the instances that show an object or are made by it."""
        key = str(ob.session_uid)
        if key not in self._reasons:
            mine = self.of_objects({ob})
            worth = float(self.score[mine].sum()) if "calibrated_mean" in self.stats else 0.0
            self._reasons[key] = Reason(
                int(mine.sum()), int((mine & ~self.culled).sum()), self.hits[mine].sum(axis=0), worth
            )
        return self._reasons[key]


@dataclass(frozen=True)
class Difference:
    """Seconds and peak bytes of the full and of the culled render; mean, worst: relative change of the picture's coarse
    tiles, noise included."""

    seconds: tuple[float, float]
    peak_bytes: tuple[int, int]
    mean: float
    worst: float


def among(uids: I64, objects: Collection[bpy.types.Object]) -> NDArray[np.bool_]:
    """(names,) bool: which session uids are those of some objects."""
    return np.isin(uids, np.fromiter((ob.session_uid for ob in objects), np.int64, len(objects)))


def session_uids(keys: Keys) -> I64:
    """(names,) int64 session uids of the objects that keys name; -1 where the file has none."""
    now = {full_name(ob): ob.session_uid for ob in bpy.data.objects}
    return np.array([now.get(name, -1) for name in keys.names], np.int64)


# What is known of the open file, by the scene's session uid

_results: dict[int, dict[int, FrameResult]] = {}
differences: dict[tuple[int, int], Difference] = {}  # what was measured, by scene and frame
live: dict[int, FrameResult] = {}  # what live mode shows
frozen: dict[int, FrameResult] = {}  # what the overlay keeps showing


def put(scene: bpy.types.Scene, frames: dict[int, FrameResult]) -> None:
    """Take the place of what earlier analyses of the scene found."""
    _results[scene.session_uid] = frames
    for key in [key for key in differences if key[0] == scene.session_uid]:
        del differences[key]


def of(scene: bpy.types.Scene) -> dict[int, FrameResult]:
    """Results of a scene by frame, empty where it was not analysed."""
    return _results.get(scene.session_uid, {})


def at(scene: bpy.types.Scene) -> FrameResult | None:
    """The result for the scene's current frame."""
    return of(scene).get(scene.frame_current)


def union(frames: Collection[FrameResult]) -> FrameResult:
    """One set for all frames: what any of them keeps. Where instances are and what met them is of no frame, so it is
    left out."""
    shot = shot_set(frames)
    # names may change from frame to frame
    name_of = {tag: name for frame in frames for tag, name in zip(_tags(frame), frame.keys.names, strict=True)}
    uids = np.array([int(tag.split()[0]) for tag in shot.keys.names], np.int64)
    state = np.where(shot.active, np.uint8(ACTIVE), np.uint8(CULLED))
    nothing, boxes = np.zeros(0, np.float32), np.zeros((0, 2, 3), np.float32)
    last = next(reversed(list(frames)))
    keys = Keys(shot.keys.records, tuple(name_of[tag] for tag in shot.keys.names))
    faces = {int(tag.split()[0]): mask for tag, mask in shot.faces.items()}
    levels = {int(tag.split()[0]): level for tag, level in shot.levels.items()}
    shapes, forms = (
        {uid: digest for frame in frames for uid, digest in getattr(frame, name).items()}
        for name in ("shapes", "forms")
    )
    return FrameResult(
        last.frame,
        keys,
        uids,
        state,
        nothing,
        np.zeros((0, len(RAYS)), np.int64),
        boxes,
        boxes,
        last.origin,
        {},
        (),
        faces=faces,
        shapes=shapes,
        levels=levels,
        forms=forms,
    )


def shot_set(frames: Iterable[FrameResult]) -> ShotSet:
    """What any of the frames keeps, by keys whose names are as of `tagged`."""
    from ....core.files.report import States
    from ...batch.shots.shot_set import ShotSet

    shot = ShotSet()
    for frame in frames:
        columns = {name: frame.keys.records[name] for name in ("kind", "host", "object", "path")}
        faces = {str(uid): mask for uid, mask in frame.faces.items()}
        levels = {str(uid): level for uid, level in frame.levels.items()}
        shot.add(States(frame.state, frame.score, frame.hits, columns, _tags(frame), faces=faces, levels=levels))
    return shot


def tagged(keys: Keys, uids: I64) -> Keys:
    """Keys whose names are session uids, which outlive renaming."""
    tags = (str(uid) if uid >= 0 else f"-1 {name}" for uid, name in zip(uids.tolist(), keys.names, strict=True))
    return replace(keys, names=tuple(tags))


def _tags(frame: FrameResult) -> tuple[str, ...]:
    return tagged(frame.keys, frame.uids).names


def shown(scene: bpy.types.Scene) -> FrameResult | None:
    """What the panel and the overlay show: what live mode found last, where it is on, else the result for the current
    frame."""
    return live.get(scene.session_uid) or at(scene)


def freeze(scene: bpy.types.Scene, on: bool) -> None:
    """Have the overlay keep showing what it shows now, or no longer."""
    frozen.pop(scene.session_uid, None)
    result = shown(scene)
    if on and result is not None:
        frozen[scene.session_uid] = result


def clear() -> None:
    """Forget all."""
    for known in (_results, differences, live, frozen):
        known.clear()
