"""The mask modifier: geometry nodes that delete single instances of their host, by index.

The culled rows are a boolean attribute on the points of a mask mesh, an object that is in no scene. The modifier samples it by instance index and deletes
where it is True; an index beyond the mask reads False and stays. One small node group serves all hosts. A million instances cost a fraction of a
second.
"""

from __future__ import annotations

import bpy
import numpy as np
from numpy.typing import NDArray

from . import marks

NAME = "LiPaC mask"
ATTRIBUTE = "culled"
_MASK = "mask"  # the mark of mask objects, meshes and the node group


def add(host: bpy.types.Object, rows: NDArray[np.bool_]) -> None:
    """Append the modifier that deletes the instances `rows` (R,) bool of the host's instance cloud from renders."""
    group = next((g for g in bpy.data.node_groups if _is_ours(g)), None) or _new_group()
    active = host.modifiers.active
    modifier = host.modifiers.new(NAME, "NODES")
    modifier.show_viewport = False
    modifier.show_expanded = False
    modifier.node_group = group
    last = len(host.modifiers) - 1
    if host.modifiers[last] != modifier:  # another one is pinned to the end
        modifier.use_pin_to_last = True
        host.modifiers.move(host.modifiers.find(modifier.name), last)
    socket = next(s.identifier for s in group.interface.items_tree if s.name == "Mask")
    _set_input(modifier, socket, _mask_object(rows))
    if active is not None:
        host.modifiers.active = active
        marks.add(host, marks.ACTIVE + active.name)


def remove_all() -> bool:
    """Remove every mask modifier and all data-blocks made for them; True where there was one."""
    groups = {g for g in bpy.data.node_groups if _is_ours(g)}
    if groups:
        for ob in bpy.data.objects:
            for modifier in [m for m in ob.modifiers if m.type == "NODES" and m.node_group in groups]:
                ob.modifiers.remove(modifier)
    blocks = [*groups, *(b for kind in (bpy.data.objects, bpy.data.meshes) for b in kind if _is_ours(b))]
    bpy.data.batch_remove(blocks)
    return bool(blocks)


def _is_ours(block: bpy.types.ID) -> bool:
    return block.get(marks.KEY) == _MASK


def _mask_object(rows: NDArray[np.bool_]) -> bpy.types.Object:
    mesh = bpy.data.meshes.new(NAME)
    mesh.vertices.add(len(rows))
    mesh.attributes.new(ATTRIBUTE, "BOOLEAN", "POINT").data.foreach_set("value", rows)
    ob = bpy.data.objects.new(NAME, mesh)
    for block in (mesh, ob):
        block[marks.KEY] = _MASK
    return ob


def _set_input(modifier: bpy.types.Modifier, socket: str, value: bpy.types.ID) -> None:
    if bpy.app.version >= (5, 2, 0):
        getattr(modifier.properties.inputs, socket).value = value
    else:
        modifier[socket] = value


def _new_group() -> bpy.types.NodeTree:
    group = bpy.data.node_groups.new(NAME, "GeometryNodeTree")
    group[marks.KEY] = _MASK
    group.is_modifier = True
    for name, way, kind in (("Geometry", "INPUT", "Geometry"), ("Mask", "INPUT", "Object"), ("Geometry", "OUTPUT", "Geometry")):
        group.interface.new_socket(name, in_out=way, socket_type="NodeSocket" + kind)
    inputs, output = group.nodes.new("NodeGroupInput"), group.nodes.new("NodeGroupOutput")
    info = group.nodes.new("GeometryNodeObjectInfo")
    attribute = group.nodes.new("GeometryNodeInputNamedAttribute")
    attribute.data_type = "BOOLEAN"
    attribute.inputs["Name"].default_value = ATTRIBUTE
    sample = group.nodes.new("GeometryNodeSampleIndex")
    sample.data_type, sample.domain, sample.clamp = "BOOLEAN", "POINT", False
    index = group.nodes.new("GeometryNodeInputIndex")
    delete = group.nodes.new("GeometryNodeDeleteGeometry")
    delete.domain = "INSTANCE"
    for source, target in (
        (inputs.outputs["Mask"], info.inputs["Object"]),
        (info.outputs["Geometry"], sample.inputs["Geometry"]),
        (attribute.outputs["Attribute"], sample.inputs["Value"]),
        (index.outputs["Index"], sample.inputs["Index"]),
        (sample.outputs["Value"], delete.inputs["Selection"]),
        (inputs.outputs["Geometry"], delete.inputs["Geometry"]),
        (delete.outputs["Geometry"], output.inputs["Geometry"]),
    ):
        group.links.new(source, target)
    return group
