"""Surface scattering as Cycles models it, before and since Blender 5.3: numba functions for one shading point.

Principled BSDF, Diffuse, Glossy, Glass, Refraction, Translucent and Transparent BSDF, with Multiscatter GGX where
Blender offers it (its default). Sheen, subsurface, anisotropy, thin film and thin walls are not modelled. `bsdf_setup`
turns a material into a list of lobes, each with a weight; sampling picks a lobe in proportion to its estimated albedo
and combines the densities of all (one-sample balance heuristic, Veach 1995).

A caller owns four scratch arrays and reuses them for every point:
  params  float32[PARAMS]   evaluated inputs of the material, slots P_* (colours take three)
  frame   float32[FRAME]    directions at the point, slots F_* (world space, unit)
  closure float64[CLOSURE]  filled by `bsdf_setup`, read by the others; the slots C_* are public
  out     float64[OUT]      results of `bsdf_sample` and `bsdf_eval`, slots O_*
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from ...jit.sampling import INNER, OPTIONS
from .lobes import (
    BACKFACING,
    BLENDER_5_3,
    C_COUNT,
    C_EMISSION,
    C_FRAME,
    C_HAS_EVAL,
    C_LOBES,
    C_MODEL,
    C_PARAMS,
    C_TRANSPARENCY,
    CUTOFF,
    DIFFUSE_SHADER,
    F82,
    F_N,
    F_NS,
    FRAME,
    GLASS,
    GLASS_SHADER,
    GLOSSY_SHADER,
    LOBE,
    LOBE_ALBEDO,
    LOBE_ALPHA,
    LOBE_EDGE,
    LOBE_F0,
    LOBE_FRESNEL,
    LOBE_KIND,
    LOBE_TINT_R,
    LOBE_TINT_T,
    NO_REFLECTIVE_CAUSTICS,
    NO_REFRACTIVE_CAUSTICS,
    P_ALPHA,
    P_BASE,
    P_COAT,
    P_COAT_IOR,
    P_COAT_ROUGHNESS,
    P_COAT_TINT,
    P_DIFFUSE_ROUGHNESS,
    P_IOR,
    P_METALLIC,
    P_ROUGHNESS,
    P_SPECULAR_LEVEL,
    P_SPECULAR_TINT,
    P_TRANSMISSION,
    PARAMS,
    PRINCIPLED,
    REFLECTION,
    REFRACTION,
    REFRACTION_SHADER,
    SINGULAR_ALPHA2,
    TRANSLUCENT,
    TRANSLUCENT_SHADER,
    TRANSPARENT_LOBE,
    TRANSPARENT_SHADER,
    add_diffuse,
    add_lobe,
    clip,
    layer,
    lift,
    normal_reflectance,
    set_schlick,
    set_tints,
)


@njit(**INNER)
def _below_coat(c: Any, coat: float, keep: float, albedo: float, tint: float, depth: float) -> float:
    """What layers below a coat of this weight get, in a channel. keep: what its reflection leaves, energy preservation
    included, and albedo: that of its reflection without; the tint absorbs (Beer) at optical depth `depth`, and is kept
    finite where it is above 1."""
    through = min(max(tint, 0.0) ** depth, 1e6)
    if c[C_MODEL] != 0.0:  # coated and bare parts side by side
        return clip(1.0 - coat * (1.0 - through * (1.0 - albedo)))
    return clip(1.0 - coat * (1.0 - keep)) * max(0.0, 1.0 + coat * (through - 1.0))


@njit(**INNER)
def _principled(c: Any, flags: int, n: Any, lifted: Any) -> None:
    """Lobes of the Principled BSDF, from the top: transparency, coat, metal | glass | specular over diffuse."""
    reflective, refractive = flags & NO_REFLECTIVE_CAUSTICS == 0, flags & NO_REFRACTIVE_CAUSTICS == 0
    alpha = clip(c[C_PARAMS + P_ALPHA])
    wr = wg = wb = alpha
    if alpha < 1.0:
        c[C_TRANSPARENCY] = c[C_TRANSPARENCY + 1] = c[C_TRANSPARENCY + 2] = 1.0 - alpha
        add_lobe(c, TRANSPARENT_LOBE, 1.0 - alpha, 1.0 - alpha, 1.0 - alpha, 0.0, 1.0, n)

    coat = max(c[C_PARAMS + P_COAT], 0.0)
    if coat > CUTOFF:
        ior = max(c[C_PARAMS + P_COAT_IOR], 1.0)
        # a normal map bends what lies below, not the coat
        smooth = lift(c, c[C_FRAME + F_NS], c[C_FRAME + F_NS + 1], c[C_FRAME + F_NS + 2])
        cos = c[C_FRAME] * smooth[0] + c[C_FRAME + 1] * smooth[1] + c[C_FRAME + 2] * smooth[2]
        keep, albedo = 1.0, 0.0
        if reflective:
            o = add_lobe(
                c, REFLECTION, coat * wr, coat * wg, coat * wb, clip(c[C_PARAMS + P_COAT_ROUGHNESS]) ** 2, ior, smooth
            )
            if o >= 0:
                set_tints(c, o, 1.0, 0.0)
                keep, _, _ = set_schlick(c, o, normal_reflectance(ior), 1.0, 1.0, 1.0)
                albedo = c[o + LOBE_ALBEDO]
        # Beer's law along the refracted ray; the tint is that of perpendicular light.
        depth = 1.0 / math.sqrt(1.0 - (1.0 - cos * cos) / (ior * ior))
        tint = C_PARAMS + P_COAT_TINT
        wr *= _below_coat(c, coat, keep, albedo, c[tint], depth)
        wg *= _below_coat(c, coat, keep, albedo, c[tint + 1], depth)
        wb *= _below_coat(c, coat, keep, albedo, c[tint + 2], depth)
    c[C_EMISSION], c[C_EMISSION + 1], c[C_EMISSION + 2] = wr, wg, wb

    rough = clip(c[C_PARAMS + P_ROUGHNESS]) ** 2
    ior = max(c[C_PARAMS + P_IOR], 1e-5)
    tint_r, tint_g, tint_b = (
        max(c[C_PARAMS + P_SPECULAR_TINT], 0.0),
        max(c[C_PARAMS + P_SPECULAR_TINT + 1], 0.0),
        max(c[C_PARAMS + P_SPECULAR_TINT + 2], 0.0),
    )

    metallic = clip(c[C_PARAMS + P_METALLIC])
    if metallic > CUTOFF:
        o = (
            add_lobe(c, REFLECTION, metallic * wr, metallic * wg, metallic * wb, rough, 1.0, lifted)
            if reflective
            else -1
        )
        if o >= 0:
            _metal(c, o)
        wr, wg, wb = wr * (1.0 - metallic), wg * (1.0 - metallic), wb * (1.0 - metallic)

    transmission = clip(c[C_PARAMS + P_TRANSMISSION])
    if transmission > CUTOFF:
        eta = 1.0 / ior if flags & BACKFACING else ior
        o = -1
        if reflective or refractive:
            o = add_lobe(c, GLASS, transmission * wr, transmission * wg, transmission * wb, rough, eta, lifted)
        if o >= 0:
            for k in range(3):
                c[o + LOBE_TINT_R + k] = 1.0 if reflective else 0.0
                c[o + LOBE_TINT_T + k] = math.sqrt(clip(c[C_PARAMS + P_BASE + k])) if refractive else 0.0
            set_schlick(c, o, normal_reflectance(ior), tint_r, tint_g, tint_b)
        wr, wg, wb = wr * (1.0 - transmission), wg * (1.0 - transmission), wb * (1.0 - transmission)

    level = max(c[C_PARAMS + P_SPECULAR_LEVEL], 0.0)
    f0, eta = normal_reflectance(ior), ior
    if level != 0.5:
        f0 *= 2.0 * level
        root = math.sqrt(min(f0, 0.99))
        eta = (1.0 + root) / (1.0 - root)
        if ior < 1.0:
            eta = 1.0 / eta
    if reflective and eta != 1.0:
        o = add_lobe(c, REFLECTION, wr, wg, wb, rough, eta, lifted)
        if o >= 0:
            set_tints(c, o, 1.0, 0.0)
            keep_r, keep_g, keep_b = set_schlick(c, o, f0, tint_r, tint_g, tint_b)
            wr, wg, wb = wr * keep_r, wg * keep_g, wb * keep_b

    base_r, base_g, base_b = (
        max(c[C_PARAMS + P_BASE], 0.0),
        max(c[C_PARAMS + P_BASE + 1], 0.0),
        max(c[C_PARAMS + P_BASE + 2], 0.0),
    )
    add_diffuse(c, wr * base_r, wg * base_g, wb * base_b, clip(c[C_PARAMS + P_DIFFUSE_ROUGHNESS]), n)


@njit(**INNER)
def _metal(c: Any, o: int) -> None:
    """F82-tint Fresnel: base colour at normal incidence; the specular tint darkens Schlick's curve at acos(1/7)."""
    c[o + LOBE_FRESNEL] = F82
    set_tints(c, o, 1.0, 0.0)
    s = 6.0 / 7.0
    s5 = s * s * s * s * s
    for k in range(3):
        f0 = clip(c[C_PARAMS + P_BASE + k])
        c[o + LOBE_F0 + k] = f0
        c[o + LOBE_EDGE + k] = (
            (f0 + (1.0 - f0) * s5) * (7.0 / (s5 * s)) * (1.0 - clip(c[C_PARAMS + P_SPECULAR_TINT + k]))
        )
    # Mean reflectance: integral of 2 cos * F82(cos).
    r = c[o + LOBE_F0] + (1.0 - c[o + LOBE_F0]) / 21.0 - c[o + LOBE_EDGE] / 126.0
    g = c[o + LOBE_F0 + 1] + (1.0 - c[o + LOBE_F0 + 1]) / 21.0 - c[o + LOBE_EDGE + 1] / 126.0
    b = c[o + LOBE_F0 + 2] + (1.0 - c[o + LOBE_F0 + 2]) / 21.0 - c[o + LOBE_EDGE + 2] / 126.0
    layer(c, o, r, g, b)


@njit(**OPTIONS)
def bsdf_setup(closure: Any, params: Any, shader: int, frame: Any, flags: int) -> None:
    """Fill closure from the material inputs at a point seen along frame[F_WI].

    shader: `core.scene.model.Shader` (EMISSION and HOLDOUT scatter nothing); flags: BACKFACING, the caustics bits,
    BLENDER_5_3.
    """
    c = closure
    for k in range(3):
        c[C_EMISSION + k] = 1.0
        c[C_TRANSPARENCY + k] = 0.0
    for k in range(PARAMS):
        c[C_PARAMS + k] = params[k]
    c[C_COUNT] = 0.0
    c[C_MODEL] = 1.0 if flags & BLENDER_5_3 else 0.0
    # In float64 unit vectors are unit to 1e-16; 1e-7 would show in the sharpest lobes.
    for k in range(0, FRAME, 3):
        # numba: float() keeps float32
        x, y, z = np.float64(frame[k]), np.float64(frame[k + 1]), np.float64(frame[k + 2])
        scale = 1.0 / math.sqrt(x * x + y * y + z * z)
        c[C_FRAME + k], c[C_FRAME + k + 1], c[C_FRAME + k + 2] = x * scale, y * scale, z * scale
    n = (c[C_FRAME + F_N], c[C_FRAME + F_N + 1], c[C_FRAME + F_N + 2])
    lifted = lift(c, n[0], n[1], n[2])
    r, g, b = max(c[C_PARAMS + P_BASE], 0.0), max(c[C_PARAMS + P_BASE + 1], 0.0), max(c[C_PARAMS + P_BASE + 2], 0.0)
    rough = clip(c[C_PARAMS + P_ROUGHNESS]) ** 2
    eta = max(c[C_PARAMS + P_IOR], 1e-5)
    reflective, refractive = flags & NO_REFLECTIVE_CAUSTICS == 0, flags & NO_REFRACTIVE_CAUSTICS == 0
    if shader == PRINCIPLED:
        _principled(c, flags, n, lifted)
    elif shader == DIFFUSE_SHADER:
        add_diffuse(c, r, g, b, clip(c[C_PARAMS + P_DIFFUSE_ROUGHNESS]), n)
    elif shader == TRANSLUCENT_SHADER:
        add_lobe(c, TRANSLUCENT, r, g, b, 0.0, 1.0, lifted)
    elif shader == TRANSPARENT_SHADER:
        c[C_TRANSPARENCY], c[C_TRANSPARENCY + 1], c[C_TRANSPARENCY + 2] = r, g, b
        add_lobe(c, TRANSPARENT_LOBE, r, g, b, 0.0, 1.0, n)
    elif shader == GLOSSY_SHADER and reflective:
        o = add_lobe(c, REFLECTION, r, g, b, rough, 1.0, lifted)
        if o >= 0:
            layer(c, o, r, g, b)
    elif shader == REFRACTION_SHADER and refractive:
        add_lobe(c, REFRACTION, r, g, b, rough, 1.0 / eta if flags & BACKFACING else eta, lifted)
    elif shader == GLASS_SHADER and (reflective or refractive):
        o = add_lobe(c, GLASS, 1.0, 1.0, 1.0, rough, 1.0 / eta if flags & BACKFACING else eta, lifted)
        if o >= 0:
            for k in range(3):
                tint = max(c[C_PARAMS + P_BASE + k], 0.0)
                c[o + LOBE_TINT_R + k], c[o + LOBE_TINT_T + k] = (
                    tint if reflective else 0.0,
                    tint if refractive else 0.0,
                )
            set_schlick(c, o, normal_reflectance(eta), 1.0, 1.0, 1.0)
    _mark(c)


@njit(**INNER)
def _mark(c: Any) -> None:
    """Set C_HAS_EVAL."""
    c[C_HAS_EVAL] = 0.0
    for o in range(C_LOBES, C_LOBES + int(c[C_COUNT]) * LOBE, LOBE):
        kind = c[o + LOBE_KIND]
        if kind != TRANSPARENT_LOBE and (kind < REFLECTION or c[o + LOBE_ALPHA] * c[o + LOBE_ALPHA] > SINGULAR_ALPHA2):
            c[C_HAS_EVAL] = 1.0


@njit(**OPTIONS)
def bsdf_blur(closure: Any, alpha: float) -> None:
    """Filter Glossy: raise the alpha of every glossy lobe to at least alpha.

    Cycles: alpha = sqrt(1 - p) / 2 with p = (least pdf of the path's bounces so far) / filter_glossy, where p < 1.
    """
    for o in range(C_LOBES, C_LOBES + int(closure[C_COUNT]) * LOBE, LOBE):
        if closure[o + LOBE_KIND] >= REFLECTION:
            closure[o + LOBE_ALPHA] = max(closure[o + LOBE_ALPHA], alpha)
    _mark(closure)


@njit(**OPTIONS)
def bsdf_transparency(params: Any, shader: int, out: Any) -> None:
    """What a shadow ray keeps when it crosses this surface: out[0:3]. Only transparency counts; glass stops a shadow
    ray, as in Cycles."""
    for k in range(3):
        out[k] = 0.0
        if shader == TRANSPARENT_SHADER:
            out[k] = max(params[P_BASE + k], 0.0)
        elif shader == PRINCIPLED:
            out[k] = 1.0 - clip(np.float64(params[P_ALPHA]))
