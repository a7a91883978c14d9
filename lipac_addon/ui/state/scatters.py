"""Are the scatters of geometry nodes still the ones that were analysed? Their instances are found again by number, and
an edit may number them anew."""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Iterable

import bpy
import numpy as np

from ....core.arrays import F32, I32


class Print:
    """The rows of a scatter as they were read, to be told from others by `digest`.

    distinct: whether no two have the same id.
    """

    def __init__(self, transforms: F32, references: I32, ids: I32 | None) -> None:
        """transforms: (16 R,); references: (R,) what the rows refer to; ids: (R,), None where they have none."""
        self.distinct = ids is None or not (np.diff(np.sort(ids)) == 0).any()
        self._rows: tuple[F32, I32] | None = (transforms, references)
        self._digest = b""

    @property
    def digest(self) -> bytes:
        """Computed when it is first asked for, by any thread: for a hundred thousand rows that takes longer than to
        read them."""
        rows = self._rows
        if rows is not None:
            digest = hashlib.blake2b(str(len(rows[1])).encode(), digest_size=16)
            if len(rows[1]):
                digest.update(rows[0])
                digest.update(rows[1])
            self._digest = digest.digest()
            self._rows = None  # after the digest, which another thread may ask for meanwhile
        return self._digest


# By session uid, of scatters that live culling has masked: the print now (None: not taken yet), and that in full
stand_ins: dict[int, tuple[Print | None, Print]] = {}


def digest_all() -> None:
    """Have the prints of masked scatters hold no rows any more."""
    for now, full in list(stand_ins.values()):
        if now is not None:
            now.digest  # noqa: B018
        full.digest  # noqa: B018


def prints_of(scene: bpy.types.Scene, uids: Iterable[int]) -> dict[int, bytes]:
    """By session uid of those objects that the viewport shows at the scene's frame, a digest of their rows: transforms,
    and what they refer to.

    Taken from the viewport's graph, which costs nothing to evaluate. Render and viewport may scatter differently; but
    what an edit changes, it changes in both.
    """
    found: dict[int, bytes] = {}
    wanted = set(uids)
    for layer in scene.view_layers:
        graph = layer.depsgraph
        if graph is None or not wanted or graph.scene_eval.frame_current != scene.frame_current:
            continue
        if threading.current_thread() is threading.main_thread():  # not in a render, which runs beside it
            layer.update()
        for ob in [ob for ob in layer.objects if ob.session_uid in wanted]:
            evaluated = ob.evaluated_get(graph)
            if evaluated.is_evaluated and ob.visible_get(view_layer=layer):
                found[ob.session_uid] = _as_in_full(ob.session_uid, _print(evaluated.evaluated_geometry()))
                wanted.discard(ob.session_uid)
    return found


def print_of(ob: bpy.types.Object, graph: bpy.types.Depsgraph) -> Print:
    """The print of an object of a graph that shows it, as it is."""
    return _print(ob.evaluated_get(graph).evaluated_geometry())


def _as_in_full(uid: int, now: Print) -> bytes:
    masked, full = stand_ins.get(uid, (None, now))
    return full.digest if masked is not None and now.digest == masked.digest else now.digest


def _print(geometry: bpy.types.GeometrySet) -> Print:
    cloud = geometry.instances_pointcloud()
    count = 0 if cloud is None else len(cloud.points)
    transforms, references = np.empty(16 * count, np.float32), np.empty(count, np.int32)
    ids = None
    if cloud is not None and count:
        cloud.attributes["instance_transform"].data.foreach_get("value", transforms)
        cloud.attributes[".reference_index"].data.foreach_get("value", references)
        if "id" in cloud.attributes:
            ids = np.empty(count, np.int32)
            cloud.attributes["id"].data.foreach_get("value", ids)
    return Print(transforms, references, ids)
