"""Directional albedo of GGX microfacet lobes: the tables behind energy preservation and layering in `bsdf`.

A single-scattering GGX lobe loses the light that bounces between microfacets. Cycles scales it up by 1 / E, where E(roughness, cos) is the lobe's
albedo without Fresnel darkening (Turquin, "Practical multiple scattering compensation for microfacet models", 2019), and weakens the layers below a
specular one by its albedo. The tables have the grid of Cycles' own (so interpolation errors are the same), but are integrated here, by quadrature
over visible normals. `python -m lipac.core.ggx_albedo` writes them to ggx_albedo.npz (deterministic, about a minute).

Axes of every table: [z, cos, roughness] with roughness and cos on [0, 1] and z = sqrt((ior - 1) / (ior + 1)); an axis that does not matter has length 1.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from numba import njit
from numpy.typing import NDArray

F32 = NDArray[np.float32]

FILE = Path(__file__).with_name("ggx_albedo.npz")
REFLECTION, GLASS, SCHLICK, SCHLICK_IOR = 0, 1, 2, 3  # integrands


@njit(nogil=True, cache=True, error_model="numpy")
def _smith(alpha2: float, cos: float) -> float:
    """Lambda of Smith's shadowing for GGX (Heitz 2014, equation 72)."""
    return 0.5 * (math.sqrt(1.0 + alpha2 * max(1.0 / (cos * cos) - 1.0, 0.0)) - 1.0)


@njit(nogil=True, cache=True, error_model="numpy")
def integrate(kind: int, roughness: float, mu: float, ior: float, steps: int) -> float:
    """Mean over the visible normals of GGX seen under cosine mu (roughness in (0, 1], mu in (0, 1]), steps**2 quadrature points.

    REFLECTION: albedo of the reflection lobe without Fresnel. GLASS: albedo of reflection plus refraction with dielectric Fresnel.
    SCHLICK, SCHLICK_IOR: mean position between F0 and F90 of (1 - cos)**5, or of the dielectric Fresnel curve, where reflection leaves the surface.
    """
    alpha = roughness * roughness
    alpha2 = alpha * alpha
    # Heitz and d'Eon's distribution of visible normals by spherical caps (Dupuy, Benyoub 2023); wi lies in the xz plane.
    wx = math.sqrt(1.0 - mu * mu)
    scale = 1.0 / math.sqrt((alpha * wx) ** 2 + mu * mu)
    sx, sz = alpha * wx * scale, mu * scale
    lambda_i = _smith(alpha2, mu)
    singular = alpha2 <= 2e-10
    f0 = ((ior - 1.0) / (ior + 1.0)) ** 2
    total = 0.0
    for i in range(steps):
        # Midpoints crowd towards the microfacets seen at grazing angles, where smooth surfaces lose their light.
        t = (i + 0.5) / steps
        cz = t**4 * (1.0 + sz) - sz
        weight = 4.0 * t**3
        sine = math.sqrt(max(0.0, 1.0 - cz * cz))
        for j in range(steps):
            phi = math.pi * (j + 0.5) / steps  # the other half is its mirror image
            hx, hy, hz = alpha * (sine * math.cos(phi) + sx), alpha * sine * math.sin(phi), max(0.0, cz + sz)
            norm = 1.0 / math.sqrt(hx * hx + hy * hy + hz * hz)
            hx, hy, hz = hx * norm, hy * norm, hz * norm
            if singular:
                hx, hy, hz = 0.0, 0.0, 1.0
            cos_hi = wx * hx + mu * hz
            cos_ro = 2.0 * cos_hi * hz - mu
            shadow_r = 1.0 if singular else (1.0 + lambda_i) / (1.0 + lambda_i + _smith(alpha2, cos_ro))
            if kind == REFLECTION:
                total += weight * shadow_r if cos_ro > 0.0 else 0.0
                continue
            if kind == SCHLICK:
                total += weight * (1.0 - cos_hi) ** 5 if cos_ro > 0.0 else 0.0
                continue
            cos_t2 = 1.0 - (1.0 - cos_hi * cos_hi) / (ior * ior)
            cos_ht = math.sqrt(max(cos_t2, 0.0))
            fresnel = 1.0
            if cos_t2 > 0.0:
                rs = (cos_hi - ior * cos_ht) / (cos_hi + ior * cos_ht)
                rp = (ior * cos_hi - cos_ht) / (ior * cos_hi + cos_ht)
                fresnel = 0.5 * (rs * rs + rp * rp)
            if kind == SCHLICK_IOR:
                total += weight * min(max((fresnel - f0) / (1.0 - f0), 0.0), 1.0) if cos_ro > 0.0 else 0.0
                continue
            total += weight * fresnel * shadow_r if cos_ro > 0.0 else 0.0
            cos_to = (cos_hi / ior - cos_ht) * hz - mu / ior
            # No test that the refracted ray ends below the surface: Cycles' table counts rays that do not, though its sampling rejects them. Where that
            # happens (rough glass seen from inside near total reflection) Cycles loses light, and so do we, to agree with it.
            # Refraction at nearly equal indices passes straight through, unshadowed.
            straight = singular or abs(ior - 1.0) < 1e-4
            total += weight * (1.0 - fresnel) * (1.0 if straight else (1.0 + lambda_i) / (1.0 + lambda_i + _smith(alpha2, cos_to)))
    return total / (steps * steps)


def grid(size: int) -> list[float]:
    """Nodes of a roughness or cosine axis: 0..1, kept off 0."""
    return [max(k / (size - 1), 1e-4) for k in range(size)]


def ior_grid(size: int) -> list[float]:
    """Index of refraction at each node of a z axis, z = F0**(1/4) up to 0.99."""
    root = [np.float32(min(max(k / (size - 1), 1e-4), 0.99)) ** 2 for k in range(size)]
    return [float((np.float32(1) + r) / (np.float32(1) - r)) for r in root]


def directional(kind: int, size: int, iors: list[float], steps: int) -> F32:
    """Table (len(iors), size, size) over [ior, cos, roughness] of `integrate`."""
    values = [[[integrate(kind, r, mu, ior, steps) for r in grid(size)] for mu in grid(size)] for ior in iors]
    return np.clip(values, 0.0, 1.0).astype(np.float32)


def average(kind: int, size: int, iors: list[float], steps: int) -> F32:
    """Table (len(iors), 1, size) of the cosine-weighted mean 2 * integral of mu * E(mu), by Gauss-Legendre quadrature."""
    nodes, weights = np.polynomial.legendre.leggauss(48)
    mus, weights = 0.5 * (nodes + 1.0), weights * 0.5
    values = [[[sum(2.0 * m * w * integrate(kind, r, m, ior, steps) for m, w in zip(mus, weights, strict=True)) for r in grid(size)]] for ior in iors]
    return np.clip(values, 0.0, 1.0).astype(np.float32)


def compute(steps: int = 512) -> dict[str, F32]:
    """Every table by name; steps**2 quadrature points an entry (a sixteenth of that below the averages)."""
    iors = ior_grid(16)
    inverse = [1.0 / ior for ior in iors]
    coarse = max(steps // 4, 1)
    return {
        "reflection": directional(REFLECTION, 32, [1.0], steps),
        "reflection_mean": average(REFLECTION, 32, [1.0], coarse),
        "glass": directional(GLASS, 16, iors, steps),
        "glass_mean": average(GLASS, 16, iors, coarse),
        "glass_inside": directional(GLASS, 16, inverse, steps),
        "glass_inside_mean": average(GLASS, 16, inverse, coarse),
        "schlick": directional(SCHLICK, 16, [1.0], steps),
        "schlick_ior": directional(SCHLICK_IOR, 16, iors, steps),
    }


def load() -> dict[str, F32]:
    """The tables as shipped."""
    with np.load(FILE) as tables:
        return {name: np.ascontiguousarray(tables[name]) for name in tables.files}


if __name__ == "__main__":
    np.savez_compressed(FILE, **compute())  # type: ignore[arg-type]
