"""The mask modifier: geometry nodes that delete single instances of their host, by index.

The culled rows are a boolean attribute on the points of a mask mesh, an object that is in no scene. The modifier
samples it by instance index and deletes where it is True; an index beyond the mask reads False and stays. Where the
mask knows where its rows were, it is the points' position, and an instance that is elsewhere stays: an edit of the
scatter has numbered it anew. One small node group serves all hosts. A million instances cost a fraction of a second.
What stays keeps its number, hence its random colour.
"""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ...core.arrays import F32
from . import marks

NAME = "LiPaC mask"
ATTRIBUTE = "culled"
REACH = 1e-5  # metres within which an instance is where it was: evaluating a scatter again gives the same numbers
INSTANCES = "Anywhere"  # input of the group that masks instances, and of no other
DISTINCT = "Distinct"  # input of a group that need not look for equal ids, which takes as long as the scatter itself
_MASK = "mask"  # the mark of mask objects, meshes and the node group


def add(host: bpy.types.Object, rows: NDArray[np.bool_], places: F32 | None = None) -> None:
    """Append the modifier that deletes the instances `rows` (R,) bool of the host's instance cloud from renders.

    places: (at least R, 3) where they are, in the host's space: those that are elsewhere stay. None: wherever they are.
    """
    group = (
        next((g for g in bpy.data.node_groups if is_ours(g) and INSTANCES in _inputs(g)), None) or new_instance_group()
    )
    append(host, group, NAME, {"Mask": mask_object(rows, places), INSTANCES: places is None})


def append(
    host: bpy.types.Object, group: bpy.types.NodeTree, name: str, inputs: dict[str, bpy.types.ID | bool]
) -> bpy.types.Modifier:
    """Append a modifier of a node group to an object, for renders alone, and return it. inputs: by name."""
    active = host.modifiers.active
    modifier = host.modifiers.new(name, "NODES")
    modifier.show_viewport = False
    modifier.show_expanded = False
    modifier.node_group = group
    last = len(host.modifiers) - 1
    if host.modifiers[last] != modifier:  # another one is pinned to the end
        modifier.use_pin_to_last = True
        host.modifiers.move(host.modifiers.find(modifier.name), last)
    sockets = {s.name: s.identifier for s in group.interface.items_tree if s.in_out == "INPUT"}
    for key, value in inputs.items():
        _set_input(modifier, sockets[key], value)
    if active is not None:
        host.modifiers.active = active
    return modifier


def remove_all() -> bool:
    """Remove every mask modifier and all data-blocks made for them; True where there was one. Those that come with a
    linked file are switched off."""
    groups = {g for g in bpy.data.node_groups if is_ours(g)}
    masked = {ob for ob, words in marks.all_marks().items() if marks.MASKED in words}
    for ob in bpy.data.objects if groups else masked:
        if ob.is_editable:
            for modifier in [
                m
                for m in ob.modifiers
                if m.type == "NODES" and (m.node_group in groups or (ob in masked and _is_emptied(m)))
            ]:
                ob.modifiers.remove(modifier)
    for ob in masked:
        for modifier in [m for m in ob.modifiers if m.type == "NODES" and m.show_render]:
            if modifier.node_group is not None and modifier.node_group.library and _looks_ours(modifier.node_group):
                modifier.show_render = False
                ob.update_tag()
    blocks = [*groups, *(ob for ob in bpy.data.objects if is_ours(ob))]
    if blocks:
        bpy.data.batch_remove(blocks)
    # with those whose object somebody has removed; not what an object of the user's shows
    meshes = [mesh for mesh in bpy.data.meshes if is_ours(mesh) and not mesh.users]
    if meshes:
        bpy.data.batch_remove(meshes)
    return bool(blocks or meshes)


def _is_emptied(modifier: bpy.types.Modifier) -> bool:
    """Whether it is a mask modifier whose node group was removed."""
    return modifier.node_group is None and modifier.name.startswith(NAME)


def is_ours(block: bpy.types.ID, mark: str = _MASK) -> bool:
    """Whether a data-block of the file bears our mark, and is what we make: anyone can copy a mark."""
    return block.library is None and _looks_ours(block, mark)


def _looks_ours(block: bpy.types.ID, mark: str = _MASK) -> bool:
    """The same of one that may be linked."""
    if block.get(marks.KEY) != mark:
        return False
    if isinstance(block, bpy.types.NodeTree):
        return block.bl_idname == "GeometryNodeTree" and _inputs(block) in (
            ["Geometry", "Mask"],
            ["Geometry", "Mask", INSTANCES],
            ["Geometry", "Mask", INSTANCES, DISTINCT],
        )
    mesh = block.data if isinstance(block, bpy.types.Object) else block
    if not isinstance(mesh, bpy.types.Mesh) or (isinstance(block, bpy.types.Object) and block.users_collection):
        return False
    attribute = mesh.attributes.get(ATTRIBUTE)
    return not mesh.edges and attribute is not None and attribute.domain == "POINT" and attribute.data_type == "BOOLEAN"


def _inputs(group: bpy.types.NodeTree) -> list[str]:
    return [s.name for s in group.interface.items_tree if s.item_type == "SOCKET" and s.in_out == "INPUT"]


def mask_object(rows: NDArray[np.bool_], places: F32 | None) -> bpy.types.Object:
    with marks.making() as made:
        made.append(mesh := bpy.data.meshes.new(NAME))
        mesh.vertices.add(len(rows))
        if places is not None and len(rows):  # a mesh without vertices has no positions
            mesh.attributes["position"].data.foreach_set(
                "vector", np.ascontiguousarray(places[: len(rows)], np.float32).ravel()
            )
        mesh.attributes.new(ATTRIBUTE, "BOOLEAN", "POINT").data.foreach_set("value", rows)
        made.append(ob := bpy.data.objects.new(NAME, mesh))
        for block in (mesh, ob):
            block[marks.KEY] = _MASK
    return ob


def _set_input(modifier: bpy.types.Modifier, socket: str, value: bpy.types.ID | bool) -> None:
    if bpy.app.version >= (5, 2, 0):
        getattr(modifier.properties.inputs, socket).value = value
    else:
        modifier[socket] = value


def new_group(name: str, inputs: tuple[tuple[str, str], ...]) -> bpy.types.NodeTree:
    """A node group that bears our mark, with inputs Geometry and others by name and type, and the output Geometry."""
    with marks.making() as made:
        made.append(group := bpy.data.node_groups.new(name, "GeometryNodeTree"))
        group[marks.KEY] = _MASK
        group.is_modifier = True
        for way, sockets in (("INPUT", (("Geometry", "Geometry"), *inputs)), ("OUTPUT", (("Geometry", "Geometry"),))):
            for socket, kind in sockets:
                group.interface.new_socket(socket, in_out=way, socket_type="NodeSocket" + kind)
    return group


def new_instance_group(knows_ids: bool = False) -> bpy.types.NodeTree:
    """The node group that masks instances: inputs Geometry, Mask (object) and Anywhere, output Geometry.

    knows_ids: with an input Distinct, too: no two instances have the same id.
    """
    group = new_group(NAME, (("Mask", "Object"), (INSTANCES, "Bool"), *([(DISTINCT, "Bool")] if knows_ids else [])))
    nodes = Nodes(group)
    inputs, output = nodes.new("NodeGroupInput"), nodes.new("NodeGroupOutput")
    goes = _goes(nodes, inputs.outputs["Mask"], inputs.outputs[INSTANCES])
    distinct = inputs.outputs[DISTINCT] if knows_ids else None
    nodes.link(_delete(nodes, inputs.outputs["Geometry"], goes, distinct), output.inputs["Geometry"])
    return group


class Nodes:
    """A node group that is being made."""

    def __init__(self, group: bpy.types.NodeTree) -> None:
        self.group = group

    def new(self, kind: str, inputs: dict[str, Any] | None = None, **settings: Any) -> bpy.types.Node:
        """A node. inputs: by name, sockets to link, or values; settings: its properties."""
        node = self.group.nodes.new(kind)
        for name, value in settings.items():
            setattr(node, name, value)
        enabled = {s.name: s for s in node.inputs if s.enabled}
        for name, value in (inputs or {}).items():
            if isinstance(value, bpy.types.NodeSocket):
                self.link(value, enabled[name])
            else:
                enabled[name].default_value = value
        return node

    def field(
        self, kind: str, inputs: dict[str, Any] | None = None, output: int = 0, **settings: Any
    ) -> bpy.types.NodeSocket:
        """An output of a new node: that of a number among the enabled ones."""
        return [s for s in self.new(kind, inputs, **settings).outputs if s.enabled][output]

    def both(self, operation: str, a: bpy.types.NodeSocket, b: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
        """A boolean operation of two."""
        node = self.new("FunctionNodeBooleanMath", operation=operation)
        self.link(a, node.inputs[0])
        self.link(b, node.inputs[1])
        return node.outputs[0]

    def link(self, source: bpy.types.NodeSocket, target: bpy.types.NodeSocket) -> None:
        """Link two sockets."""
        self.group.links.new(source, target)


def _goes(nodes: Nodes, mask: bpy.types.NodeSocket, anywhere: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
    """The field of instances to delete: those that the mask names, and that are where it says, or anywhere."""
    points = nodes.new("GeometryNodeObjectInfo", {"Object": mask}).outputs["Geometry"]
    index, position = nodes.field("GeometryNodeInputIndex"), nodes.field("GeometryNodeInputPosition")
    sampled: dict[str, Any] = {"domain": "POINT", "clamp": False}
    named = nodes.field("GeometryNodeInputNamedAttribute", {"Name": ATTRIBUTE}, data_type="BOOLEAN")
    culled = nodes.field(
        "GeometryNodeSampleIndex", {"Geometry": points, "Value": named, "Index": index}, data_type="BOOLEAN", **sampled
    )
    place = nodes.field(
        "GeometryNodeSampleIndex",
        {"Geometry": points, "Value": position, "Index": index},
        data_type="FLOAT_VECTOR",
        **sampled,
    )
    compared: dict[str, Any] = {"data_type": "VECTOR", "mode": "ELEMENT", "operation": "EQUAL"}
    there = nodes.field("FunctionNodeCompare", {"A": position, "B": place, "Epsilon": REACH}, **compared)
    return nodes.both("AND", culled, nodes.both("OR", there, anywhere))


def _delete(
    nodes: Nodes,
    geometry: bpy.types.NodeSocket,
    goes: bpy.types.NodeSocket,
    distinct: bpy.types.NodeSocket | None = None,
) -> bpy.types.NodeSocket:
    """The geometry without the instances `goes`, the others numbered as before.

    Blender's number of an instance, from which Object Info > Random and motion blur go, is its id, or its place among
    all where there are none. Of instances with equal ids the first has this number, and each later one draws another:
    so what goes is made empty where it shares its id with one that stays. distinct: whether none does; Blender computes
    no more of a Switch than what it lets through.
    """
    own = nodes.field("GeometryNodeInputID")
    numbered = nodes.field(
        "GeometryNodeStoreNamedAttribute",
        {"Geometry": geometry, "Name": "id", "Value": own},
        domain="INSTANCE",
        data_type="INT",
    )
    stays = nodes.field("FunctionNodeBooleanMath", {"Boolean": goes}, operation="NOT")
    stay = nodes.field(
        "GeometryNodeAccumulateField", {"Value": stays, "Group ID": own}, output=2, data_type="INT", domain="INSTANCE"
    )
    needed = nodes.both("AND", goes, stay)
    some = nodes.field(
        "GeometryNodeAttributeStatistic",
        {"Geometry": numbered, "Attribute": needed},
        output=4,
        data_type="FLOAT",
        domain="INSTANCE",
    )
    if distinct is not None:
        some = nodes.field("GeometryNodeSwitch", {"Switch": distinct, "False": some, "True": 0.0}, input_type="FLOAT")
    deleted = nodes.field("GeometryNodeDeleteGeometry", {"Geometry": numbered, "Selection": goes}, domain="INSTANCE")
    emptied = _emptied(nodes, numbered, nodes.both("NIMPLY", goes, needed), needed)
    return nodes.field("GeometryNodeSwitch", {"Switch": some, "False": deleted, "True": emptied}, input_type="GEOMETRY")


def _emptied(
    nodes: Nodes, geometry: bpy.types.NodeSocket, goes: bpy.types.NodeSocket, empties: bpy.types.NodeSocket
) -> bpy.types.NodeSocket:
    """The geometry without the instances `goes`, and with instances of nothing in place of `empties`, in the same
    order."""
    capture = nodes.new("GeometryNodeCaptureAttribute", domain="INSTANCE")
    for kind, name in (("INT", "Row"), ("BOOLEAN", "Empty")):
        capture.capture_items.new(kind, name)
    for value, name in ((geometry, "Geometry"), (nodes.field("GeometryNodeInputIndex"), "Row"), (empties, "Empty")):
        nodes.link(value, capture.inputs[name])
    left = nodes.field(
        "GeometryNodeDeleteGeometry", {"Geometry": capture.outputs["Geometry"], "Selection": goes}, domain="INSTANCE"
    )
    parts = nodes.new(
        "GeometryNodeSeparateGeometry", {"Geometry": left, "Selection": capture.outputs["Empty"]}, domain="INSTANCE"
    )
    places = nodes.field("GeometryNodeInstancesToPoints", {"Instances": parts.outputs["Selection"]})
    joined = nodes.new("GeometryNodeJoinGeometry")
    for part in (nodes.field("GeometryNodeInstanceOnPoints", {"Points": places}), parts.outputs["Inverted"]):
        nodes.link(part, joined.inputs["Geometry"])
    return nodes.field(
        "GeometryNodeSortElements",
        {"Geometry": joined.outputs["Geometry"], "Sort Weight": capture.outputs["Row"]},
        domain="INSTANCE",
    )
