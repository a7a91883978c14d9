"""Reading a dependency graph: its objects, collections and instance references, each once, and again only where Blender
says that it changed.

`depsgraph.object_instances` makes a Python object per instance, 5 s per million. Here Python walks objects, collections
and instance references: `GeometrySet.instances_pointcloud()` gives the instances of geometry nodes as arrays. Particles
and vertex or face instancing come as arrays too: `evaluated_geometry()` lists them as instances (Blender's
`object_duplilist_legacy_instances`), so `object_instances` serves as an oracle in the tests alone.

What is instanced, how, and what is visible follows Blender's `object_dupli.cc` and `depsgraph_query_iter.cc`, and
Cycles' `blender/object.cpp`.
"""

from __future__ import annotations

from collections.abc import Iterator
from copy import copy
from typing import Any

import numpy as np

from ...core.errors import InputError
from ...core.scene.model import InstanceFlag, RayType
from ..keys import Kind, full_name
from .geometry.fibres import hair
from .geometry.geometry_sets import Geometry, GeometryReader
from .graph_items import (
    Members,
    Node,
    is_light_linked,
    legacy_instancing,
    mark_mesh,
    matrix,
    ray_visibility,
    render_objects,
    visible_members,
)
from .lights import read_lamp

GEOMETRY_TYPES = {"MESH", "CURVE", "SURFACE", "META", "FONT", "CURVES", "POINTCLOUD", "VOLUME", "GREASEPENCIL"}
NOTHING_TYPES = {"ARMATURE", "CAMERA", "SPEAKER", "LATTICE"}  # show nothing themselves


def top_level(depsgraph: Any, layer: Any) -> Iterator[Any]:
    """Objects visible in the render, and those hidden themselves whose instances are visible (which `depsgraph.objects`
    leaves out)."""
    seen: set[int] = set()
    for item in depsgraph.objects:
        seen.add(item.as_pointer())
        yield item
    enabled: set[str] | None = None
    for item in layer.objects:
        if item.as_pointer() not in seen and not item.show_instancer_for_render and not item.hide_render:
            if enabled is None:
                enabled = {full_name(o) for o in render_objects(depsgraph.view_layer.layer_collection)}
            if full_name(item) in enabled:
                yield item


class GraphReader:
    """The objects of a scene, frame by frame.

    In a graph that goes on from the frame before, only what `depsgraph.updates` lists is read; in a new one everything
    is, and compared with what was there. What Blender's memory is referred to by is forgotten with the graph.

    After `read`: names (name to index, never fewer), geometry (meshes and their materials), unsupported (lines), frame
    (a count), addresses (of the graph's data-blocks), order (all objects found). most: as of `MaterialTable`.
    """

    def __init__(self, most: bool = True) -> None:
        self.most, self.geometry = most, GeometryReader(self)
        self.names: dict[str, int] = {}
        self.frame = 0
        self.unsupported: dict[str, None] = {}
        self.listed: dict[int, Any] | None = None  # updates by address; None: everything
        self._nodes: dict[int, Node] = {}
        self._members: dict[int, Members] = {}
        self._before: dict[str, Node | Members] = {}  # of another graph
        self.addresses: frozenset[int] = frozenset()
        self.order: list[Node] = []

    def read(self, depsgraph: Any, goes_on: bool) -> list[Node]:
        """Read a frame and return the objects at the top. goes_on: the graph is that of the last call, evaluated
        anew."""
        self.frame += 1
        self.depsgraph, self.layer = depsgraph, depsgraph.view_layer_eval
        addresses = addresses_of(depsgraph)
        if goes_on and addresses == self.addresses:
            self.listed = {update.id.as_pointer(): update for update in depsgraph.updates}
        else:
            self.forget()
        self.addresses = addresses
        self._lamps_listed = self.listed is None or any(
            "NodeTree" in type(update.id).__name__ for update in self.listed.values()
        )
        self.geometry.begin(getattr(self.layer, "material_override", None), self.layer.use_strand)
        self.unsupported.clear()
        self.order.clear()
        nodes = [self.node(item) for item in top_level(depsgraph, self.layer)]
        for node in self.order:  # grows meanwhile
            if node.kind == Kind.COLLECTION:
                self.members(node.collection)
        return nodes

    def forget(self) -> None:
        """Keep no reference to a graph that may be gone."""
        for node in self._nodes.values():
            node.item = node.collection = None
        for members in self._members.values():
            members.collection = None
        if self._nodes:
            self._before = {f"object {node.full_name}": node for node in self._nodes.values()}
            self._before |= {f"collection {members.full_name}": members for members in self._members.values()}
        self.geometry.forget()
        self._nodes, self._members, self.listed, self.addresses = {}, {}, None, frozenset()

    # Objects

    def node(self, item: Any) -> Node:
        """The Node of an object of the graph."""
        key = item.as_pointer()
        node = self._nodes.get(key)
        if node is not None and node.seen == self.frame:
            return node
        fresh = node is None or node.seen < self.frame - 1
        if node is None:
            node = self._nodes[key] = Node(item, key, full_name(item), 0, np.zeros((3, 4)), 0, 0)
        before = self._before.get(f"object {full_name(item)}") if fresh else copy(node)
        node.item, node.seen = item, self.frame
        self.order.append(node)
        if fresh or self._is_listed(node):
            update = None if self.listed is None else self.listed.get(key)
            geometry = self.listed is None or (update is not None and update.is_updated_geometry)
            self._read_node(node, fresh or geometry)
        elif node.geometry is not None:
            node.geometry = self.geometry.still(node.geometry)
        self.unsupported |= dict.fromkeys(node.unsupported)
        if not isinstance(before, Node) or not node.same(before):
            node.changed = self.frame
        else:
            node.changed = before.changed
        return node

    def _is_listed(self, node: Node) -> bool:
        listed = self.listed or {}
        return node.key in listed or (node.data != 0 and (node.data in listed or self._lamps_listed))

    def _read_node(self, node: Node, geometry_changed: bool) -> None:
        item = node.item
        node.full_name = full_name(item)
        node.name = self.names.setdefault(node.full_name, len(self.names))
        node.shown, node.recursive, node.alone, node.kind = True, True, False, Kind.OBJECT
        node.collection, node.collection_name, node.lamp, node.data = None, "", None, 0
        if item.type in NOTHING_TYPES and item.instance_type == "NONE":
            return
        holdout, node.linked = item.holdout_get(view_layer=self.layer), is_light_linked(item)
        node.world, node.visible = matrix(item.matrix_world), ray_visibility(item)
        if not holdout and item.indirect_only_get(view_layer=self.layer):
            node.visible &= ~(1 << RayType.CAMERA)
        marks = {InstanceFlag.HOLDOUT: holdout, InstanceFlag.SHADOW_CATCHER: item.is_shadow_catcher}
        node.marks = sum(int(flag) for flag, is_so in marks.items() if is_so)
        lines: dict[str, None] = {}
        legacy = legacy_instancing(item, lines)
        if item.type in GEOMETRY_TYPES:
            self._read_geometry(node, legacy, lines, geometry_changed)
        elif item.type == "LIGHT":
            node.lamp, node.data = read_lamp(item, self.most), item.data.as_pointer()
        if node.kind == Kind.OBJECT and item.instance_type == "COLLECTION" and item.instance_collection is not None:
            node.collection, node.kind = item.instance_collection, Kind.COLLECTION
            node.collection_name = full_name(node.collection)
        if len(item.particle_systems) or node.kind == Kind.GEOMETRY_NODES or item.instance_type != "NONE":
            node.shown = item.show_instancer_for_render
        # reached as an instance: shows itself alone; and a mesh that is not its own data is an instance already
        if item.hide_render:
            node.kind = Kind.OBJECT
            node.alone = item.type != "MESH"
        node.alone |= item.type == "META"
        parent = item.parent
        mark_mesh(node, self.geometry.meshes, self.depsgraph.scene)
        node.replaced = parent is not None and parent.instance_type in {"VERTS", "FACES"}
        node.unsupported = tuple(lines)

    # Geometry

    def _read_geometry(self, node: Node, legacy: Kind | None, lines: dict[str, None], changed: bool) -> None:
        item = node.item
        if item.type == "MESH" and item.data.is_editmode:  # Blender gives out no faces of it
            raise InputError(f"object {item.name!r} is in Edit Mode: leave it first")
        data = item.data.as_pointer() if item.type == "MESH" else 0
        shared = self.geometry.shared(item, data) if not len(item.modifiers) and legacy is None else None
        if shared is not None:
            node.geometry = shared
            return
        if not changed and node.geometry is not None:
            node.geometry = self.geometry.still(node.geometry)
            lines.update(dict.fromkeys(line for line in node.unsupported if line not in lines))
        else:
            key = f"mesh {full_name(item.data)}" if data and not len(item.modifiers) else f"object {node.full_name}"
            evaluated = item.evaluated_geometry(), item.evaluated_geometry()
            node.geometry = self.geometry.read(*evaluated, item, key, lines, data, hair(item))
        if node.geometry.groups:
            # Instances of geometry nodes come before the older ones, which are of objects and always have an id
            objects = all(isinstance(target, Node) for _, target in node.geometry.groups)
            older = legacy is not None and objects and node.geometry.ids
            node.kind = legacy if older and legacy is not None else Kind.GEOMETRY_NODES
            node.recursive = node.kind != Kind.PARTICLE

    # Collections, and what instances refer to

    def refer(self, target: Any) -> Node | Members:
        """The Node or Members of an object or a collection of the graph."""
        return self.members(target) if hasattr(target, "all_objects") else self.node(target)

    def refer_again(self, target: Node | Members) -> Node | Members:
        """The same object or collection in this frame."""
        return self.members(target.collection) if isinstance(target, Members) else self.node(target.item)

    def members(self, collection: Any) -> Members:
        """The Members of a collection that something instances."""
        key = collection.as_pointer()
        members = self._members.get(key)
        if members is not None and members.seen == self.frame:
            return members
        offset = np.eye(3, 4)
        offset[:, 3] = -np.array(collection.instance_offset)
        name = full_name(collection)
        before: Any = self._before.get(f"collection {name}") if members is None else copy(members)
        if members is None:
            members = self._members[key] = Members(collection, name, offset)
        # seen from here on, so that a cycle of collections ends
        members.collection, members.full_name, members.offset = collection, name, offset
        members.objects, members.seen = [], self.frame
        shown = {item.as_pointer() for item in visible_members(collection)}
        listed = [pair for pair in enumerate(collection.all_objects) if pair[1].as_pointer() in shown]
        members.objects = [(k, self.node(item)) for k, item in listed]
        now = [(k, node.full_name) for k, node in members.objects]
        then = None if before is None else [(k, node.full_name) for k, node in before.objects]
        same = now == then and np.array_equal(before.offset, offset)
        members.changed = before.changed if same else self.frame
        return members

    def latest(self, thing: Any, known: dict[int, int]) -> int:
        """The last frame in which a Node, Members or Geometry changed, or anything that it refers to. known: what was
        found in this frame, by id."""
        found = known.get(id(thing))
        if found is not None:
            return found
        known[id(thing)] = self.frame  # what is in a cycle counts as changed
        below: list[Any] = []
        if isinstance(thing, Node):
            below = [thing.geometry] if thing.geometry is not None else []
            below += [self._members[thing.collection.as_pointer()]] if thing.kind == Kind.COLLECTION else []
        elif isinstance(thing, Members):
            below = [node for _, node in thing.objects]
        elif isinstance(thing, Geometry):
            below = [target for _, target in thing.groups if target is not None]
        value = max([getattr(thing, "changed", 0), *(self.latest(one, known) for one in below)])
        known[id(thing)] = value
        return value


def addresses_of(depsgraph: Any) -> frozenset[int]:
    """Where a graph's data-blocks are: graphs of the same ones go on from each other."""
    return frozenset(block.as_pointer() for block in depsgraph.ids)
