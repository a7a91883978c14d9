"""What a dependency graph consists of, as far as it shows anything: objects and collections, and who of them is
visible."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ...core.arrays import F64
from ...core.scene.mesh import DIVIDED_LEAST
from ...core.scene.model import InstanceFlag
from ..coarsening import setting_of
from ..keys import Kind
from .geometry.geometry_sets import Geometry
from .geometry.mesh_table import MeshTable
from .lights import LampData
from .materials.wholeness import needs_whole_mesh, reads_triangles

LOOKED_AT = "particles, instances or a material go by their triangles"


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
    """An evaluated object. `geometry` holds its own mesh even where it instances nothing. changed, seen: as of
    `Members`, but for what it refers to."""

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
    linked: bool = False  # what it emits is for some objects alone
    changed: int = 0
    seen: int = 0

    def same(self, other: Node) -> bool:
        """Whether it shows and instances the same in the same place."""
        plain = ("visible", "marks", "shown", "collection_name", "kind", "recursive", "replaced", "alone", "lamp")
        return (
            all(getattr(self, name) == getattr(other, name) for name in plain)
            and np.array_equal(self.world, other.world, equal_nan=True)
            and (
                self.geometry is other.geometry
                or (self.geometry is not None and other.geometry is not None and self.geometry.same(other.geometry))
            )
        )


def matrix(value: Any) -> F64:
    """(3, 4) float64 of a mathutils.Matrix."""
    return np.array(value, np.float64)[:3]


def ray_visibility(item: Any) -> int:
    """Bits per RayType of an object's ray visibility."""
    flags = (
        item.visible_camera, item.visible_diffuse, item.visible_glossy, item.visible_transmission, item.visible_shadow
    )
    return sum(1 << bit for bit, on in enumerate(flags) if on)


def is_light_linked(item: Any) -> bool:
    """Whether what an object emits is for some objects alone, or blocked by some alone."""
    linking = item.light_linking
    return linking.receiver_collection is not None or linking.blocker_collection is not None


def colors_by_material(nodes: Iterable[Node]) -> dict[str | None, list[tuple[float, ...]]]:
    """Red, green, blue, alpha of the objects that show each material, by its name, by what they instance themselves,
    too."""
    out: dict[str | None, list[tuple[float, ...]]] = {}
    for node in nodes:
        shown = [] if node.geometry is None else [node.geometry]
        for geometry in shown:  # grows meanwhile
            shown += [target for _, target in geometry.groups if isinstance(target, Geometry)]
            for name in set(geometry.materials):
                out.setdefault(name, []).append(tuple(node.item.color))
    return out


def casts_caustics(item: Any) -> bool:
    """Whether lamps shine through an object by Cycles' shadow caustics."""
    return bool(getattr(getattr(item, "cycles", None), "is_caustics_caster", False))


def linked_materials(nodes: Iterable[Node]) -> dict[str | None, str]:
    """Materials, by name, of objects that light some objects alone: the name of such an object."""
    linked = [node for node in nodes if node.linked and node.geometry is not None]
    return {name: node.full_name for node in linked if node.geometry is not None for name in node.geometry.materials}


def legacy_instancing(item: Any, lines: dict[str, None]) -> Kind | None:
    """PARTICLE or DUPLI where an object instances by these."""
    kind = None
    for system in item.particle_systems:
        settings = system.settings
        if settings.render_type in {"OBJECT", "COLLECTION"}:
            kind = Kind.PARTICLE
        elif settings.render_type == "PATH" and settings.type == "HAIR":
            if item.show_instancer_for_render:
                lines.setdefault(f"object {item.name}: hair strands rendered as faces")
            else:
                lines.setdefault(f"object {item.name}: hair strands not rendered")
    return Kind.DUPLI if kind is None and item.instance_type in {"VERTS", "FACES"} else kind


def is_divisible(node: Node) -> bool:
    """Whether faces of an object may be culled by themselves: those of a mesh that is not tiny, that instances nothing,
    and which nothing grows from in a render."""
    item = node.item
    if (
        item.type != "MESH"
        or node.kind != Kind.OBJECT
        or node.marks
        or node.geometry is None
        or node.geometry.mesh < 0
        or len(item.particle_systems)
    ):
        return False
    diced = any(m.type == "SUBSURF" and getattr(m, "use_adaptive_subdivision", False) for m in item.modifiers)
    diced |= bool(getattr(getattr(item, "cycles", None), "use_adaptive_subdivision", False))
    if diced or 2 * len(item.data.polygons) < DIVIDED_LEAST:
        return False
    return not any(needs_whole_mesh(slot.material) for slot in item.material_slots)


def is_simplifiable(node: Node) -> bool:
    """Whether the mesh of an object may be exchanged for one made of corners of it: where nothing is made from it but
    what an armature deforms, corner by corner, and no material looks at its triangles."""
    item = node.item
    original = item.original
    if (
        item.type != "MESH"
        or node.kind != Kind.OBJECT
        or node.marks & ~int(InstanceFlag.DIVISIBLE)
        or len(item.particle_systems)
        or original.library is not None
        or original.override_library is not None
        or original.data.shape_keys is not None
        or original.data.animation_data is not None
    ):
        return False
    if any(m.type != "ARMATURE" for m in item.modifiers if m.show_render):
        return False
    return not any(needs_whole_mesh(slot.material) or reads_triangles(slot.material) for slot in item.material_slots)


def coarser_steps(node: Node, scene: Any) -> tuple[int, str]:
    """By how many steps a render of a scene (bpy.types.Scene) can have fewer triangles of an object, by a setting of
    its own, and why not; not where more than its mesh comes of these, or a material looks at them."""
    item = node.item
    setting = setting_of(item.original, scene)
    if isinstance(setting, str):
        return 0, setting
    alone = node.kind == Kind.OBJECT and not node.marks & ~int(InstanceFlag.DIVISIBLE)
    if not alone or len(item.particle_systems) or any(reads_triangles(slot.material) for slot in item.material_slots):
        return 0, LOOKED_AT
    return len(setting.values), ""


def mark_mesh(node: Node, meshes: MeshTable, scene: Any) -> None:
    """Mark an object of whose mesh faces may be culled, and its mesh where all that show it let it be exchanged, or
    where it can be had coarser. scene: bpy.types.Scene."""
    if node.geometry is not None and node.geometry.mesh >= 0:
        source = meshes.source(node.geometry.mesh)
        node.marks |= int(InstanceFlag.DIVISIBLE) * (source.fibres is None and is_divisible(node))
        source.simplifiable = source.simplifiable is not False and is_simplifiable(node)
        source.owner, (source.steps, source.fixed) = node.full_name, coarser_steps(node, scene)


def visible_members(collection: Any) -> Iterator[Any]:
    """Objects of an instanced collection that render: neither they nor a collection on the way hidden."""
    if collection.hide_render:
        return
    for item in collection.objects:
        if not item.hide_render:
            yield item
    for child in collection.children:
        yield from visible_members(child)


def render_objects(layer: Any) -> Iterator[Any]:
    """Objects that a view layer renders, seen from its tree of layer collections."""
    if layer.collection.hide_render:
        return
    if not layer.exclude:
        yield from layer.collection.objects
    for child in layer.children:
        yield from render_objects(child)
