"""The path tracing kernel: one tile of pixels, all of its samples.

Paths follow Cycles' rules: what counts as which bounce, where a path ends, what is weighed against what (kernel/integrator/path_state.h, shade_surface.h).
At every vertex one light is sampled and one direction; both are weighed by the power heuristic (Veach 1997).
Where a raster has found the first hits (core.primary), paths start at these instead of with a camera ray, and their light is also summed by parts.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import carray, njit

from .atomics import atomic_add_int64, pointer
from .bsdf import (
    BACKFACING,
    C_EMISSION,
    C_HAS_EVAL,
    C_TRANSPARENCY,
    CLOSURE,
    DIFFUSE,
    F_N,
    FRAME,
    NO_REFLECTIVE_CAUSTICS,
    NO_REFRACTIVE_CAUSTICS,
    O_PDF,
    O_WEIGHT,
    OUT,
    PARAMS,
    REFLECT,
    SINGULAR,
    TRANSMIT,
    TRANSPARENT,
    bsdf_blur,
    bsdf_eval,
    bsdf_sample,
    bsdf_setup,
    bsdf_transparency,
)
from .camera import camera_ray
from .embree import DIR, FLAGS, GEOM_ID, HIT_U, HIT_V, ID, INST_ID, INST_PRIM_ID, INVALID, MASK, ORG, PRIM_ID, RAY, TFAR, TIME, TNEAR
from .embree import _intersect1 as rtc_intersect
from .embree import _occluded1 as rtc_occluded
from .environment import environment_radiance
from .feedback import COLUMNS, ROWS, TILES
from .film import LUMINANCE, filter_offset
from .hitboxes import QUERY, count_crossings
from .lamps import FAR, LAMP, lamp_hit, lamp_share
from .lights import (
    INSTANCE,
    L_COUNT_SHAPES,
    L_EMITTERS,
    L_HEIGHT,
    L_IMAGE,
    L_INFINITE,
    L_LAMPS,
    L_MESHES,
    L_WIDTH,
    L_WORLD_VISIBILITY,
    LIGHT_SAMPLE,
    NONE,
    WORLD,
    lamp_density,
    sample_light,
    triangle_density,
    world_density,
)
from .memory import f32_pointer, f64_pointer, i32_pointer, i64_pointer, load_f32, load_i32, load_u8, load_u32, u32_pointer, u64_pointer
from .path_log import RECORD
from .sampling import INNER, mix, normalize, path_key, power_heuristic, uniform2
from .scene import RAY_TYPES, InstanceFlag, RayType, Shader
from .shading import (
    M_MIS,
    M_SHADER,
    S_ERROR,
    SURF,
    T_FLAGS,
    T_TRANSFORM,
    apply_normal_map,
    attenuates_emission,
    emission,
    emits,
    face,
    interpolate,
    material_alpha,
    material_inputs,
    material_of,
    mesh_record,
    offset_origin,
    shadow_origin,
    transmits_shadow,
)

# settings, int64[SETTINGS]
(
    I_WIDTH,
    I_HEIGHT,
    I_FIRST_SAMPLE,
    I_SAMPLES,
    I_SEED,
    I_TOTAL,
    I_DIFFUSE,
    I_GLOSSY,
    I_TRANSMISSION,
    I_TRANSPARENT,
    I_REFLECTIVE,
    I_REFRACTIVE,
    I_TRANSPARENT_FILM,
    I_TRANSPARENT_SHADOWS,
    I_HITBOX_EVERY,
    I_HITBOX_NEAREST,
    I_STRATEGY,
    I_LAMPS_KNOWN,
) = range(18)
SETTINGS = 18
BOTH, LIGHT_ONLY, BSDF_ONLY = 0, 1, 2  # I_STRATEGY: for tests, all agree in the mean

# limits, float32[LIMITS]: clamps (sum over channels, FAR where off), inverse of filter glossy (0: off), exposure, world colour
# (3), and for weights (feedback.Weights): mean luminance of the picture, fixed-point units to one of luminance
V_CLAMP_DIRECT, V_CLAMP_INDIRECT, V_FILTER_GLOSSY, V_EXPOSURE, V_WORLD, V_AMBIENT, V_UNITS = 0, 1, 2, 3, 4, 7, 8
LIMITS = 9

# Parts of the light of paths that start at raster hits, float32[PARTS] per pixel. Emission and background seen at the first hit; light of lamps from their own
# sampling or from the path's next ray at the first hit, free of what is built: without (CLEAR) and with (MAYBE) boxes of culled instances on the way. Then the
# luminance of light sampling alone at the first hit: clear, maybe, and denied by what is built (BLOCKED).
STRAIGHT, CLEAR, MAYBE, SAMPLED_CLEAR, SAMPLED_MAYBE, SAMPLED_BLOCKED = 0, 3, 6, 9, 10, 11
PARTS = 12
_NO_PART = -1
_PARTS_AT = 4  # in Scratch.total

RAYS, PATHS = 0, 1  # stats, int64[2]
_TILE, _VERTICES, _RECORD = 2, 3, 4  # of a thread's own stats: coarse tile of the pixel, how many instances the path has met, address of its record
MAX_VERTICES = 64  # met by one path and weighed; what is met after them goes with the last

_CAMERA, _DIFFUSE_RAY, _GLOSSY_RAY, _TRANSMISSION_RAY, _SHADOW = (int(t) for t in RayType)
_HOLDOUT_FLAG = int(InstanceFlag.HOLDOUT)
_HOLDOUT = int(Shader.HOLDOUT)
_ZERO, _ONE, _THIRD = np.float32(0.0), np.float32(1.0), np.float32(1.0 / 3.0)
# Exactly flat ground at 0 has no error to move by: a hit at distance 0 must not count.
_NEAR = np.float32(1e-30)
# What a ray from far away adds to the error at its end, per distance: 12 roundings to take its origin there, 5 of the distance to the plane, 4 of its length.
_REACH = np.float32(24 * 2.0**-24)
_DIMENSIONS = 4  # pairs of numbers per vertex
_LENS, _FILTER = np.uint64(1 << 40), np.uint64((1 << 40) + 1)
_INSTANCE_BYTES = np.uint64(48)
_RED, _GREEN, _BLUE = (np.float32(x) for x in LUMINANCE)
_MOST = np.float32(1e12)  # units of one event, so that no sum of them overflows


class Scenery(NamedTuple):
    """All that a path reads, as pointers or addresses; arrays as their owners describe them (SceneTable, Lights, Tlas, BlasCache, Hitboxes)."""

    table: Any
    lights: Any
    lamps: Any
    nodes: Any
    children: Any
    meshes: Any
    tlas: Any
    ids: Any
    first: Any
    hitboxes: Any
    counters: Any
    counters_length: Any
    feedback: Any
    weights: Any
    tile_light: Any
    entries: Any
    log: Any
    primary_meshes: Any
    boxes: Any
    box_counters: Any
    box_count: Any
    settings: Any
    limits: Any


class Scratch(NamedTuple):
    """Work space of one thread. `far_*`: for the point on a light or on the way to it."""

    ray: Any
    shadow: Any
    ray_words: Any
    shadow_words: Any
    query: Any
    surf: Any
    frame: Any
    params: Any
    closure: Any
    out: Any
    light: Any
    chosen: Any
    far_surf: Any
    far_frame: Any
    far_params: Any
    far_closure: Any
    radiance: Any
    total: Any
    stats: Any
    vertex: Any
    carried: Any


# Where the kernel finds things, uint64[ADDRESSES]: A_* addresses, N_* lengths, handles as they are.
(
    A_TABLE,
    A_LIGHTS,
    A_LAMPS,
    A_NODES,
    A_CHILDREN,
    A_MESHES,
    TLAS,
    A_IDS,
    A_FIRST,
    HITBOXES,
    A_COUNTERS,
    N_COUNTERS,
    A_FEEDBACK,
    A_WEIGHTS,
    A_TILE_LIGHT,
    A_ENTRIES,
    A_LOG,
    A_LUMINANCE,
    A_ONLY,
    A_PRIMARY,
    A_PRIMARY_MESHES,
    A_PARTS,
    BOXES,
    A_BOX_COUNTERS,
    N_BOXES,
    A_SETTINGS,
    A_LIMITS,
    A_CAMERA,
    A_FILTER,
    A_SUMS,
    A_STATS,
) = range(31)
ADDRESSES = 31


@njit(**INNER)
def _scenery(a):
    return Scenery(
        u64_pointer(a[A_TABLE]),
        u64_pointer(a[A_LIGHTS]),
        a[A_LAMPS],
        a[A_NODES],
        i32_pointer(a[A_CHILDREN]),
        a[A_MESHES],
        a[TLAS],
        i32_pointer(a[A_IDS]),
        i64_pointer(a[A_FIRST]),
        a[HITBOXES],
        a[A_COUNTERS],
        a[N_COUNTERS],
        a[A_FEEDBACK],
        a[A_WEIGHTS],
        a[A_TILE_LIGHT],
        i32_pointer(a[A_ENTRIES]),
        a[A_LOG],
        a[A_PRIMARY_MESHES],
        a[BOXES],
        a[A_BOX_COUNTERS],
        a[N_BOXES],
        i64_pointer(a[A_SETTINGS]),
        f32_pointer(a[A_LIMITS]),
    )


# Parts of the work space, in bytes, each a multiple of 16 (Embree wants rays so).
_RAY_AT = 0
_SHADOW_AT = _RAY_AT + 4 * RAY
_QUERY_AT = _SHADOW_AT + 4 * RAY
_CLOSURE_AT = _QUERY_AT + 8 * (QUERY + QUERY % 2)
_FAR_CLOSURE_AT = _CLOSURE_AT + 8 * (CLOSURE + CLOSURE % 2)
_REST_AT = _FAR_CLOSURE_AT + 8 * (CLOSURE + CLOSURE % 2)
_PART = (max(8 * OUT, 4 * SURF, 4 * FRAME, 4 * PARAMS, 4 * LIGHT_SAMPLE) + 63) // 64 * 64  # of each of the small parts
_VERTICES_AT = _REST_AT + 12 * _PART
_WORK = _VERTICES_AT + (8 + 8) * MAX_VERTICES


@njit(**INNER)
def _scratch(start):
    """Work space at an address of _WORK bytes, 16-byte aligned."""
    rest = start + np.uint64(_REST_AT)
    part = np.uint64(_PART)
    return Scratch(
        f32_pointer(start + np.uint64(_RAY_AT)),
        f32_pointer(start + np.uint64(_SHADOW_AT)),
        start + np.uint64(_RAY_AT),
        start + np.uint64(_SHADOW_AT),
        start + np.uint64(_QUERY_AT),
        f32_pointer(rest),
        f32_pointer(rest + part),
        f32_pointer(rest + np.uint64(2) * part),
        f64_pointer(start + np.uint64(_CLOSURE_AT)),
        f64_pointer(rest + np.uint64(3) * part),
        f32_pointer(rest + np.uint64(4) * part),
        i64_pointer(rest + np.uint64(5) * part),
        f32_pointer(rest + np.uint64(6) * part),
        f32_pointer(rest + np.uint64(7) * part),
        f32_pointer(rest + np.uint64(8) * part),
        f64_pointer(start + np.uint64(_FAR_CLOSURE_AT)),
        f32_pointer(rest + np.uint64(9) * part),
        f32_pointer(rest + np.uint64(10) * part),
        i64_pointer(rest + np.uint64(11) * part),
        i64_pointer(start + np.uint64(_VERTICES_AT)),
        f32_pointer(start + np.uint64(_VERTICES_AT + 8 * MAX_VERTICES)),
    )


@njit(**INNER)
def _set_ray(ray, words, ox, oy, oz, dx, dy, dz, far, ray_type):
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
def _intersect(tlas, words):
    """Closest hit of the ray at address words."""
    rtc_intersect(pointer(tlas), pointer(words), pointer(np.uint64(0)))
    return load_u32(words, GEOM_ID) != np.uint32(INVALID)


@njit(**INNER)
def _entry(s, words):
    """TLAS entry that the ray at address words met."""
    return s.first[np.int64(load_u32(words, INST_ID))] + np.int64(load_u32(words, INST_PRIM_ID))


@njit(**INNER)
def _count_boxes(hitboxes, counters, length, query, words, far, ray_type, nearest):
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
def _met(s, instance, ray_type):
    """Count a hit of an instance by a type of ray."""
    atomic_add_int64(s.feedback + np.uint64(8) * np.uint64(instance * RAY_TYPES + ray_type), np.int64(1))


@njit(**INNER)
def _luminance(r, g, b):
    return _RED * r + _GREEN * g + _BLUE * b


@njit(**INNER)
def _worth(s, w, entry, luminance):
    """Credit a TLAS entry with luminance of the current tile."""
    units = luminance * s.limits[V_UNITS]
    if units >= _ONE:
        atomic_add_int64(s.weights + np.uint64(8) * np.uint64(entry * TILES + w.stats[_TILE]), np.int64(min(units, _MOST)))


@njit(**INNER)
def _log(s, w, entry):
    """Write a TLAS entry that the path met into the path's record (path_log.PathLog)."""
    if s.log == np.uint64(0):
        return
    record = i32_pointer(np.uint64(w.stats[_RECORD]))
    n = record[0]
    if n == RECORD:
        return
    for k in range(1, n + 1):
        if record[k] == entry:
            return
    if n + 1 < RECORD:
        record[n + 1] = entry
    record[0] = n + 1


@njit(**INNER)
def _remember(s, w, entry, tr, tg, tb):
    """Note a TLAS entry that the path meets for the first time: what it has gathered so far, and what it carries."""
    n = w.stats[_VERTICES]
    for k in range(n):
        if w.vertex[k] == entry:
            return
    _log(s, w, entry)
    if n < MAX_VERTICES:
        w.vertex[n] = entry
        w.carried[2 * n] = _luminance(w.total[0], w.total[1], w.total[2])
        w.carried[2 * n + 1] = _luminance(tr, tg, tb) * s.limits[V_AMBIENT]
        w.stats[_VERTICES] = n + 1


@njit(**INNER)
def _settle(s, w):
    """At the end of a path: credit what it met with what it gathered behind it, or with what it carried there where that is more."""
    total = _luminance(w.total[0], w.total[1], w.total[2])
    for k in range(w.stats[_VERTICES]):
        _worth(s, w, w.vertex[k], max(total - w.carried[2 * k], w.carried[2 * k + 1]))
    units = total * s.limits[V_UNITS]
    if units >= _ONE:
        atomic_add_int64(s.tile_light + np.uint64(8) * np.uint64(w.stats[_TILE]), np.int64(min(units, _MOST)))


@njit(**INNER)
def _add(s, w, r, g, b, bounce, part):
    """Add a contribution to the path's total, and to a part of it, clamped as Cycles does; bounce: how many bounces lie before the light's last one."""
    total = abs(r) + abs(g) + abs(b)
    limit = s.limits[V_CLAMP_INDIRECT] if bounce > 0 else s.limits[V_CLAMP_DIRECT]
    if not total < FAR:  # also NaN
        return
    f = limit / total if total > limit else _ONE
    w.total[0] += r * f
    w.total[1] += g * f
    w.total[2] += b * f
    if part != _NO_PART:
        w.total[_PARTS_AT + part] += r * f
        w.total[_PARTS_AT + part + 1] += g * f
        w.total[_PARTS_AT + part + 2] += b * f


@njit(**INNER)
def _may_be_blocked(s, w, words, far):
    """Whether a box of what is culled lies on the ray at address words, before far."""
    return s.boxes != np.uint64(0) and _count_boxes(s.boxes, s.box_counters, s.box_count, w.query, words, far, _SHADOW, 1) > 0


@njit(**INNER)
def _shadow(s, w, ox, oy, oz, dx, dy, dz, far, transparent_bounce, count, known):
    """What share of light passes along a segment, into w.radiance as a factor; True where some arrives. count: count the hitboxes it crosses. known: what
    blocks it is known without the blocker being built, so that is worth nothing to it."""
    hits_left = max(s.settings[I_TRANSPARENT] - transparent_bounce, 0)
    watched = s.feedback != np.uint64(0)
    weighed = s.weights != np.uint64(0) and not known
    if not watched and s.settings[I_TRANSPARENT_SHADOWS] == 0:
        _set_ray(w.shadow, w.shadow_words, ox, oy, oz, dx, dy, dz, far, _SHADOW)
        w.stats[RAYS] += 1
        rtc_occluded(pointer(s.tlas), pointer(w.shadow_words), pointer(np.uint64(0)))
        blocked = w.shadow[TFAR] < _ZERO
        if count:
            _count_boxes(s.hitboxes, s.counters, s.counters_length, w.query, w.shadow_words, far, _SHADOW, s.settings[I_HITBOX_NEAREST])
        return not blocked
    while True:
        _set_ray(w.shadow, w.shadow_words, ox, oy, oz, dx, dy, dz, far, _SHADOW)
        w.stats[RAYS] += 1
        hit = _intersect(s.tlas, w.shadow_words)
        t = w.shadow[TFAR] if hit else far
        if count:
            _count_boxes(s.hitboxes, s.counters, s.counters_length, w.query, w.shadow_words, t, _SHADOW, s.settings[I_HITBOX_NEAREST])
        if not hit:
            return True
        entry = _entry(s, w.shadow_words)
        instance = np.int64(s.ids[entry])
        if watched:
            _met(s, instance, _SHADOW)
            if not known:
                _log(s, w, entry)
        triangle = np.int64(load_u32(w.shadow_words, PRIM_ID))
        b1, b2 = w.shadow[HIT_U], w.shadow[HIT_V]
        mesh = mesh_record(s.meshes, s.table, instance)
        material = material_of(s.table, mesh, instance, triangle)
        arriving = _luminance(w.radiance[0], w.radiance[1], w.radiance[2])
        if hits_left <= 0 or not transmits_shadow(material):
            if weighed:
                _worth(s, w, entry, arriving)
            return False
        hits_left -= 1
        material_alpha(s.table, mesh, material, triangle, b1, b2, w.far_params)
        bsdf_transparency(w.far_params, np.int64(load_u32(material + M_SHADER, 0)), w.out)
        for k in range(3):
            w.radiance[k] *= np.float32(w.out[k])
        if weighed:
            _worth(s, w, entry, arriving - _luminance(w.radiance[0], w.radiance[1], w.radiance[2]))
        if not (w.radiance[0] > _ZERO or w.radiance[1] > _ZERO or w.radiance[2] > _ZERO):
            return False
        interpolate(mesh, s.table[T_TRANSFORM] + _INSTANCE_BYTES * np.uint64(instance), triangle, b1, b2, w.far_surf, w.far_frame)
        ex, ey, ez = offset_origin(w.far_surf, w.far_frame, dx, dy, dz)
        step = ((ex - ox) * dx + (ey - oy) * dy + (ez - oz) * dz) / (dx * dx + dy * dy + dz * dz)
        far -= max(step, t)
        if not far > _ZERO:
            return True
        ox, oy, oz = ex, ey, ez


@njit(**INNER)
def _emitted(s, w, instance, triangle, b1, b2, dx, dy, dz):
    """Radiance of a point of an emissive instance (sampled as a light) against direction d, into w.radiance; its place into w.far_surf, w.far_frame."""
    mesh = mesh_record(s.lights[L_MESHES], s.table, instance)
    interpolate(mesh, s.table[T_TRANSFORM] + _INSTANCE_BYTES * np.uint64(instance), triangle, b1, b2, w.far_surf, w.far_frame)
    back = face(w.far_frame, dx, dy, dz)
    material = material_of(s.table, mesh, instance, triangle)
    r, g, b = emission(s.table, mesh, material, triangle, b1, b2, back)
    w.radiance[0] = r
    w.radiance[1] = g
    w.radiance[2] = b
    if attenuates_emission(material):
        material_inputs(s.table, mesh, material, triangle, b1, b2, w.far_params)
        bsdf_setup(w.far_closure, w.far_params, np.int64(load_u32(material + M_SHADER, 0)), w.far_frame, BACKFACING if back else 0)
        for k in range(3):
            w.radiance[k] *= np.float32(w.far_closure[C_EMISSION + k])


@njit(**INNER)
def _world(s, dx, dy, dz):
    """Radiance of the world in a direction."""
    if s.lights[L_IMAGE] == np.uint64(0):
        return s.limits[V_WORLD], s.limits[V_WORLD + 1], s.limits[V_WORLD + 2]
    return environment_radiance(s.lights[L_IMAGE], np.int64(s.lights[L_WIDTH]), np.int64(s.lights[L_HEIGHT]), dx, dy, dz)


@njit(**INNER)
def _direct_light(s, w, mesh, m, triangle, tr, tg, tb, u, u0, u1, bounce, transparent_bounce, count, first):
    """Sample one light from the point in w.surf, w.frame and w.closure, seen with throughput (tr, tg, tb), and add what arrives. first: of a raster hit, where
    light of lamps is also summed by parts."""
    px, py, pz = w.surf[0], w.surf[1], w.surf[2]
    nx, ny, nz = w.frame[F_N], w.frame[F_N + 1], w.frame[F_N + 2]
    light = w.light
    kind = sample_light(s.table, s.lights, s.lamps, s.nodes, s.children, px, py, pz, nx, ny, nz, u, u0, u1, light, w.chosen)
    if kind == NONE:
        return
    dx, dy, dz, t, pdf = light[0], light[1], light[2], light[3], light[4]
    instance = np.int64(-1)
    k = f32_pointer(s.lamps + np.uint64(4 * LAMP) * np.uint64(max(kind, 0) if kind != INSTANCE else 0))
    if kind == INSTANCE:
        instance = w.chosen[0]
        visibility = np.int64(load_u8(s.table[T_FLAGS], instance))
    elif kind == WORLD:
        visibility = np.int64(s.lights[L_WORLD_VISIBILITY])
    else:
        if bounce > np.int64(k[27]):
            return
        visibility = np.int64(k[24])
    bsdf_eval(w.closure, dx, dy, dz, w.out, visibility)
    fr, fg, fb = np.float32(w.out[0]), np.float32(w.out[1]), np.float32(w.out[2])
    if not (fr > _ZERO or fg > _ZERO or fb > _ZERO):
        return
    weighed = True
    shadowed = True
    if kind == INSTANCE:
        _emitted(s, w, instance, w.chosen[1], light[6], light[7], dx, dy, dz)
    elif kind == WORLD:
        w.radiance[0], w.radiance[1], w.radiance[2] = _world(s, dx, dy, dz)
    else:
        weighed = k[26] != _ZERO
        shadowed = k[25] != _ZERO
        for c in range(3):
            w.radiance[c] = k[13 + c] * light[5]
    f = _ONE / pdf
    if weighed:
        if s.settings[I_STRATEGY] == BOTH:
            f *= power_heuristic(pdf, np.float32(w.out[O_PDF]))
        elif s.settings[I_STRATEGY] == BSDF_ONLY:
            return
    w.radiance[0] *= tr * fr * f
    w.radiance[1] *= tg * fg * f
    w.radiance[2] *= tb * fb * f
    if not (w.radiance[0] > _ZERO or w.radiance[1] > _ZERO or w.radiance[2] > _ZERO):
        return
    sorted_out = first and 0 <= kind < INSTANCE  # a lamp
    unshadowed = _luminance(w.radiance[0], w.radiance[1], w.radiance[2])
    part = CLEAR if sorted_out else _NO_PART
    if shadowed:
        ox, oy, oz = shadow_origin(mesh, m, triangle, w.surf, w.frame, dx, dy, dz)
        far = FAR
        if kind == INSTANCE:
            for c in range(3):
                w.far_surf[S_ERROR + c] += _REACH * t
            ex, ey, ez = offset_origin(w.far_surf, w.far_frame, -dx, -dy, -dz)
            dx, dy, dz, far = normalize(ex - ox, ey - oy, ez - oz)
        elif t < FAR:
            dx, dy, dz, far = normalize(px + t * dx - ox, py + t * dy - oy, pz + t * dz - oz)
        known = sorted_out and s.settings[I_LAMPS_KNOWN] != 0
        if not _shadow(s, w, ox, oy, oz, dx, dy, dz, far, transparent_bounce, count, known):
            if sorted_out:
                w.total[_PARTS_AT + SAMPLED_BLOCKED] += unshadowed
            return
        if sorted_out:
            _set_ray(w.shadow, w.shadow_words, ox, oy, oz, dx, dy, dz, far, _SHADOW)
            if _may_be_blocked(s, w, w.shadow_words, far):
                part = MAYBE
    if sorted_out:
        arriving = _luminance(w.radiance[0], w.radiance[1], w.radiance[2])
        w.total[_PARTS_AT + (SAMPLED_MAYBE if part == MAYBE else SAMPLED_CLEAR)] += arriving
        w.total[_PARTS_AT + SAMPLED_BLOCKED] += unshadowed - arriving
    if instance >= 0 and s.feedback != np.uint64(0):
        _met(s, instance, _SHADOW)
        if s.weights != np.uint64(0) and s.entries[instance] >= 0:
            _worth(s, w, np.int64(s.entries[instance]), _luminance(w.radiance[0], w.radiance[1], w.radiance[2]))
            _log(s, w, np.int64(s.entries[instance]))
    _add(s, w, w.radiance[0], w.radiance[1], w.radiance[2], bounce, part)


@njit(**INNER)
def _lamps_seen(s, w, ox, oy, oz, dx, dy, dz, far, tr, tg, tb, ray_type, bounce, mis, pdf, px, py, pz, nx, ny, nz, before, part):
    """Add the lamps whose shapes a ray meets before far. mis: weigh against light sampling from p with normal n, `before` further back along the ray. part: of
    the light where no box of what is culled lies before the lamp."""
    for i in range(np.int64(s.lights[L_LAMPS])):
        k = f32_pointer(s.lamps + np.uint64(4 * LAMP) * np.uint64(i))
        if np.int64(k[24]) & (1 << ray_type) == 0 or (ray_type != _CAMERA and k[26] == _ZERO):
            continue
        t = lamp_hit(k, ox, oy, oz, dx, dy, dz, far)
        if t < _ZERO:
            continue
        f = lamp_share(k, ox, oy, oz, dx, dy, dz)
        if f == _ZERO:
            continue
        if mis and k[26] != _ZERO:
            if s.settings[I_STRATEGY] == LIGHT_ONLY:
                continue
            if s.settings[I_STRATEGY] == BOTH:
                f *= power_heuristic(pdf, lamp_density(s.lights, s.lamps, s.nodes, s.children, i, px, py, pz, nx, ny, nz, dx, dy, dz, t + before))
        to = part
        if part == CLEAR and _may_be_blocked(s, w, w.ray_words, t):
            to = MAYBE
        _add(s, w, tr * k[13] * f, tg * k[14] * f, tb * k[15] * f, bounce - 1, to)


@njit(**INNER)
def _start(s, w, record, ox, oy, oz, dx, dy, dz):
    """The hit that a raster found on the ray from o along d, into w.ray as if traced; its instance, or -1. record: address of a primary.HIT."""
    instance = np.int64(load_i32(record, 0))
    if instance < 0:
        return instance
    triangle, b1, b2 = load_u32(record, 1), load_f32(record, 2), load_f32(record, 3)
    mesh = mesh_record(s.primary_meshes, s.table, instance)
    interpolate(mesh, s.table[T_TRANSFORM] + _INSTANCE_BYTES * np.uint64(instance), np.int64(triangle), b1, b2, w.surf, w.frame)
    w.ray[TFAR] = max((w.surf[0] - ox) * dx + (w.surf[1] - oy) * dy + (w.surf[2] - oz) * dz, _ZERO)
    w.ray[HIT_U] = b1
    w.ray[HIT_V] = b2
    u32_pointer(w.ray_words)[PRIM_ID] = triangle
    return instance


@njit(**INNER)
def _trace_path(s, w, key, record, ox, oy, oz, dx, dy, dz, far):
    """Trace one path from a camera ray; its radiance goes into w.total[0:3], how much of the pixel is transparent into w.total[3], its parts behind that.

    record: address of what a raster found on the camera ray (primary.HIT), 0 to trace it.
    """
    first = record != np.uint64(0)  # at the raster's hit
    second = False  # on the ray that left it
    for k in range(_PARTS_AT + PARTS if first else _PARTS_AT):
        w.total[k] = _ZERO
    tr = tg = tb = _ONE
    bounce = diffuse = glossy = transmission = transparent = np.int64(0)
    ray_type = np.int64(_CAMERA)
    background = True  # PATH_RAY_TRANSPARENT_BACKGROUND: the ray still goes straight from the camera
    straight = False  # it has passed something transparent since the last bounce
    last = False  # a limit is reached: only emission counts, and what lies behind transparency
    stop = False  # too many transparent surfaces: ends at the next surface
    after_diffuse = False
    mis = False
    pdf = min_pdf = FAR
    px, py, pz = ox, oy, oz  # where the last bounce was
    nx = ny = nz = _ZERO
    before = _ZERO  # distance from there to the origin of the ray
    every = s.settings[I_HITBOX_EVERY]
    count = s.hitboxes != np.uint64(0) and every > 0 and mix(key) % np.uint64(max(every, 1)) == np.uint64(0)
    watched = s.feedback != np.uint64(0)
    lit = s.lights[L_EMITTERS] + s.lights[L_INFINITE] != np.uint64(0)
    strategy = s.settings[I_STRATEGY]
    dimension = np.uint64(0)
    while True:
        _set_ray(w.ray, w.ray_words, ox, oy, oz, dx, dy, dz, far, ray_type)
        instance = np.int64(-1)
        if first:
            instance = _start(s, w, record, ox, oy, oz, dx, dy, dz)
            hit = instance >= 0
        else:
            w.stats[RAYS] += 1
            hit = _intersect(s.tlas, w.ray_words)
        t = w.ray[TFAR] if hit else far
        part = np.int64(_NO_PART)
        if record != np.uint64(0):
            part = STRAIGHT if bounce == 0 else CLEAR if second else _NO_PART
        if count and not first:
            _count_boxes(s.hitboxes, s.counters, s.counters_length, w.query, w.ray_words, t, ray_type, s.settings[I_HITBOX_NEAREST])
        if s.lights[L_COUNT_SHAPES] != np.uint64(0):
            _lamps_seen(
                s, w, ox, oy, oz, dx, dy, dz, t if hit else FAR, tr, tg, tb, ray_type, bounce, mis, pdf, px, py, pz, nx, ny, nz, before, part
            )
        if bounce > 0:
            part = _NO_PART
        if not hit:
            if s.settings[I_TRANSPARENT_FILM] != 0 and background:
                w.total[3] += (tr + tg + tb) * _THIRD
            elif np.int64(s.lights[L_WORLD_VISIBILITY]) & (1 << ray_type) != 0:
                r, g, b = _world(s, dx, dy, dz)
                f = _ONE
                if mis and s.lights[L_IMAGE] != np.uint64(0):
                    if strategy == BOTH:
                        f = power_heuristic(pdf, world_density(s.lights, dx, dy, dz))
                    elif strategy == LIGHT_ONLY:
                        f = _ZERO
                _add(s, w, tr * r * f, tg * g * f, tb * b * f, bounce - 1, part)
            return
        if not first:
            entry = _entry(s, w.ray_words)
            instance = np.int64(s.ids[entry])
            if watched:
                _met(s, instance, ray_type)
                if s.weights != np.uint64(0):
                    _remember(s, w, entry, tr, tg, tb)
        triangle = np.int64(load_u32(w.ray_words, PRIM_ID))
        b1, b2 = w.ray[HIT_U], w.ray[HIT_V]
        mesh = mesh_record(s.primary_meshes if first else s.meshes, s.table, instance)
        m = s.table[T_TRANSFORM] + _INSTANCE_BYTES * np.uint64(instance)
        material = material_of(s.table, mesh, instance, triangle)
        shader = np.int64(load_u32(material + M_SHADER, 0))
        glows = emits(material)
        u, roulette = uniform2(key, dimension)

        # Russian roulette: the square root ends paths later than their brightness says, as displays show square roots.
        survival = _ONE
        if (transparent > 1) if straight else (bounce > 1):
            survival = min(math.sqrt(max(tr, max(tg, tb))), _ONE)
        ends = stop or roulette >= survival
        if ends and not glows:
            return
        if last and not glows and not transmits_shadow(material):
            return

        interpolate(mesh, m, triangle, b1, b2, w.surf, w.frame)
        back = face(w.frame, dx, dy, dz)
        if background and (shader == _HOLDOUT or np.int64(load_u8(s.table[T_FLAGS], instance)) & _HOLDOUT_FLAG != 0):
            w.total[3] += (tr + tg + tb) * _THIRD
            return
        material_inputs(s.table, mesh, material, triangle, b1, b2, w.params)
        apply_normal_map(s.table, mesh, m, material, triangle, b1, b2, back, w.frame)
        flags = BACKFACING if back else 0
        if after_diffuse:
            if s.settings[I_REFLECTIVE] == 0:
                flags |= NO_REFLECTIVE_CAUSTICS
            if s.settings[I_REFRACTIVE] == 0:
                flags |= NO_REFRACTIVE_CAUSTICS
        bsdf_setup(w.closure, w.params, shader, w.frame, flags)
        if glows:
            r, g, b = emission(s.table, mesh, material, triangle, b1, b2, back)
            f = _ONE
            if mis and load_u8(material + M_MIS, 0) != 0:
                if strategy == BOTH:
                    density = triangle_density(
                        s.table, s.lights, s.nodes, s.children, instance, triangle, px, py, pz, nx, ny, nz, dx, dy, dz, t + before
                    )
                    f = power_heuristic(pdf, density)
                elif strategy == LIGHT_ONLY:
                    f = _ZERO
            r *= f * np.float32(w.closure[C_EMISSION])
            g *= f * np.float32(w.closure[C_EMISSION + 1])
            b *= f * np.float32(w.closure[C_EMISSION + 2])
            _add(s, w, tr * r, tg * g, tb * b, bounce - 1, part)
        if ends:
            return
        f = _ONE / survival
        tr *= f
        tg *= f
        tb *= f
        if last:
            label = np.int64(TRANSPARENT)
            tr *= np.float32(w.closure[C_TRANSPARENCY])
            tg *= np.float32(w.closure[C_TRANSPARENCY + 1])
            tb *= np.float32(w.closure[C_TRANSPARENCY + 2])
        else:
            blur = s.limits[V_FILTER_GLOSSY] * min_pdf
            if s.limits[V_FILTER_GLOSSY] > _ZERO and blur < _ONE:
                bsdf_blur(w.closure, 0.5 * math.sqrt(_ONE - blur))
            if w.closure[C_HAS_EVAL] != 0.0 and lit:
                u0, u1 = uniform2(key, dimension + np.uint64(1))
                _direct_light(s, w, mesh, m, triangle, tr, tg, tb, u, u0, u1, bounce, transparent, count, first)
            u0, u1 = uniform2(key, dimension + np.uint64(2))
            u2, _ = uniform2(key, dimension + np.uint64(3))
            label = np.int64(bsdf_sample(w.closure, u0, u1, u2, w.out))
            if label == 0:
                return
            tr *= np.float32(w.out[O_WEIGHT])
            tg *= np.float32(w.out[O_WEIGHT + 1])
            tb *= np.float32(w.out[O_WEIGHT + 2])
        if not (tr > _ZERO or tg > _ZERO or tb > _ZERO):
            return
        dimension += np.uint64(_DIMENSIONS)
        far = FAR
        second = first
        first = False
        if label & TRANSPARENT:
            transparent += 1
            straight = True
            stop = stop or transparent > s.settings[I_TRANSPARENT]
            ox, oy, oz = offset_origin(w.surf, w.frame, dx, dy, dz)
            before += t
            continue
        bounce += 1
        last = bounce > s.settings[I_TOTAL]
        if label & REFLECT:
            background = False
            if label & DIFFUSE:
                diffuse += 1
                last = last or diffuse > s.settings[I_DIFFUSE]
                ray_type = np.int64(_DIFFUSE_RAY)
            else:
                glossy += 1
                last = last or glossy > s.settings[I_GLOSSY]
                ray_type = np.int64(_GLOSSY_RAY)
        elif label & TRANSMIT:
            background = False
            transmission += 1
            last = last or transmission > s.settings[I_TRANSMISSION]
            ray_type = np.int64(_TRANSMISSION_RAY)
        straight = False
        after_diffuse = label & DIFFUSE != 0
        mis = label & SINGULAR == 0
        pdf = np.float32(w.out[O_PDF])
        min_pdf = min(min_pdf, pdf)
        px, py, pz = w.surf[0], w.surf[1], w.surf[2]
        nx, ny, nz = w.frame[F_N], w.frame[F_N + 1], w.frame[F_N + 2]
        before = _ZERO
        dx, dy, dz, _ = normalize(np.float32(w.out[0]), np.float32(w.out[1]), np.float32(w.out[2]))
        ox, oy, oz = offset_origin(w.surf, w.frame, dx, dy, dz)


@njit(nogil=True, cache=True, error_model="numpy")
def trace_tile(x0, y0, x1, y1, a):
    """Trace all samples of the pixels [x0, x1) x [y0, y1), or those paths that A_ONLY marks; a: addresses, A_*.

    Adds to the sums, (H, W, 4) float32, and atomically to stats, int64[2]; writes the luminance of each path to A_LUMINANCE where that is given.
    """
    s = _scenery(a)
    work = np.empty(_WORK + 16, np.uint8)
    w = _scratch((np.uint64(work.ctypes.data) + np.uint64(15)) & ~np.uint64(15))
    w.stats[RAYS] = 0
    width, height = s.settings[I_WIDTH], s.settings[I_HEIGHT]
    camera = f32_pointer(a[A_CAMERA])
    pixel_filter = f32_pointer(a[A_FILTER])
    sums = f32_pointer(a[A_SUMS])
    parts = f32_pointer(a[A_PARTS])
    seed = np.uint64(s.settings[I_SEED])
    exposure = s.limits[V_EXPOSURE]
    samples = s.settings[I_SAMPLES]
    luminance = f32_pointer(a[A_LUMINANCE])
    paths = 0
    for y in range(y0, y1):
        for x in range(x0, x1):
            w.stats[_TILE] = (y * ROWS // height) * COLUMNS + x * COLUMNS // width
            r = g = b = t = _ZERO
            for k in range(samples):
                path = (y * width + x) * samples + k
                if a[A_ONLY] != np.uint64(0) and load_u8(a[A_ONLY], path) == 0:
                    continue
                paths += 1
                key = path_key(seed, np.uint64(y * width + x), np.uint64(s.settings[I_FIRST_SAMPLE] + k))
                f0, f1 = uniform2(key, _FILTER)
                l0, l1 = uniform2(key, _LENS)
                record = np.uint64(0)
                if a[A_PRIMARY] != np.uint64(0):  # its jitter is in the camera
                    record = a[A_PRIMARY] + np.uint64(16) * np.uint64(y * width + x)
                    f0 = f1 = np.float32(0.5)
                u = (np.float32(x) + np.float32(0.5) + filter_offset(pixel_filter, f0)) / np.float32(width)
                v = (np.float32(y) + np.float32(0.5) + filter_offset(pixel_filter, f1)) / np.float32(height)
                ox, oy, oz, dx, dy, dz, far = camera_ray(camera, u, v, l0, l1)
                w.stats[_VERTICES] = 0
                w.stats[_RECORD] = np.int64(s.log + np.uint64(4 * RECORD) * np.uint64(path))
                _trace_path(s, w, key, record, ox, oy, oz, dx, dy, dz, far)
                if record != np.uint64(0):
                    for c in range(PARTS):
                        parts[PARTS * (y * width + x) + c] += exposure * w.total[_PARTS_AT + c]
                if s.weights != np.uint64(0):
                    _settle(s, w)
                if a[A_LUMINANCE] != np.uint64(0):
                    luminance[path] = _luminance(w.total[0], w.total[1], w.total[2])
                    if record != np.uint64(0) and s.settings[I_LAMPS_KNOWN] != 0:
                        for part in range(_PARTS_AT + CLEAR, _PARTS_AT + MAYBE + 3, 3):
                            luminance[path] -= _luminance(w.total[part], w.total[part + 1], w.total[part + 2])
                r += w.total[0]
                g += w.total[1]
                b += w.total[2]
                t += w.total[3]
            i = 4 * (y * width + x)
            sums[i] += r * exposure
            sums[i + 1] += g * exposure
            sums[i + 2] += b * exposure
            sums[i + 3] += np.float32(samples) - t
    atomic_add_int64(a[A_STATS] + np.uint64(8 * RAYS), w.stats[RAYS])
    atomic_add_int64(a[A_STATS] + np.uint64(8 * PATHS), paths)
    return work[0]  # keeps the work space alive until here
