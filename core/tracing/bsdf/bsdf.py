"""Surface scattering as Cycles models it, before and since Blender 5.3: numba functions for one shading point.

Principled BSDF, Diffuse, Glossy, Glass, Refraction, Translucent and Transparent BSDF, with Multiscatter GGX where Blender offers it (its default).
Sheen, subsurface, anisotropy, thin film and thin walls are not modelled. `bsdf_setup` turns a material into a list of lobes, each with a weight;
sampling picks a lobe in proportion to its estimated albedo and combines the densities of all (one-sample balance heuristic, Veach 1995).

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
from ...scene.model import ALL_RAYS
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
    DELTA,
    DIFFUSE,
    DIFFUSE_RAYS,
    DIFFUSE_SHADER,
    F82,
    F_N,
    F_NG,
    F_NS,
    F_WI,
    FRAME,
    GLASS,
    GLASS_RAYS,
    GLASS_SHADER,
    GLOSSY,
    GLOSSY_RAYS,
    GLOSSY_SHADER,
    LOBE,
    LOBE_ALBEDO,
    LOBE_ALPHA,
    LOBE_BUMPED,
    LOBE_EDGE,
    LOBE_ETA,
    LOBE_F0,
    LOBE_FRESNEL,
    LOBE_KIND,
    LOBE_N,
    LOBE_PICK,
    LOBE_SCALE,
    LOBE_TINT_R,
    LOBE_TINT_T,
    LOBE_WEIGHT,
    NO_REFLECTIVE_CAUSTICS,
    NO_REFRACTIVE_CAUSTICS,
    O_PDF,
    O_ROUGHNESS,
    O_WEIGHT,
    O_WO,
    OREN_NAYAR,
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
    REFLECT,
    REFLECTION,
    REFRACTION,
    REFRACTION_SHADER,
    SINGULAR,
    SINGULAR_ALPHA2,
    TRANSLUCENT,
    TRANSLUCENT_SHADER,
    TRANSMISSION_RAYS,
    TRANSMIT,
    TRANSPARENT,
    TRANSPARENT_LOBE,
    TRANSPARENT_SHADER,
    add_diffuse,
    add_lobe,
    clip,
    dielectric_fresnel,
    fresnel,
    layer,
    lift,
    normal_reflectance,
    oren_nayar_g,
    set_schlick,
    set_tints,
    smith,
)


@njit(**INNER)
def _below_coat(c: Any, coat: float, keep: float, albedo: float, tint: float, depth: float) -> float:
    """What layers below a coat of this weight get, in a channel. keep: what its reflection leaves, energy preservation included, and albedo: that of its
    reflection without; the tint absorbs (Beer) at optical depth `depth`, and is kept finite where it is above 1."""
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
        smooth = lift(c, c[C_FRAME + F_NS], c[C_FRAME + F_NS + 1], c[C_FRAME + F_NS + 2])  # a normal map bends what lies below, not the coat
        cos = c[C_FRAME] * smooth[0] + c[C_FRAME + 1] * smooth[1] + c[C_FRAME + 2] * smooth[2]
        keep, albedo = 1.0, 0.0
        if reflective:
            o = add_lobe(c, REFLECTION, coat * wr, coat * wg, coat * wb, clip(c[C_PARAMS + P_COAT_ROUGHNESS]) ** 2, ior, smooth)
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
    tint_r, tint_g, tint_b = max(c[C_PARAMS + P_SPECULAR_TINT], 0.0), max(c[C_PARAMS + P_SPECULAR_TINT + 1], 0.0), max(c[C_PARAMS + P_SPECULAR_TINT + 2], 0.0)

    metallic = clip(c[C_PARAMS + P_METALLIC])
    if metallic > CUTOFF:
        o = add_lobe(c, REFLECTION, metallic * wr, metallic * wg, metallic * wb, rough, 1.0, lifted) if reflective else -1
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

    base_r, base_g, base_b = max(c[C_PARAMS + P_BASE], 0.0), max(c[C_PARAMS + P_BASE + 1], 0.0), max(c[C_PARAMS + P_BASE + 2], 0.0)
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
        c[o + LOBE_EDGE + k] = (f0 + (1.0 - f0) * s5) * (7.0 / (s5 * s)) * (1.0 - clip(c[C_PARAMS + P_SPECULAR_TINT + k]))
    # Mean reflectance: integral of 2 cos * F82(cos).
    r = c[o + LOBE_F0] + (1.0 - c[o + LOBE_F0]) / 21.0 - c[o + LOBE_EDGE] / 126.0
    g = c[o + LOBE_F0 + 1] + (1.0 - c[o + LOBE_F0 + 1]) / 21.0 - c[o + LOBE_EDGE + 1] / 126.0
    b = c[o + LOBE_F0 + 2] + (1.0 - c[o + LOBE_F0 + 2]) / 21.0 - c[o + LOBE_EDGE + 2] / 126.0
    layer(c, o, r, g, b)


@njit(**OPTIONS)
def bsdf_setup(closure: Any, params: Any, shader: int, frame: Any, flags: int) -> None:
    """Fill closure from the material inputs at a point seen along frame[F_WI].

    shader: `core.scene.model.Shader` (EMISSION and HOLDOUT scatter nothing); flags: BACKFACING, the caustics bits, BLENDER_5_3.
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
        x, y, z = np.float64(frame[k]), np.float64(frame[k + 1]), np.float64(frame[k + 2])  # numba: float() keeps float32
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
                c[o + LOBE_TINT_R + k], c[o + LOBE_TINT_T + k] = tint if reflective else 0.0, tint if refractive else 0.0
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


@njit(**INNER)
def _bump_shadowing(c: Any, o: int, wx: float, wy: float, wz: float, sampled: float) -> float:
    """What a bent normal leaves of light from w: none from behind the smooth surface, and for diffuse lobes a soft terminator.

    (Conty Estevez, Lecocq, Stein, "A microfacet-based shadowing function to solve the bump terminator problem", Ray Tracing Gems, 2019.)
    """
    sx, sy, sz = c[C_FRAME + F_NS], c[C_FRAME + F_NS + 1], c[C_FRAME + F_NS + 2]
    nx, ny, nz = c[o + LOBE_N], c[o + LOBE_N + 1], c[o + LOBE_N + 2]
    cos_sw = sx * wx + sy * wy + sz * wz
    cos_sn = sx * nx + sy * ny + sz * nz
    cos_nw = nx * wx + ny * wy + nz * wz
    diffuse = c[o + LOBE_KIND] <= TRANSLUCENT
    if cos_sw * cos_sn * cos_nw < 0.0 and (diffuse or sampled == 0.0):
        return 0.0
    cos_i, cos_d = abs(cos_sw), abs(cos_sn)
    if not diffuse or cos_d >= 1.0 or cos_i >= 1.0:
        return 1.0
    if cos_i < 1e-6:
        return 0.0
    return 1.0 / (1.0 + smith(clip(0.125 * (1.0 / (cos_d * cos_d) - 1.0)), cos_i))


@njit(**INNER)
def _add_eval(c: Any, o: int, wx: float, wy: float, wz: float, sampled: float, out: Any) -> float:
    """Add lobe o's weighted f * |cos| towards w to out[O_WEIGHT:]; returns its pdf. sampled: 1 where w was sampled from this lobe."""
    kind = c[o + LOBE_KIND]
    nx, ny, nz = c[o + LOBE_N], c[o + LOBE_N + 1], c[o + LOBE_N + 2]
    cos_o = nx * wx + ny * wy + nz * wz
    shadow = 1.0
    if c[o + LOBE_BUMPED] != 0.0 and not (sampled != 0.0 and cos_o < 0.0):
        shadow = _bump_shadowing(c, o, wx, wy, wz, sampled)
        if shadow == 0.0 and sampled == 0.0:
            return 0.0
    ix, iy, iz = c[C_FRAME + F_WI], c[C_FRAME + F_WI + 1], c[C_FRAME + F_WI + 2]
    cos_i = nx * ix + ny * iy + nz * iz

    if kind < TRANSPARENT_LOBE:
        pdf = max(-cos_o if kind == TRANSLUCENT else cos_o, 0.0) / math.pi
        if pdf <= 0.0:
            return 0.0
        if kind == OREN_NAYAR:
            t = ix * wx + iy * wy + iz * wz - cos_o * max(cos_i, 0.0)
            if t > 0.0:
                t /= max(cos_o, cos_i)
            lost = max(1.0 - c[o + LOBE_ALPHA] * math.pi - c[o + LOBE_ETA] * oren_nayar_g(cos_o), 0.0)
            single = max(c[o + LOBE_ALPHA] + c[o + LOBE_ETA] * t, 0.0)  # rounding
            for k in range(3):
                out[O_WEIGHT + k] += c[o + LOBE_WEIGHT + k] * shadow * cos_o * (single + c[o + LOBE_F0 + k] * lost)
        else:
            for k in range(3):
                out[O_WEIGHT + k] += c[o + LOBE_WEIGHT + k] * shadow * pdf
        return pdf

    alpha2 = c[o + LOBE_ALPHA] * c[o + LOBE_ALPHA]
    transmit = cos_o < 0.0
    if kind == TRANSPARENT_LOBE or cos_i <= 0.0 or alpha2 <= SINGULAR_ALPHA2 or kind == (REFLECTION if transmit else REFRACTION):
        return 0.0
    # Walter et al., "Microfacet models for refraction through rough surfaces", EGSR 2007.
    eta = c[o + LOBE_ETA]
    if transmit:
        hx, hy, hz = -(eta * wx + ix), -(eta * wy + iy), -(eta * wz + iz)
    else:
        hx, hy, hz = ix + wx, iy + wy, iz + wz
    length2 = hx * hx + hy * hy + hz * hz
    if length2 <= 0.0:
        return 0.0
    inverse = 1.0 / math.sqrt(length2)
    cos_hi = (hx * ix + hy * iy + hz * iz) * inverse
    cos_nh = (hx * nx + hy * ny + hz * nz) * inverse
    cos_nh2 = min(cos_nh * cos_nh, 1.0)
    d = alpha2 / (math.pi * (1.0 - cos_nh2 + alpha2 * cos_nh2) ** 2)
    common = d / cos_i * 0.25
    if transmit:
        common = d / cos_i * eta * eta * abs(cos_hi * (hx * wx + hy * wy + hz * wz)) * inverse**3
    lambda_i, lambda_o = smith(alpha2, cos_i), smith(alpha2, cos_o)
    value = common / (1.0 + lambda_i + lambda_o) * c[o + LOBE_SCALE] * shadow

    dielectric, _ = dielectric_fresnel(cos_hi, eta)
    reflected, total = 0.0, 0.0
    for k in range(3):
        r, t = fresnel(c, o, k, cos_hi, dielectric)
        out[O_WEIGHT + k] += c[o + LOBE_WEIGHT + k] * value * (t if transmit else r)
        reflected += r
        total += r + t
    if total <= 0.0:
        return 0.0
    return common / (1.0 + lambda_i) * ((total - reflected) if transmit else reflected) / total


@njit(**OPTIONS)
def bsdf_eval(closure: Any, wx: float, wy: float, wz: float, out: Any, visibility: int = ALL_RAYS) -> None:
    """Value of the BSDF towards the unit direction w: out[0:3] = f * |cos|, out[O_PDF] = pdf. w below the surface means transmission.

    visibility: bit per RayType, of the light that is looked at: lobes whose rays do not see it count for nothing (glass needs but one of its two).
    Like Cycles, it tests w against the normals that the lobes use, not against the geometric normal: smooth shading would show the triangles.
    """
    out[O_WEIGHT] = out[O_WEIGHT + 1] = out[O_WEIGHT + 2] = 0.0
    x, y, z = np.float64(wx), np.float64(wy), np.float64(wz)  # one variant of what follows
    pdf, picks = 0.0, 0.0
    for o in range(C_LOBES, C_LOBES + int(closure[C_COUNT]) * LOBE, LOBE):
        picks += closure[o + LOBE_PICK]
        kind = closure[o + LOBE_KIND]
        rays = GLASS_RAYS
        if kind <= TRANSLUCENT:
            rays = DIFFUSE_RAYS
        elif kind == REFLECTION:
            rays = GLOSSY_RAYS
        elif kind == REFRACTION:
            rays = TRANSMISSION_RAYS
        if visibility & rays:
            pdf += closure[o + LOBE_PICK] * _add_eval(closure, o, x, y, z, 0.0, out)
    for k in range(3):
        out[k] = out[O_WEIGHT + k]
    out[O_PDF] = pdf / picks if picks > 0.0 else 0.0


@njit(**INNER)
def _basis(x: float, y: float, z: float, nx: float, ny: float, nz: float) -> tuple[float, float, float]:
    """(x, y, z) of the frame around the unit normal n, in world space (Duff et al., "Building an orthonormal basis, revisited", JCGT 6(1), 2017)."""
    sign = math.copysign(1.0, nz)
    a = -1.0 / (sign + nz)
    b = nx * ny * a
    return (
        x * (1.0 + sign * nx * nx * a) + y * b + z * nx,
        x * sign * b + y * (sign + ny * ny * a) + z * ny,
        x * -sign * nx - y * ny + z * nz,
    )


@njit(**INNER)
def _local(x: float, y: float, z: float, nx: float, ny: float, nz: float) -> tuple[float, float, float]:
    """Inverse of `_basis`."""
    sign = math.copysign(1.0, nz)
    a = -1.0 / (sign + nz)
    b = nx * ny * a
    return (
        x * (1.0 + sign * nx * nx * a) + y * sign * b - z * sign * nx,
        x * b + y * (sign + ny * ny * a) - z * ny,
        x * nx + y * ny + z * nz,
    )


@njit(**INNER)
def _microfacet(c: Any, o: int, u0: float, u1: float) -> tuple[float, float, float]:
    """A visible normal of GGX lobe o (Dupuy, Benyoub, "Sampling visible GGX normals with spherical caps", HPG 2023), world space."""
    nx, ny, nz = c[o + LOBE_N], c[o + LOBE_N + 1], c[o + LOBE_N + 2]
    alpha = c[o + LOBE_ALPHA]
    if alpha * alpha <= SINGULAR_ALPHA2:
        return nx, ny, nz
    x, y, z = _local(c[C_FRAME + F_WI], c[C_FRAME + F_WI + 1], c[C_FRAME + F_WI + 2], nx, ny, nz)
    x, y = x * alpha, y * alpha
    scale = 1.0 / math.sqrt(x * x + y * y + z * z)
    x, y, z = x * scale, y * scale, z * scale
    phi = 2.0 * math.pi * u0
    height = (1.0 - u1) * (1.0 + z) - z
    sine = math.sqrt(max(0.0, 1.0 - height * height))
    x, y, z = alpha * (x + sine * math.cos(phi)), alpha * (y + sine * math.sin(phi)), max(z + height, 0.0)
    scale = 1.0 / math.sqrt(x * x + y * y + z * z)
    return _basis(x * scale, y * scale, z * scale, nx, ny, nz)


@njit(**OPTIONS)
def bsdf_sample(closure: Any, u0: float, u1: float, u2: float, out: Any) -> int:
    """Sample a direction with three uniform numbers of [0, 1). Returns label bits, 0 where the path is absorbed; out as O_* say."""
    c = closure
    end = C_LOBES + int(c[C_COUNT]) * LOBE
    picks = 0.0
    for o in range(C_LOBES, end, LOBE):
        picks += c[o + LOBE_PICK]
    if not picks > 0.0:
        return 0
    left = u2 * picks
    o = C_LOBES
    while o + LOBE < end and left >= c[o + LOBE_PICK]:
        left -= c[o + LOBE_PICK]
        o += LOBE
    pick = c[o + LOBE_PICK]
    if pick <= 0.0:
        return 0
    u2 = min(left / pick, 1.0 - 1e-12)

    kind = c[o + LOBE_KIND]
    nx, ny, nz = c[o + LOBE_N], c[o + LOBE_N + 1], c[o + LOBE_N + 2]
    ix, iy, iz = c[C_FRAME + F_WI], c[C_FRAME + F_WI + 1], c[C_FRAME + F_WI + 2]
    gx, gy, gz = c[C_FRAME + F_NG], c[C_FRAME + F_NG + 1], c[C_FRAME + F_NG + 2]
    out[O_WEIGHT] = out[O_WEIGHT + 1] = out[O_WEIGHT + 2] = 0.0
    if kind == TRANSPARENT_LOBE:
        for k in range(3):
            out[O_WO + k] = -c[C_FRAME + F_WI + k]
            out[O_WEIGHT + k] = c[o + LOBE_WEIGHT + k] * picks / pick
        out[O_PDF] = DELTA * pick / picks
        out[O_ROUGHNESS] = 0.0
        return TRANSMIT | TRANSPARENT

    if kind < TRANSPARENT_LOBE:
        side = -1.0 if kind == TRANSLUCENT else 1.0
        radius, phi = math.sqrt(u0), 2.0 * math.pi * u1
        wx, wy, wz = _basis(radius * math.cos(phi), radius * math.sin(phi), side * math.sqrt(max(0.0, 1.0 - u0)), nx, ny, nz)
        if side * (gx * wx + gy * wy + gz * wz) <= 0.0:
            return 0
        label = (TRANSMIT if kind == TRANSLUCENT else REFLECT) | DIFFUSE
        out[O_ROUGHNESS] = 1.0
    else:
        if nx * ix + ny * iy + nz * iz <= 0.0:
            return 0
        hx, hy, hz = _microfacet(c, o, u0, u1)
        cos_hi = hx * ix + hy * iy + hz * iz
        eta = c[o + LOBE_ETA]
        dielectric, cos_ht = dielectric_fresnel(cos_hi, eta)
        reflected, total = 0.0, 0.0
        for k in range(3):
            r, t = fresnel(c, o, k, cos_hi, dielectric)
            reflected += r
            total += r + t
        if total <= 0.0:
            return 0
        share = reflected / total
        refract = u2 >= share
        if refract:
            a, b = cos_hi / eta + cos_ht, 1.0 / eta
            wx, wy, wz = a * hx - b * ix, a * hy - b * iy, a * hz - b * iz
            share = 1.0 - share
        else:
            wx, wy, wz = 2.0 * cos_hi * hx - ix, 2.0 * cos_hi * hy - iy, 2.0 * cos_hi * hz - iz
        if (gx * wx + gy * wy + gz * wz < 0.0) != refract or (nx * wx + ny * wy + nz * wz < 0.0) != refract:
            return 0
        label = TRANSMIT if refract else REFLECT
        out[O_ROUGHNESS] = c[o + LOBE_ALPHA]
        if c[o + LOBE_ALPHA] * c[o + LOBE_ALPHA] <= SINGULAR_ALPHA2 or (refract and abs(eta - 1.0) < 1e-4):
            for k in range(3):
                r, t = fresnel(c, o, k, cos_hi, dielectric)
                out[O_WEIGHT + k] = c[o + LOBE_WEIGHT + k] * c[o + LOBE_SCALE] * (t if refract else r) / share * picks / pick
            out[O_WO], out[O_WO + 1], out[O_WO + 2] = wx, wy, wz
            out[O_PDF] = DELTA * share * pick / picks
            return label | SINGULAR
        label |= GLOSSY

    pdf = 0.0
    for other in range(C_LOBES, end, LOBE):
        pdf += c[other + LOBE_PICK] * _add_eval(c, other, wx, wy, wz, 1.0 if other == o else 0.0, out)
    pdf /= picks
    if not pdf > 0.0:
        return 0
    out[O_WO], out[O_WO + 1], out[O_WO + 2] = wx, wy, wz
    for k in range(3):
        out[O_WEIGHT + k] /= pdf
    out[O_PDF] = pdf
    return label


@njit(**OPTIONS)
def bsdf_transparency(params: Any, shader: int, out: Any) -> None:
    """What a shadow ray keeps when it crosses this surface: out[0:3]. Only transparency counts; glass stops a shadow ray, as in Cycles."""
    for k in range(3):
        out[k] = 0.0
        if shader == TRANSPARENT_SHADER:
            out[k] = max(params[P_BASE + k], 0.0)
        elif shader == PRINCIPLED:
            out[k] = 1.0 - clip(np.float64(params[P_ALPHA]))
