"""Reading a dependency graph: its objects, collections and instance references, each once, and again only where Blender says that it changed.

`depsgraph.object_instances` makes a Python object per instance, 5 s per million. Here Python walks objects, collections and instance references:
`GeometrySet.instances_pointcloud()` gives the instances of geometry nodes as arrays. Particles and vertex or face instancing come as arrays too:
`evaluated_geometry()` lists them as instances (Blender's `object_duplilist_legacy_instances`), so `object_instances` serves as an oracle in the tests alone.

What is instanced, how, and what is visible follows Blender's `object_dupli.cc` and `depsgraph_query_iter.cc`, and Cycles' `blender/object.cpp`.
"""

from __future__ import annotations

from collections.abc import Iterator
from copy import copy
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.arrays import F32, F64
from ...core.errors import InputError
from ...core.scene.model import InstanceFlag, RayType
from ..keys import Kind
from .geometry.mesh_table import MeshTable
from .geometry.meshes import matrices, read
from .geometry.slots import Slots, SlotTable, material_slots
from .lights import LampData, read_lamp

GEOMETRY_TYPES = {"MESH", "CURVE", "SURFACE", "META", "FONT", "CURVES", "POINTCLOUD", "VOLUME", "GREASEPENCIL"}
NOTHING_TYPES = {"ARMATURE", "CAMERA", "SPEAKER", "LATTICE"}  # show nothing themselves


def matrix(value: Any) -> F64:
    """(3, 4) float64 of a mathutils.Matrix."""
    return np.array(value, np.float64)[:3]


@dataclass(eq=False)
class Geometry:
    """A GeometrySet: its mesh (-1: none) with the materials of its slots, and its instances grouped by what they refer to.

    offset: of the materials in `Scene.slot_materials`, in this frame. data: address of the data-block, where several objects may share it. ids: whether its
    instances have ids.
    """

    mesh: int = -1
    key: str = ""
    bounds: F32 | None = None
    materials: Slots = ()
    offset: int = 0
    data: int = 0
    ids: bool = False
    columns: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 4, 4), np.float32))  # (n, 4, 4), column-major
    groups: list[tuple[NDArray[np.int64] | None, Any]] = field(default_factory=list)  # rows (None: all), Node | Members | Geometry | None

    def same(self, other: Geometry) -> bool:
        """Whether it places the same in the same way; not what becomes of objects and collections that it refers to."""
        return (
            (self.mesh, self.materials, self.offset, len(self.groups)) == (other.mesh, other.materials, other.offset, len(other.groups))
            and (self.bounds is other.bounds or np.array_equal(self.bounds, other.bounds))  # type: ignore[arg-type]
            and (self.columns is other.columns or np.array_equal(self.columns, other.columns))
            and all(_same_rows(a, b) and _same_target(x, y) for (a, x), (b, y) in zip(self.groups, other.groups, strict=True))
        )


def _same_rows(a: NDArray[np.int64] | None, b: NDArray[np.int64] | None) -> bool:
    return a is b or (a is not None and b is not None and np.array_equal(a, b))


def _same_target(a: Any, b: Any) -> bool:
    if type(a) is not type(b):
        return False
    if isinstance(a, Geometry):
        return a.same(b)
    return bool(a is b or a.full_name == b.full_name)


@dataclass(eq=False)
class Members:
    """A collection as it is instanced: visible objects, with the place of each among all objects of the collection.

    changed: the frame in which it became what it is; seen: the last frame in which it was looked at.
    """

    collection: Any  # bpy.types.Collection, of the graph
    full_name: str
    offset: F64
    objects: list[tuple[int, Node]] = field(default_factory=list)
    changed: int = 0
    seen: int = 0


@dataclass(eq=False)
class Node:
    """An evaluated object. `geometry` holds its own mesh even where it instances nothing. changed, seen: as of `Members`, but for what it refers to."""

    item: Any  # bpy.types.Object, of the graph
    key: int
    full_name: str
    name: int
    world: F64
    visible: int
    marks: int
    shown: bool = True  # the object itself, beside what it instances
    geometry: Geometry | None = None
    lamp: LampData | None = None
    collection: Any = None
    collection_name: str = ""
    kind: Kind = Kind.OBJECT  # how it instances, OBJECT: not at all
    recursive: bool = True  # what it instances may instance in turn
    replaced: bool = False  # shown only by its parent's vertex or face instancing
    alone: bool = False  # shows its mesh only where it is not instanced
    unsupported: tuple[str, ...] = ()
    data: int = 0  # address of a lamp's data
    changed: int = 0
    seen: int = 0

    def same(self, other: Node) -> bool:
        """Whether it shows and instances the same in the same place."""
        plain = ("visible", "marks", "shown", "collection_name", "kind", "recursive", "replaced", "alone", "lamp")
        return (
            all(getattr(self, name) == getattr(other, name) for name in plain)
            and np.array_equal(self.world, other.world, equal_nan=True)
            and (self.geometry is other.geometry or (self.geometry is not None and other.geometry is not None and self.geometry.same(other.geometry)))
        )


def full_name(data: Any) -> str:
    """Name that finds a datablock again: for linked ones the library path and the name, with a newline between."""
    return f"{data.library.filepath}\n{data.name}" if data.library is not None else str(data.name)


def ray_visibility(item: Any) -> int:
    """Bits per RayType of an object's ray visibility."""
    flags = (item.visible_camera, item.visible_diffuse, item.visible_glossy, item.visible_transmission, item.visible_shadow)
    return sum(1 << bit for bit, on in enumerate(flags) if on)


class GraphReader:
    """The objects of a scene, frame by frame.

    In a graph that goes on from the frame before, only what `depsgraph.updates` lists is read; in a new one everything is, and compared with what was there.
    What Blender's memory is referred to by is forgotten with the graph.

    After `read`: names (name to index, never fewer), meshes, slots, materials (by name, of the graph), unsupported and warnings (lines), frame (a count).
    """

    def __init__(self) -> None:
        self.meshes = MeshTable()
        self.names: dict[str, int] = {}
        self.frame = 0
        self.slots = SlotTable()
        self.materials: dict[str, Any] = {}
        self.unsupported: dict[str, None] = {}
        self.warnings: dict[str, None] = {}
        self.listed: dict[int, Any] | None = None  # updates by address; None: everything
        self._nodes: dict[int, Node] = {}
        self._members: dict[int, Members] = {}
        self._before: dict[str, Node | Members] = {}  # of another graph
        self._addresses: frozenset[int] = frozenset()
        self._keys: dict[int, str] = {}  # of data that objects share, in this frame
        self._order: list[Node] = []
        self.pairs: set[tuple[int, int]] = set()  # meshes with their offsets into the slot table

    def read(self, depsgraph: Any, goes_on: bool) -> list[Node]:
        """Read a frame and return the objects at the top. goes_on: the graph is that of the last call, evaluated anew."""
        self.frame += 1
        self.depsgraph, self.layer = depsgraph, depsgraph.view_layer_eval
        addresses = frozenset(block.as_pointer() for block in depsgraph.ids)
        if goes_on and addresses == self._addresses:
            self.listed = {update.id.as_pointer(): update for update in depsgraph.updates}
        else:
            self.forget()
        self._addresses = addresses
        self._lamps_listed = self.listed is None or any("NodeTree" in type(update.id).__name__ for update in self.listed.values())
        self._override = getattr(self.layer, "material_override", None)
        self.slots = SlotTable()
        self.meshes.begin()
        for lines in (self.unsupported, self.warnings, self._keys, self._order, self.pairs):
            lines.clear()
        nodes = [self.node(item) for item in self._top_level()]
        for node in self._order:  # grows meanwhile
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
        self._nodes, self._members, self.materials, self.listed, self._addresses = {}, {}, {}, None, frozenset()

    # Objects

    def _top_level(self) -> Iterator[Any]:
        """Objects visible in the render, and those hidden themselves whose instances are visible (which `depsgraph.objects` leaves out)."""
        seen: set[int] = set()
        for item in self.depsgraph.objects:
            seen.add(item.as_pointer())
            yield item
        enabled: set[str] | None = None
        for item in self.layer.objects:
            if item.as_pointer() not in seen and not item.show_instancer_for_render and not item.hide_render:
                if enabled is None:
                    enabled = {full_name(o) for o in _render_objects(self.depsgraph.view_layer.layer_collection)}
                if full_name(item) in enabled:
                    yield item

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
        self._order.append(node)
        if fresh or self._is_listed(node):
            self._read_node(node, fresh or self.listed is None or (key in self.listed and self.listed[key].is_updated_geometry))
        elif node.geometry is not None:
            node.geometry = self._still(node.geometry)
        self.unsupported |= dict.fromkeys(node.unsupported)
        if not isinstance(before, Node) or not node.same(before):
            node.changed = self.frame
        else:
            node.changed = before.changed
        return node

    def _is_listed(self, node: Node) -> bool:
        assert self.listed is not None
        return node.key in self.listed or (node.data != 0 and (node.data in self.listed or self._lamps_listed))

    def _read_node(self, node: Node, geometry_changed: bool) -> None:
        item = node.item
        node.full_name = full_name(item)
        node.name = self.names.setdefault(node.full_name, len(self.names))
        node.shown, node.recursive, node.alone, node.kind = True, True, False, Kind.OBJECT
        node.collection, node.collection_name, node.lamp, node.data = None, "", None, 0
        if item.type in NOTHING_TYPES and item.instance_type == "NONE":
            return
        holdout = item.holdout_get(view_layer=self.layer)
        node.world, node.visible = matrix(item.matrix_world), ray_visibility(item)
        if not holdout and item.indirect_only_get(view_layer=self.layer):
            node.visible &= ~(1 << RayType.CAMERA)
        node.marks = (int(InstanceFlag.HOLDOUT) if holdout else 0) | (int(InstanceFlag.SHADOW_CATCHER) if item.is_shadow_catcher else 0)
        lines: dict[str, None] = {}
        legacy = self._legacy(item, lines)
        if item.type in GEOMETRY_TYPES:
            self._read_geometry(node, legacy, lines, geometry_changed)
        elif item.type == "LIGHT":
            node.lamp, node.data = read_lamp(item), item.data.as_pointer()
        if node.kind == Kind.OBJECT and item.instance_type == "COLLECTION" and item.instance_collection is not None:
            node.collection, node.kind = item.instance_collection, Kind.COLLECTION
            node.collection_name = full_name(node.collection)
        if len(item.particle_systems) or node.kind == Kind.GEOMETRY_NODES or item.instance_type != "NONE":
            node.shown = item.show_instancer_for_render
        if item.hide_render:  # reached as an instance: shows itself, instances nothing; and a mesh that is not its own data is an instance already
            node.kind = Kind.OBJECT
            node.alone = item.type != "MESH"
        node.alone |= item.type == "META"
        parent = item.parent
        node.replaced = parent is not None and parent.instance_type in {"VERTS", "FACES"}
        node.unsupported = tuple(lines)

    def _legacy(self, item: Any, lines: dict[str, None]) -> Kind | None:
        """PARTICLE or DUPLI where an object instances by these."""
        kind = None
        for system in item.particle_systems:
            settings = system.settings
            if settings.render_type in {"OBJECT", "COLLECTION"}:
                kind = Kind.PARTICLE
            elif settings.render_type == "PATH" and settings.type == "HAIR":
                lines.setdefault(f"object {item.name}: hair strands not rendered")
        return Kind.DUPLI if kind is None and item.instance_type in {"VERTS", "FACES"} else kind

    # Geometry

    def _read_geometry(self, node: Node, legacy: Kind | None, lines: dict[str, None], changed: bool) -> None:
        item = node.item
        if item.type == "MESH" and item.data.is_editmode:  # Blender gives out no faces of it
            raise InputError(f"object {item.name!r} is in Edit Mode: leave it first")
        data = item.data.as_pointer() if item.type == "MESH" else 0
        if data in self._keys and not len(item.modifiers) and legacy is None:
            key = self._keys[data]
            node.geometry = Geometry(self.meshes.touch(key), key, data=data, materials=material_slots(item, item.data, self._override, self.materials))
            self._settle(node.geometry)
            return
        if not changed and node.geometry is not None:
            node.geometry = self._still(node.geometry)
            lines.update(dict.fromkeys(line for line in node.unsupported if line not in lines))
        else:
            key = f"mesh {full_name(item.data)}" if data and not len(item.modifiers) else f"object {node.full_name}"
            node.geometry = self._geometry(item.evaluated_geometry(), item.evaluated_geometry(), item, key, lines, data)
        if node.geometry.groups:
            # Instances of geometry nodes come before the older ones, which are of objects and always have an id
            objects = all(isinstance(target, Node) for _, target in node.geometry.groups)
            older = legacy is not None and objects and node.geometry.ids
            node.kind = legacy if older and legacy is not None else Kind.GEOMETRY_NODES
            node.recursive = node.kind != Kind.PARTICLE

    def _geometry(self, geometry: Any, kept: Any, item: Any, key: str, lines: dict[str, None], data: int = 0) -> Geometry:
        """Read a GeometrySet; kept: another of the same, for meshes that are read later."""
        while self.meshes.taken(key):  # an evaluated mesh of an object's own may have the name of another
            key = f"{key}\n{item.name}"
        out = Geometry(self.meshes.read(key, geometry, kept, item.name), key, data=data)
        for name, kind in (("pointcloud", "point cloud"), ("curves", "curves (hair)"), ("volume", "volume"), ("grease_pencil", "Grease Pencil")):
            part = getattr(geometry, name, None)
            if part is not None and not (name == "curves" and geometry.mesh is not None and item.type in {"CURVE", "FONT", "SURFACE"}):
                splats = getattr(part, "type", "") == "GAUSSIAN_SPLAT"
                lines.setdefault(f"object {item.name}: {'Gaussian splats' if splats else kind} not rendered")
        if out.mesh >= 0:
            out.materials = material_slots(item, geometry.mesh, self._override, self.materials)
        self._settle(out)
        cloud = geometry.instances_pointcloud()
        if cloud is None:
            return out
        count, out.ids = len(cloud.points), "id" in cloud.attributes
        out.columns = matrices(cloud.attributes["instance_transform"].data, count, geometry)
        reference = read(cloud.attributes[".reference_index"].data, "value", count, dtype=np.int32)
        targets = list(zip(geometry.instance_references(), kept.instance_references(), strict=True))
        if len(targets) == 1:
            out.groups.append((None, self._reference(*targets[0], item, f"{key}/0", lines)))
        elif targets:
            order = np.argsort(reference.astype(np.min_scalar_type(len(targets))), kind="stable")  # small types are sorted by counting
            ends = np.searchsorted(reference[order], np.arange(len(targets) + 1))
            for k, (a, b) in enumerate(pairwise(ends)):
                if b > a:
                    out.groups.append((order[a:b], self._reference(*targets[k], item, f"{key}/{k}", lines)))
        return out

    def _reference(self, target: Any, kept: Any, owner: Any, key: str, lines: dict[str, None]) -> Any:
        if target is None:
            return None
        if hasattr(target, "instances_pointcloud"):
            return self._geometry(target, kept, owner, key, lines)
        if hasattr(target, "all_objects"):
            return self.members(target)
        return self.node(target)

    def _still(self, geometry: Geometry) -> Geometry:
        """A geometry that was not evaluated anew, in this frame: another where its numbers are."""
        out = copy(geometry)
        if out.key:
            out.mesh = self.meshes.touch(out.key)
        self._settle(out)
        groups: list[tuple[NDArray[np.int64] | None, Any]] = []
        for rows, target in geometry.groups:
            now = target
            if isinstance(target, Geometry):
                now = self._still(target)
            elif isinstance(target, Members):
                now = self.members(target.collection)
            elif isinstance(target, Node):
                now = self.node(target.item)
            groups.append((rows, now))
        out.groups = groups
        return out

    def _settle(self, geometry: Geometry) -> None:
        """Find a geometry's numbers for this frame."""
        if geometry.data:
            self._keys.setdefault(geometry.data, geometry.key)
        if geometry.mesh < 0:
            return
        source = self.meshes.source(geometry.mesh)
        geometry.bounds = source.bounds
        geometry.offset = self.slots.offset(geometry.materials, source.slot_count)
        self.pairs.add((geometry.mesh, geometry.offset))
        if source.broken:
            self.warnings.setdefault(f"mesh of {source.name!r} has vertices that are not finite: triangles with these are left out")

    # Collections

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
        members.collection, members.full_name, members.offset, members.objects, members.seen = collection, name, offset, [], self.frame  # a cycle ends here
        shown = {item.as_pointer() for item in _visible_members(collection)}
        members.objects = [(k, self.node(item)) for k, item in enumerate(collection.all_objects) if item.as_pointer() in shown]
        now, then = ([(k, node.full_name) for k, node in m.objects] if m is not None else None for m in (members, before))
        same = now == then and np.array_equal(before.offset, offset)
        members.changed = before.changed if same else self.frame
        return members

    def latest(self, thing: Any, known: dict[int, int]) -> int:
        """The last frame in which a Node, Members or Geometry changed, or anything that it refers to. known: what was found in this frame, by id."""
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


def _visible_members(collection: Any) -> Iterator[Any]:
    """Objects of an instanced collection that render: neither they nor a collection on the way hidden."""
    if collection.hide_render:
        return
    for item in collection.objects:
        if not item.hide_render:
            yield item
    for child in collection.children:
        yield from _visible_members(child)


def _render_objects(layer: Any) -> Iterator[Any]:
    """Objects that a view layer renders, seen from its tree of layer collections."""
    if layer.collection.hide_render:
        return
    if not layer.exclude:
        yield from layer.collection.objects
    for child in layer.children:
        yield from _render_objects(child)
