"""The path tracing kernel: one tile of pixels, all of its samples.

Paths follow Cycles' rules: what counts as which bounce, where a path ends, what is weighed against what
(kernel/integrator/path_state.h, shade_surface.h). At every vertex one light is sampled and one direction; both are
weighed by the power heuristic (Veach 1997).
Where a raster has found the first hits (core.hybrid.first_hits), paths start at these instead of with a camera ray, and
their light is also summed by parts.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from ..accel.embree import HIT_U, HIT_V, PRIM_ID, TFAR
from ..jit.pointers import load_f32, load_u8, load_u32
from ..jit.sampling import INNER, mix, normalize, power_heuristic, uniform2
from ..scene.model import VIEWS, InstanceFlag, RayType, Shader, Unsure
from .bsdf.lobes import (
    BACKFACING,
    C_EMISSION,
    C_HAS_EVAL,
    C_TRANSPARENCY,
    DIFFUSE,
    F_N,
    NO_REFLECTIVE_CAUSTICS,
    NO_REFRACTIVE_CAUSTICS,
    O_PDF,
    O_ROUGHNESS,
    O_WEIGHT,
    REFLECT,
    SINGULAR,
    TRANSMIT,
    TRANSPARENT,
)
from .bsdf.sample import bsdf_sample
from .bsdf.setup import bsdf_blur, bsdf_setup
from .direct_light import add_direct_light, add_lamps_seen, world_radiance
from .lights.environment import environment_radiance
from .lights.lamps import FAR
from .lights.light_sampling import (
    L_COUNT_SHAPES,
    L_EMITTERS,
    L_HEIGHT,
    L_IMAGE,
    L_INFINITE,
    L_SEEN,
    L_WIDTH,
    L_WORLD_VISIBILITY,
    triangle_density,
    world_density,
)
from .materials import (
    M_MIS,
    M_REACH,
    M_SHADER,
    M_UNSURE,
    apply_normal_map,
    composed,
    emission,
    emits,
    material_inputs,
    material_of,
    part_of,
    transmits_shadow,
)
from .path_feedback import add_light, add_worth, count_hit, luminance_of, record_vertex
from .path_rays import (
    coincident,
    count_boxes,
    entry_of,
    hidden_in_full,
    intersect,
    look_around,
    looks_for_coincident,
    set_ray,
    start_at_hit,
)
from .path_state import (
    BOTH,
    CLEAR,
    COINCIDENT,
    I_CATCHERS,
    I_DIFFUSE,
    I_FAST_GI,
    I_GLOSSY,
    I_HITBOX_EVERY,
    I_HITBOX_NEAREST,
    I_REFLECTIVE,
    I_REFRACTIVE,
    I_SHADING,
    I_STRATEGY,
    I_TOTAL,
    I_TRANSMISSION,
    I_TRANSPARENT,
    I_TRANSPARENT_FILM,
    I_UNBUILT,
    I_WEIGHED_FROM,
    LIGHT_ONLY,
    LOOKS,
    NO_PART,
    PARTS,
    PARTS_AT,
    RAYS,
    STRAIGHT,
    V_FAST_FACTOR,
    V_FAST_REACH,
    V_FILTER_GLOSSY,
    V_GLASS,
)
from .surface import T_FLAGS, T_TRANSFORM, face, interpolate, mesh_record, offset_origin

_CAMERA, _DIFFUSE_RAY, _GLOSSY_RAY, _TRANSMISSION_RAY = (int(t) for t in RayType if t != RayType.SHADOW)
_HOLDOUT_FLAG = int(InstanceFlag.HOLDOUT)
_VIEWS = np.int64(VIEWS)
_CLEAR = np.uint32(Unsure.CLEAR)
_BEHIND = np.uint32(Unsure.BEHIND)
_PASSING = np.uint64(7)  # one path in so many and one passes all that may not be there
_HOLDOUT = int(Shader.HOLDOUT)
_ZERO, _ONE, _THIRD = np.float32(0.0), np.float32(1.0), np.float32(1.0 / 3.0)
_DIMENSIONS = 4  # pairs of numbers per vertex
_INSTANCE_BYTES = np.uint64(48)
_SALT = np.uint64(0x636C656172)


@njit(**INNER)
def trace_path(s, w, key, record, ox, oy, oz, dx, dy, dz, far):
    """Trace one path from a camera ray; its radiance goes into w.total[0:3], how much of the pixel is transparent into
    w.total[3], its parts behind that.

    record: address of what a raster found on the camera ray (scene.model.HIT), 0 to trace it.
    """
    first = record != np.uint64(0)  # at the raster's hit
    second = False  # on the ray that left it
    for k in range(PARTS_AT + PARTS if first else PARTS_AT):
        w.total[k] = _ZERO
    tr = tg = tb = _ONE
    bounce = diffuse = glossy = transmission = transparent = np.int64(0)
    ray_type = np.int64(_CAMERA)
    background = True  # PATH_RAY_TRANSPARENT_BACKGROUND: the ray still goes straight from the camera
    straight = False  # it has passed something transparent since the last bounce
    last = False  # a limit is reached: only emission counts, and what lies behind transparency
    fast = False  # Fast GI: what the ray meets within reach ends it, what it does not meet is the world
    stop = False  # too many transparent surfaces: ends at the next surface
    after_diffuse = False
    through = False  # it has passed straight on through something of which we do not know how much that lets through
    clear = mix(key + _SALT) & _PASSING == np.uint64(0)  # it passes whatever may not be there
    mis = bounce > 0  # False: a literal would compile what it is given to once more
    pdf = min_pdf = FAR
    px, py, pz = ox, oy, oz  # where the last bounce was
    nx = ny = nz = _ZERO
    before = _ZERO  # distance from there to the origin of the ray
    every = s.settings[I_HITBOX_EVERY]
    count = s.hitboxes != np.uint64(0) and every > 0 and mix(key) % np.uint64(max(every, 1)) == np.uint64(0)
    watched = s.feedback != np.uint64(0)
    weighed = watched and s.weights != np.uint64(0) and s.settings[I_WEIGHED_FROM] == 0
    looks = weighed and looks_for_coincident(key)
    lit = s.lights[L_EMITTERS] + s.lights[L_INFINITE] != np.uint64(0)
    strategy = s.settings[I_STRATEGY]
    dimension = np.uint64(0)
    while True:
        set_ray(w.ray, w.ray_words, ox, oy, oz, dx, dy, dz, far, ray_type)
        instance = np.int64(-1)
        if first:
            instance = start_at_hit(s, w, record, ox, oy, oz, dx, dy, dz)
            hit = instance >= 0
        else:
            w.stats[RAYS] += 1
            hit = intersect(s.tlas, w.ray_words)
        t = w.ray[TFAR] if hit else far
        part = np.int64(NO_PART)
        if record != np.uint64(0):
            part = STRAIGHT if bounce == 0 else CLEAR if second else NO_PART
        if count and not first:
            crossed = count_boxes(
                s.hitboxes, s.counters, s.counters_length, w.query, w.ray_words, t, ray_type,
                s.settings[I_HITBOX_NEAREST]
            )
            if crossed > 0 and s.settings[I_UNBUILT] >= 0:
                record_vertex(s, w, s.settings[I_UNBUILT], tr, tg, tb)
        if s.lights[L_COUNT_SHAPES] != np.uint64(0):
            add_lamps_seen(
                s,
                w,
                ox,
                oy,
                oz,
                dx,
                dy,
                dz,
                t if hit else FAR,
                tr,
                tg,
                tb,
                ray_type,
                bounce,
                mis,
                pdf,
                px,
                py,
                pz,
                nx,
                ny,
                nz,
                before,
                part,
            )
        if bounce > 0:
            part = NO_PART
        if not hit:
            if s.settings[I_TRANSPARENT_FILM] != 0 and background:
                w.total[3] += (tr + tg + tb) * _THIRD
            elif np.int64(s.lights[L_WORLD_VISIBILITY]) & (1 << ray_type) != 0:
                r, g, b = world_radiance(s, dx, dy, dz)
                if ray_type == _CAMERA and s.lights[L_SEEN] != np.uint64(0):
                    r, g, b = environment_radiance(
                        s.lights[L_SEEN], np.int64(s.lights[L_WIDTH]), np.int64(s.lights[L_HEIGHT]), dx, dy, dz
                    )
                f = s.limits[V_FAST_FACTOR] if fast else _ONE
                if mis and s.lights[L_IMAGE] != np.uint64(0):
                    if strategy == BOTH:
                        f *= power_heuristic(pdf, world_density(s.lights, dx, dy, dz))
                    elif strategy == LIGHT_ONLY:
                        f = _ZERO
                add_light(s, w, tr * r * f, tg * g * f, tb * b * f, bounce - 1, part)
            return
        if not first:
            entry = entry_of(s, w.ray_words)
            instance = np.int64(s.ids[entry])
            if watched:
                count_hit(s, instance, ray_type)
                if s.weights != np.uint64(0) or s.log != np.uint64(0):
                    record_vertex(s, w, entry, tr, tg, tb)
                # before a catcher it shows, which shows nothing of its own where it goes
                seen = background and s.settings[I_CATCHERS] != 0
                if (through or seen) and s.weights != np.uint64(0):
                    add_worth(s, w, entry, FAR)
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
        if composed(material):
            _, u0 = uniform2(key, dimension + np.uint64(3))
            material = part_of(
                s.table, mesh, material, triangle, b1, b2, w.frame, ray_type + (_VIEWS if back else np.int64(0)), u0
            )
            shader = np.int64(load_u32(material + M_SHADER, 0))
            glows = emits(material)
        unsure = load_u32(material + M_UNSURE, 0)
        if unsure & _CLEAR and watched and s.weights != np.uint64(0) and not first:
            add_worth(s, w, entry_of(s, w.ray_words), FAR)
        if watched and load_f32(material + M_REACH, 0) > _ZERO:
            look_around(s, w, key, dimension, load_f32(material + M_REACH, 0), count, luminance_of(tr, tg, tb))
        if (looks or s.full != np.uint64(0)) and not first:
            entry = entry_of(s, w.ray_words)
            other = coincident(s, w, ray_type)
            if looks:
                w.stats[LOOKS] += 1
                if other >= 0:
                    w.stats[COINCIDENT] += 1
                    add_worth(s, w, entry, FAR)
                    add_worth(s, w, other, FAR)
            elif other >= 0 and hidden_in_full(s, w, ox, oy, oz, dx, dy, dz, t, ray_type):
                return  # nobody knows what shows here, and it did not show: the light of such a path is gone
        if background and (shader == _HOLDOUT or np.int64(load_u8(s.table[T_FLAGS], instance)) & _HOLDOUT_FLAG != 0):
            w.total[3] += (tr + tg + tb) * _THIRD
            return
        material_inputs(s.table, mesh, material, triangle, b1, b2, w.params)
        apply_normal_map(s.table, mesh, m, material, triangle, b1, b2, back, w.frame)
        flags = s.settings[I_SHADING] | (BACKFACING if back else 0)
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
                        s.table, s.lights, s.nodes, s.children, instance, triangle, px, py, pz, nx, ny, nz, dx, dy, dz,
                        t + before
                    )
                    f = power_heuristic(pdf, density)
                elif strategy == LIGHT_ONLY:
                    f = _ZERO
            r *= f * np.float32(w.closure[C_EMISSION])
            g *= f * np.float32(w.closure[C_EMISSION + 1])
            b *= f * np.float32(w.closure[C_EMISSION + 2])
            add_light(s, w, tr * r, tg * g, tb * b, bounce - 1, part)
        if ends:
            return
        f = _ONE / survival
        tr *= f
        tg *= f
        tb *= f
        if clear and unsure & _CLEAR:
            label = np.int64(TRANSPARENT)
        elif last:
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
                add_direct_light(s, w, mesh, m, triangle, tr, tg, tb, u, u0, u1, bounce, transparent, count, first)
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
        if label & (TRANSPARENT | TRANSMIT) and unsure & _BEHIND:
            through = True
        elif label & TRANSPARENT == 0:
            through = False
        dimension += np.uint64(_DIMENSIONS)
        far = s.limits[V_FAST_REACH] - before - t if fast else FAR
        second = first
        first = False
        if label & TRANSPARENT:
            transparent += 1
            straight = True
            stop = transparent >= s.settings[I_TRANSPARENT]
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
            rough = _ZERO if label & SINGULAR else np.float32(w.out[O_ROUGHNESS])
            background = background and label & DIFFUSE == 0 and rough <= s.limits[V_GLASS]
            transmission += 1
            last = last or transmission > s.settings[I_TRANSMISSION]
            ray_type = np.int64(_TRANSMISSION_RAY)
        ambient = s.settings[I_FAST_GI]
        fast = ambient > 0 and bounce - transmission - (1 if glossy > 0 else 0) >= ambient
        last = last or fast
        far = s.limits[V_FAST_REACH] if fast else FAR
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
