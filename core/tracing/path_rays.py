"""Rays of path kernels: their queries to Embree, the hitboxes that they cross, and the surfaces that share a place.

Surfaces of two instances may lie in one plane: a decal on its wall at no distance, two floors at 0. A renderer shows
neither properly: which of them a ray meets, and whether one shadows the other, is chance. Where one goes, the other
looks different, though paths may have met but one of them. Instances that lie exactly where another one does are found
by their boxes (core.scene.together); those that share a plane, by short rays at what paths meet.

Shaders may ask what is around a surface (Ambient Occlusion, Raycast): what that does to its look nobody knows, so rays
look around where paths meet such a surface, and what these find stays.
"""

from __future__ import annotations

import math

import numpy as np
from numba import carray, cfunc, njit, types

from ..accel.embree import (
    DIR,
    FLAGS,
    GEOM_ID,
    HIT_U,
    HIT_V,
    ID,
    INST_ID,
    INST_PRIM_ID,
    INVALID,
    MASK,
    NG,
    ORG,
    PRIM_ID,
    RAY,
    TFAR,
    TIME,
    TNEAR,
)
from ..accel.embree import _intersect1 as rtc_intersect
from ..accel.hitboxes import QUERY, count_crossings
from ..jit.atomics import pointer
from ..jit.pointers import i32_pointer, load_f32, load_i32, load_u32, u32_pointer, u64_pointer
from ..jit.sampling import INNER, mix, uniform2
from ..scene.model import ALL_RAYS, RAY_TYPES, RayType
from .bsdf.lobes import F_NG
from .lights.lamps import FAR
from .lights.light_sampling import triangle_edges
from .path_feedback import add_worth, count_hit, credit_unbuilt
from .path_state import I_HITBOX_NEAREST, RAYS, V_AMBIENT
from .surface import S_ERROR, S_P, T_TRANSFORM, interpolate, mesh_record, offset_origin

_ZERO, _ONE, _TWO, _TURN = map(np.float32, (0.0, 1.0, 2.0, 2 * math.pi))
_INSTANCE_BYTES = np.uint64(48)
# Exactly flat ground at 0 has no error to move by: a hit at distance 0 must not count.
_NEAR = np.float32(1e-30)
_EVERY = np.uint64(7)  # paths look where these bits of their key are 0: one in eight
_SALT, _AROUND = np.uint64(0x636F706C616E6172), np.uint64(0x61726F756E64)
_SHADOW, _ALL = np.int64(RayType.SHADOW), np.uint32(ALL_RAYS)
_REACH = np.float32(2.0)  # times the bound of a hit's error: this tracer's error, and that of a renderer
_ARGUMENT_FILTER = np.uint64(0xFFFFFFFF00000002)  # of RTCIntersectArguments: flags, and every feature
_GRAZING = np.float32(0.01)  # cosine to the normal: at less, a surface counts as no thicker
_PARALLEL = np.float32(0.99)  # cosine between normals: at less, surfaces cross in a line, which is no area


@njit(**INNER)
def set_ray(ray, words, ox, oy, oz, dx, dy, dz, far, ray_type):
    """Fill a ray for a query: ray as float32, words its address."""
    ray[ORG] = ox
    ray[ORG + 1] = oy
    ray[ORG + 2] = oz
    ray[TNEAR] = _NEAR
    ray[DIR] = dx
    ray[DIR + 1] = dy
    ray[DIR + 2] = dz
    ray[TIME] = _ZERO
    ray[TFAR] = far
    w = u32_pointer(words)
    w[MASK] = np.uint32(1 << ray_type)
    w[ID] = np.uint32(0)
    w[FLAGS] = np.uint32(0)
    w[GEOM_ID] = w[INST_ID] = w[INST_PRIM_ID] = np.uint32(INVALID)


@njit(**INNER)
def intersect(tlas, words):
    """Closest hit of the ray at address words."""
    rtc_intersect(pointer(tlas), pointer(words), pointer(np.uint64(0)))
    return load_u32(words, GEOM_ID) != np.uint32(INVALID)


@njit(**INNER)
def entry_of(s, words):
    """TLAS entry that the ray at address words met."""
    return s.first[np.int64(load_u32(words, INST_ID))] + np.int64(load_u32(words, INST_PRIM_ID))


@njit(**INNER)
def count_boxes(hitboxes, counters, length, query, words, far, ray_type, nearest):
    """`count_crossings` of what lies at addresses."""
    return count_crossings(
        hitboxes,
        carray(pointer(counters), (np.int64(length), RAY_TYPES), np.int64),
        carray(pointer(query), (QUERY,), np.int64),
        carray(pointer(words), (RAY,), np.float32),
        far,
        ray_type,
        nearest,
    )


@njit(**INNER)
def start_at_hit(s, w, record, ox, oy, oz, dx, dy, dz):
    """The hit that a raster found on the ray from o along d, into w.ray as if traced; its instance, or -1. record:
    address of a scene.model.HIT."""
    instance = np.int64(load_i32(record, 0))
    if instance < 0:
        return instance
    triangle, b1, b2 = load_u32(record, 1), load_f32(record, 2), load_f32(record, 3)
    mesh = mesh_record(s.primary_meshes, s.table, instance)
    interpolate(
        mesh, s.table[T_TRANSFORM] + _INSTANCE_BYTES * np.uint64(instance), np.int64(triangle), b1, b2, w.surf, w.frame
    )
    w.ray[TFAR] = max((w.surf[0] - ox) * dx + (w.surf[1] - oy) * dy + (w.surf[2] - oz) * dz, _ZERO)
    w.ray[HIT_U] = b1
    w.ray[HIT_V] = b2
    u32_pointer(w.ray_words)[PRIM_ID] = triangle
    return instance


@njit(**INNER)
def looks_for_coincident(key):
    """Whether the path of a key is one of those that look for coincident surfaces."""
    return mix(key + _SALT) & _EVERY == np.uint64(0)


@njit(**INNER)
def reach_of(w):
    """How far from where a path has met a surface, w.surf, another may lie that a renderer takes for the same.

    Of all axes: ground at 0 is exactly flat here, but a renderer meets it at distances that it has rounded.
    """
    return _REACH * max(w.surf[S_ERROR], max(w.surf[S_ERROR + 1], w.surf[S_ERROR + 2]))


@cfunc(types.void(types.CPointer(types.uintp)), cache=True)
def _others(arguments):
    # RTCFilterFunctionNArguments: valid, user pointer, context, ray, hit, N. Rejects hits of the instance that is named
    # behind Embree's part of the context.
    hit, context = arguments[4], arguments[2]
    same = load_u32(hit, INST_ID - NG) == load_u32(context, 2)
    if same and load_u32(hit, INST_PRIM_ID - NG) == load_u32(context, 3):
        i32_pointer(arguments[0])[0] = 0


OTHERS = int(_others.address or 0)


@njit(**INNER)
def _nearest_other(s, w, instance, prim):
    """Closest hit of w.ray of another instance than that which Embree names so. Overwrites w.query."""
    query, words = u64_pointer(w.query), u32_pointer(w.query)
    words[0] = words[1] = np.uint32(INVALID)  # RTCRayQueryContext, and what the callback needs
    words[2] = instance
    words[3] = prim
    query[2] = _ARGUMENT_FILTER  # RTCIntersectArguments
    query[3] = w.query
    query[4] = s.others
    query[5] = query[6] = np.uint64(0)
    rtc_intersect(pointer(s.tlas), pointer(w.ray_words), pointer(w.query + np.uint64(16)))
    return load_u32(w.ray_words, GEOM_ID) != np.uint32(INVALID)


@njit(**INNER)
def coincident(s, w, ray_type):
    """TLAS entry of another instance that has a surface of the same plane where a path has met one, or -1. w.ray: as it
    met it, and overwritten; w.surf, w.frame: of the hit, its normals turned to where the path came from."""
    instance, prim = load_u32(w.ray_words, INST_ID), load_u32(w.ray_words, INST_PRIM_ID)
    nx, ny, nz = w.frame[F_NG], w.frame[F_NG + 1], w.frame[F_NG + 2]
    reach = reach_of(w)
    ox, oy, oz = w.surf[S_P] - reach * nx, w.surf[S_P + 1] - reach * ny, w.surf[S_P + 2] - reach * nz
    set_ray(w.ray, w.ray_words, ox, oy, oz, nx, ny, nz, _TWO * reach, ray_type)
    if not _nearest_other(s, w, instance, prim):
        return np.int64(-1)
    entry = entry_of(s, w.ray_words)
    other = np.int64(s.ids[entry])
    triangle = np.int64(load_u32(w.ray_words, PRIM_ID))
    _, _, _, ux, uy, uz, vx, vy, vz = triangle_edges(s.meshes, s.table, other, triangle)
    mx, my, mz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    along = abs(mx * nx + my * ny + mz * nz)
    if not along * along > _PARALLEL * _PARALLEL * (mx * mx + my * my + mz * mz):
        return np.int64(-1)
    return entry


@njit(**INNER)
def hidden_in_full(s, w, ox, oy, oz, dx, dy, dz, t, ray_type):
    """Whether something of the full scene lies before what a path has met at t on the ray from o along d. w.surf,
    w.frame: of the hit. Overwrites w.ray."""
    along = abs(w.frame[F_NG] * dx + w.frame[F_NG + 1] * dy + w.frame[F_NG + 2] * dz)
    before = t - _TWO * reach_of(w) / max(along, _GRAZING)
    if before <= _ZERO:
        return False
    set_ray(w.ray, w.ray_words, ox, oy, oz, dx, dy, dz, before, ray_type)
    return intersect(s.full, w.ray_words)


@njit(**INNER)
def look_around(s, w, key, dimension, reach, count, carried):
    """Look in a direction, any one, for what lies within reach of a surface whose look depends on it: it stays. w.surf,
    w.frame: of the hit. count: count the hitboxes on the way, for which the path carried so much luminance. Overwrites
    w.shadow."""
    u0, u1 = uniform2(mix(key + _AROUND), dimension)
    dz = _ONE - _TWO * u0
    r = math.sqrt(max(_ONE - dz * dz, _ZERO))
    dx, dy = r * math.cos(_TURN * u1), r * math.sin(_TURN * u1)
    ox, oy, oz = offset_origin(w.surf, w.frame, dx, dy, dz)
    set_ray(w.shadow, w.shadow_words, ox, oy, oz, dx, dy, dz, reach, _SHADOW)
    u32_pointer(w.shadow_words)[MASK] = _ALL
    w.stats[RAYS] += 1
    hit = intersect(s.tlas, w.shadow_words)
    if count:
        t = w.shadow[TFAR] if hit else reach
        crossed = count_boxes(
            s.hitboxes, s.counters, s.counters_length, w.query, w.shadow_words, t, _SHADOW, s.settings[I_HITBOX_NEAREST]
        )
        if crossed > 0 and s.weights != np.uint64(0):
            credit_unbuilt(s, w, carried * s.limits[V_AMBIENT])
    if hit:
        entry = entry_of(s, w.shadow_words)
        count_hit(s, np.int64(s.ids[entry]), _SHADOW)
        if s.weights != np.uint64(0):
            add_worth(s, w, entry, FAR)
