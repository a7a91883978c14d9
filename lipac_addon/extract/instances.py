"""Dependency graph -> placed meshes and lights, without a Python step per instance.

`depsgraph.object_instances` makes a Python object per instance, 5 s per million. Here Python walks objects, collections and instance references, each once, and
NumPy composes the transforms of everything they place: `GeometrySet.instances_pointcloud()` gives the instances of geometry nodes as arrays; the contents of a
collection are composed with all objects that instance it at once. Particles and vertex or face instancing come as arrays too: `evaluated_geometry()` lists them
as instances (Blender's `object_duplilist_legacy_instances`), so `object_instances` serves as an oracle in the tests alone.

What is instanced, how, and what is visible follows Blender's `object_dupli.cc` and `depsgraph_query_iter.cc`, and Cycles' `blender/object.cpp`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.placing import compose_rows, finish
from ...core.scene import F32, F64, InstanceFlag, Instances, RayType
from ..keys import KEY, MAX_DEPTH, Keys, Kind
from .meshes import MeshSource, describe, read

GEOMETRY_TYPES = {"MESH", "CURVE", "SURFACE", "META", "FONT", "CURVES", "POINTCLOUD", "VOLUME", "GREASEPENCIL"}
BLOCK = 1 << 14  # instances composed at a time: their float64 temporaries stay in the cache
VISIBLE = (1 << len(RayType)) - 1
Ints = int | NDArray[Any]  # one for all, or one per placement


def _take(values: Ints, index: NDArray[Any] | slice) -> Ints:
    return values if isinstance(values, int) else values[index]


def matrix(value: Any) -> F64:
    """(3, 4) float64 of a mathutils.Matrix."""
    return np.array(value, np.float64)[:3]


def compose(a: F64, b: F64) -> F64:
    """Affine products a b: (n, 3, 4) or (3, 4) with the same, broadcast."""
    out = a[..., :3] @ b
    out[..., 3] += a[..., 3]
    return out


@dataclass(frozen=True)
class Placements:
    """Where something is placed: transform (n, 3, 4) float64 object to world, and for each what the key and the flags of its instances need.

    host: name index (-1: the object is real, not instanced). visible: ray visibility of the top-level object. marks: HOLDOUT and SHADOW_CATCHER of the same.
    path: one value per level of instancing.
    """

    transform: F64
    kind: Ints
    host: Ints
    visible: Ints
    marks: Ints
    path: tuple[Ints, ...] = ()

    def __len__(self) -> int:
        return len(self.transform)

    def inside(self, transform: F64, index: NDArray[Any] | slice, place: Ints) -> Placements:
        """One level deeper: placement k stems from placement `index[k]` of this, at `place` of that level."""
        path = (*(_take(level, index) for level in self.path), place)
        return Placements(transform, _take(self.kind, index), _take(self.host, index), _take(self.visible, index), _take(self.marks, index), path)

    @staticmethod
    def join(parts: Sequence[Placements]) -> Placements:
        """All placements of several objects at the same depth."""
        if len(parts) == 1:
            return parts[0]
        sizes = [len(p) for p in parts]

        def column(values: Sequence[Ints]) -> Ints:
            first = values[0]
            if isinstance(first, int) and all(isinstance(v, int) and v == first for v in values):
                return first
            return np.concatenate([np.full(n, v, np.int32) if isinstance(v, int) else v for v, n in zip(values, sizes, strict=True)])

        return Placements(
            np.concatenate([p.transform for p in parts]),
            column([p.kind for p in parts]),
            column([p.host for p in parts]),
            column([p.visible for p in parts]),
            column([p.marks for p in parts]),
            tuple(column([p.path[d] for p in parts]) for d in range(len(parts[0].path))),
        )


@dataclass
class Geometry:
    """A GeometrySet, read once: its mesh, and its instances grouped by what they refer to."""

    mesh: int
    slots: int
    columns: NDArray[np.float32]  # (n, 4, 4), column-major
    groups: list[tuple[NDArray[np.int64] | None, Any]]  # rows (None: all), Node | Members | Geometry


@dataclass
class Members:
    """A collection as it is instanced: visible objects, with the place of each among all objects of the collection."""

    objects: list[tuple[int, Node]]
    offset: F64
    key: int


@dataclass
class Node:
    """An evaluated object, read once. `geometry` holds its own mesh even where it instances nothing."""

    key: int
    name: int
    world: F64
    visible: int
    marks: int
    shown: bool  # the object itself, beside what it instances
    geometry: Geometry | None = None
    light: Any = None
    collection: Any = None
    kind: Kind = Kind.OBJECT  # how it instances, OBJECT: not at all
    recursive: bool = True  # what it instances may instance in turn
    replaced: bool = False  # shown only by its parent's vertex or face instancing
    alone: bool = False  # shows its mesh only where it is not instanced


class _Output:
    """The final arrays, grown as needed: untouched memory costs nothing, and no instance is copied twice."""

    def __init__(self) -> None:
        self.count = 0
        self.transform, self.bounds = np.empty((0, 3, 4), np.float32), np.empty((0, 2, 3), np.float32)
        self.mesh, self.slots, self.flags = np.empty(0, np.int32), np.empty(0, np.int32), np.empty(0, np.uint8)
        self.records = np.empty(0, KEY)

    def reserve(self, more: int) -> None:
        """Makes room for `more` instances."""
        need = self.count + more
        if need <= len(self.mesh):
            return
        capacity = max(need, 2 * len(self.mesh))
        for name in ("transform", "bounds", "mesh", "slots", "flags", "records"):
            old = getattr(self, name)
            new = np.empty((capacity, *old.shape[1:]), old.dtype)
            new[: self.count] = old[: self.count]
            setattr(self, name, new)


@dataclass
class Lamp:
    """A light object's data (`bpy.types.Light`), where it is placed, and which rays see it."""

    data: Any
    name: str
    visible: Ints
    transform: F64


def full_name(data: Any) -> str:
    """Name that finds a datablock again: for linked ones the library path and the name, with a newline between."""
    return f"{data.library.filepath}\n{data.name}" if data.library is not None else str(data.name)


def ray_visibility(item: Any) -> int:
    """Bits per RayType of an object's ray visibility."""
    flags = (item.visible_camera, item.visible_diffuse, item.visible_glossy, item.visible_transmission, item.visible_shadow)
    return sum(1 << bit for bit, on in enumerate(flags) if on)


class Collector:
    """Walks a dependency graph. After `run`: `meshes` (sources), `lamps`, `warnings`, `unsupported`, and `result()`.

    origin: (3,) float64, subtracted from all positions before they become float32.
    slots: callback(object, mesh) -> offset into `Scene.slot_materials`, given the number of slots needed.
    """

    def __init__(self, depsgraph: Any, origin: F64, slots: Callable[[Any, Any, int], int]) -> None:
        self.depsgraph = depsgraph
        self.origin = origin
        self.layer = depsgraph.view_layer_eval
        self.slots = slots
        self.meshes: list[MeshSource] = []
        self.lamps: list[Lamp] = []
        self.warnings: list[str] = []
        self.unsupported: dict[str, None] = {}
        self._names: dict[str, int] = {}
        self._nodes: dict[int, Node] = {}
        self._members: dict[int, Members] = {}
        self._meshes_of_data: dict[int, int] = {}
        self._output = _Output()
        self._dropped: dict[str, int] = {}

    # Reading Blender

    def _name(self, item: Any) -> int:
        return self._names.setdefault(full_name(item), len(self._names))

    def _mesh(self, geometry: Any, name: str, key: int | None = None) -> int:
        """Index of a GeometrySet's mesh, -1 without faces. key: of data that several objects share."""
        if key is not None and key in self._meshes_of_data:
            return self._meshes_of_data[key]
        source = describe(geometry, name)
        index = -1
        if source is not None:
            index = len(self.meshes)
            self.meshes.append(source)
            if source.broken:
                self.warnings.append(f"mesh of {name!r} has vertices that are not finite: triangles with these are left out")
        if key is not None:
            self._meshes_of_data[key] = index
        return index

    def _geometry(self, geometry: Any, item: Any, key: int | None = None) -> Geometry:
        mesh = self._mesh(geometry, item.name, key)
        for name, kind in (("pointcloud", "point cloud"), ("curves", "curves (hair)"), ("volume", "volume"), ("grease_pencil", "Grease Pencil")):
            part = getattr(geometry, name, None)
            if part is not None and not (name == "curves" and geometry.mesh is not None and item.type in {"CURVE", "FONT", "SURFACE"}):
                self.unsupported.setdefault(f"object {item.name}: {kind} not rendered")
        slots = self.slots(item, geometry.mesh, self.meshes[mesh].slot_count) if mesh >= 0 else 0
        cloud = geometry.instances_pointcloud()
        if cloud is None:
            return Geometry(mesh, slots, np.zeros((0, 4, 4), np.float32), [])
        count = len(cloud.points)
        columns = read(cloud.attributes["instance_transform"].data, "value", count, 16).reshape(count, 4, 4)
        reference = read(cloud.attributes[".reference_index"].data, "value", count, dtype=np.int32)
        targets = geometry.instance_references()
        groups: list[tuple[NDArray[np.int64] | None, Any]] = []
        if len(targets) == 1:
            groups.append((None, self._reference(targets[0], item)))
        elif targets:
            order = np.argsort(reference, kind="stable")
            ends = np.searchsorted(reference[order], np.arange(len(targets) + 1))
            groups += [(order[a:b], self._reference(t, item)) for t, a, b in zip(targets, ends[:-1], ends[1:], strict=True) if b > a]
        return Geometry(mesh, slots, columns, groups)

    def _reference(self, target: Any, owner: Any) -> Any:
        if target is None:
            return None
        if hasattr(target, "instances_pointcloud"):
            return self._geometry(target, owner)
        if hasattr(target, "all_objects"):
            return self.members(target)
        return self.node(target)

    def node(self, item: Any) -> Node:
        """The Node of an object of the graph."""
        key = item.as_pointer()
        known = self._nodes.get(key)
        if known is not None:
            return known
        holdout = item.holdout_get(view_layer=self.layer)
        visible = ray_visibility(item)
        if not holdout and item.indirect_only_get(view_layer=self.layer):
            visible &= ~(1 << RayType.CAMERA)
        marks = (int(InstanceFlag.HOLDOUT) if holdout else 0) | (int(InstanceFlag.SHADOW_CATCHER) if item.is_shadow_catcher else 0)
        node = Node(key, self._name(item), matrix(item.matrix_world), visible, marks, shown=True)
        self._nodes[key] = node
        legacy = self._legacy(item)
        if item.type in GEOMETRY_TYPES:
            data = item.data.as_pointer() if item.type == "MESH" else None
            if data in self._meshes_of_data and not len(item.modifiers) and legacy is None:
                mesh = self._meshes_of_data[data]
                slots = self.slots(item, item.data, self.meshes[mesh].slot_count) if mesh >= 0 else 0
                node.geometry = Geometry(mesh, slots, np.zeros((0, 4, 4), np.float32), [])
            else:
                geometry = item.evaluated_geometry()
                node.geometry = self._geometry(geometry, item, data)
                if node.geometry.groups:
                    # Instances of geometry nodes come before the older ones, which are of objects and always have an id
                    objects = all(isinstance(target, Node) for _, target in node.geometry.groups)
                    older = legacy is not None and objects and "id" in geometry.instances_pointcloud().attributes
                    node.kind = legacy if older and legacy is not None else Kind.GEOMETRY_NODES
                    node.recursive = node.kind != Kind.PARTICLE
        elif item.type == "LIGHT":
            node.light = item.data
        if node.kind == Kind.OBJECT and item.instance_type == "COLLECTION" and item.instance_collection is not None:
            node.collection, node.kind = item.instance_collection, Kind.COLLECTION
        if len(item.particle_systems) or node.kind == Kind.GEOMETRY_NODES or item.instance_type != "NONE":
            node.shown = item.show_instancer_for_render
        if item.hide_render:  # reached as an instance: shows itself, instances nothing; and a mesh that is not its own data is an instance already
            node.kind = Kind.OBJECT
            node.alone = item.type != "MESH"
        node.alone |= item.type == "META"
        parent = item.parent
        node.replaced = parent is not None and parent.instance_type in {"VERTS", "FACES"}
        return node

    def _legacy(self, item: Any) -> Kind | None:
        """PARTICLE or DUPLI where an object instances by these."""
        kind = None
        for system in item.particle_systems:
            settings = system.settings
            if settings.render_type in {"OBJECT", "COLLECTION"}:
                kind = Kind.PARTICLE
            elif settings.render_type == "PATH" and settings.type == "HAIR":
                self.unsupported.setdefault(f"object {item.name}: hair strands not rendered")
        return Kind.DUPLI if kind is None and item.instance_type in {"VERTS", "FACES"} else kind

    def members(self, collection: Any) -> Members:
        """The Members of a collection that something instances."""
        key = collection.as_pointer()
        known = self._members.get(key)
        if known is None:
            offset = np.eye(3, 4)
            offset[:, 3] = -np.array(collection.instance_offset)
            known = self._members[key] = Members([], offset, key)  # first, so that a cycle ends
            shown = {item.as_pointer() for item in _visible_members(collection)}
            known.objects = [(k, self.node(item)) for k, item in enumerate(collection.all_objects) if item.as_pointer() in shown]
        return known

    # Placing

    def run(self) -> None:
        """Walks the graph once."""
        nodes = [self.node(item) for item in self._top_level()]
        self._plain(nodes)
        hosts = [(n, Placements(n.world[None], int(n.kind), n.name, n.visible, n.marks)) for n in nodes if n.kind != Kind.OBJECT]
        self._instances_of(hosts, (), 0)

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

    def _plain(self, nodes: Iterable[Node]) -> None:
        """Objects themselves, grouped by what they show."""
        groups: dict[tuple[int, int], list[Node]] = {}
        for node in nodes:
            if not node.shown or node.replaced:
                continue
            if node.light is not None:
                self._lamp(node, Placements(node.world[None], int(Kind.OBJECT), -1, node.visible, node.marks))
            elif node.geometry is not None and node.geometry.mesh >= 0:
                groups.setdefault((node.geometry.mesh, node.geometry.slots), []).append(node)
        for (mesh, slots), members in groups.items():
            visible = np.array([n.visible for n in members], np.uint8)
            marks = np.array([n.marks for n in members], np.uint8)
            at = Placements(np.stack([n.world for n in members]), int(Kind.OBJECT), -1, visible, marks)
            self._emit(mesh, slots, np.array([n.name for n in members], np.int32), VISIBLE, 0, at)

    def _object(self, node: Node, at: Placements, replaced: bool = False) -> None:
        """An instanced object, without what it instances itself. replaced: by its parent's vertex or face instancing."""
        if not node.shown or node.alone or (node.replaced and not replaced):
            return
        if node.light is not None:
            self._lamp(node, at)
        elif node.geometry is not None and node.geometry.mesh >= 0:
            self._emit(node.geometry.mesh, node.geometry.slots, node.name, node.visible, node.marks & int(InstanceFlag.SHADOW_CATCHER), at)

    def _instances_of(self, hosts: Sequence[tuple[Node, Placements]], stack: tuple[int, ...], depth: int) -> None:
        """What objects instance, for objects placed at the same depth. Those of one collection are taken together."""
        if depth >= MAX_DEPTH:
            return
        together: dict[int, list[Placements]] = {}
        for node, at in hosts:
            if node.key in stack or not len(at):
                continue
            if node.kind != Kind.COLLECTION and node.geometry is not None:
                self._geometry_instances(node.geometry, node, at, (*stack, node.key))
            else:
                members = self.members(node.collection)
                if any(child.key == node.key for _, child in members.objects):
                    self._collection(members, compose(at.transform, members.offset), at, (*stack, node.key))
                else:
                    together.setdefault(members.key, []).append(at)
        for key, parts in together.items():
            at = Placements.join(parts)
            members = self._members[key]
            self._collection(members, compose(at.transform, members.offset), at, stack)

    def _collection(self, members: Members, spaces: F64, at: Placements, stack: tuple[int, ...]) -> None:
        """The objects of a collection in each of `spaces` (n, 3, 4)."""
        hosts = []
        for place, node in members.objects:
            if node.key in stack:
                continue
            child = at.inside(compose(spaces, node.world), slice(None), place)
            self._object(node, child)
            if node.kind != Kind.OBJECT:
                hosts.append((node, child))
        if hosts:
            self._instances_of(hosts, stack, len(at.path) + 1)

    def _geometry_instances(self, geometry: Geometry, owner: Node, at: Placements, stack: tuple[int, ...]) -> None:
        """The instances of a geometry, in blocks of all (placement, row) pairs."""
        if len(at.path) >= MAX_DEPTH:
            return
        for rows, target in geometry.groups:
            if target is None:
                continue
            count = len(geometry.columns) if rows is None else len(rows)
            self._output.reserve(len(at) * count)
            for start in range(0, len(at) * count, BLOCK):
                flat = np.arange(start, min(start + BLOCK, len(at) * count))
                placement, row = flat // count, flat % count
                row = row if rows is None else rows[row]
                child = self._place_rows(geometry, at, placement, row)
                if isinstance(target, Node):
                    self._object(target, child, owner.kind == Kind.DUPLI)
                    if owner.recursive and target.kind != Kind.OBJECT:
                        self._instances_of([(target, child)], stack, len(child.path))
                elif isinstance(target, Members):
                    self._collection(target, compose(child.transform, target.offset), child, stack)
                else:
                    if target.mesh >= 0:
                        self._emit(target.mesh, target.slots, owner.name, VISIBLE, 0, child)
                    self._geometry_instances(target, owner, child, stack)

    @staticmethod
    def _place_rows(geometry: Geometry, at: Placements, placement: NDArray[np.int64], row: NDArray[np.int64]) -> Placements:
        transform = np.empty((len(row), 3, 4))
        compose_rows(at.transform, placement, geometry.columns, row, transform)
        return at.inside(transform, placement, row.astype(np.int32))

    def _lamp(self, node: Node, at: Placements) -> None:
        visible = node.visible & at.visible
        transform = at.transform.copy()
        transform[:, :, 3] -= self.origin
        self.lamps.append(Lamp(node.light, node.light.name, visible, transform))

    def _emit(self, mesh: int, slots: int, name: Ints, visible: int, marks: int, at: Placements) -> None:
        """Instances of a mesh: visibility of the object and of the top-level object combined (invisible ones left out), unusable transforms left out."""
        flags: Ints = (at.visible & visible) | at.marks | marks
        if not isinstance(flags, int):
            flags = np.asarray(flags, np.uint8)
        seen = (flags & VISIBLE) != 0
        out, count = self._output, len(at)
        out.reserve(count)
        room = slice(out.count, out.count + count)
        transform, bounds, good = out.transform[room], out.bounds[room], np.empty(count, np.bool_)
        low, high = self.meshes[mesh].bounds.astype(np.float64)
        usable = finish(np.ascontiguousarray(at.transform), self.origin, low, high, transform, bounds, good)
        keep: Any = slice(None)
        if usable < count:
            self._dropped[self.meshes[mesh].name] = self._dropped.get(self.meshes[mesh].name, 0) + count - usable
        if usable < count or not np.all(seen):
            keep = good & seen
            count = int(keep.sum())
            transform[:count], bounds[:count] = transform[keep], bounds[keep]
        part = slice(out.count, out.count + count)
        out.count += count
        out.mesh[part], out.slots[part], out.flags[part] = mesh, slots, _take(flags, keep)
        record, arrays = np.zeros((), KEY), {}
        record["path"] = -1
        for field, value in (("kind", at.kind), ("host", at.host), ("object", name)):
            if isinstance(value, int):
                record[field] = value
            else:
                arrays[field] = value[keep]
        out.records[part] = record
        for field, values in arrays.items():
            out.records[field][part] = values
        for depth, level in enumerate(at.path):
            out.records["path"][part, depth] = _take(level, keep)

    # Results

    def result(self) -> tuple[Instances, Keys]:
        """All instances found, in a stable order; and their keys."""
        for name, count in self._dropped.items():
            self.warnings.append(f"{count} instance{'s' if count > 1 else ''} of {name!r} left out: the transform is singular or not finite")
        out, n = self._output, self._output.count
        return Instances(out.transform[:n], out.mesh[:n], out.slots[:n], out.flags[:n], out.bounds[:n]), Keys(out.records[:n], tuple(self._names))

    def mesh_bounds(self) -> F32:
        """(M, 2, 3) float32."""
        return np.stack([m.bounds for m in self.meshes]) if self.meshes else np.zeros((0, 2, 3), np.float32)


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
