"""Emptying: objects that only culled instances show lose their data and modifiers in renders, hence their meshes,
materials and images.

Modifiers are switched off for renders. The data is replaced by a stand-in of the same kind with nothing in it, and as
many material slots. What was there is kept by a pointer of the object, so it stays in the file, and is put back where
nobody has put something else.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import bpy

from ..coarsening import is_animated
from . import marks
from .form import is_edited, is_sealed, unseal

NAME = "LiPaC stand-in"
_STAND_IN = "stand-in"  # the mark of these
LEVEL = "level"  # and of simplified meshes (`levels`)
EDITED_LEVEL = "LiPaC edited level"  # what the user has edited of one stays in the file by this name
_KEPT = "lipac_kept"  # the custom property that points to the data
_CURVES = {"CURVE", "SURFACE", "FONT"}


def can_be_emptied(ob: bpy.types.Object) -> bool:
    """Whether an object is of a kind that can be emptied, and Blender keeps that."""
    return ob.type in {"MESH", *_CURVES} and ob.mode == "OBJECT" and ob.library is None and ob.override_library is None


def words(ob: bpy.types.Object) -> Iterator[str]:
    """What an object that is to be emptied is marked by."""
    yield marks.EMPTIED
    for modifier in ob.modifiers:
        if _is_free(ob, modifier):
            yield f"{marks.MODIFIER}{modifier.persistent_uid}"


def empty(objects: Iterable[bpy.types.Object]) -> None:
    """Empty objects, which have been marked."""
    stand_ins: dict[tuple[str, int], bpy.types.ID] = {}
    for ob in objects:
        for modifier in ob.modifiers:
            if _is_free(ob, modifier):
                modifier.show_render = False
        if _is_exchangeable(ob):
            kind = ob.type, len(ob.data.materials)
            if kind not in stand_ins:
                stand_ins[kind] = _new(*kind)
            exchange(ob, stand_ins[kind])


def fill_all() -> bool:
    """Put back what objects had whose data were exchanged, and remove what they had meanwhile; True where there was
    something. Modifiers have marks."""
    # Blender exchanges no data in Edit Mode: the next call does
    emptied = [ob for ob in bpy.data.objects if _KEPT in ob and (ob.mode == "OBJECT" or not _is_stand_in(ob.data))]
    for ob in emptied:
        data = ob[_KEPT]
        if (
            isinstance(data, bpy.types.ID)
            and ob.data is not None
            and (ob.data.library is None or ob.library is not None or ob.override_library is not None)
            and _is_stand_in(ob.data)
            and type(data) is type(ob.data)
        ):
            ob.data = data
        del ob[_KEPT]
    unused = [
        block
        for kind in (bpy.data.meshes, bpy.data.curves)
        for block in kind
        if block.library is None and _is_stand_in(block) and not block.users
    ]
    for edited in [block for block in unused if isinstance(block, bpy.types.Mesh) and is_edited(block)]:
        unused.remove(edited)
        edited.name, edited.use_fake_user = EDITED_LEVEL, True
        unseal(edited)
        del edited[marks.KEY]
    if unused:
        bpy.data.batch_remove(unused)
    return bool(emptied or unused)


def drop_kept() -> None:
    """Let go of what emptied objects had: nothing puts it back any more."""
    for ob in bpy.data.objects:
        if _KEPT in ob:
            del ob[_KEPT]


def exchange(ob: bpy.types.Object, stand_in: bpy.types.ID) -> None:
    """Give an object other data; what it had is kept."""
    ob[_KEPT] = ob.data
    ob.data = stand_in


def _is_exchangeable(ob: bpy.types.Object) -> bool:
    """Whether data can be exchanged, put back without a trace, and cost nothing meanwhile: not where something of the
    object's own goes by what is in it, nor where the object has materials of its own, to which a pointer would load
    their images."""
    if (
        ob.particle_systems
        or any(m.type == "MULTIRES" for m in ob.modifiers)
        or getattr(ob.data, "shape_keys", None) is not None
    ):
        return False
    return ob.data is not None and not any(
        slot.link == "OBJECT" and slot.material is not None for slot in ob.material_slots
    )


def _is_free(ob: bpy.types.Object, modifier: bpy.types.Modifier) -> bool:
    """Whether a modifier can be switched off for renders, and stays so."""
    return modifier.show_render and not is_animated(
        ob, f'modifiers["{bpy.utils.escape_identifier(modifier.name)}"].show_render'
    )


def _new(kind: str, slots: int) -> bpy.types.ID:
    with marks.making() as made:
        made.append(data := bpy.data.meshes.new(NAME) if kind == "MESH" else bpy.data.curves.new(NAME, kind))
        data[marks.KEY] = _STAND_IN
        if isinstance(data, bpy.types.TextCurve):
            data.body = ""
        for _ in range(slots):
            data.materials.append(None)
    return data


def _is_stand_in(data: bpy.types.ID) -> bool:
    """Whether data bears our mark, and is what we make: anyone can copy a mark."""
    if data.get(marks.KEY) == LEVEL:
        return isinstance(data, bpy.types.Mesh) and (is_sealed(data) or len(data.loops) == 3 * len(data.polygons))
    if data.get(marks.KEY) != _STAND_IN:
        return False
    return (
        not data.vertices
        if isinstance(data, bpy.types.Mesh)
        else not data.splines and getattr(data, "body", "") in ("", "Text")
    )
