"""Geometry sets of evaluated objects: a mesh with its materials, and instances grouped by what they refer to."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ....core.arrays import F32
from ....core.errors import InputError
from ... import attributes
from .fibres import Fibres, balls, joined, strands
from .mesh_table import MeshTable
from .meshes import matrices, read
from .slots import Slots, SlotTable, material_slots

PLACES = {"instance_transform", "position", "id"}  # attributes of instances that no material is coloured by


class Target(Protocol):
    """An object or a collection that instances refer to."""

    full_name: str


class References(Protocol):
    """Who knows the objects and collections that instances refer to."""

    def refer(self, target: Any) -> Target:
        """What is known of an object or a collection of the graph."""

    def refer_again(self, target: Any) -> Target:
        """The same target in this frame."""


@dataclass(eq=False)
class Geometry:
    """A GeometrySet: its mesh (-1: none) with the materials of its slots, and its instances grouped by what they refer
    to.

    offset: of the materials in `Scene.slot_materials`, in this frame. data: address of the data-block, where several
    objects may share it. ids: whether its instances have ids.
    """

    mesh: int = -1
    key: str = ""
    bounds: F32 | None = None
    materials: Slots = ()
    offset: int = 0
    data: int = 0
    ids: bool = False
    # (n, 4, 4), column-major
    columns: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 4, 4), np.float32))
    # rows (None: all), Target | Geometry | None
    groups: list[tuple[NDArray[np.int64] | None, Any]] = field(default_factory=list)

    def same(self, other: Geometry) -> bool:
        """Whether it places the same in the same way; not what becomes of objects and collections that it refers to."""
        return (
            (self.mesh, self.materials, self.offset, len(self.groups))
            == (other.mesh, other.materials, other.offset, len(other.groups))
            and (self.bounds is other.bounds or np.array_equal(self.bounds, other.bounds))  # type: ignore[arg-type]
            and (self.columns is other.columns or np.array_equal(self.columns, other.columns))
            and all(
                _same_rows(a, b) and _same_target(x, y)
                for (a, x), (b, y) in zip(self.groups, other.groups, strict=True)
            )
        )


def _same_rows(a: NDArray[np.int64] | None, b: NDArray[np.int64] | None) -> bool:
    return a is b or (a is not None and b is not None and np.array_equal(a, b))


def _same_target(a: Any, b: Any) -> bool:
    if type(a) is not type(b):
        return False
    if isinstance(a, Geometry):
        return a.same(b)
    return bool(a is b or a.full_name == b.full_name)


class GeometryReader:
    """The geometry of a scene's objects, frame by frame.

    meshes: of all frames. slots, materials (by name, of the graph), pairs (meshes with their offsets into the slot
    table) and warnings: of this frame. bounds: within what attributes of instances lie, by name, in all frames so far.
    """

    def __init__(self, references: References) -> None:
        self._references = references
        self.meshes = MeshTable()
        self.slots = SlotTable()
        self.materials: dict[str, Any] = {}
        self.bounds: dict[str, tuple[float, float]] = {}
        self.warnings: dict[str, None] = {}
        self.pairs: set[tuple[int, int]] = set()
        self.override: Any = None
        self.strands = True
        self._keys: dict[int, str] = {}  # of data that objects share, in this frame

    def begin(self, override: Any, strands: bool = True) -> None:
        """Begin a frame. override: the material that takes the place of all others, or None. strands: whether hair
        renders."""
        self.override, self.strands, self.slots = override, strands, SlotTable()
        self.meshes.begin()
        for held in (self.warnings, self._keys, self.pairs):
            held.clear()

    def forget(self) -> None:
        """Keep no reference to a graph that may be gone."""
        self.materials = {}

    def shared(self, item: Any, data: int) -> Geometry | None:
        """The geometry of an object without modifiers whose data-block, at that address, has been read for another in
        this frame."""
        if data not in self._keys:
            return None
        key = self._keys[data]
        out = Geometry(
            self.meshes.touch(key),
            key,
            data=data,
            materials=material_slots(item, item.data, self.override, self.materials),
        )
        self._settle(out)
        return out

    def read(
        self,
        geometry: Any,
        kept: Any,
        item: Any,
        key: str,
        lines: dict[str, None],
        data: int = 0,
        hair: Fibres | None = None,
        instanced: bool = False,
    ) -> Geometry:
        """Read the GeometrySet of an object. kept: another of the same, for meshes that are read later. key: names its
        mesh over the frames. lines: what is not rendered is added. data: as of `Geometry`. hair: of the object.
        instanced: it is not the object's own. Raises InputError for a mesh in Edit Mode, of whose faces Blender gives
        out nothing."""
        if geometry.mesh is not None and geometry.mesh.is_editmode:  # perhaps another object's
            raise InputError(f"object {item.name!r} shows a mesh that is in Edit Mode: leave it first")
        while self.meshes.taken(key):  # an evaluated mesh of an object's own may have the name of another
            key = f"{key}\n{item.name}"
        materials: Slots = () if geometry.mesh is None else self._slots(item, geometry.mesh)
        found = [hair if self.strands else None]
        for name, kind, as_faces in (
            ("curves", "curves (hair)", strands),
            ("pointcloud", "point cloud", balls),
            ("volume", "volume", None),
            ("grease_pencil", "Grease Pencil", None),
        ):
            part = getattr(geometry, name, None)
            # Cycles renders no other curves than those that an object of them is
            if part is None or (name == "curves" and (instanced or item.type != "CURVES" or not self.strands)):
                continue
            splats = getattr(part, "type", "") == "GAUSSIAN_SPLAT"
            if as_faces is None or splats:
                lines.setdefault(f"object {item.name}: {'Gaussian splats' if splats else kind} not rendered")
            else:
                lines.setdefault(f"object {item.name}: {kind} rendered as faces")
                found.append(as_faces(part, len(materials)))
                materials += self._slots(item, part)
        out = Geometry(self.meshes.read(key, geometry, kept, item.name, joined(found)), key, data=data)
        if out.mesh >= 0:
            out.materials = materials
        self._settle(out)
        cloud = geometry.instances_pointcloud()
        if cloud is None:
            if out.mesh >= 0 and not instanced:
                self.meshes.spare(out.mesh, item.evaluated_geometry)
            return out
        count, out.ids = len(cloud.points), "id" in cloud.attributes
        out.columns = matrices(cloud.attributes["instance_transform"].data, count, geometry)
        self._bound(cloud.attributes)
        reference = read(cloud.attributes[".reference_index"].data, "value", count, dtype=np.int32)
        targets = list(zip(geometry.instance_references(), kept.instance_references(), strict=True))
        if len(targets) == 1:
            out.groups.append((None, self._reference(*targets[0], item, f"{key}/0", lines)))
        elif targets:
            # small types are sorted by counting
            order = np.argsort(reference.astype(np.min_scalar_type(len(targets))), kind="stable")
            ends = np.searchsorted(reference[order], np.arange(len(targets) + 1))
            for k, (a, b) in enumerate(pairwise(ends)):
                if b > a:
                    out.groups.append((order[a:b], self._reference(*targets[k], item, f"{key}/{k}", lines)))
        return out

    def _bound(self, found: Any) -> None:
        """Take in the attributes of instances."""
        for attribute in found:
            name = attribute.name
            if name in PLACES or name.startswith(".") or not len(attribute.data):
                continue
            values = attributes.colors_of(attribute)
            if values is not None:
                low, high = self.bounds.get(name, (np.inf, -np.inf))
                values = np.nan_to_num(values)
                self.bounds[name] = min(low, float(values.min())), max(high, float(values.max()))

    def _slots(self, item: Any, data: Any) -> Slots:
        return material_slots(item, data, self.override, self.materials)

    def _reference(self, target: Any, kept: Any, owner: Any, key: str, lines: dict[str, None]) -> Any:
        if target is None:
            return None
        if hasattr(target, "instances_pointcloud"):
            return self.read(target, kept, owner, key, lines, instanced=True)
        return self._references.refer(target)

    def still(self, geometry: Geometry) -> Geometry:
        """A geometry that was not evaluated anew, in this frame: another where its numbers are."""
        out = copy(geometry)
        if out.key:
            out.mesh = self.meshes.touch(out.key)
        self._settle(out)
        groups: list[tuple[NDArray[np.int64] | None, Any]] = []
        for rows, target in geometry.groups:
            if isinstance(target, Geometry):
                groups.append((rows, self.still(target)))
            else:
                groups.append((rows, None if target is None else self._references.refer_again(target)))
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
            self.warnings.setdefault(
                f"mesh of {source.name!r} has vertices that are not finite: triangles with these are left out"
            )
