"""Light that reaches a point straight from a light: sampled ones with their shadows, emitters met, lamps seen and the
world."""

from __future__ import annotations

import numpy as np
from numba import njit

from ..accel.embree import HIT_U, HIT_V, PRIM_ID, TFAR
from ..accel.embree import _occluded1 as rtc_occluded
from ..jit.atomics import pointer
from ..jit.pointers import f32_pointer, load_u8, load_u32
from ..jit.sampling import INNER, normalize, power_heuristic
from ..scene.model import VIEWS, RayType, Unsure
from .bsdf.evaluate import bsdf_eval
from .bsdf.lobes import BACKFACING, C_EMISSION, F_N, O_PDF
from .bsdf.setup import bsdf_setup, bsdf_transparency
from .lights.environment import environment_radiance
from .lights.lamps import FAR, LAMP, lamp_hit, lamp_share
from .lights.light_sampling import (
    INSTANCE,
    L_HEIGHT,
    L_IMAGE,
    L_LAMPS,
    L_MESHES,
    L_WIDTH,
    L_WORLD_VISIBILITY,
    NONE,
    WORLD,
    lamp_density,
    sample_light,
)
from .materials import (
    M_SHADER,
    M_UNSURE,
    attenuates_emission,
    composed,
    emission,
    material_alpha,
    material_inputs,
    material_of,
    part_of,
    transmits_shadow,
)
from .path_feedback import add_light, add_worth, count_hit, credit_unbuilt, log_entry, luminance_of
from .path_rays import count_boxes, entry_of, intersect, set_ray
from .path_state import (
    BOTH,
    BSDF_ONLY,
    CLEAR,
    I_HITBOX_NEAREST,
    I_LAMPS_KNOWN,
    I_SHADING,
    I_STRATEGY,
    I_TRANSPARENT,
    I_TRANSPARENT_SHADOWS,
    I_WORLD,
    LIGHT_ONLY,
    MAYBE,
    NO_PART,
    PARTS_AT,
    RAYS,
    SAMPLED_BLOCKED,
    SAMPLED_CLEAR,
    SAMPLED_MAYBE,
    V_WORLD,
)
from .surface import (
    LIGHT_VIEW,
    S_ERROR,
    T_FLAGS,
    T_TRANSFORM,
    face,
    hit_number,
    interpolate,
    mesh_record,
    offset_origin,
    shadow_origin,
)

# a literal argument would compile another variant
_CAMERA, _SHADOW, _NEAREST = int(RayType.CAMERA), np.int64(RayType.SHADOW), np.int64(1)
_LIGHT, _VIEWS = np.int64(LIGHT_VIEW), np.int64(VIEWS)
_ZERO, _ONE = np.float32(0.0), np.float32(1.0)
_CLEAR = np.uint32(Unsure.CLEAR)
# What a ray from far away adds to the error at its end, per distance: 12 roundings to take its origin there, 5 of the
# distance to the plane, 4 of its length.
_REACH = np.float32(24 * 2.0**-24)
_INSTANCE_BYTES = np.uint64(48)


@njit(**INNER)
def may_be_blocked(s, w, words, far):
    """Whether a box of what is culled lies on the ray at address words, before far."""
    return (
        s.boxes != np.uint64(0)
        and count_boxes(s.boxes, s.box_counters, s.box_count, w.query, words, far, _SHADOW, _NEAREST) > 0
    )


@njit(**INNER)
def light_passing(s, w, ox, oy, oz, dx, dy, dz, far, transparent_bounce, count, known):
    """What share of light passes along a segment, into w.radiance as a factor; True where some arrives. count: count
    the hitboxes it crosses. known: what blocks it is known without the blocker being built, so that is worth nothing to
    it."""
    hits_left = max(s.settings[I_TRANSPARENT] - transparent_bounce, 0)
    watched = s.feedback != np.uint64(0)
    weighed = s.weights != np.uint64(0) and not known
    doubtful = False  # a box lies on the way
    if not watched and s.settings[I_TRANSPARENT_SHADOWS] == 0:
        set_ray(w.shadow, w.shadow_words, ox, oy, oz, dx, dy, dz, far, _SHADOW)
        w.stats[RAYS] += 1
        rtc_occluded(pointer(s.tlas), pointer(w.shadow_words), pointer(np.uint64(0)))
        blocked = w.shadow[TFAR] < _ZERO
        if count:
            count_boxes(
                s.hitboxes, s.counters, s.counters_length, w.query, w.shadow_words, far, _SHADOW,
                s.settings[I_HITBOX_NEAREST]
            )
        return not blocked
    while True:
        set_ray(w.shadow, w.shadow_words, ox, oy, oz, dx, dy, dz, far, _SHADOW)
        w.stats[RAYS] += 1
        hit = intersect(s.tlas, w.shadow_words)
        t = w.shadow[TFAR] if hit else far
        if count:
            crossed = count_boxes(
                s.hitboxes, s.counters, s.counters_length, w.query, w.shadow_words, t, _SHADOW,
                s.settings[I_HITBOX_NEAREST]
            )
            doubtful = doubtful or (crossed > 0 and weighed)
        if not hit:
            if doubtful:
                credit_unbuilt(s, w, luminance_of(w.radiance[0], w.radiance[1], w.radiance[2]))
            return True
        entry = entry_of(s, w.shadow_words)
        instance = np.int64(s.ids[entry])
        if watched:
            count_hit(s, instance, _SHADOW)
            if not known:
                log_entry(s, w, entry)
        triangle = np.int64(load_u32(w.shadow_words, PRIM_ID))
        b1, b2 = w.shadow[HIT_U], w.shadow[HIT_V]
        mesh = mesh_record(s.meshes, s.table, instance)
        material = material_of(s.table, mesh, instance, triangle)
        arriving = luminance_of(w.radiance[0], w.radiance[1], w.radiance[2])
        if hits_left <= 0 or not transmits_shadow(material):
            if weighed:
                add_worth(s, w, entry, arriving)
            return False
        hits_left -= 1
        if composed(material):
            interpolate(
                mesh, s.table[T_TRANSFORM] + _INSTANCE_BYTES * np.uint64(instance), triangle, b1, b2, w.far_surf,
                w.far_frame
            )
            view = _SHADOW + (_VIEWS if face(w.far_frame, dx, dy, dz) else np.int64(0))
            u = hit_number(triangle, b1, b2)
            material = part_of(s.table, mesh, material, triangle, b1, b2, w.far_frame, view, u)
        if load_u32(material + M_UNSURE, 0) & _CLEAR:  # all light may pass, and none
            if weighed:
                add_worth(s, w, entry, FAR)
        else:
            material_alpha(s.table, mesh, material, triangle, b1, b2, w.far_params)
            bsdf_transparency(w.far_params, np.int64(load_u32(material + M_SHADER, 0)), w.out)
            for k in range(3):
                w.radiance[k] *= np.float32(w.out[k])
            if weighed:
                add_worth(s, w, entry, arriving - luminance_of(w.radiance[0], w.radiance[1], w.radiance[2]))
        if not (w.radiance[0] > _ZERO or w.radiance[1] > _ZERO or w.radiance[2] > _ZERO):
            return False
        interpolate(
            mesh, s.table[T_TRANSFORM] + _INSTANCE_BYTES * np.uint64(instance), triangle, b1, b2, w.far_surf,
            w.far_frame
        )
        ex, ey, ez = offset_origin(w.far_surf, w.far_frame, dx, dy, dz)
        step = ((ex - ox) * dx + (ey - oy) * dy + (ez - oz) * dz) / (dx * dx + dy * dy + dz * dz)
        far -= max(step, t)
        if not far > _ZERO:
            if doubtful:
                credit_unbuilt(s, w, luminance_of(w.radiance[0], w.radiance[1], w.radiance[2]))
            return True
        ox, oy, oz = ex, ey, ez


@njit(**INNER)
def _emitted(s, w, instance, triangle, b1, b2, dx, dy, dz):
    """Radiance of a point of an emissive instance (sampled as a light) against direction d, into w.radiance; its place
    into w.far_surf, w.far_frame."""
    mesh = mesh_record(s.lights[L_MESHES], s.table, instance)
    interpolate(
        mesh, s.table[T_TRANSFORM] + _INSTANCE_BYTES * np.uint64(instance), triangle, b1, b2, w.far_surf, w.far_frame
    )
    back = face(w.far_frame, dx, dy, dz)
    material = material_of(s.table, mesh, instance, triangle)
    if composed(material):
        view = _LIGHT + (_VIEWS if back else np.int64(0))
        u = hit_number(triangle, b1, b2)
        material = part_of(s.table, mesh, material, triangle, b1, b2, w.far_frame, view, u)
    r, g, b = emission(s.table, mesh, material, triangle, b1, b2, back)
    w.radiance[0] = r
    w.radiance[1] = g
    w.radiance[2] = b
    if attenuates_emission(material):
        material_inputs(s.table, mesh, material, triangle, b1, b2, w.far_params)
        flags = s.settings[I_SHADING] | (BACKFACING if back else 0)
        bsdf_setup(w.far_closure, w.far_params, np.int64(load_u32(material + M_SHADER, 0)), w.far_frame, flags)
        for k in range(3):
            w.radiance[k] *= np.float32(w.far_closure[C_EMISSION + k])


@njit(**INNER)
def world_radiance(s, dx, dy, dz):
    """Radiance of the world in a direction."""
    if s.lights[L_IMAGE] == np.uint64(0):
        return s.limits[V_WORLD], s.limits[V_WORLD + 1], s.limits[V_WORLD + 2]
    return environment_radiance(
        s.lights[L_IMAGE], np.int64(s.lights[L_WIDTH]), np.int64(s.lights[L_HEIGHT]), dx, dy, dz
    )


@njit(**INNER)
def add_direct_light(s, w, mesh, m, triangle, tr, tg, tb, u, u0, u1, bounce, transparent_bounce, count, first):
    """Sample one light from the point in w.surf, w.frame and w.closure, seen with throughput (tr, tg, tb), and add what
    arrives. first: of a raster hit, where light of lamps is also summed by parts."""
    px, py, pz = w.surf[0], w.surf[1], w.surf[2]
    nx, ny, nz = w.frame[F_N], w.frame[F_N + 1], w.frame[F_N + 2]
    light = w.light
    kind = sample_light(
        s.table, s.lights, s.lamps, s.nodes, s.children, px, py, pz, nx, ny, nz, u, u0, u1, light, w.chosen
    )
    if kind == NONE:
        return
    dx, dy, dz, t, pdf = light[0], light[1], light[2], light[3], light[4]
    instance = np.int64(-1)
    k = f32_pointer(s.lamps + np.uint64(4 * LAMP) * np.uint64(max(kind, 0) if kind != INSTANCE else 0))
    if kind == INSTANCE:
        instance = w.chosen[0]
        visibility = np.int64(load_u8(s.table[T_FLAGS], instance))
    elif kind == WORLD:
        if bounce > s.settings[I_WORLD]:
            return
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
        w.radiance[0], w.radiance[1], w.radiance[2] = world_radiance(s, dx, dy, dz)
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
    unshadowed = luminance_of(w.radiance[0], w.radiance[1], w.radiance[2])
    part = CLEAR if sorted_out else NO_PART
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
        if not light_passing(s, w, ox, oy, oz, dx, dy, dz, far, transparent_bounce, count, known):
            if sorted_out:
                w.total[PARTS_AT + SAMPLED_BLOCKED] += unshadowed
            return
        if sorted_out:
            set_ray(w.shadow, w.shadow_words, ox, oy, oz, dx, dy, dz, far, _SHADOW)
            if may_be_blocked(s, w, w.shadow_words, far):
                part = MAYBE
    if sorted_out:
        arriving = luminance_of(w.radiance[0], w.radiance[1], w.radiance[2])
        w.total[PARTS_AT + (SAMPLED_MAYBE if part == MAYBE else SAMPLED_CLEAR)] += arriving
        w.total[PARTS_AT + SAMPLED_BLOCKED] += unshadowed - arriving
    if instance >= 0 and s.feedback != np.uint64(0):
        count_hit(s, instance, _SHADOW)
        if s.weights != np.uint64(0) or s.log != np.uint64(0):
            entry = np.int64(s.entries[instance])
            arriving = luminance_of(w.radiance[0], w.radiance[1], w.radiance[2])
            if entry < 0:
                credit_unbuilt(s, w, arriving)
            else:
                log_entry(s, w, entry)
                if s.weights != np.uint64(0):
                    add_worth(s, w, entry, arriving)
    add_light(s, w, w.radiance[0], w.radiance[1], w.radiance[2], bounce, part)


@njit(**INNER)
def add_lamps_seen(
    s, w, ox, oy, oz, dx, dy, dz, far, tr, tg, tb, ray_type, bounce, mis, pdf, px, py, pz, nx, ny, nz, before, part
):
    """Add the lamps whose shapes a ray meets before far. mis: weigh against light sampling from p with normal n,
    `before` further back along the ray. part: of the light where no box of what is culled lies before the lamp."""
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
                f *= power_heuristic(
                    pdf,
                    lamp_density(
                        s.lights, s.lamps, s.nodes, s.children, i, px, py, pz, nx, ny, nz, dx, dy, dz, t + before
                    ),
                )
        to = part
        if part == CLEAR and may_be_blocked(s, w, w.ray_words, t):
            to = MAYBE
        add_light(s, w, tr * k[13] * f, tg * k[14] * f, tb * k[15] * f, bounce - 1, to)
