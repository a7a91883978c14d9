"""The record of what was hidden: a mark on each touched data-block, as a custom property.

The mark lives and travels with what it speaks of: it survives saving, loading, a crash, renaming and duplication (a copy of a hidden object is shown again,
too).
A mark is a list of words: "hide_render" for the data-block's own switch, "particles:NAME" for the render switch of the modifier NAME. All switches were on
before, else they are not touched, so the old value needs no storing.
"""

from __future__ import annotations

from collections.abc import Iterable

import bpy
import numpy as np

KEY = "lipac_writeback"
HIDDEN = "hide_render"
PARTICLES = "particles:"


def words(block: bpy.types.ID) -> list[str]:
    """The mark of a data-block, empty where there is none."""
    value = block.get(KEY, "")
    return value.split("\n") if isinstance(value, str) and value else []


def add(block: bpy.types.ID, word: str) -> None:
    """Add a word to the mark of a data-block."""
    block[KEY] = "\n".join([*words(block), word])


def hide(objects: Iterable[bpy.types.Object], collections: Iterable[bpy.types.Collection]) -> None:
    """Hide objects and collections from renders and mark them; they are visible before."""
    _set_hidden(list(objects), True)
    for collection in collections:
        collection.hide_render = True
        add(collection, HIDDEN)


def switch_off(emitter: bpy.types.Object, modifier: str) -> None:
    """Switch a particle system modifier off in renders and mark its object; it is on before."""
    emitter.modifiers[modifier].show_render = False
    add(emitter, PARTICLES + modifier)


def take_back() -> bool:
    """Undo every mark in the file and remove it; True where there was one. Values that are no longer as they were set stay."""
    collections = [c for c in bpy.data.collections if KEY in c]
    for collection in collections:
        collection.hide_render = False
        del collection[KEY]
    objects = [ob for ob in bpy.data.objects if KEY in ob]
    hidden = []
    for ob in objects:
        for word in words(ob):
            if word == HIDDEN:
                hidden.append(ob)
            elif word.startswith(PARTICLES) and (modifier := ob.modifiers.get(word.removeprefix(PARTICLES))) is not None:
                modifier.show_render = True
    _set_hidden(hidden, False)
    for ob in objects:
        del ob[KEY]
    return bool(collections or objects)


def _set_hidden(objects: list[bpy.types.Object], hidden: bool) -> None:
    """Set `hide_render` of many objects.

    Assigning one by one walks all view layers each time, which is quadratic; so all values are written at once, and one assignment has Blender look at them.
    """
    if not objects:
        return
    values = np.empty(len(bpy.data.objects), bool)
    bpy.data.objects.foreach_get("hide_render", values)
    place = {ob: i for i, ob in enumerate(bpy.data.objects)}
    values[[place[ob] for ob in objects]] = hidden
    bpy.data.objects.foreach_set("hide_render", values)
    for ob in objects:
        if hidden:
            add(ob, HIDDEN)
        ob.update_tag()
    for ob in (objects[0], *(ob for ob in objects if ob.library)):  # linked ones only take an assignment
        ob.hide_render = hidden
