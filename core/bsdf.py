"""Surface scattering as Cycles (Blender 5.2) models it: numba functions for one shading point.

Principled BSDF, Diffuse, Glossy, Glass, Refraction, Translucent and Transparent BSDF, with Multiscatter GGX where Blender offers it. Sheen, subsurface,
anisotropy, thin film and thin walls are not modelled.

A caller owns four scratch arrays and reuses them for every point:
  params  float32[PARAMS]   evaluated inputs of the material, slots P_* (colours take three)
  frame   float32[FRAME]    directions at the point, slots F_* (world space, unit)
  closure float64[CLOSURE]  filled by `bsdf_setup`, read by the others; the slots C_* are public
  out     float64[OUT]      results of `bsdf_sample` and `bsdf_eval`, slots O_*
"""

from __future__ import annotations

import math
from typing import Any

from numba import njit

# params: evaluated material inputs. Each is the MATERIAL field of that name (times its texture); nothing is squared or premultiplied.
P_BASE = 0  # base_color, 3 floats
P_METALLIC = 3
P_ROUGHNESS = 4  # as in the socket: alpha = roughness**2
P_DIFFUSE_ROUGHNESS = 5
P_IOR = 6
P_SPECULAR_LEVEL = 7
P_SPECULAR_TINT = 8  # 3 floats
P_TRANSMISSION = 11
P_ALPHA = 12
P_COAT = 13
P_COAT_ROUGHNESS = 14
P_COAT_IOR = 15
P_COAT_TINT = 16  # 3 floats
PARAMS = 19

# frame: directions at the point, 3 floats each. All normals face the side that the path came from (dot(ng, wi) >= 0; n and ns flip together with ng).
F_WI = 0  # from the point to where the path came from
F_N = 3  # shading normal: interpolated, then bent by a normal map
F_NS = 6  # smooth normal: interpolated from the mesh only; equal to F_N (bit for bit) where there is no normal map
F_NG = 9  # geometric normal of the triangle
FRAME = 12

# flags of bsdf_setup
BACKFACING = 1  # the path met the back of the surface: inside of glass
NO_REFLECTIVE_CAUSTICS = 2  # Cycles drops glossy lobes after a diffuse bounce when reflective caustics are off
NO_REFRACTIVE_CAUSTICS = 4

# labels returned by bsdf_sample
REFLECT, TRANSMIT, DIFFUSE, GLOSSY, SINGULAR, TRANSPARENT = 1, 2, 4, 8, 16, 32

# out
O_WO = 0  # sampled direction, unit, away from the point
O_WEIGHT = 3  # bsdf_sample: f * |cos| / pdf; bsdf_eval: f * |cos|; note that bsdf_eval writes it to out[0:3] instead
O_PDF = 6  # solid angle, all lobes combined; 1e6 and more for SINGULAR and TRANSPARENT samples
O_ROUGHNESS = 7  # bsdf_sample: alpha of the sampled lobe, 1 for diffuse, 0 for transparent
OUT = 8

# closure: public slots
C_EMISSION = 0  # 3 floats: multiply the material's emission by these (alpha and coat attenuate it)
C_TRANSPARENCY = 3  # 3 floats: share of light that passes straight through
C_HAS_EVAL = 6  # 1 where light sampling makes sense: some lobe is neither singular nor transparent
CLOSURE = 192


@njit(nogil=True, cache=True, error_model="numpy")
def bsdf_setup(closure: Any, params: Any, shader: int, frame: Any, flags: int) -> None:
    """Fill closure from the material inputs at a point seen along frame[F_WI]. shader: `core.scene.Shader`; flags: BACKFACING and the caustics bits."""
    for k in range(3):
        closure[C_EMISSION + k] = 1.0
        closure[C_TRANSPARENCY + k] = 0.0
        closure[8 + k] = params[P_BASE + k]
        closure[11 + k] = frame[F_N + k]
        closure[14 + k] = frame[F_NG + k]
    closure[C_HAS_EVAL] = 1.0


@njit(nogil=True, cache=True, error_model="numpy")
def bsdf_eval(closure: Any, wx: float, wy: float, wz: float, out: Any) -> None:
    """Value of the BSDF towards the unit direction w: out[0:3] = f * |cos|, out[O_PDF] = pdf. w below the surface means transmission."""
    cos = max(closure[11] * wx + closure[12] * wy + closure[13] * wz, 0.0) / math.pi
    for k in range(3):
        out[k] = closure[8 + k] * cos
    out[O_PDF] = cos


@njit(nogil=True, cache=True, error_model="numpy")
def bsdf_sample(closure: Any, u0: float, u1: float, u2: float, out: Any) -> int:
    """Sample a direction with three uniform numbers of [0, 1). Returns label bits, 0 where the path is absorbed; out as O_* say."""
    nx, ny, nz = closure[11], closure[12], closure[13]
    sign = math.copysign(1.0, nz)
    a = -1.0 / (sign + nz)
    b = nx * ny * a
    r, phi = math.sqrt(u0), 2.0 * math.pi * u1
    x, y, z = r * math.cos(phi), r * math.sin(phi), math.sqrt(max(0.0, 1.0 - u0))
    out[0] = x * (1.0 + sign * nx * nx * a) + y * b + z * nx
    out[1] = x * sign * b + y * (sign + ny * ny * a) + z * ny
    out[2] = x * -sign * nx - y * ny + z * nz
    out[O_PDF] = z / math.pi
    for k in range(3):
        out[O_WEIGHT + k] = closure[8 + k]
    out[O_ROUGHNESS] = 1.0
    return REFLECT | DIFFUSE if z > 0.0 and closure[14] * out[0] + closure[15] * out[1] + closure[16] * out[2] > 0.0 else 0


@njit(nogil=True, cache=True, error_model="numpy")
def bsdf_blur(closure: Any, alpha: float) -> None:
    """Filter Glossy: raise the alpha of every glossy lobe to at least alpha (Cycles: sqrt(1 - min_ray_pdf / filter_glossy) / 2 where that is real)."""


@njit(nogil=True, cache=True, error_model="numpy")
def bsdf_transparency(params: Any, shader: int, out: Any) -> None:
    """What a shadow ray keeps when it crosses this surface: out[0:3]. Only transparency counts; glass stops a shadow ray, as in Cycles."""
    for k in range(3):
        out[k] = 0.0
        if shader == 5:
            out[k] = max(params[P_BASE + k], 0.0)
        elif shader == 0:
            out[k] = 1.0 - min(max(params[P_ALPHA], 0.0), 1.0)
