"""Are the faces of meshes still the ones that were analysed? They are culled by their numbers, and an edit may number
them anew."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable

import bpy
import numpy as np


def digests_of(uids: Iterable[int]) -> dict[int, bytes]:
    """By session uid, of those objects that have a mesh, a digest of which corners make its faces, before modifiers:
    what sculpting and moving leave as it is."""
    wanted = set(uids)
    found = (ob for ob in bpy.data.objects if ob.session_uid in wanted and ob.type == "MESH") if wanted else ()
    return {ob.session_uid: _digest(ob.data) for ob in found}


def _digest(mesh: bpy.types.Mesh) -> bytes:
    digest = hashlib.blake2b(digest_size=16)
    for items, name in ((mesh.loops, "vertex_index"), (mesh.polygons, "loop_start")):
        values = np.empty(len(items), np.int32)
        items.foreach_get(name, values)
        digest.update(str(len(values)).encode())
        digest.update(values)
    return digest.digest()
