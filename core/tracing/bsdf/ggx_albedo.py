"""Directional albedo of GGX microfacet lobes: the tables behind energy preservation and layering in `bsdf`.

A single-scattering GGX lobe loses the light that bounces between microfacets. Cycles scales it up by 1 / E, where
E(roughness, cos) is the lobe's albedo without Fresnel darkening (Turquin, "Practical multiple scattering compensation
for microfacet models", 2019), and weakens the layers below a specular one by its albedo. The tables have the grid of
Cycles' own (so interpolation errors are the same), but are integrated here, by quadrature over visible normals. `python
-m lipac.core.tracing.bsdf.ggx_albedo` writes them to ggx_albedo.npz (deterministic, some minutes).

Axes of every table: [z, y, roughness] on [0, 1], with z = sqrt((ior - 1) / (ior + 1)), and y the cosine, or its square
root in the finer tables of Blender 5.3 ("fine_"); an axis that does not matter has length 1. Blender before 5.3 counts
refracted rays that its sampling rejects, and so loses light in rough glass seen from inside; so do we, to agree with
it.
"""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from itertools import product
from pathlib import Path

import numpy as np
from numba import njit
from numpy.typing import NDArray

F32 = NDArray[np.float32]

FILE = Path(__file__).with_name("ggx_albedo.npz")
REFLECTION, GLASS, SCHLICK, SCHLICK_IOR, GLASS_BELOW = 0, 1, 2, 3, 4  # integrands


@njit(nogil=True, cache=True, error_model="numpy")
def _smith(alpha2: float, cos: float) -> float:
    """Lambda of Smith's shadowing for GGX (Heitz 2014, equation 72)."""
    return 0.5 * (math.sqrt(1.0 + alpha2 * max(1.0 / (cos * cos) - 1.0, 0.0)) - 1.0)


@njit(nogil=True, cache=True, error_model="numpy")
def integrate(kind: int, roughness: float, mu: float, ior: float, steps: int) -> float:
    """Mean over the visible normals of GGX seen under cosine mu (roughness in (0, 1], mu in (0, 1]), steps**2
    quadrature points.

    REFLECTION: albedo of the reflection lobe without Fresnel. GLASS: albedo of reflection plus refraction with
    dielectric Fresnel; GLASS_BELOW: without the refracted rays that do not end below the surface (rough glass seen from
    inside near total reflection), which sampling rejects.
    SCHLICK, SCHLICK_IOR: mean position between F0 and F90 of (1 - cos)**5, or of the dielectric Fresnel curve, where
    reflection leaves the surface.
    """
    alpha = roughness * roughness
    alpha2 = alpha * alpha
    # Heitz and d'Eon's distribution of visible normals by spherical caps (Dupuy, Benyoub 2023); wi lies in the xz
    # plane.
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
            if kind == GLASS_BELOW and cos_to >= 0.0:
                continue
            # Refraction at nearly equal indices passes straight through, unshadowed.
            straight = singular or abs(ior - 1.0) < 1e-4
            total += (
                weight
                * (1.0 - fresnel)
                * (1.0 if straight else (1.0 + lambda_i) / (1.0 + lambda_i + _smith(alpha2, cos_to)))
            )
    return total / (steps * steps)


def grid(size: int) -> list[float]:
    """Nodes of a roughness or cosine axis: 0..1, kept off 0."""
    return [max(k / (size - 1), 1e-4) for k in range(size)]


def fine_cosines(size: int) -> list[float]:
    """Cosines at the nodes of an axis of their square roots."""
    return [max((k / (size - 1)) ** 2, 1e-4) for k in range(size)]


def ior_grid(size: int) -> list[float]:
    """Index of refraction at each node of a z axis, z = F0**(1/4) up to 0.99."""
    root = [np.float32(min(max(k / (size - 1), 1e-4), 0.99)) ** 2 for k in range(size)]
    return [float((np.float32(1) + r) / (np.float32(1) - r)) for r in root]


def directional(kind: int, size: int, iors: list[float], steps: int, cosines: list[float] | None = None) -> F32:
    """Table (len(iors), size, size) over [ior, cos, roughness] of `integrate`; cosines: `grid` if not given."""
    entries = list(product(iors, cosines or grid(size), grid(size)))
    with ThreadPoolExecutor() as pool:
        values = list(pool.map(lambda e: integrate(kind, e[2], e[1], e[0], steps), entries))
    return np.clip(values, 0.0, 1.0).astype(np.float32).reshape(len(iors), size, size)


def average(kind: int, size: int, iors: list[float], steps: int) -> F32:
    """Table (len(iors), 1, size) of the cosine-weighted mean 2 * integral of mu * E(mu), by Gauss-Legendre
    quadrature."""
    nodes, weights = np.polynomial.legendre.leggauss(48)
    mus, weights = 0.5 * (nodes + 1.0), weights * 0.5

    def mean(entry: tuple[float, float]) -> float:
        return sum(
            2.0 * m * w * integrate(kind, entry[1], m, entry[0], steps) for m, w in zip(mus, weights, strict=True)
        )

    with ThreadPoolExecutor() as pool:
        values = list(pool.map(mean, product(iors, grid(size))))
    return np.clip(values, 0.0, 1.0).astype(np.float32).reshape(len(iors), 1, size)


def compute(steps: int = 512) -> dict[str, F32]:
    """Every table by name; steps**2 quadrature points an entry (a quarter of that in the finer tables, a sixteenth
    below the averages)."""
    iors, fine_iors, cosines = ior_grid(16), ior_grid(32), fine_cosines(32)
    inverse, fine_inverse = [1.0 / ior for ior in iors], [1.0 / ior for ior in fine_iors]
    half, coarse = max(steps // 2, 1), max(steps // 4, 1)
    return {
        "reflection": directional(REFLECTION, 32, [1.0], steps),
        "reflection_mean": average(REFLECTION, 32, [1.0], coarse),
        "glass": directional(GLASS, 16, iors, steps),
        "glass_mean": average(GLASS, 16, iors, coarse),
        "glass_inside": directional(GLASS, 16, inverse, steps),
        "glass_inside_mean": average(GLASS, 16, inverse, coarse),
        "schlick": directional(SCHLICK, 16, [1.0], steps),
        "schlick_ior": directional(SCHLICK_IOR, 16, iors, steps),
        "fine_reflection": directional(REFLECTION, 32, [1.0], half, cosines),
        "fine_reflection_mean": average(REFLECTION, 32, [1.0], coarse),
        "fine_glass": directional(GLASS, 32, fine_iors, half, cosines),
        "fine_glass_mean": average(GLASS, 32, fine_iors, coarse),
        "fine_glass_inside": directional(GLASS_BELOW, 32, fine_inverse, half, cosines),
        "fine_glass_inside_mean": average(GLASS_BELOW, 32, fine_inverse, coarse),
        "fine_schlick": directional(SCHLICK, 32, [1.0], half, cosines),
        "fine_schlick_ior": directional(SCHLICK_IOR, 32, fine_iors, half, cosines),
    }


def load() -> dict[str, F32]:
    """The tables as shipped."""
    with np.load(FILE) as tables:
        return {name: np.ascontiguousarray(tables[name]) for name in tables.files}


if __name__ == "__main__":
    np.savez_compressed(FILE, **compute())  # type: ignore[arg-type]
