"""Emitters as the camera sees them: sampled on the emitters themselves.

An emitter of less than a pixel can be as bright as all else in a tile, and of the paths from the camera few or none
meet it: that they did not is no evidence that nobody sees it. Light sampling finds it from surfaces, not from the
camera. So points on each small emitter are connected to the camera, as light tracing does: the estimate's noise does
not depend on how small or how bright an emitter is.

Erring on the side of seeing more: what is not surely opaque is looked through without loss, what is not built stands in
nothing's way, and a textured emitter is as bright as its strength. Where one instance alone hides a point, it has what
the point would bring: so much more the camera sees without it. Not modelled: an emitter that the camera's motion blurs
counts where the sharp picture has it, and what emits without being sampled as a light is left to paths.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ..accel.embree import INST_ID, INST_PRIM_ID, PRIM_ID, RAY, TFAR
from ..accel.tlas import Tlas
from ..arrays import F64, I32, I64
from ..feedback.tiles import COLUMNS, ROWS, TILES, tiles_of
from ..jit.pointers import f32_pointer, load_f32, load_i32, load_i64, load_u8, load_u32, offset
from ..jit.sampling import INNER, OPTIONS, normalize, path_key, uniform2
from ..scene.camera import aperture_point
from ..scene.frustum import View
from ..scene.model import RayType, Scene, Shader, Unsure
from .lights.environment import find_interval
from .lights.light_sampling import (
    L_CDF,
    L_EMITTER_RECORDS,
    L_INSTANCE_EMITTER,
    L_MESHES,
    L_TRIANGLES,
    triangle_edges,
)
from .lights.lights import EMITTER
from .materials import M_EMISSION, M_SINGLE_SIDED, MATERIAL_SIZE, material_of
from .path_rays import intersect, set_ray
from .surface import T_MATERIALS, mesh_record
from .tracer import Prepared

SMALL = 12.0  # pixels: of an emitter larger than this, paths find what it is worth
POINTS = (16, 256)  # on each emitter, at least and at most
RAYS = 1 << 19  # in all, where many emitters are small
POLISHED = 0.2  # roughness below which a lobe is narrower than most that light sampling finds
PASSES = 64  # surfaces that a ray looks through at most
_SURE = np.float32(0.999)  # of the way to a point on an emitter: what a ray meets behind that is the emitter
_BEYOND = np.float32(1 + 1e-5)  # times the distance of a surface that is looked through: where the ray goes on
_CAMERA = int(RayType.CAMERA)
_EMITTER_SIZE = np.uint64(EMITTER.itemsize)
_FIRST, _COUNT = offset(EMITTER, "first"), offset(EMITTER, "count")
_NOTHING, _SEVERAL = -1, -2
_ONE, _ZERO, _HALF, _TINY = np.float32(1.0), np.float32(0.0), np.float32(0.5), np.float32(1e-30)


@dataclass(frozen=True)
class SeenEmitters:
    """What the camera sees of small emitters, and what hides of them.

    instance: (S,) int64; tile: (S,) int32; color: (S, 3) float64, what of the mean radiance of a tile the instance
    brings, or, where hiding, (S,) bool, keeps away.
    """

    instance: I64
    tile: I32
    color: F64
    hiding: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.instance)

    def without(self, keep: np.ndarray) -> F64:
        """(T, 3) mean radiance that each tile lacks, or has besides, where only keep, (N,) bool, is in the scene."""
        return self._sums(~keep[self.instance])

    def shown(self, keep: np.ndarray) -> F64:
        """(T, 3) mean radiance that each tile has of those of keep, (N,) bool, that nothing hides."""
        return self._sums(keep[self.instance] & ~self.hiding)

    def _sums(self, which: np.ndarray) -> F64:
        return np.stack([np.bincount(self.tile[which], self.color[which, c], TILES) for c in range(3)], axis=1)


NONE_SEEN = SeenEmitters(np.zeros(0, np.int64), np.zeros(0, np.int32), np.zeros((0, 3)), np.zeros(0, bool))


def seen_emitters(prepared: Prepared, tlas: Tlas, size: tuple[int, int], seed: int = 0) -> SeenEmitters:
    """What the camera sees of those emitters, built or not, that are small in a picture of size (width, height), past
    what is in tlas."""
    scene, emissive = prepared.scene, prepared.emissive
    rows = emissive[(scene.instances.flags[emissive] & (1 << _CAMERA)) != 0]
    boxes = scene.instances.bounds[rows]
    view, extent = View.of(scene.camera, lens=True), np.linalg.norm(boxes[:, 1] - boxes[:, 0], axis=1)
    rows = rows[view.shows(boxes, extent, 0.0) & ~view.shows(boxes, extent, SMALL / size[0])]
    if not len(rows):
        return NONE_SEEN
    points = int(np.clip(RAYS // len(rows), *POINTS))
    tile, color = np.full((len(rows), points), -1, np.int32), np.zeros((len(rows), points, 3), np.float32)
    whose = np.repeat(rows.astype(np.int64)[:, None], points, axis=1)
    camera = prepared.camera[len(prepared.camera) // 2]  # of a shutter: the one in its middle
    _see(
        rows,
        prepared.table.table,
        prepared.lights.table,
        prepared.blas.table.ctypes.data,
        tlas.handle,
        tlas.ids,
        tlas.first,
        _opaque(scene),
        camera,
        np.array(size),
        seed,
        tile,
        color,
        whose,
    )
    seen = tile >= 0
    hiding = whose != rows[:, None]
    place = ((whose * 2 + hiding) * TILES + tile)[seen]
    named, number = np.unique(place, return_inverse=True)
    pixels = np.bincount(tiles_of(size[1], size[0]).ravel(), minlength=TILES)
    sums = np.stack([np.bincount(number, color[..., c][seen], len(named)) for c in range(3)], axis=1)
    tiles = (named % TILES).astype(np.int32)
    whom = (named // TILES).astype(np.int64)
    return SeenEmitters(whom // 2, tiles, sums / np.maximum(pixels, 1)[tiles][:, None], whom % 2 > 0)


def polished(scene: Scene) -> bool:
    """Whether some surface may be so smooth that light sampling hardly finds what it reflects or refracts."""
    m = scene.materials
    base = (m["roughness"] < POLISHED) | (m["roughness_texture"] >= 0)
    coat = (m["coat"] > 0) & (m["coat_roughness"] < POLISHED)
    shaders = [Shader.PRINCIPLED, Shader.GLOSSY, Shader.GLASS, Shader.REFRACTION]
    return bool((np.isin(m["shader"], shaders) & (base | coat)).any())


def _opaque(scene: Scene) -> np.ndarray:
    """(M,) bool: materials that surely let no light pass straight on."""
    m = scene.materials
    shaders = [Shader.PRINCIPLED, Shader.DIFFUSE, Shader.GLOSSY, Shader.EMISSION, Shader.HOLDOUT]
    solid = (m["alpha"] >= 1) & (m["alpha_texture"] < 0) & (m["transmission"] == 0) & (m["transmission_texture"] < 0)
    return np.asarray(np.isin(m["shader"], shaders) & solid & (m["unsure"] & (Unsure.BEHIND | Unsure.CLEAR) == 0))


@njit(**OPTIONS)
def _see(rows, table, lights, meshes, tlas, ids, first, opaque, camera, size, seed, tile, color, whose):
    """Connect points of the emitters rows, (E,), to the camera: the tile of each, (E, K) int32, where the camera sees
    it or one instance hides it, and what it brings there, (E, K, 3) float32, summed over the tile's pixels. whose:
    (E, K) int64, the emitters, in whose place what hides them is put. meshes: address of those in the
    TLAS, whose entries ids and first tell. opaque: (M,) by material. camera: `camera_constants`."""
    points = tile.shape[1]
    buffer = np.zeros(RAY + 4, np.float32)
    words = (np.uint64(buffer.ctypes.data) + np.uint64(15)) & ~np.uint64(15)
    ray = f32_pointer(words)
    for e in range(len(rows)):
        instance = np.int64(rows[e])
        record = lights[L_EMITTER_RECORDS] + _EMITTER_SIZE * np.uint64(load_i32(lights[L_INSTANCE_EMITTER], instance))
        start, count = load_i64(record + _FIRST, 0), load_i64(record + _COUNT, 0)
        mesh = mesh_record(lights[L_MESHES], table, instance)
        for k in range(points):
            u, v = uniform2(path_key(np.uint64(seed), np.uint64(instance), np.uint64(k)), np.uint64(0))
            u = (np.float32(k) + u) / np.float32(points)  # in strata
            i = find_interval(lights[L_CDF], start, count, u)
            a, b = load_f32(lights[L_CDF], start + i), load_f32(lights[L_CDF], start + i + 1)
            root = math.sqrt(min((u - a) / max(b - a, _TINY), _ONE))
            b1, b2 = root * (_ONE - v), root * v
            triangle = np.int64(load_i32(lights[L_TRIANGLES], start + i))
            px, py, pz, ux, uy, uz, vx, vy, vz = triangle_edges(lights[L_MESHES], table, instance, triangle)
            # normal with twice the area as its length
            nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
            px, py, pz = px + b1 * ux + b2 * vx, py + b1 * uy + b2 * vy, pz + b1 * uz + b2 * vz
            lx, ly = _ZERO, _ZERO
            if camera[19] > _ZERO:
                lx, ly = aperture_point(
                    camera, *uniform2(path_key(np.uint64(seed), np.uint64(instance), np.uint64(k)), np.uint64(1))
                )
            x, y, ox, oy, oz, pixels = _on_picture(camera, lx * camera[19], ly * camera[19], px, py, pz, nx, ny, nz)
            column, row = math.floor(x * size[0]), math.floor(y * size[1])
            if not (pixels > _ZERO and 0 <= column < size[0] and 0 <= row < size[1]):
                continue
            dx, dy, dz, distance = normalize(px - ox, py - oy, pz - oz)
            material = material_of(table, mesh, instance, triangle)
            if load_u8(material + M_SINGLE_SIDED, 0) != 0 and nx * dx + ny * dy + nz * dz > _ZERO:
                continue
            hides = _hides(words, ray, table, meshes, tlas, ids, first, opaque, ox, oy, oz, dx, dy, dz, distance)
            if hides == _SEVERAL:
                continue
            if hides != _NOTHING:
                whose[e, k] = hides
            tile[e, k] = row * ROWS // size[1] * COLUMNS + column * COLUMNS // size[0]
            pixels *= _HALF * np.float32(size[0] * size[1]) / (max(b - a, _TINY) * np.float32(points))
            for c in range(3):
                color[e, k, c] = pixels * load_f32(material + M_EMISSION, c)
    return buffer[0]  # keeps it alive until here


@njit(**INNER)
def _on_picture(c, lx, ly, px, py, pz, nx, ny, nz):
    """Where a camera sees a point through (lx, ly) of its lens, metres, in [0, 1]^2, v upward; the origin of the ray to
    it, 3 numbers; and the share of the picture that an area takes there, whose normal n is as long as the area is
    large; 0 behind the camera."""
    x, y, z = px - c[3], py - c[7], pz - c[11]
    right = c[0] * x + c[4] * y + c[8] * z
    up = c[1] * x + c[5] * y + c[9] * z
    depth = -(c[2] * x + c[6] * y + c[10] * z)
    if not c[17] < depth < c[18]:
        return _ZERO, _ZERO, px, py, pz, _ZERO
    wide, high = c[13] - c[12], c[15] - c[14]
    sx, sy = (lx / c[20], ly / c[20]) if c[19] > _ZERO else (_ZERO, _ZERO)  # to where it is in focus
    if c[16] != _ZERO:  # orthographic: along its axis, or aslant through the lens, from its plane
        x, y, z = c[2] + sx * c[0] + sy * c[1], c[6] + sx * c[4] + sy * c[5], c[10] + sx * c[8] + sy * c[9]
        facing = abs(nx * x + ny * y + nz * z)
        ox, oy, oz = px + depth * x, py + depth * y, pz + depth * z
        right, up = right + sx * depth - lx, up + sy * depth - ly
    else:
        ox, oy, oz = c[3] + lx * c[0] + ly * c[1], c[7] + lx * c[4] + ly * c[5], c[11] + lx * c[8] + ly * c[9]
        facing = abs(nx * (px - ox) + ny * (py - oy) + nz * (pz - oz)) / (depth * depth * depth)
        right, up = (right - lx) / depth + sx, (up - ly) / depth + sy
    near = c[17] / depth
    ox, oy, oz = ox + near * (px - ox), oy + near * (py - oy), oz + near * (pz - oz)
    return (right - c[12]) / wide, (up - c[14]) / high, ox, oy, oz, facing / abs(wide * high)


@njit(**INNER)
def _hides(words, ray, table, meshes, tlas, ids, first, opaque, ox, oy, oz, dx, dy, dz, distance):
    """The instance that alone is surely opaque on a ray before a distance; _NOTHING, or _SEVERAL."""
    left, found = _SURE * distance, np.int64(_NOTHING)
    for _ in range(PASSES):
        set_ray(ray, words, ox, oy, oz, dx, dy, dz, left, _CAMERA)
        if not intersect(tlas, words):
            return found
        entry = first[np.int64(load_u32(words, INST_ID))] + np.int64(load_u32(words, INST_PRIM_ID))
        instance, triangle = np.int64(ids[entry]), np.int64(load_u32(words, PRIM_ID))
        material = material_of(table, mesh_record(meshes, table, instance), instance, triangle)
        if opaque[np.int64((material - table[T_MATERIALS]) // MATERIAL_SIZE)]:
            if found not in (_NOTHING, instance):
                return np.int64(_SEVERAL)
            found = instance
        step = ray[TFAR] * _BEYOND + _TINY
        ox, oy, oz, left = ox + step * dx, oy + step * dy, oz + step * dz, left - step
        if not left > _ZERO:
            return found
    return found
