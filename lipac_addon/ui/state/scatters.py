"""Are the scatters of geometry nodes still the ones that were analysed? Their instances are found again by number, and
an edit may number them anew."""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Iterable

import bpy
import numpy as np

# By session uid, of scatters that live culling has masked: the print now, and that in full
stand_ins: dict[int, tuple[bytes, bytes]] = {}


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


def print_of(ob: bpy.types.Object, graph: bpy.types.Depsgraph) -> bytes:
    """The digest of an object of a graph that shows it, as it is."""
    return _print(ob.evaluated_get(graph).evaluated_geometry())


def _as_in_full(uid: int, now: bytes) -> bytes:
    masked, full = stand_ins.get(uid, (b"", b""))
    return full if now == masked else now


def _print(geometry: bpy.types.GeometrySet) -> bytes:
    cloud = geometry.instances_pointcloud()
    count = 0 if cloud is None else len(cloud.points)
    digest = hashlib.blake2b(str(count).encode(), digest_size=16)
    if cloud is not None and count:
        transforms, references = np.empty(16 * count, np.float32), np.empty(count, np.int32)
        cloud.attributes["instance_transform"].data.foreach_get("value", transforms)
        cloud.attributes[".reference_index"].data.foreach_get("value", references)
        digest.update(transforms)
        digest.update(references)
    return digest.digest()
