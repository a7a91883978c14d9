"""What the viewport goes without, by switches of the viewport alone: no render, of this session or of another, looks at
them.

- Single rows of geometry nodes: a mask modifier as of `mask`, shown in the viewport and not in renders. A row goes only
  while its instance is where it was.
- Objects as a whole: the eye of the view layer. What it closes Blender goes on to evaluate, so the analysis still sees
  it.

The record is kept where the switch is, so that an undo never parts them: a view layer names the objects whose eyes were
closed, by a custom property; the node group of the modifier bears a mark. So all is found again after undo, a crash, or
in a file that was saved by an autosave.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import bpy
import numpy as np
from numpy.typing import NDArray

from ...core.arrays import F32
from . import marks, mask

NAME = "LiPaC viewport mask"
KEY = "lipac_viewport"  # the custom property of a view layer: objects by their session uid when their eyes were closed
_MARK = "viewport mask"  # of node groups, mask objects and their meshes


# Rows


def mask_rows(host: bpy.types.Object, rows: NDArray[np.bool_], places: F32, distinct: bool = False) -> None:
    """Take the rows (R,) bool of a host's instance cloud out of the viewport, all others back in. places: (at least R,
    3) where they are, in its own space; distinct: whether no two of them have the same id, which a new mask need not
    find out, then."""
    modifier = _mask_of(host)
    if modifier is not None:
        holder = next(mask_inputs(modifier), None)
        if holder is not None and len(holder.data.vertices) == len(rows) > 0:
            holder.data.attributes[mask.ATTRIBUTE].data.foreach_set("value", rows)
            holder.data.attributes["position"].data.foreach_set("vector", _flat(places, len(rows)))
            holder.data.update()
            return
        unmask([host])
    group = next((g for g in bpy.data.node_groups if mask.is_ours(g, _MARK)), None) or _claimed(
        mask.new_instance_group(knows_ids=True)
    )
    holder = _claimed(mask.mask_object(rows, places))
    _claimed(holder.data)
    modifier = mask.append(host, group, NAME, {"Mask": holder, mask.INSTANCES: False, mask.DISTINCT: distinct})
    modifier.show_render, modifier.show_viewport = False, True


def unmask(hosts: Iterable[bpy.types.Object] | None = None) -> bool:
    """Bring all rows of some hosts back, None: of all that the file has; True where there was something."""
    holders: set[bpy.types.Object] = set()
    found = False
    for host in masked() if hosts is None else hosts:
        for modifier in [m for m in host.modifiers if _is_mask(m)]:
            holders.update(mask_inputs(modifier))
            host.modifiers.remove(modifier)
            found = True
    gone: list[bpy.types.ID] = [block for holder in holders if not holder.users for block in (holder, holder.data)]
    if hosts is None:  # also what nobody uses
        kinds = (bpy.data.node_groups, bpy.data.objects, bpy.data.meshes)
        gone = [block for kind in kinds for block in kind if mask.is_ours(block, _MARK)]
    if gone:
        bpy.data.batch_remove(gone)
    return found or bool(gone)


def masked() -> list[bpy.types.Object]:
    """Objects with a mask, also copies that the user made of such."""
    return [
        ob for ob in bpy.data.objects if len(ob.modifiers) and ob.is_editable and any(_is_mask(m) for m in ob.modifiers)
    ]


def set_masks_shown(hosts: Iterable[bpy.types.Object], shown: bool) -> None:
    """Switch the masks of hosts on or off, without forgetting their rows."""
    for host in hosts:
        modifier = _mask_of(host)
        if modifier is not None:
            modifier.show_viewport = shown


def is_ours(block: bpy.types.ID) -> bool:
    """Whether a data-block, evaluated or not, was made for the viewport's masks."""
    return block.get(marks.KEY) == _MARK


def mask_inputs(modifier: bpy.types.Modifier) -> Iterator[bpy.types.Object]:
    """The mask objects that a modifier of ours reads."""
    from .references import inputs_of

    return (block for block in inputs_of(modifier) if isinstance(block, bpy.types.Object) and is_ours(block))


def _mask_of(host: bpy.types.Object) -> bpy.types.Modifier | None:
    return next((m for m in host.modifiers if _is_mask(m)), None)


def _is_mask(modifier: bpy.types.Modifier) -> bool:
    if modifier.type != "NODES":
        return False
    group = modifier.node_group
    return modifier.name.startswith(NAME) if group is None else mask.is_ours(group, _MARK)


def _claimed(block: bpy.types.ID) -> bpy.types.ID:
    """A data-block that `mask` has made, as one of ours."""
    block.name, block[marks.KEY] = NAME, _MARK
    return block


def _flat(places: F32, count: int) -> F32:
    return np.ascontiguousarray(places[:count], np.float32).ravel()


# Objects


def close_eyes(layer: bpy.types.ViewLayer, objects: Iterable[bpy.types.Object]) -> None:
    """Hide objects in a view layer's viewports. Each takes Blender a walk over the layer."""
    for ob in objects:
        if not ob.hide_get(view_layer=layer):
            if KEY not in layer:
                layer[KEY] = {}
            layer[KEY][str(ob.session_uid)] = ob
            ob.hide_set(True, view_layer=layer)


def open_eyes(layer: bpy.types.ViewLayer, objects: Iterable[bpy.types.Object] | None = None) -> bool:
    """Show objects again that `close_eyes` hid, None: all of them; True where there was something. Those that the user
    showed since are only forgotten."""
    record = _record(layer)
    wanted = record.keys() if objects is None else record.keys() & {str(ob.session_uid) for ob in objects}
    for key in wanted:
        ob = record[key]
        if ob is not None and ob.hide_get(view_layer=layer):
            ob.hide_set(False, view_layer=layer)
    _forget(layer, wanted)
    return bool(record)


def closed_eyes(layer: bpy.types.ViewLayer) -> list[bpy.types.Object]:
    """Objects that `close_eyes` hid. Those that the user showed since are forgotten."""
    record = _record(layer)
    closed = {key: ob for key, ob in record.items() if ob is not None and ob.hide_get(view_layer=layer)}
    _forget(layer, record.keys() - closed.keys())
    return list(closed.values())


def _record(layer: bpy.types.ViewLayer) -> dict[str, bpy.types.Object | None]:
    """Objects whose eyes were closed, None where one is gone, by their session uids at that time."""
    if KEY not in layer:
        return {}
    return {key: ob if isinstance(ob, bpy.types.Object) else None for key, ob in layer[KEY].items()}


def _forget(layer: bpy.types.ViewLayer, keys: Iterable[str]) -> None:
    for key in keys:
        del layer[KEY][key]
    if KEY in layer and not len(layer[KEY]):
        del layer[KEY]


def restore() -> bool:
    """Take back all that the viewport goes without, in every view layer of the file; True where there was something."""
    found = unmask()
    for scene in bpy.data.scenes:
        if scene.library is None:
            for layer in scene.view_layers:
                found |= open_eyes(layer)
    return found
