"""All lights of a scene: which one to sample from a point, where on it, and with what density (for multiple importance
sampling).

Lights at infinity (suns, the world image) share half of the samples where there are others; lamps and emissive
instances are picked by a light tree. An emissive instance picks a triangle by area times emission, then a point
uniformly: the density uses that triangle's area in world space, so any scale is exact.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...arrays import F32, F64, I32
from ...jit.pointers import address
from ...scene.bounds import existing
from ...scene.film import LUMINANCE
from ...scene.mesh import MESH, Mesh, record
from ...scene.model import RayType, Scene
from .environment import Environment, build_environment
from .lamps import AREA, K_KIND, K_RADIANCE, SPOT, SUN, lamp_constants
from .light_tree import NODE, LightBounds, LightTree, build_light_tree

LIGHTS = 21
# One emitter of the tree: a lamp, or an emissive instance with its part of the triangle distribution.
EMITTER = np.dtype([("lamp", "i4"), ("instance", "i4"), ("first", "i8"), ("count", "i8")], align=True)
# light sample, float32[LIGHT_SAMPLE]: direction, distance, density (selection included), radiance share (lamps),
# barycentrics (triangles)
LIGHT_SAMPLE = 8
_BSDF_RAYS = (1 << RayType.DIFFUSE) | (1 << RayType.GLOSSY) | (1 << RayType.TRANSMISSION)


def emissive_instances(scene: Scene) -> NDArray[np.int64]:
    """Instances with a material that emits and is sampled as a light, by materials alone: no mesh is loaded. Indices,
    ascending."""
    if not _strength(scene).any() or not len(scene.instances):
        return np.zeros(0, np.int64)
    rows = np.flatnonzero(brightest(scene) > 0)
    rows = rows[(scene.instances.flags[rows] & _BSDF_RAYS) != 0]
    return rows[existing(scene.instances.bounds[rows])]


def brightest(scene: Scene) -> F64:
    """(N,) luminance that the brightest of each instance's materials emits, of those that are sampled as lights."""
    # A mesh's slots follow each other from its instance's first one, to where the next instance's begin.
    of_slot = np.append(_strength(scene)[scene.slot_materials], 0.0)
    starts = np.unique(np.append(scene.instances.slots, len(scene.slot_materials)))
    most = np.maximum.reduceat(of_slot, starts)[:-1] if len(starts) > 1 else np.zeros(1)
    return np.asarray(most[np.searchsorted(starts, scene.instances.slots)])


def _strength(scene: Scene) -> F64:
    """(M,) luminance that each material emits; what emits invisible light alone is not 0."""
    emission = np.maximum(scene.materials["emission"], 0)
    strength = np.maximum(emission @ LUMINANCE, 1e-30 * (emission > 0).any(axis=1))
    return np.where(scene.materials["mis_emission"] != 0, strength, 0.0)


@dataclass(frozen=True)
class _Emission:
    """Emissive triangles of one mesh under one slot table: triangle indices, cumulative weight in [0, 1], and its
    bounds as a light, object space."""

    triangles: I32
    cdf: F32
    weight: float
    axis: NDArray[np.float64]
    theta_o: float
    single_sided: bool


def _mesh_emission(scene: Scene, mesh: Mesh, slot: int, scale: NDArray[np.float64]) -> _Emission | None:
    """scale: (3, 3) linear part of an instance, for the areas that weigh its triangles."""
    t = len(mesh.triangles)
    slots = mesh.slots.astype(np.int64) if mesh.slots is not None else np.zeros(t, np.int64)
    material = scene.materials[scene.slot_materials[slot + slots]]
    strength = np.where(material["mis_emission"] != 0, np.maximum(material["emission"], 0) @ LUMINANCE, 0.0)
    corners = mesh.positions[mesh.triangles].astype(np.float64) @ scale.T
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2
    area = np.linalg.norm(cross, axis=1)
    weight = np.where(np.isfinite(area), area, 0) * strength
    lit = np.flatnonzero(weight > 0)
    if not len(lit):
        return None
    weight = weight[lit]
    total = weight.sum()
    normal = cross[lit] / area[lit][:, None]
    single = bool((material["single_sided_emission"][lit] != 0).all())
    mean = (normal * weight[:, None]).sum(0)
    length = np.linalg.norm(mean)
    axis = mean / length if length > 1e-6 * total else normal[0]
    cos = normal @ axis
    theta_o = float(np.arccos(np.clip((cos if single else np.abs(cos)).min(), -1, 1)))
    cdf = np.append(0, np.cumsum(weight) / total)
    cdf[-1] = 1
    return _Emission(
        lit.astype(np.int32), cdf.astype(np.float32), total, axis, theta_o if single or theta_o < 1.5 else np.pi, single
    )


# place of the first array's address in the table, and which array tells the emitter of each instance
FIRST_ARRAY, INSTANCE_EMITTER = 3, 4


class Lights:
    """Tables of all lights for the kernels.

    table: uint64[LIGHTS]; lamps: (L, LAMP) float32; nodes, children: the light tree; emissive: (E,) instances that are
    sampled as lights.
    """

    def __init__(
        self, scene: Scene, candidates: NDArray[np.int64] | None = None, meshes: dict[int, Mesh] | None = None
    ) -> None:
        """candidates: instances to sample as lights, default `emissive_instances`; their meshes are loaded (taken from
        meshes where given there)."""
        instances = scene.instances
        candidates = emissive_instances(scene) if candidates is None else candidates
        self.lamps: F32 = lamp_constants(scene.lights)
        self.meshes: dict[int, Mesh] = {}
        known = meshes or {}
        records: list[tuple[Any, ...]] = []
        cdfs, triangles, bounds = [np.zeros(0, np.float32)], [np.zeros(0, np.int32)], []
        lamp_emitter = np.full(max(len(self.lamps), 1), -1, np.int32)
        instance_emitter = np.full(len(instances) if len(candidates) else 0, -1, np.int32)
        for i in np.flatnonzero(
            (self.lamps[:, K_KIND] != SUN) & (self.lamps[:, K_RADIANCE : K_RADIANCE + 3] > 0).any(1)
        ).tolist():
            lamp_emitter[i] = len(records)
            records.append((i, -1, 0, 0))
            bounds.append(_lamp_bounds(scene.lights[i], self.lamps[i]))
        made: dict[tuple[Any, ...], tuple[_Emission | None, int]] = {}
        used = 0
        for i in candidates.tolist():
            m = int(instances.mesh[i])
            linear = instances.transform[i, :, :3].astype(np.float64)
            if m not in self.meshes:
                self.meshes[m] = known[m] if m in known else scene.meshes[m]
            key, scale = _scale_class(m, int(instances.slots[i]), linear)
            if key not in made:
                emission = _mesh_emission(scene, self.meshes[m], int(instances.slots[i]), scale)
                made[key] = (emission, used)
                if emission is not None:
                    cdfs.append(emission.cdf)
                    triangles.append(np.append(emission.triangles, 0).astype(np.int32))  # as long as its cdf
                    used += len(emission.cdf)
            emission, first = made[key]
            if emission is None:
                continue
            instance_emitter[i] = len(records)
            records.append((-1, i, first, len(emission.triangles)))
            bounds.append(_instance_bounds(emission, linear, scale, instances.bounds[i]))
        self.emissive = np.flatnonzero(instance_emitter >= 0)
        self.environment: Environment | None = build_environment(scene.world)
        tree = (
            build_light_tree(_stack(bounds))
            if records
            else LightTree(np.zeros((1, NODE), np.float32), np.full(1, -1, np.int32), np.zeros(1, np.uint64))
        )
        self.nodes, self.children = tree.nodes, tree.children
        suns = np.flatnonzero((self.lamps[:, K_KIND] == SUN) & (self.lamps[:, K_RADIANCE : K_RADIANCE + 3] > 0).any(1))
        infinite, infinite_cdf = self._infinite(scene, suns)
        lamp_emitter[suns] = np.arange(len(suns))
        mesh_table = np.zeros(len(scene.meshes), MESH)
        for m, mesh in self.meshes.items():
            mesh_table[m] = record(mesh)
        image = self.environment.image if self.environment else np.zeros((1, 1, 3), np.float32)
        seen = (
            np.zeros((0, 0, 3), np.float32)
            if scene.world.seen is None
            else np.ascontiguousarray(scene.world.seen, np.float32)
        )
        self._arrays: tuple[np.ndarray, ...] = (
            np.array(records, EMITTER),
            tree.trails,
            np.concatenate(cdfs),
            np.concatenate(triangles),
            instance_emitter,
            lamp_emitter,
            infinite_cdf,
            infinite,
            mesh_table,
            seen,
        )
        e = self.environment
        h, w = image.shape[:2]
        self.table = np.array(
            [
                len(self.lamps),
                len(records),
                len(infinite),
                *[address(a) for a in self._arrays[:-1]],  # from FIRST_ARRAY on
                *((address(e.image), w, h, address(e.marginal), address(e.conditional)) if e else (0, 0, 0, 0, 0)),
                scene.world.visibility,
                len(infinite) - 1 if e else 0,
                np.count_nonzero(self.lamps[:, K_RADIANCE : K_RADIANCE + 3].any(1)),
                address(seen) if e else 0,
            ],
            np.uint64,
        )

    def with_more_instances(self, count: int) -> Lights:
        """The same lights in a scene of so many instances more, which do not emit."""
        out = copy.copy(self)
        emitter = self._arrays[INSTANCE_EMITTER]
        emitter = np.append(emitter, np.full(count if len(emitter) else 0, -1, np.int32))
        out._arrays = (*self._arrays[:INSTANCE_EMITTER], emitter, *self._arrays[INSTANCE_EMITTER + 1 :])
        out.table = self.table.copy()
        out.table[FIRST_ARRAY + INSTANCE_EMITTER] = address(emitter)
        return out

    def _infinite(self, scene: Scene, suns: NDArray[np.int64]) -> tuple[I32, F32]:
        """Lights at infinity, suns then the world image (as lamp -1), and their cumulative probabilities: half uniform,
        half by irradiance."""
        power = [float(p) for p in scene.lights["power"][suns] @ LUMINANCE]
        lamps = suns.tolist()
        if self.environment is not None:
            h = len(self.environment.image)
            cos = np.cos((np.arange(h) + 0.5) / h * np.pi - np.pi / 2)
            power.append(float((self.environment.image.mean(1) @ LUMINANCE * cos).sum() / cos.sum() * np.pi))
            lamps.append(-1)
        share = np.maximum(np.array(power), 0)
        share = (
            0.5 / max(len(share), 1) + 0.5 * share / max(share.sum(), 1e-30)
            if share.sum() > 0
            else np.full(len(share), 1 / max(len(share), 1))
        )
        cdf = np.append(0, np.cumsum(share))
        cdf[-1] = 1
        return np.array(lamps, np.int32), cdf.astype(np.float32)


def _scale_class(mesh: int, slot: int, linear: NDArray[np.float64]) -> tuple[tuple[Any, ...], NDArray[np.float64]]:
    """Instances whose triangles weigh alike share a distribution: (key, scale to weigh by). Rotation and uniform scale
    change no weight."""
    gram = linear.T @ linear
    s2 = np.trace(gram) / 3
    if s2 > 0 and np.abs(gram - s2 * np.eye(3)).max() < 1e-4 * s2:
        return (mesh, slot), np.eye(3)
    return (mesh, slot, *np.round(gram / max(s2, 1e-30), 6).ravel().tolist()), linear


def _instance_bounds(
    e: _Emission, linear: NDArray[np.float64], scale: NDArray[np.float64], box: F32
) -> tuple[Any, ...]:
    """Bounds of an emissive instance as a light. An Emission made with the instance's own scale is in world space
    already, up to rotation."""
    det = np.linalg.det(linear)
    if scale is linear:
        axis, weight = e.axis * (1 if det >= 0 else -1), e.weight
        # Classes share by shape, not by rotation: only a planar or fully open cone may be reused; else open it.
        normal = np.linalg.inv(linear).T if det != 0 else np.eye(3)
        theta = np.pi if e.theta_o > 1e-3 else e.theta_o
        if e.theta_o <= 1e-3:
            axis = normal @ (scale.T @ e.axis)
        weight = e.weight
    else:
        s2 = np.trace(linear.T @ linear) / 3
        axis, theta, weight = linear @ e.axis, e.theta_o, e.weight * s2
    length = np.linalg.norm(axis)
    axis = axis / length if length > 0 else np.array([0.0, 0.0, 1.0])
    sided = 1.0 if e.single_sided else 2.0
    return (
        box[0].astype(float),
        box[1].astype(float),
        axis,
        theta,
        np.pi / 2,
        max(weight * np.pi * sided, 1e-20),
        not e.single_sided,
    )


def _lamp_bounds(light: np.void, k: F32) -> tuple[Any, ...]:
    """Bounds of a lamp as a light."""
    p = light["position"].astype(float)
    axis = -light["axis_z"].astype(float)
    radiance = float(np.maximum(k[K_RADIANCE : K_RADIANCE + 3], 0) @ LUMINANCE)
    if light["kind"] == AREA:
        half = np.abs(light["axis_x"] * light["size"][0]) / 2 + np.abs(light["axis_y"] * light["size"][1]) / 2
        area = float(light["size"][0] * light["size"][1])
        return (
            p - half,
            p + half,
            axis,
            0.0,
            min(float(light["spread"]), np.pi) / 2,
            max(radiance * abs(area) * np.pi, 1e-20),
            False,
        )
    r = float(k[16])
    power = max(radiance * (np.pi * r * r if r > 0 else 1.0) * 4 * np.pi, 1e-20)
    if light["kind"] == SPOT:
        half = min(float(light["spot_size"]) / 2, np.pi)
        wide = max(1.0, *light["size"].tolist())
        if wide > 1:
            half = float(np.arctan(np.tan(half) * wide)) if half < np.pi / 2 else np.pi
        return p - r, p + r, axis, 0.0, half, power, False
    return p - r, p + r, axis, np.pi, np.pi / 2, power, False


def _stack(bounds: Sequence[tuple[Any, ...]]) -> LightBounds:
    low, high, axis, theta_o, theta_e, power, two_sided = zip(*bounds, strict=True)
    return LightBounds(
        np.array(low),
        np.array(high),
        np.array(axis),
        np.array(theta_o),
        np.array(theta_e),
        np.array(power),
        np.array(two_sided, bool),
    )
