"""What a render of an extracted frame takes, from what Blender says of its meshes, images and picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import bpy
import numpy as np

from ...core.arrays import I32, I64, Records
from ...core.scene.render_costs import EMPTY, OBJECT, PLACED, ROW, RenderCosts
from ..extract import Extraction
from ..keys import Kind
from .images import image_bytes, images_of

PIXEL, PASS_PIXEL, DENOISED_PIXEL = 80, 42, 830  # bytes: of a picture, of each further pass, of one that is denoised
CYCLES, DENOISER = 60_000_000, 60_000_000  # without anything in the scene


@dataclass(frozen=True)
class SlotMaterials:
    """table: (S,) int32, as `Scene.slot_materials`, into materials, by full name."""

    table: I32
    materials: Sequence[str | None]


@dataclass(frozen=True)
class NamedCosts:
    """Costs, and names for these: of M meshes and I images."""

    costs: RenderCosts
    meshes: tuple[str, ...]
    images: tuple[str, ...]


def costs_of(extraction: Extraction, scene: bpy.types.Scene) -> NamedCosts:
    """Of the frame of a scene that was extracted. Its meshes are not read for it."""
    one, records = extraction.scene, extraction.keys.records
    slots = SlotMaterials(one.slot_materials, extraction.materials)
    return named_costs(
        getattr(one.meshes, "sources", ()), one.instances.mesh, one.instances.slots, records, slots, scene
    )


def named_costs(
    sources: Sequence[Any], mesh: I32, offset: I32, records: Records, slots: SlotMaterials, scene: bpy.types.Scene
) -> NamedCosts:
    """sources: M of `MeshSource`, or None. Of each of N instances: mesh, offset, the slot that its materials begin at,
    and records, its key."""
    found = [None if source is None else source.geometry.mesh for source in sources]
    counts = np.array([_counts(mesh) for mesh in found], np.int64).reshape(-1, 2)
    textured = np.array([mesh is not None and len(mesh.uv_layers) > 0 for mesh in found], bool)
    per_mesh = RenderCosts.of_meshes(counts[:, 0], counts[:, 1], textured)
    count = np.zeros(len(slots.table) + 1, np.int64)
    count[offset] = np.array([0 if source is None else source.slot_count for source in sources], np.int64)[mesh]
    images, uses = _images(slots, count)
    world = images_of(scene.world.node_tree) if scene.world is not None else set()
    sizes = {image: image_bytes(image) for image in {*images, *world}}
    size = np.array([sizes[image] for image in images], np.int64)
    stay = np.array([image in world for image in images], bool)
    # while it is read, Blender's own of it is there too
    largest = max(sizes.values(), default=0)
    rows = int(np.count_nonzero(records["kind"] == Kind.GEOMETRY_NODES))
    fixed = CYCLES + film_bytes(scene) + ROW * rows + largest + sum(sizes[image] for image in world - set(images))
    costs = RenderCosts(*per_mesh, _instances(records), size, uses, fixed).with_images_that_stay(stay)
    # Blender 5.0 gives no other name to what modifiers made
    names = tuple(
        "" if mesh is None else source.name if mesh.name == "Mesh" else mesh.name
        for source, mesh in zip(sources, found, strict=True)
    )
    return NamedCosts(costs, names, tuple(image.name_full for image in images))


def _instances(records: Records) -> I32:
    """(N,) bytes of each instance. An object that instances a collection is there for all that it shows."""
    out = np.where(records["kind"] == Kind.OBJECT, OBJECT, PLACED).astype(np.int32)
    rows = np.flatnonzero(records["kind"] == Kind.COLLECTION)
    hosts = records["host"][rows]
    out[rows] += EMPTY // np.maximum(np.bincount(hosts[hosts >= 0], minlength=1)[hosts], 1)
    return out


def film_bytes(scene: bpy.types.Scene) -> int:
    """What the picture of a scene takes while Cycles renders it: its passes, and the denoiser."""
    render = scene.render
    scale = render.resolution_percentage / 100
    pixels = int(render.resolution_x * scale) * int(render.resolution_y * scale)
    passes = max((_passes(layer) for layer in scene.view_layers if layer.use), default=0)
    denoised = scene.render.engine != "CYCLES" or scene.cycles.use_denoising
    return pixels * (PIXEL + passes * PASS_PIXEL + denoised * DENOISED_PIXEL) + denoised * DENOISER


def _passes(layer: bpy.types.ViewLayer) -> int:
    """How many passes a view layer has beside the picture."""
    names = [name for name in dir(layer) if name.startswith("use_pass_")]
    return sum(bool(getattr(layer, name)) for name in names if name != "use_pass_combined")


def _counts(mesh: Any) -> tuple[int, int]:
    """Triangles and vertices of a mesh."""
    return (0, 0) if mesh is None else (max(len(mesh.loops) - 2 * len(mesh.polygons), 0), len(mesh.vertices))


def _images(slots: SlotMaterials, count: I64) -> tuple[list[bpy.types.Image], I32]:
    """Images, and which of them objects have whose materials begin at a slot: (U, 2) of slot and image. count: (S + 1,)
    how many slots those have that begin there, 0: none do."""
    known = {material.name_full: material for material in bpy.data.materials}
    own = [images_of(getattr(known.get(name or ""), "node_tree", None)) for name in slots.materials]
    order: dict[bpy.types.Image, int] = {}
    pairs = []
    for slot in np.flatnonzero(count).tolist():
        used = set().union(*(own[k] for k in slots.table[slot : slot + int(count[slot])].tolist()))
        pairs += [
            (slot, order.setdefault(image, len(order))) for image in sorted(used, key=lambda image: image.name_full)
        ]
    return list(order), np.array(pairs, np.int32).reshape(-1, 2)
