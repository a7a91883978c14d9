"""What analyses found, per scene and frame: plain arrays that outlive undo, renaming and deletion in the file."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import bpy
import numpy as np

from ..keys import Keys

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from ...core.loop import CullingResult
    from ...core.scene import F32, F64, I64
    from ..extract import Extraction

RAYS = ("camera", "diffuse", "glossy", "transmission", "shadow")


@dataclass(frozen=True)
class Reason:
    """Why an object's instances stay or go. instances, kept: how many; paths: (RAY_TYPES,) light paths that met them, by type of ray."""

    instances: int
    kept: int
    paths: I64


@dataclass(frozen=True, eq=False)
class FrameResult:
    """The analysis of a frame.

    keys: of its N instances; uids: (names,) int64, the session uid of each of `keys.names`, -1 for what was none of the file's objects.
    culled: (N,) bool; hits: (N, RAY_TYPES) int64; bounds: (N, 2, 3), regions: (H, 2, 3) float32 boxes, `origin` (3,) float64 to be added.
    stats: figures as in report.json. warnings: lines for the user.
    """

    frame: int
    keys: Keys
    uids: I64
    culled: NDArray[np.bool_]
    hits: I64
    bounds: F32
    regions: F32
    origin: F64
    stats: dict[str, float | int]
    warnings: tuple[str, ...]
    _reasons: dict[str, Reason] = field(default_factory=dict)

    @staticmethod
    def of(frame: int, extraction: Extraction, uids: I64, result: CullingResult) -> FrameResult:
        """Put together what extraction and analysis gave."""
        scene = extraction.scene
        lines = (*extraction.warnings, *scene.approximated)
        return FrameResult(
            frame, extraction.keys, uids, ~result.active, result.hits, scene.instances.bounds, result.boxes, scene.origin, result.stats, lines
        )

    def current_keys(self) -> Keys:
        """The keys with the names that the objects have now; deleted ones get a name that none has."""
        now = {ob.session_uid: _name(ob) for ob in bpy.data.objects}
        names = tuple(now.get(int(uid), "") for uid in self.uids)
        return replace(self.keys, names=names)

    def of_objects(self, objects: set[bpy.types.Object]) -> NDArray[np.bool_]:
        """(N,) bool: the instances that show one of some objects, or are made by one."""
        chosen = np.isin(self.uids, np.fromiter((ob.session_uid for ob in objects), np.int64, len(objects)))
        return instances_of(self.keys, chosen)

    def reason(self, ob: bpy.types.Object) -> Reason:
        """What was found about the instances that show an object or are made by it."""
        key = str(ob.session_uid)
        if key not in self._reasons:
            mine = self.of_objects({ob})
            self._reasons[key] = Reason(int(mine.sum()), int((mine & ~self.culled).sum()), self.hits[mine].sum(axis=0))
        return self._reasons[key]


def instances_of(keys: Keys, chosen: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(N,) bool: instances whose object or host is among chosen, (names,) bool."""
    table = np.append(chosen, False)  # index -1: no such object
    return table[keys.records["object"]] | table[keys.records["host"]]


def _name(ob: bpy.types.Object) -> str:
    """The name of an object in `Keys`."""
    return ob.name if ob.library is None else f"{ob.library.filepath}\n{ob.name}"


def session_uids(keys: Keys) -> I64:
    """(names,) int64 session uids of the objects that keys name; -1 where the file has none."""
    now = {_name(ob): ob.session_uid for ob in bpy.data.objects}
    return np.array([now.get(name, -1) for name in keys.names], np.int64)


_results: dict[int, dict[int, FrameResult]] = {}


def put(scene: bpy.types.Scene, frames: dict[int, FrameResult]) -> None:
    """Take the place of what earlier analyses of the scene found."""
    _results[scene.session_uid] = frames


def of(scene: bpy.types.Scene) -> dict[int, FrameResult]:
    """Results of a scene by frame, empty where it was not analysed."""
    return _results.get(scene.session_uid, {})


def at(scene: bpy.types.Scene) -> FrameResult | None:
    """The result for the scene's current frame."""
    return of(scene).get(scene.frame_current)


def clear() -> None:
    """Forget all."""
    _results.clear()
