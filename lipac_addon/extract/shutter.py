"""What an exposure sees with motion blur: the camera over the time that the shutter is open, and whether anything else
moves meanwhile."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from itertools import pairwise, product
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix
from numpy.typing import NDArray

from ...core.arrays import F64, Records
from ...core.feedback.tiles import COLUMNS
from ...core.scene.model import Camera, Film, Scene
from ..keys import Keys, full_name, packed
from .camera import extract_camera
from .materials.reader import WORTHLESS

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
    """What passes during an exposure where none of the moments that are looked at finds it: it stays, and what it does
    there to others is said to be left out."""

    def __init__(self) -> None:
        self._seen: list[tuple[float, Records, Scene]] = []

    def add(self, at: float, keys: Keys, scene: Scene) -> None:
        """Take in a moment: so many frames after the frame, where its instances are."""
        self._seen.append((at, keys.records, scene))

    def found(self) -> list[Records]:
        """Records of KEY of instances that move by more than their own size from one moment to the next, and of those
        larger than a tile that turn so far: wheels."""
        out = []
        moments = sorted(self._seen, key=lambda moment: moment[0])
        for (_, records, before), (_, others, after) in pairwise(moments):
            _, i, j = np.intersect1d(packed(records), packed(others), return_indices=True)
            a, b = (
                scene.instances.bounds[rows] + scene.origin[None, None] for scene, rows in ((before, i), (after, j))
            )
            size = (a[:, 1] - a[:, 0]).max(axis=1)
            way = np.maximum(b[:, 0] - a[:, 1], a[:, 0] - b[:, 1]).max(axis=1)
            far = way > size
            large = np.flatnonzero(~far & (size > _tile(before.camera, a - before.origin[None, None])))
            far[large] = _turned(before, i[large], after, j[large]) > size[large]
            out.append(records[i[far]])
        return out


def _tile(camera: Camera, boxes: F64) -> F64:
    """(n,) how wide a tile of the picture is at the nearest point of boxes, (n, 2, 3) relative to the scene's
    origin."""
    place = camera.to_world[:, 3]
    distance = np.linalg.norm(np.clip(place, boxes[:, 0], boxes[:, 1]) - place, axis=1)
    width = float(abs(camera.frame[1] - camera.frame[0])) / COLUMNS
    return np.full_like(distance, width) if camera.orthographic else width * distance


def in_between(count: int) -> str:
    """A line for so many instances that are elsewhere between the moments that are looked at."""
    return (
        f"motion blur: what {count} instance{'s' if count > 1 else ''} that move{'' if count > 1 else 's'} far while "
        f"the shutter is open hide{'' if count > 1 else 's'}, light{'' if count > 1 else 's'} or "
        f"shade{'' if count > 1 else 's'} between the moments that were looked at {WORTHLESS}"
    )


def _turned(before: Scene, i: NDArray[np.int64], after: Scene, j: NDArray[np.int64]) -> F64:
    """(n,) how far corners of the boxes of meshes move at most about their centres, as rows i of a scene become rows j
    of another."""
    box = before.mesh_bounds[before.instances.mesh[i]].astype(np.float64)
    half = np.maximum((box[:, 1] - box[:, 0]) / 2, 0.0)
    step = after.instances.transform[j, :, :3].astype(np.float64) - before.instances.transform[i, :, :3]
    ways = [np.einsum("nij,nj->ni", step, half * signs) for signs in product((-1.0, 1.0), repeat=3)]
    return np.asarray(np.max([np.linalg.norm(way, axis=1) for way in ways], axis=0))


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
