"""What an exposure sees with motion blur: the camera over the time that the shutter is open, and whether anything else
moves meanwhile."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from itertools import pairwise
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix
from numpy.typing import NDArray

from ...core.arrays import F64, Records
from ...core.scene.model import Camera, Film, Scene
from ..keys import Keys, full_name, packed
from .camera import extract_camera

CAMERAS = 64  # of an exposure: a path takes one of them
OPENS = {"START": 0.0, "CENTER": -0.5, "END": -1.0}  # when the shutter opens, in its own time after the frame
UNSEEN = {"CAMERA", "ARMATURE", "LATTICE", "SPEAKER"}  # what moves of these alone moves nothing that shows


@dataclass(frozen=True)
class Shutter:
    """cameras: in world space, over the exposure, none where it stands still. moments: frames after this one, at which
    other things are elsewhere. rolling: rows of the picture have moments of their own."""

    cameras: tuple[Camera, ...] = ()
    moments: tuple[float, ...] = ()
    rolling: bool = False


def exposure(scene: Any, layer: Any = None) -> tuple[float, float] | None:
    """When the shutter opens and closes, in frames after the frame; None without motion blur, which a view layer may
    switch off."""
    render = scene.render
    off = not getattr(layer, "use_motion_blur", True)
    if off or not render.use_motion_blur or render.motion_blur_shutter <= 0:
        return None
    first = OPENS[render.motion_blur_position] * render.motion_blur_shutter
    return first, first + render.motion_blur_shutter


def read_shutter(depsgraph: Any, film: Film, at: Callable[[float], None]) -> Shutter:
    """The exposure of a frame. at: evaluates the graph so many frames after it; it is called with 0 at last. Raises as
    `extract_camera`.

    Cameras lie between those at the steps that Cycles evaluates, as Cycles places them: 2 to the power of the camera's
    motion steps, and one.
    """
    scene = depsgraph.scene_eval
    times = exposure(scene, depsgraph.view_layer_eval)
    if times is None or scene.camera is None or scene.camera.type != "CAMERA":
        return Shutter()
    name, settings = scene.camera.name_full, getattr(scene.camera, "cycles", None)
    steps = (1 << (settings.motion_steps if settings is not None else 1)) + 1
    keys, moved = [], False
    try:
        for time in np.linspace(*times, steps).tolist():
            at(time)
            moved |= any(_shows(update) for update in depsgraph.updates)
            item = depsgraph.scene_eval.camera
            if item is not None and item.name_full == name:
                keys.append(extract_camera(item, depsgraph.scene_eval, film))
    finally:
        at(0.0)
    moments = tuple(time for time in (times[0], sum(times) / 2, times[1]) if time != 0.0) if moved else ()
    rolling = getattr(getattr(scene, "cycles", None), "rolling_shutter_type", "NONE") != "NONE"
    cameras = between(keys, CAMERAS)
    return Shutter(cameras, moments, rolling and (moved or len(cameras) > 0))


class Passing:
    """What passes during an exposure where none of the moments that are looked at finds it: it stays."""

    def __init__(self) -> None:
        self._seen: list[tuple[float, Records, F64]] = []

    def add(self, at: float, keys: Keys, scene: Scene) -> None:
        """Take in a moment: so many frames after the frame, where its instances are."""
        self._seen.append((at, keys.records, scene.instances.bounds + scene.origin[None, None]))

    def found(self) -> list[Records]:
        """Records of KEY of instances that move by more than their own size from one moment to the next."""
        out = []
        moments = sorted(self._seen, key=lambda moment: moment[0])
        for (_, records, before), (_, others, after) in pairwise(moments):
            _, i, j = np.intersect1d(packed(records), packed(others), return_indices=True)
            a, b = before[i], after[j]
            gap = np.maximum(b[:, 0] - a[:, 1], a[:, 0] - b[:, 1]).max(axis=1)
            out.append(records[i[gap > (a[:, 1] - a[:, 0]).max(axis=1)]])
        return out


def of_more_steps(keys: Keys) -> NDArray[np.bool_]:
    """(names,) bool: objects of the open file that Cycles moves along more places than those that are looked at."""
    blurred = (ob for ob in bpy.data.objects if getattr(ob, "cycles", None) is not None and ob.cycles.use_motion_blur)
    names = {full_name(ob) for ob in blurred if ob.cycles.motion_steps > 1 and ob.type not in UNSEEN}
    return np.array([name in names for name in keys.names], bool)


def _shows(update: Any) -> bool:
    """Whether an update of a graph says that something moves that shows."""
    if not (update.is_updated_transform or update.is_updated_geometry):
        return False
    item = update.id
    kind = getattr(item, "type", None) if item.id_type == "OBJECT" else None
    return kind is not None and kind not in UNSEEN and not (kind == "EMPTY" and item.instance_type == "NONE")


def between(keys: Sequence[Camera], count: int) -> tuple[Camera, ...]:
    """So many cameras at evenly spaced moments of a motion that evenly spaced keys describe; none where all keys are
    the same."""
    if len(keys) < 2 or all(same_camera(camera, keys[0]) for camera in keys[1:]):
        return ()
    out = []
    for x in (np.arange(count) + 0.5) / count * (len(keys) - 1):
        k = min(int(x), len(keys) - 2)
        out.append(_blend(keys[k], keys[k + 1], float(x) - k))
    return tuple(out)


def same_camera(a: Camera, b: Camera) -> bool:
    """Whether two cameras see the same."""
    return all(np.array_equal(getattr(a, field.name), getattr(b, field.name)) for field in fields(Camera))


def _blend(a: Camera, b: Camera, t: float) -> Camera:
    """A camera between two: turned by the shortest way, all else in proportion."""
    turn = _rotation(a).slerp(_rotation(b), t).to_matrix()
    to_world = np.column_stack((np.array(turn, np.float64), (1 - t) * a.to_world[:, 3] + t * b.to_world[:, 3]))
    numbers = {
        name: (1 - t) * getattr(a, name) + t * getattr(b, name)
        for name in ("frame", "aperture", "focus", "clip_start", "clip_end")
    }
    return replace(a, to_world=to_world, **numbers)


def _rotation(camera: Camera) -> Any:
    return Matrix(camera.to_world[:, :3].tolist()).to_quaternion()
