"""All lights of a scene: which one to sample from a point, where on it, and with what density (for multiple importance sampling).

Lights at infinity (suns, the world image) share half of the samples where there are others; lamps and emissive instances are picked by a light tree.
An emissive instance picks a triangle by area times emission, then a point uniformly: the density uses that triangle's area in world space, so any scale is
exact.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ...arrays import F32, I32
from ...jit.pointers import address, f32_pointer, load_f32, load_i32, load_i64, load_u64, offset
from ...jit.sampling import OPTIONS, normalize
from ...scene.bounds import existing
from ...scene.mesh import MESH, Mesh
from ...scene.model import RayType, Scene
from ..shading import T_TRANSFORM, corners
from .environment import Environment, build_environment, environment_pdf, find_interval, sample_environment
from .lamps import AREA, FAR, K_KIND, K_RADIANCE, LAMP, SPOT, SUN, lamp_constants, lamp_pdf, sample_lamp
from .light_tree import NODE, LightBounds, LightTree, build_light_tree, sample_tree, tree_pdf

# Light table, uint64[LIGHTS]: counts and addresses.
(
    L_LAMPS,
    L_EMITTERS,
    L_INFINITE,
    L_EMITTER_RECORDS,
    L_TRAILS,
    L_CDF,
    L_TRIANGLES,
    L_INSTANCE_EMITTER,
    L_LAMP_EMITTER,
    L_INFINITE_CDF,
    L_INFINITE_LAMP,
    L_MESHES,
    L_IMAGE,
    L_WIDTH,
    L_HEIGHT,
    L_MARGINAL,
    L_CONDITIONAL,
    L_WORLD_VISIBILITY,
    L_WORLD_LIGHT,
    L_COUNT_SHAPES,
    L_SEEN,
) = range(21)
LIGHTS = 21

# One emitter of the tree: a lamp, or an emissive instance with its part of the triangle distribution.
EMITTER = np.dtype([("lamp", "i4"), ("instance", "i4"), ("first", "i8"), ("count", "i8")], align=True)
_EMITTER_SIZE = np.uint64(EMITTER.itemsize)
_LAMP, _INSTANCE, _FIRST, _COUNT = (offset(EMITTER, n) for n in ("lamp", "instance", "first", "count"))
_MESH_SIZE = np.uint64(MESH.itemsize)

# light sample, float32[LIGHT_SAMPLE]: direction, distance, density (selection included), radiance share (lamps), barycentrics (triangles)
D_DIR, D_T, D_PDF, D_SHARE, D_BARY = 0, 3, 4, 5, 6
LIGHT_SAMPLE = 8
NONE, WORLD, INSTANCE = -1, -2, 1 << 40  # what sample_light returns: a lamp's index, WORLD, or INSTANCE + emitter

_ZERO, _ONE, _HALF = np.float32(0.0), np.float32(1.0), np.float32(0.5)
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
_BSDF_RAYS = (1 << RayType.DIFFUSE) | (1 << RayType.GLOSSY) | (1 << RayType.TRANSMISSION)


def emissive_instances(scene: Scene) -> NDArray[np.int64]:
    """Instances with a material that emits and is sampled as a light, by materials alone: no mesh is loaded. Indices, ascending."""
    emits = (scene.materials["emission"] > 0).any(1) & (scene.materials["mis_emission"] != 0)
    if not emits.any() or not len(scene.instances):
        return np.zeros(0, np.int64)
    # A mesh's slots follow each other from its instance's first one, to where the next instance's begin.
    emits_slot = np.append(emits[scene.slot_materials], False)
    starts = np.unique(np.append(scene.instances.slots, len(scene.slot_materials)))
    any_from = np.logical_or.reduceat(emits_slot, starts)[:-1] if len(starts) > 1 else np.zeros(0, bool)
    flagged = any_from[np.searchsorted(starts, scene.instances.slots)]
    rows = np.flatnonzero(flagged & ((scene.instances.flags & _BSDF_RAYS) != 0))
    return rows[existing(scene.instances.bounds[rows])]


@dataclass(frozen=True)
class _Emission:
    """Emissive triangles of one mesh under one slot table: triangle indices, cumulative weight in [0, 1], and its bounds as a light, object space."""

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
    strength = np.where(material["mis_emission"] != 0, np.maximum(material["emission"], 0) @ _LUMINANCE, 0.0)
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
    return _Emission(lit.astype(np.int32), cdf.astype(np.float32), total, axis, theta_o if single or theta_o < 1.5 else np.pi, single)


class Lights:
    """Tables of all lights for the kernels.

    table: uint64[LIGHTS]; lamps: (L, LAMP) float32; nodes, children: the light tree; emissive: (E,) instances that are sampled as lights.
    """

    def __init__(self, scene: Scene, candidates: NDArray[np.int64] | None = None, meshes: dict[int, Mesh] | None = None) -> None:
        """candidates: instances to sample as lights, default `emissive_instances`; their meshes are loaded (taken from meshes where given there)."""
        instances = scene.instances
        candidates = emissive_instances(scene) if candidates is None else candidates
        self.lamps: F32 = lamp_constants(scene.lights)
        self.meshes: dict[int, Mesh] = {}
        known = meshes or {}
        records: list[tuple[Any, ...]] = []
        cdfs, triangles, bounds = [np.zeros(0, np.float32)], [np.zeros(0, np.int32)], []
        lamp_emitter = np.full(max(len(self.lamps), 1), -1, np.int32)
        instance_emitter = np.full(len(instances) if len(candidates) else 0, -1, np.int32)
        for i in np.flatnonzero((self.lamps[:, K_KIND] != SUN) & (self.lamps[:, K_RADIANCE : K_RADIANCE + 3] > 0).any(1)).tolist():
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
        tree = build_light_tree(_stack(bounds)) if records else LightTree(np.zeros((1, NODE), np.float32), np.full(1, -1, np.int32), np.zeros(1, np.uint64))
        self.nodes, self.children = tree.nodes, tree.children
        suns = np.flatnonzero((self.lamps[:, K_KIND] == SUN) & (self.lamps[:, K_RADIANCE : K_RADIANCE + 3] > 0).any(1))
        infinite, infinite_cdf = self._infinite(scene, suns)
        lamp_emitter[suns] = np.arange(len(suns))
        mesh_table = np.zeros(len(scene.meshes), MESH)
        for m, mesh in self.meshes.items():
            mesh_table[m] = mesh_addresses(mesh)
        image = self.environment.image if self.environment else np.zeros((1, 1, 3), np.float32)
        seen = np.zeros((0, 0, 3), np.float32) if scene.world.seen is None else np.ascontiguousarray(scene.world.seen, np.float32)
        self._arrays = (
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
                *[address(a) for a in self._arrays[:-1]],
                *((address(e.image), w, h, address(e.marginal), address(e.conditional)) if e else (0, 0, 0, 0, 0)),
                scene.world.visibility,
                len(infinite) - 1 if e else 0,
                np.count_nonzero(self.lamps[:, K_RADIANCE : K_RADIANCE + 3].any(1)),
                address(seen) if e else 0,
            ],
            np.uint64,
        )

    def _infinite(self, scene: Scene, suns: NDArray[np.int64]) -> tuple[I32, F32]:
        """Lights at infinity, suns then the world image (as lamp -1), and their cumulative probabilities: half uniform, half by irradiance."""
        power = [float(p) for p in scene.lights["power"][suns] @ _LUMINANCE]
        lamps = suns.tolist()
        if self.environment is not None:
            h = len(self.environment.image)
            cos = np.cos((np.arange(h) + 0.5) / h * np.pi - np.pi / 2)
            power.append(float((self.environment.image.mean(1) @ _LUMINANCE * cos).sum() / cos.sum() * np.pi))
            lamps.append(-1)
        share = np.maximum(np.array(power), 0)
        share = 0.5 / max(len(share), 1) + 0.5 * share / max(share.sum(), 1e-30) if share.sum() > 0 else np.full(len(share), 1 / max(len(share), 1))
        cdf = np.append(0, np.cumsum(share))
        cdf[-1] = 1
        return np.array(lamps, np.int32), cdf.astype(np.float32)


def mesh_addresses(mesh: Mesh) -> tuple[int, ...]:
    """A blas.MESH record of a mesh whose arrays the caller keeps alive."""
    parts = (mesh.positions, mesh.triangles, mesh.normals, mesh.uvs, mesh.slots)
    return (*[0 if a is None else address(a) for a in parts], len(mesh.triangles))


def _scale_class(mesh: int, slot: int, linear: NDArray[np.float64]) -> tuple[tuple[Any, ...], NDArray[np.float64]]:
    """Instances whose triangles weigh alike share a distribution: (key, scale to weigh by). Rotation and uniform scale change no weight."""
    gram = linear.T @ linear
    s2 = np.trace(gram) / 3
    if s2 > 0 and np.abs(gram - s2 * np.eye(3)).max() < 1e-4 * s2:
        return (mesh, slot), np.eye(3)
    return (mesh, slot, *np.round(gram / max(s2, 1e-30), 6).ravel().tolist()), linear


def _instance_bounds(e: _Emission, linear: NDArray[np.float64], scale: NDArray[np.float64], box: F32) -> tuple[Any, ...]:
    """Bounds of an emissive instance as a light. An Emission made with the instance's own scale is in world space already, up to rotation."""
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
    return box[0].astype(float), box[1].astype(float), axis, theta, np.pi / 2, max(weight * np.pi * sided, 1e-20), not e.single_sided


def _lamp_bounds(light: np.void, k: F32) -> tuple[Any, ...]:
    """Bounds of a lamp as a light."""
    p = light["position"].astype(float)
    axis = -light["axis_z"].astype(float)
    radiance = float(np.maximum(k[K_RADIANCE : K_RADIANCE + 3], 0) @ _LUMINANCE)
    if light["kind"] == AREA:
        half = np.abs(light["axis_x"] * light["size"][0]) / 2 + np.abs(light["axis_y"] * light["size"][1]) / 2
        area = float(light["size"][0] * light["size"][1])
        return p - half, p + half, axis, 0.0, min(float(light["spread"]), np.pi) / 2, max(radiance * abs(area) * np.pi, 1e-20), False
    r = float(k[16])
    power = max(radiance * (np.pi * r * r if r > 0 else 1.0) * 4 * np.pi, 1e-20)
    if light["kind"] == SPOT:
        return p - r, p + r, axis, 0.0, min(float(light["spot_size"]) / 2, np.pi), power, False
    return p - r, p + r, axis, np.pi, np.pi / 2, power, False


def _stack(bounds: Sequence[tuple[Any, ...]]) -> LightBounds:
    low, high, axis, theta_o, theta_e, power, two_sided = zip(*bounds, strict=True)
    return LightBounds(np.array(low), np.array(high), np.array(axis), np.array(theta_o), np.array(theta_e), np.array(power), np.array(two_sided, bool))


@njit(**OPTIONS)
def finite_share(lights):
    """Probability of sampling a lamp or emissive instance instead of a light at infinity."""
    if lights[L_EMITTERS] == np.uint64(0):
        return _ZERO
    return _ONE if lights[L_INFINITE] == np.uint64(0) else _HALF


@njit(**OPTIONS)
def triangle_edges(meshes, table, instance, triangle):
    """World-space first corner of a triangle of an instance, and its edges to the second and the third: 9 float32.

    The edges are transformed as differences: of world-space corners a small emitter far from the origin would have lost them.
    """
    mesh = meshes + np.uint64(load_i32(table[1], instance)) * _MESH_SIZE
    m = table[T_TRANSFORM] + np.uint64(48) * np.uint64(instance)
    ax, ay, az, bx, by, bz, cx, cy, cz = corners(mesh, triangle)
    ux, uy, uz, vx, vy, vz = bx - ax, by - ay, bz - az, cx - ax, cy - ay, cz - az
    m00, m01, m02, tx = load_f32(m, 0), load_f32(m, 1), load_f32(m, 2), load_f32(m, 3)
    m10, m11, m12, ty = load_f32(m, 4), load_f32(m, 5), load_f32(m, 6), load_f32(m, 7)
    m20, m21, m22, tz = load_f32(m, 8), load_f32(m, 9), load_f32(m, 10), load_f32(m, 11)
    return (
        m00 * ax + m01 * ay + m02 * az + tx,
        m10 * ax + m11 * ay + m12 * az + ty,
        m20 * ax + m21 * ay + m22 * az + tz,
        m00 * ux + m01 * uy + m02 * uz,
        m10 * ux + m11 * uy + m12 * uz,
        m20 * ux + m21 * uy + m22 * uz,
        m00 * vx + m01 * vy + m02 * vz,
        m10 * vx + m11 * vy + m12 * vz,
        m20 * vx + m21 * vy + m22 * vz,
    )


@njit(**OPTIONS)
def sample_light(table, lights, lamps, nodes, children, px, py, pz, nx, ny, nz, u, u0, u1, ls, chosen):
    """Sample a light from a point p with shading normal n.

    table: SceneTable; lights, lamps, nodes, children: of `Lights`; u, u0, u1: uniform numbers; ls: float32[LIGHT_SAMPLE], D_*; chosen: int64[2], instance and
    triangle of an emissive sample. Returns a lamp's index, WORLD, INSTANCE, or NONE where nothing arrives.
    """
    finite = finite_share(lights)
    if u < finite:
        u /= finite
        e = np.int64(0)
        share = finite
        if lights[L_EMITTERS] > np.uint64(1):
            e, p = sample_tree(nodes, children, u, px, py, pz, nx, ny, nz)
            if e < 0:
                return NONE
            share *= p
        record = lights[L_EMITTER_RECORDS] + np.uint64(e) * _EMITTER_SIZE
        lamp = np.int64(load_i32(record + _LAMP, 0))
        if lamp < 0:
            instance = np.int64(load_i32(record + _INSTANCE, 0))
            first = load_i64(record + _FIRST, 0)
            i = find_interval(lights[L_CDF], first, load_i64(record + _COUNT, 0), u0)
            a, b = load_f32(lights[L_CDF], first + i), load_f32(lights[L_CDF], first + i + 1)
            u0 = min((u0 - a) / max(b - a, np.float32(1e-30)), np.float32(1.0))
            triangle = np.int64(load_i32(lights[L_TRIANGLES], first + i))
            root = math.sqrt(u0)
            b1 = root * (_ONE - u1)
            b2 = root * u1
            ax, ay, az, ux, uy, uz, vx, vy, vz = triangle_edges(lights[L_MESHES], table, instance, triangle)
            dx, dy, dz, t = normalize(ax - px + b1 * ux + b2 * vx, ay - py + b1 * uy + b2 * vy, az - pz + b1 * uz + b2 * vz)
            cos_area = abs((uy * vz - uz * vy) * dx + (uz * vx - ux * vz) * dy + (ux * vy - uy * vx) * dz) * _HALF
            if not (cos_area > _ZERO and t > _ZERO):
                return NONE
            ls[0], ls[1], ls[2], ls[3] = dx, dy, dz, t
            ls[4] = share * (b - a) * t * t / cos_area
            ls[5] = _ONE
            ls[6], ls[7] = b1, b2
            chosen[0], chosen[1] = instance, triangle
            return INSTANCE
    else:
        u = (u - finite) / max(_ONE - finite, np.float32(1e-30))
        i = find_interval(lights[L_INFINITE_CDF], np.int64(0), np.int64(lights[L_INFINITE]), u)
        share = (_ONE - finite) * (load_f32(lights[L_INFINITE_CDF], i + 1) - load_f32(lights[L_INFINITE_CDF], i))
        lamp = np.int64(load_i32(lights[L_INFINITE_LAMP], i))
        if lamp < 0:
            dx, dy, dz, pdf = sample_environment(lights[L_MARGINAL], lights[L_CONDITIONAL], np.int64(lights[L_WIDTH]), np.int64(lights[L_HEIGHT]), u0, u1)
            ls[0], ls[1], ls[2], ls[3] = dx, dy, dz, FAR
            ls[4] = share * pdf
            ls[5] = _ONE
            return WORLD if pdf > _ZERO else NONE
    if not sample_lamp(f32_pointer(lamps + np.uint64(4 * LAMP) * np.uint64(lamp)), px, py, pz, u0, u1, ls):
        return NONE
    ls[4] *= share
    return lamp


@njit(**OPTIONS)
def emitter_share(lights, nodes, children, e, px, py, pz, nx, ny, nz):
    """Probability with which `sample_light` picks emitter e of the tree."""
    share = finite_share(lights)
    if lights[L_EMITTERS] > np.uint64(1):
        share *= tree_pdf(nodes, children, load_u64(lights[L_TRAILS], e), px, py, pz, nx, ny, nz)
    return share


@njit(**OPTIONS)
def infinite_share(lights, i):
    """Probability with which `sample_light` picks light i at infinity."""
    return (_ONE - finite_share(lights)) * (load_f32(lights[L_INFINITE_CDF], i + 1) - load_f32(lights[L_INFINITE_CDF], i))


@njit(**OPTIONS)
def lamp_density(lights, lamps, nodes, children, lamp, px, py, pz, nx, ny, nz, dx, dy, dz, t):
    """Density per solid angle with which `sample_light` makes a direction d from p by way of a lamp that d meets at distance t."""
    e = np.int64(load_i32(lights[L_LAMP_EMITTER], lamp))
    if e < 0:
        return _ZERO
    k = f32_pointer(lamps + np.uint64(4 * LAMP) * np.uint64(lamp))
    if k[0] == SUN:
        share = infinite_share(lights, e)
    else:
        share = emitter_share(lights, nodes, children, e, px, py, pz, nx, ny, nz)
    return share * lamp_pdf(k, px, py, pz, dx, dy, dz, t)


@njit(**OPTIONS)
def world_density(lights, dx, dy, dz):
    """Density per solid angle with which `sample_light` makes a direction by way of the world; 0 where the world is not sampled."""
    if lights[L_IMAGE] == np.uint64(0):
        return _ZERO
    pdf = environment_pdf(lights[L_MARGINAL], lights[L_CONDITIONAL], np.int64(lights[L_WIDTH]), np.int64(lights[L_HEIGHT]), dx, dy, dz)
    return infinite_share(lights, np.int64(lights[L_WORLD_LIGHT])) * pdf


@njit(**OPTIONS)
def triangle_density(table, lights, nodes, children, instance, triangle, px, py, pz, nx, ny, nz, dx, dy, dz, t):
    """Density per solid angle with which `sample_light` makes a direction d from p by way of an emissive triangle that d meets at distance t."""
    if lights[L_INSTANCE_EMITTER] == np.uint64(0) or lights[L_EMITTERS] == np.uint64(0):
        return _ZERO
    e = np.int64(load_i32(lights[L_INSTANCE_EMITTER], instance))
    if e < 0:
        return _ZERO
    record = lights[L_EMITTER_RECORDS] + np.uint64(e) * _EMITTER_SIZE
    first = load_i64(record + _FIRST, 0)
    count = load_i64(record + _COUNT, 0)
    # Its place in the distribution: triangles are ascending there.
    low, high = np.int64(0), count
    while high - low > 1:
        middle = (low + high) >> 1
        if np.int64(load_i32(lights[L_TRIANGLES], first + middle)) <= triangle:
            low = middle
        else:
            high = middle
    if np.int64(load_i32(lights[L_TRIANGLES], first + low)) != triangle:
        return _ZERO
    p = load_f32(lights[L_CDF], first + low + 1) - load_f32(lights[L_CDF], first + low)
    _, _, _, ux, uy, uz, vx, vy, vz = triangle_edges(lights[L_MESHES], table, instance, triangle)
    cos_area = abs((uy * vz - uz * vy) * dx + (uz * vx - ux * vz) * dy + (ux * vy - uy * vx) * dz) * _HALF
    if not cos_area > _ZERO:
        return _ZERO
    return emitter_share(lights, nodes, children, e, px, py, pz, nx, ny, nz) * p * t * t / cos_area
