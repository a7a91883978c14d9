"""Faces for what Cycles renders without any: hair and curves as ribbons, points as octahedra.

A ribbon is turned at random about its strand, an octahedron is not; both are as wide as covers, in the mean over all
directions, what the round thing covers. Of more than `MOST` there are fewer, which are wider.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ....core.arrays import F32, U32
from ....core.scene.mesh import Mesh
from ....core.scene.placing import LARGEST
from ...attributes import NAME, PLACE, colors_of, places, places_in_pattern

MOST = 200_000  # control points of strands, or points, of an object
RIBBON = np.pi / 2  # half a ribbon's width to the radius of a strand: the mean of a ribbon's is 2 / pi of it
OCTAHEDRON = float(np.sqrt(np.pi / np.sqrt(3)))  # of its corners from the centre, to the radius of a ball
CORNERS = np.array([(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)], np.float32)
SIDES = np.array([(0, 2, 4), (2, 1, 4), (1, 3, 4), (3, 0, 4), (2, 0, 5), (1, 2, 5), (3, 1, 5), (0, 3, 5)], np.uint32)


@dataclass(frozen=True)
class Fibres:
    """positions, normals: (V, 3) float32, in the space of the object. triangles: (T, 3) uint32. slots: (T,) uint16 of
    the object's materials.

    of: (T,) of which of its points a triangle is a part. maps: by name of a UV map, attributes too
    (`lipac_addon.attributes`), (P, 2) float32 of its points.
    """

    positions: F32
    normals: F32
    triangles: U32
    slots: NDArray[np.uint16]
    of: NDArray[np.int64]
    maps: Mapping[str, F32] = field(default_factory=dict)

    def box(self) -> F32:
        """(2, 3) float32, lowest and highest."""
        return np.stack((self.positions.min(axis=0), self.positions.max(axis=0)))

    def behind(self, mesh: Mesh, origin: NDArray[np.float64] | None, uv_maps: Sequence[str] = ("",)) -> Mesh:
        """A mesh with these behind its own triangles. origin: as of `MeshSource`, which the mesh begins at; uv_maps:
        the names of the mesh's."""
        first = len(mesh.positions)
        positions = self.positions if origin is None else (self.positions - origin).astype(np.float32)
        normals = mesh.normals
        if normals is not None:
            normals = np.concatenate((normals, self.normals if normals.ndim == 2 else self.normals[self.triangles]))
        uvs = mesh.uvs
        if uvs is not None:
            nothing = np.zeros((int(self.of.max()) + 1, 2), np.float32)
            own = np.stack([self.maps.get(name, nothing)[self.of] for name in uv_maps])
            own = np.repeat(own[:, :, None], 3, axis=2)
            if PLACE in uv_maps:
                own[uv_maps.index(PLACE)] = places_in_pattern(self.positions[self.triangles], self.box())
            uvs = np.concatenate((uvs, own), axis=1)
        slots = np.zeros(len(mesh.triangles), np.uint16) if mesh.slots is None else mesh.slots
        return Mesh(
            np.concatenate((mesh.positions, positions)),
            np.concatenate((mesh.triangles, self.triangles + np.uint32(first))),
            normals,
            uvs,
            np.concatenate((slots, self.slots)),
        )


def joined(parts: Iterable[Fibres | None]) -> Fibres | None:
    """All of them together; None where there are none."""
    found = [part for part in parts if part is not None]
    if len(found) < 2:
        return found[0] if found else None
    first = np.cumsum([0, *(len(part.positions) for part in found)])
    points = [int(part.of.max()) + 1 for part in found]
    names = dict.fromkeys(name for part in found for name in part.maps)
    return Fibres(
        np.concatenate([part.positions for part in found]),
        np.concatenate([part.normals for part in found]),
        np.concatenate([part.triangles + np.uint32(k) for part, k in zip(found, first, strict=False)]),
        np.concatenate([part.slots for part in found]),
        np.concatenate([part.of + k for part, k in zip(found, np.cumsum([0, *points]), strict=False)]),
        {
            name: np.concatenate(
                [part.maps.get(name, np.zeros((n, 2), np.float32))[:n] for part, n in zip(found, points, strict=True)]
            )
            for name in names
        },
    )


def ribbons(points: F32, radius: F32, count: NDArray[np.int64], slot: int = 0) -> Fibres | None:
    """Strands as ribbons. points: (P, 3), of one strand after the other; radius: (P,); count: (S,) points of each.
    None where no strand has two points in a usable place."""
    ends = np.cumsum(count)
    strand = np.repeat(np.arange(len(count)), count)
    with np.errstate(invalid="ignore"):
        bad = ~((np.abs(points) <= LARGEST).all(axis=1) & np.isfinite(radius))
    usable = (count > 1) & (np.bincount(strand, bad, len(count)) == 0)
    rng, chosen = np.random.default_rng(0), np.flatnonzero(usable)
    if not len(chosen):
        return None
    share = min(MOST / float(count[chosen].sum()), 1.0)
    if share < 1:
        chosen = np.sort(rng.permutation(chosen)[: max(int(share * len(chosen)), 1)])
        share = len(chosen) / int(usable.sum())
    kept = np.isin(strand, chosen)
    of = np.searchsorted(chosen, strand[kept])
    places, reach = points[kept].astype(np.float64), radius[kept].astype(np.float64) * (RIBBON / share)
    last = np.zeros(len(strand), bool)
    last[ends[count > 0] - 1] = True
    start = np.flatnonzero(~last[kept])  # of each segment
    step = np.zeros_like(places)
    np.add.at(step, start, places[start + 1] - places[start])
    np.add.at(step, start + 1, places[start + 1] - places[start])
    side = np.cross(step, rng.normal(size=(len(chosen), 3))[of])
    side /= np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-30)
    normal = np.cross(side, step)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    offset = side * reach[:, None]
    positions = np.stack((places - offset, places + offset), axis=1).reshape(-1, 3)
    a = 2 * start.astype(np.uint32)[:, None]
    triangles = np.concatenate((a + np.array((0, 1, 2), np.uint32), a + np.array((1, 3, 2), np.uint32)), axis=0)
    return Fibres(
        positions.astype(np.float32),
        np.repeat(normal, 2, axis=0).astype(np.float32),
        triangles,
        np.full(len(triangles), slot, np.uint16),
        np.tile(np.flatnonzero(kept)[start], 2),
    )


def octahedra(points: F32, radius: F32, slot: int = 0) -> Fibres | None:
    """Points as octahedra. points: (P, 3); radius: (P,). None where none is in a usable place."""
    with np.errstate(invalid="ignore"):
        chosen = np.flatnonzero((np.abs(points) <= LARGEST).all(axis=1) & np.isfinite(radius) & (radius > 0))
    if not len(chosen):
        return None
    larger = 1.0
    if len(chosen) > MOST:
        larger = float(np.sqrt(len(chosen) / MOST))
        chosen = np.sort(np.random.default_rng(0).permutation(chosen)[:MOST])
    corners = CORNERS * (radius[chosen] * np.float32(OCTAHEDRON * larger))[:, None, None]
    positions = (points[chosen][:, None] + corners).reshape(-1, 3)
    first = 6 * np.arange(len(chosen), dtype=np.uint32)[:, None, None]
    triangles = (SIDES + first).reshape(-1, 3)
    return Fibres(
        positions.astype(np.float32),
        np.tile(CORNERS, (len(chosen), 1)),
        triangles,
        np.full(len(triangles), slot, np.uint16),
        np.repeat(chosen, len(SIDES)),
    )


def hair(item: Any) -> Fibres | None:
    """What the hair systems of an evaluated object render as strands, in its own space; None where there is none, where
    the object itself is not shown, or where it is nowhere: its transform is not finite.

    Which strands, and how thick, is as in Cycles (blender/curves.cpp)."""
    systems = _strand_modifiers(item) if item.show_instancer_for_render else []
    to_world = np.array(item.matrix_world, np.float64)
    if not systems or not np.isfinite(to_world).all():
        return None
    found = []
    inverse, place = np.linalg.pinv(to_world[:3, :3]), to_world[:3, 3]
    for modifier in systems:
        system, settings = modifier.particle_system, modifier.particle_system.settings
        parents, children = len(system.particles), len(system.child_particles)
        first = 0 if not children or settings.use_parent_particles else parents
        total, steps = parents + children - first, (1 << settings.render_step) + 1
        if total <= 0:
            continue
        wanted = max(min(MOST // steps, total), 1)
        numbers = np.unique(np.linspace(first, parents + children - 1, wanted).astype(np.int64))
        read = [system.co_hair(item, particle_no=k, step=j) for k in numbers.tolist() for j in range(steps)]
        points = ((np.array(read, np.float64) - place) @ inverse.T).astype(np.float32)
        ends = settings.root_radius, 0.0 if settings.use_close_tip else settings.tip_radius
        radius = np.tile(np.linspace(*ends, steps), len(numbers)) * (settings.radius_scale / 2 * total / len(numbers))
        slot = min(max(settings.material - 1, 0), max(len(item.material_slots) - 1, 0))
        one = ribbons(points, radius.astype(np.float32), np.full(len(numbers), steps, np.int64), slot)
        if one is not None and item.type == "MESH":
            one = replace(one, maps=_roots(item.data, modifier, numbers, steps))
        found.append(one)
    return joined(found)


def _roots(mesh: Any, modifier: Any, numbers: NDArray[np.int64], steps: int) -> dict[str, F32]:
    """What UV maps and colours of a mesh are where strands grow from it, of each of their steps, as `Fibres.maps`."""
    system, out = modifier.particle_system, dict[str, F32]()
    last, strands = len(system.particles) - 1, numbers.tolist()
    at = [{"particle": system.particles[min(k, last)], "particle_no": k} for k in strands]
    for k, layer in enumerate(mesh.uv_layers):
        read = [system.uv_on_emitter(modifier, **one, uv_no=k) for one in at]
        out[layer.name] = np.repeat(np.array(read, np.float32).reshape(-1, 2), steps, axis=0)
        if layer.active_render:
            out[""] = out[layer.name]
    for k, layer in enumerate(mesh.vertex_colors):
        colors = [system.mcol_on_emitter(modifier, **one, vcol_no=k) for one in at]
        out[f"{NAME}{layer.name}"] = np.repeat(places(np.array(colors, np.float32).reshape(-1, 3)), steps, axis=0)
        if layer.active_render:
            out[NAME] = out[f"{NAME}{layer.name}"]
    return out


def _strand_modifiers(item: Any) -> list[Any]:
    """The modifiers of an object whose particle systems render as strands."""
    found = [(m, m.particle_system.settings) for m in item.modifiers if m.type == "PARTICLE_SYSTEM" and m.show_render]
    return [m for m, settings in found if settings.render_type == "PATH" and settings.type == "HAIR"]


def strands(curves: Any, slot: int) -> Fibres | None:
    """Curves of a GeometrySet, None where there are none. slot: of their first material."""
    if not len(curves.points):
        return None  # nor can the offsets be read, of which Blender then says that there is one
    points = _values(curves, "position", "vector", len(curves.points), 3)
    radius = _values(curves, "radius", "value", len(curves.points), 1, 0.01)
    ends = np.zeros(len(curves.curve_offset_data), np.int32)
    curves.curve_offset_data.foreach_get("value", ends)
    count = np.diff(ends).astype(np.int64)
    out = ribbons(points, radius, count, slot)
    return None if out is None else replace(out, maps=_attributes(curves, {"POINT": 1, "CURVE": count}))


def balls(cloud: Any, slot: int) -> Fibres | None:
    """Points of a GeometrySet. slot: of their first material."""
    points = _values(cloud, "position", "vector", len(cloud.points), 3)
    out = octahedra(points, _values(cloud, "radius", "value", len(cloud.points), 1, 0.05), slot)
    return None if out is None else replace(out, maps=_attributes(cloud, {"POINT": 1}))


def _attributes(data: Any, domains: Mapping[str, int | NDArray[np.int64]]) -> dict[str, F32]:
    """Colours and numbers that points or curves have, as `Fibres.maps`. domains: how many points have each value of
    one."""
    out = {}
    for attribute in data.attributes:
        colors = colors_of(attribute) if attribute.domain in domains and attribute.name[0] != "." else None
        if colors is not None:
            out[f"{NAME}{attribute.name}"] = np.repeat(places(colors), domains[attribute.domain], axis=0)
    return out


def _values(data: Any, name: str, field: str, count: int, width: int, default: float = 0.0) -> F32:
    """(count, width) float32 of an attribute, (count,) where width is 1; the default where there is none."""
    out = np.full(count * width, default, np.float32)
    attribute = data.attributes.get(name)
    if attribute is not None and len(attribute.data) == count:
        attribute.data.foreach_get(field, out)
    return out if width == 1 else out.reshape(count, width)
