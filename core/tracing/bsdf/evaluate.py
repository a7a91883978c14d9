"""What a surface scatters from one direction into another, and the density with which it is sampled; see `setup`."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from ...jit.sampling import INNER, OPTIONS
from ...scene.model import ALL_RAYS
from .lobes import (
    C_COUNT,
    C_FRAME,
    C_LOBES,
    DIFFUSE_RAYS,
    F_NS,
    F_WI,
    GLASS_RAYS,
    GLOSSY_RAYS,
    LOBE,
    LOBE_ALPHA,
    LOBE_BUMPED,
    LOBE_ETA,
    LOBE_F0,
    LOBE_KIND,
    LOBE_N,
    LOBE_PICK,
    LOBE_SCALE,
    LOBE_WEIGHT,
    O_PDF,
    O_WEIGHT,
    OREN_NAYAR,
    REFLECTION,
    REFRACTION,
    SINGULAR_ALPHA2,
    TRANSLUCENT,
    TRANSMISSION_RAYS,
    TRANSPARENT_LOBE,
    clip,
    dielectric_fresnel,
    fresnel,
    oren_nayar_g,
    smith,
)


@njit(**INNER)
def _bump_shadowing(c: Any, o: int, wx: float, wy: float, wz: float, sampled: float) -> float:
    """What a bent normal leaves of light from w: none from behind the smooth surface, and for diffuse lobes a soft
    terminator.

    (Conty Estevez, Lecocq, Stein, "A microfacet-based shadowing function to solve the bump terminator problem", Ray
    Tracing Gems, 2019.)
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
def add_eval(c: Any, o: int, wx: float, wy: float, wz: float, sampled: float, out: Any) -> float:
    """Add lobe o's weighted f * |cos| towards w to out[O_WEIGHT:]; returns its pdf. sampled: 1 where w was sampled from
    this lobe."""
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
    if (
        kind == TRANSPARENT_LOBE
        or cos_i <= 0.0
        or alpha2 <= SINGULAR_ALPHA2
        or kind == (REFLECTION if transmit else REFRACTION)
    ):
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
    """Value of the BSDF towards the unit direction w: out[0:3] = f * |cos|, out[O_PDF] = pdf. w below the surface means
    transmission.

    visibility: bit per RayType, of the light that is looked at: lobes whose rays do not see it count for nothing (glass
    needs but one of its two). Like Cycles, it tests w against the normals that the lobes use, not against the geometric
    normal: smooth shading would show the triangles.
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
            pdf += closure[o + LOBE_PICK] * add_eval(closure, o, x, y, z, 0.0, out)
    for k in range(3):
        out[k] = out[O_WEIGHT + k]
    out[O_PDF] = pdf / picks if picks > 0.0 else 0.0
