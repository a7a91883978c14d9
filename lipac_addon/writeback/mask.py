"""The mask modifier: geometry nodes that delete single instances of their host, by index.

The culled rows are a boolean attribute on the points of a mask mesh, an object that is in no scene. The modifier samples it by instance index and deletes
where it is True; an index beyond the mask reads False and stays. Where the mask knows where its rows were, it is the points' position, and an instance that is
elsewhere stays: an edit of the scatter has numbered it anew. One small node group serves all hosts. A million instances cost a fraction of a second.
"""

from __future__ import annotations

import bpy
import numpy as np
from numpy.typing import NDArray

from ...core.scene import F32
from . import marks

NAME = "LiPaC mask"
ATTRIBUTE = "culled"
REACH = 1e-5  # metres within which an instance is where it was: evaluating a scatter again gives the same numbers
_MASK = "mask"  # the mark of mask objects, meshes and the node group


def add(host: bpy.types.Object, rows: NDArray[np.bool_], places: F32 | None = None) -> None:
    """Append the modifier that deletes the instances `rows` (R,) bool of the host's instance cloud from renders.

    places: (at least R, 3) where they are, in the host's space: those that are elsewhere stay. None: wherever they are.
    """
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
    sockets = {s.name: s.identifier for s in group.interface.items_tree if s.in_out == "INPUT"}
    _set_input(modifier, sockets["Mask"], _mask_object(rows, places))
    _set_input(modifier, sockets["Anywhere"], places is None)
    if active is not None:
        host.modifiers.active = active


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


def _mask_object(rows: NDArray[np.bool_], places: F32 | None) -> bpy.types.Object:
    mesh = bpy.data.meshes.new(NAME)
    mesh.vertices.add(len(rows))
    if places is not None:
        mesh.attributes["position"].data.foreach_set("vector", np.ascontiguousarray(places[: len(rows)], np.float32).ravel())
    mesh.attributes.new(ATTRIBUTE, "BOOLEAN", "POINT").data.foreach_set("value", rows)
    ob = bpy.data.objects.new(NAME, mesh)
    for block in (mesh, ob):
        block[marks.KEY] = _MASK
    return ob


def _set_input(modifier: bpy.types.Modifier, socket: str, value: bpy.types.ID | bool) -> None:
    if bpy.app.version >= (5, 2, 0):
        getattr(modifier.properties.inputs, socket).value = value
    else:
        modifier[socket] = value


def _new_group() -> bpy.types.NodeTree:
    group = bpy.data.node_groups.new(NAME, "GeometryNodeTree")
    group[marks.KEY] = _MASK
    group.is_modifier = True
    inputs_and_outputs = (("Geometry", "INPUT", "Geometry"), ("Mask", "INPUT", "Object"), ("Anywhere", "INPUT", "Bool"), ("Geometry", "OUTPUT", "Geometry"))
    for name, way, kind in inputs_and_outputs:
        group.interface.new_socket(name, in_out=way, socket_type="NodeSocket" + kind)
    inputs, output = group.nodes.new("NodeGroupInput"), group.nodes.new("NodeGroupOutput")
    info = group.nodes.new("GeometryNodeObjectInfo")
    attribute = group.nodes.new("GeometryNodeInputNamedAttribute")
    attribute.data_type = "BOOLEAN"
    attribute.inputs["Name"].default_value = ATTRIBUTE
    index, position = group.nodes.new("GeometryNodeInputIndex"), group.nodes.new("GeometryNodeInputPosition")
    sample, place = (group.nodes.new("GeometryNodeSampleIndex") for _ in range(2))
    for node, kind in ((sample, "BOOLEAN"), (place, "FLOAT_VECTOR")):
        node.data_type, node.domain, node.clamp = kind, "POINT", False
    there = group.nodes.new("FunctionNodeCompare")
    there.data_type, there.mode, there.operation = "VECTOR", "ELEMENT", "EQUAL"
    compared = {s.name: s for s in there.inputs if s.enabled}
    compared["Epsilon"].default_value = REACH
    either, both = (group.nodes.new("FunctionNodeBooleanMath") for _ in range(2))
    either.operation, both.operation = "OR", "AND"
    delete = group.nodes.new("GeometryNodeDeleteGeometry")
    delete.domain = "INSTANCE"
    for source, target in (
        (inputs.outputs["Mask"], info.inputs["Object"]),
        (info.outputs["Geometry"], sample.inputs["Geometry"]),
        (attribute.outputs["Attribute"], sample.inputs["Value"]),
        (index.outputs["Index"], sample.inputs["Index"]),
        (info.outputs["Geometry"], place.inputs["Geometry"]),
        (position.outputs["Position"], place.inputs["Value"]),
        (index.outputs["Index"], place.inputs["Index"]),
        (position.outputs["Position"], compared["A"]),
        (place.outputs["Value"], compared["B"]),
        (there.outputs["Result"], either.inputs[0]),
        (inputs.outputs["Anywhere"], either.inputs[1]),
        (sample.outputs["Value"], both.inputs[0]),
        (either.outputs["Boolean"], both.inputs[1]),
        (both.outputs["Boolean"], delete.inputs["Selection"]),
        (inputs.outputs["Geometry"], delete.inputs["Geometry"]),
        (delete.outputs["Geometry"], output.inputs["Geometry"]),
    ):
        group.links.new(source, target)
    return group
