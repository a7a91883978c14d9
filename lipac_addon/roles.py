"""What the user says of objects and collections: whether culling may touch them."""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np
from bpy.props import EnumProperty
from numpy.typing import NDArray

from .keys import Keys, full_name

AUTO, PIN, IGNORE = "AUTO", "PIN", "IGNORE"
ROLES = (
    (AUTO, "Automatic", "The analysis decides", "NONE", 0),
    (PIN, "Pin", "Never cull: the analysis keeps it, whatever its light paths say", "PINNED", 1),
    (IGNORE, "Ignore", "Stay out of it: the analysis sees it, but renders show it as you set it", "GHOST_DISABLED", 2),
)
changes = 0  # how often a role was set: no dependency graph tells
_OWNERS: tuple[Any, ...] = (bpy.types.Object, bpy.types.Collection)


def register() -> None:
    """Put roles on objects and collections: no group of properties, of which Blender saves nothing on a library
    override."""
    for owner in _OWNERS:
        owner.lipac_role = EnumProperty(
            name="Culling",
            description="Whether the analysis may cull this",
            items=ROLES,
            override={"LIBRARY_OVERRIDABLE"},
            update=_changed,
        )


def unregister() -> None:
    """Take them away again."""
    for owner in _OWNERS:
        del owner.lipac_role


def make_known() -> None:
    """Have Blender read roles of files that it opens, where the extension is not enabled: of a library override it
    forgets what it does not know."""
    if not hasattr(bpy.types.Object, "lipac_role"):
        register()


def marked(*wanted: str) -> set[bpy.types.Object]:
    """Objects of the file with one of some roles of their own, or in a collection (at any depth) with one."""
    make_known()
    found = {ob for ob in bpy.data.objects if ob.lipac_role in wanted}
    for collection in (*bpy.data.collections, *(scene.collection for scene in bpy.data.scenes)):
        if collection.lipac_role in wanted:
            found.update(collection.all_objects)
    return found


def instances_of(keys: Keys, chosen: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(N,) bool: instances whose object or host is among chosen, (names,) bool."""
    table = np.append(chosen, False)  # index -1: no such object
    return np.asarray(table[keys.records["object"]] | table[keys.records["host"]])


def untouched(keys: Keys) -> NDArray[np.bool_] | None:
    """(N,) bool: instances that no render without a window may go without, pinned or ignored; None where there are
    none. keys: of a frame of the open file."""
    names = {full_name(ob) for ob in marked(PIN, IGNORE)}
    return instances_of(keys, np.array([name in names for name in keys.names], bool)) if names else None


def _changed(_owner: bpy.types.ID, _context: bpy.types.Context) -> None:
    global changes  # noqa: PLW0603
    changes += 1
