"""Directions picked in proportion to what lobes scatter; see `setup`."""

from __future__ import annotations

import math
from typing import Any

from numba import njit

from ...jit.sampling import INNER, OPTIONS
from .evaluate import add_eval
from .lobes import (
    C_COUNT,
    C_FRAME,
    C_LOBES,
    DELTA,
    DIFFUSE,
    F_NG,
    F_WI,
    GLOSSY,
    LOBE,
    LOBE_ALPHA,
    LOBE_ETA,
    LOBE_KIND,
    LOBE_N,
    LOBE_PICK,
    LOBE_SCALE,
    LOBE_WEIGHT,
    O_PDF,
    O_ROUGHNESS,
    O_WEIGHT,
    O_WO,
    REFLECT,
    SINGULAR,
    SINGULAR_ALPHA2,
    TRANSLUCENT,
    TRANSMIT,
    TRANSPARENT,
    TRANSPARENT_LOBE,
    dielectric_fresnel,
    fresnel,
)


@njit(**INNER)
def _basis(x: float, y: float, z: float, nx: float, ny: float, nz: float) -> tuple[float, float, float]:
    """(x, y, z) of the frame around the unit normal n, in world space (Duff et al., "Building an orthonormal basis,
    revisited", JCGT 6(1), 2017)."""
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
    """A visible normal of GGX lobe o (Dupuy, Benyoub, "Sampling visible GGX normals with spherical caps", HPG 2023),
    world space."""
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
    """Sample a direction with three uniform numbers of [0, 1). Returns label bits, 0 where the path is absorbed; out as
    O_* say."""
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
        wx, wy, wz = _basis(
            radius * math.cos(phi), radius * math.sin(phi), side * math.sqrt(max(0.0, 1.0 - u0)), nx, ny, nz
        )
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
                out[O_WEIGHT + k] = (
                    c[o + LOBE_WEIGHT + k] * c[o + LOBE_SCALE] * (t if refract else r) / share * picks / pick
                )
            out[O_WO], out[O_WO + 1], out[O_WO + 2] = wx, wy, wz
            out[O_PDF] = DELTA * share * pick / picks
            return label | SINGULAR
        label |= GLOSSY

    pdf = 0.0
    for other in range(C_LOBES, end, LOBE):
        pdf += c[other + LOBE_PICK] * add_eval(c, other, wx, wy, wz, 1.0 if other == o else 0.0, out)
    pdf /= picks
    if not pdf > 0.0:
        return 0
    out[O_WO], out[O_WO + 1], out[O_WO + 2] = wx, wy, wz
    for k in range(3):
        out[O_WEIGHT + k] /= pdf
    out[O_PDF] = pdf
    return label
