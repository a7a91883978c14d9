"""What a culled file need not carry: objects that are hidden in all frames and that nothing else uses, and the data
that only they use."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..keys import Keys, Kind
from ..writeback.emptying import drop_kept
from ..writeback.marks import EMPTIED, HIDDEN, MODIFIER, all_marks
from ..writeback.plan import Obstacles

# Kept by a fake user alone, these are nothing to a render
_FAKE = (
    "meshes", "curves", "materials", "images", "node_groups", "textures", "armatures", "actions", "objects",
    "collections"
)


def strip() -> int:
    """Remove from the open file what write-back has hidden and nothing else refers to, with its data, and the data of
    what it has emptied; returns how many objects went. Restore does not bring any of it back.

    An object stays where anything but collections and scenes uses it, a constraint, a driver or a child that stays, for
    example; or one of its collections is instanced, or read by nodes, for what these show may go by the places of
    objects in it.
    """
    hidden = {
        ob
        for ob, words in all_marks().items()
        if HIDDEN in words and all(map(_of_itself, words)) and ob.library is None and ob.override_library is None
    }
    going = _unused(hidden)
    bpy.data.batch_remove(going)
    drop_kept()
    _drop_fakes(_FAKE)
    bpy.data.orphans_purge(do_local_ids=True, do_linked_ids=True, do_recursive=True)
    return len(going)


def drop_linked(culled: NDArray[np.bool_], keys: Keys) -> NDArray[np.bool_]:
    """Remove from the open file directly linked objects of which all instances are culled, (N,) bool of `keys`, and
    that nothing else uses: Blender would not save that they are hidden. Returns the instances that went, (N,) bool."""
    obstacles = Obstacles(bpy.context.scene, lasting=False, in_render=False)
    own = np.where(keys.records["kind"] == Kind.OBJECT, keys.records["object"], -1)
    shown = np.zeros(len(keys.names) + 1, bool)  # the last is that of -1
    for name in ("object", "host"):
        shown[keys.records[name][~culled]] = True
    found = {int(n): obstacles.found.get(keys.names[n]) for n in np.unique(own[culled]) if n >= 0 and not shown[n]}
    linked = {ob: n for n, ob in found.items() if ob is not None and ob.library and obstacles.obstacle(ob) is None}
    going = _unused(set(linked))
    gone = np.isin(own, [linked[ob] for ob in going])
    bpy.data.batch_remove(going)
    return gone


def _unused(objects: set[bpy.types.Object]) -> set[bpy.types.Object]:
    """Those that the file does not use but for each other, and by collections that nothing shows or reads."""
    picked = _used_collections()
    users = bpy.data.user_map(subset=objects) if objects else {}
    going = {ob for ob in objects if not picked & set(ob.users_collection)}
    while True:
        staying = {ob for ob in going if not all(_lets_go(user, ob, going) for user in users[ob])}
        if not staying:
            return going
        going -= staying


def _of_itself(word: str) -> bool:
    """Whether a mark speaks of nothing that the object does to others."""
    return word in (HIDDEN, EMPTIED) or word.startswith(MODIFIER)


def _lets_go(user: bpy.types.ID, ob: bpy.types.Object, going: set[bpy.types.Object]) -> bool:
    """Whether a user of an object does not mind that it goes."""
    return (
        (isinstance(user, bpy.types.Collection) and user.library is None)
        or (isinstance(user, bpy.types.Scene) and user.camera != ob)
        or user in going
    )


def _used_collections() -> set[bpy.types.Collection]:
    """Those that something else than scenes and collections uses, and all in these."""
    users: dict[Any, set[bpy.types.ID]] = bpy.data.user_map(subset=bpy.data.collections) if bpy.data.collections else {}
    used = {
        c for c, by in users.items() if any(not isinstance(user, bpy.types.Collection | bpy.types.Scene) for user in by)
    }
    return used | {child for collection in used for child in collection.children_recursive}


def _drop_fakes(kinds: Iterable[str]) -> None:
    for kind in kinds:
        for block in getattr(bpy.data, kind):
            if block.use_fake_user and block.users == 1 and block.library is None:
                block.use_fake_user = False
