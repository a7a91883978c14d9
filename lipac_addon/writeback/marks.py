"""The record of what was hidden: a mark on each touched object, as a custom property.

The mark lives and travels with what it speaks of: it survives saving, loading, a crash, renaming and duplication (a
copy of a hidden object is shown again, too). Blender saves no custom property that is added to a library override: the
marks of these are on an object of our own, which points to them.

A mark is a list of words: `HIDDEN` for the object's own switch, `PARTICLES` and a number for the render switch of the
modifier with that persistent number, `MASKED` for a mask modifier, `EMPTIED` for a source that shows nothing
(`emptying`), `MODIFIER` and a number for its modifiers, `SIMPLIFIED` for one whose mesh is exchanged (`levels`). All
switches were on before, else they are not touched, so the old value needs no storing. Settings by which a render has
fewer triangles (`coarsening`) are marked by `COARSER`, the number of the modifier or `DATA`, what they were, and what
they are. A word that fits nothing does nothing.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import bpy
import numpy as np

from ..coarsening import RENDERED, SUBDIVIDES, Setting

KEY = "lipac_writeback"
HIDDEN = "hide_render"
PARTICLES = "particles:"
MASKED = "masked"
EMPTIED = "emptied"
SIMPLIFIED = "simplified"
MODIFIER = "modifier:"
COARSER, DATA = "coarser:", "data"
_NUMBERED = (PARTICLES, MODIFIER, COARSER)
_WORDS = {HIDDEN, MASKED, EMPTIED, SIMPLIFIED}
_RECORD = "overrides"  # the mark of the object that bears those of library overrides; also the name of its list
_NAME = "LiPaC overrides"

Words = dict[bpy.types.Object, list[str]]


def all_marks() -> Words:
    """The marked objects of the file, and their words."""
    found: Words = {}
    for ob in bpy.data.objects:
        value = ob.get(KEY)
        if isinstance(value, str) and (
            words := [word for word in value.split("\n") if word in _WORDS or word.startswith(_NUMBERED)]
        ):
            found[ob] = words
        elif _is_record(ob):
            for entry in ob[_RECORD]:
                if isinstance(entry.get("object"), bpy.types.Object):
                    found.setdefault(entry["object"], []).append(str(entry.get("word")))
    return found


def culled_libraries() -> list[str]:
    """Linked files that were saved with marks, whose objects the file shows or overrides: what is taken back of these
    holds until the file is opened again."""
    marked = (ob for ob in all_marks() if KEY in ob)  # on no override of the file itself
    of = (ob.override_library.reference if ob.override_library is not None else ob for ob in marked)
    return sorted({ob.library.filepath for ob in of if ob.library is not None})


def write(words: Iterable[tuple[bpy.types.Object, str]]) -> None:
    """Mark objects; to be done before what the words say."""
    overrides = []
    for ob, word in words:
        if ob.override_library is None:
            ob[KEY] = f"{ob[KEY]}\n{word}" if KEY in ob else word
        else:
            overrides.append({"object": ob, "word": word})
    if overrides:
        with making() as made:
            made.append(bpy.data.objects.new(_NAME, None))
            made[0].use_fake_user = True
            made[0][KEY], made[0][_RECORD] = _RECORD, overrides


@contextmanager
def making() -> Iterator[list[bpy.types.ID]]:
    """Takes the data-blocks that are put into the list away again where an error ends their making, before they can be
    told as ours."""
    made: list[bpy.types.ID] = []
    try:
        yield made
    except BaseException:
        bpy.data.batch_remove(made)
        raise


def particles(modifier: bpy.types.Modifier) -> str:
    """The word for a particle system modifier that is switched off."""
    return f"{PARTICLES}{modifier.persistent_uid}"


def coarser(setting: Setting, value: int) -> str:
    """The word for a setting that is about to have another value."""
    return f"{COARSER}{getattr(setting.owner, 'persistent_uid', DATA)}:{setting.now}:{value}"


def _refine(owner: Any, name: str, number: str, words: Iterable[str]) -> None:
    """Put back the property of a modifier, or of data, that a word speaks of by its number."""
    for word in words:
        found = re.fullmatch(rf"{COARSER}{number}:(\d{{1,3}}):(\d{{1,3}})", word)
        if found and getattr(owner, name) == int(found[2]):
            setattr(owner, name, int(found[1]))


def take_back(in_render: bool = False) -> bool:
    """Undo every mark in the file and remove it; True where there was one. Values that are no longer as they were set
    stay. in_render: as of `set_hidden`."""
    found = all_marks()
    for ob, words in found.items():
        for modifier in ob.modifiers:
            own = {f"{MODIFIER}{modifier.persistent_uid}"}
            if modifier.type == "PARTICLE_SYSTEM":
                own |= {particles(modifier), PARTICLES + modifier.name}  # earlier versions went by names
            if own.intersection(words):
                modifier.show_render = True
            if modifier.type in SUBDIVIDES:
                _refine(modifier, RENDERED["modifier"], str(modifier.persistent_uid), words)
        if hasattr(ob.data, RENDERED["data"]):
            _refine(ob.data, RENDERED["data"], DATA, words)
    set_hidden([ob for ob, words in found.items() if HIDDEN in words], False, in_render)
    for ob in found:
        if KEY in ob:
            del ob[KEY]
    collections = [c for c in bpy.data.collections if c.get(KEY) == HIDDEN]  # which earlier versions hid, too
    for collection in collections:
        collection.hide_render = False
        del collection[KEY]
    if records := [ob for ob in bpy.data.objects if _is_record(ob)]:
        bpy.data.batch_remove(records)
    return bool(found or collections)


def set_hidden(objects: list[bpy.types.Object], hidden: bool, in_render: bool = False) -> None:
    """Set `hide_render` of many objects.

    Assigning one by one walks all view layers each time, which is quadratic; so values are written at once. That
    changes no linked object, and Blender saves no change of a library override that was not assigned. in_render: a
    handler of a render calls, in which an assignment crashes Blender where the compositor reads a second scene; so
    overrides, which nobody saves meanwhile, are not assigned.
    """
    if not objects:
        return
    values = np.empty(len(bpy.data.objects), bool)
    bpy.data.objects.foreach_get("hide_render", values)
    place = {ob: i for i, ob in enumerate(bpy.data.objects)}
    values[[place[ob] for ob in objects]] = hidden
    assigned = [ob for ob in objects if ob.library or (ob.override_library and not in_render)]
    if not in_render:
        assigned.append(objects[0])  # has Blender find out what its view layers show, in time for a render that begins
    for ob in assigned:
        ob.hide_render = hidden
    free = np.array([not ob.is_property_readonly("hide_render") for ob in bpy.data.objects])
    # Blender passes over the others, without their values
    bpy.data.objects.foreach_set("hide_render", np.concatenate([values[free], values[~free]]))
    for ob in objects:
        ob.update_tag()


def _is_record(ob: bpy.types.Object) -> bool:
    return (
        ob.get(KEY) == _RECORD
        and ob.type == "EMPTY"
        and not ob.users_collection
        and not isinstance(ob.get(_RECORD, ""), str)
    )
