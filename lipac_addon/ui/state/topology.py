"""Are meshes still the ones that were analysed? Faces are culled by their numbers, and an edit may number them anew;
and what takes the place of a mesh, or of levels of its subdivision, was judged for the form that it had."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator
from contextlib import suppress
from typing import Any

import bpy
import numpy as np

from ...coarsening import is_animated

_PLAIN = {"BOOLEAN", "INT", "FLOAT", "ENUM", "STRING"}
# of modifiers and data: what no render looks at
_UNSEEN = {"name", "show_viewport", "show_in_editmode", "show_on_cage", "show_expanded", "is_active", "use_pin_to_last"}
_UNSEEN |= {"levels", "sculpt_levels", "tag", "use_fake_user", "use_extra_user"}


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


def forms_of(uids: Iterable[int]) -> dict[int, bytes]:
    """By session uid, of objects with a mesh, a curve or a text, a digest of what gives them their form: their data
    before modifiers, positions included, and the modifiers with all settings that nothing animates."""
    wanted = set(uids)
    found = (ob for ob in bpy.data.objects if ob.session_uid in wanted and ob.data is not None) if wanted else ()
    return {ob.session_uid: _form(ob) for ob in found}


def _form(ob: bpy.types.Object) -> bytes:
    digest = hashlib.blake2b(digest_size=16)
    if ob.type == "MESH":
        digest.update(_digest(ob.data))
        points = [(ob.data.vertices, "co", 3)]
    else:
        digest.update(repr([*_settings(ob.data, ob.data, "")]).encode())
        points = [each for spline in getattr(ob.data, "splines", ()) for each in _points(spline)]
    for items, name, width in points:
        values = np.empty(width * len(items), np.float32)
        items.foreach_get(name, values)
        digest.update(str(len(items)).encode())
        digest.update(values)
    for modifier in ob.modifiers:
        path = f'modifiers["{bpy.utils.escape_identifier(modifier.name)}"].'
        digest.update(repr((modifier.type, *_settings(modifier, ob, path))).encode())
    return digest.digest()


def _points(spline: bpy.types.Spline) -> Iterator[tuple[Any, str, int]]:
    """What a spline goes by."""
    yield spline.points, "co", 4
    for name in ("co", "handle_left", "handle_right"):
        yield spline.bezier_points, name, 3


def _settings(owner: Any, block: bpy.types.ID, path: str) -> Iterator[tuple[str, str]]:
    """Settings of a modifier, or of data, that renders look at and nothing animates. block: that it is of, path: where
    it is in that."""
    for prop in owner.bl_rna.properties:
        name = prop.identifier
        if name in _UNSEEN or prop.is_readonly or is_animated(block, path + name):
            continue
        value = getattr(owner, name)
        if prop.type in _PLAIN:
            yield name, str(tuple(value) if getattr(prop, "is_array", False) else value)
        elif prop.type == "POINTER" and isinstance(value, bpy.types.ID):
            yield name, str(value.session_uid)
    with suppress(TypeError):  # of most modifiers, which bear nothing else
        for name in owner.keys():  # noqa: SIM118 (inputs of geometry nodes)
            if isinstance(owner[name], (bool, int, float, str)):
                yield name, str(owner[name])
