"""Surface scattering as Cycles (Blender 5.2) models it: numba functions for one shading point.

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

from . import ggx_albedo
from .sampling import INNER
from .scene import ALL_RAYS, RayType, Shader

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
O_WO = 0  # bsdf_sample: sampled direction, 3 floats, unit, away from the point; bsdf_eval: f * |cos| instead
O_WEIGHT = 3  # bsdf_sample: f * |cos| / pdf, 3 floats
O_PDF = 6  # solid angle, all lobes combined; of the order of 1e6 for SINGULAR and TRANSPARENT samples
O_ROUGHNESS = 7  # bsdf_sample: alpha of the sampled lobe, 1 for diffuse, 0 for transparent
OUT = 8

# closure: public slots
C_EMISSION = 0  # 3 floats: multiply the material's emission by these (alpha and coat attenuate it)
C_TRANSPARENCY = 3  # 3 floats: share of light that passes straight through
C_HAS_EVAL = 6  # 1 where sampling lights makes sense: some lobe is neither singular nor transparent
# closure: the rest is private
_COUNT = 7  # lobes in use
_FRAME = 8  # copy of frame
_PARAMS = _FRAME + FRAME  # copy of params
_LOBES = _PARAMS + PARAMS

# A lobe, from _LOBES + k * _LOBE
_KIND = 0
_WEIGHT = 1  # 3 floats
_PICK = 4  # unnormalised probability of sampling this lobe
_N = 5  # 3 floats, its own normal
_ALPHA = 8  # GGX roughness; Oren-Nayar's A
_ETA = 9  # index of refraction, transmitted over incident side; Oren-Nayar's B
_SCALE = 10  # energy preservation
_FRESNEL = 11
_F0 = 12  # 3 floats; Oren-Nayar's multiple scattering term
_EDGE = 15  # 3 floats, F82 darkening
_TINT_R = 18  # 3 floats, of reflection
_TINT_T = 21  # 3 floats, of transmission
_BUMPED = 24  # 1 where the lobe's normal is not the smooth normal
_LOBE = 25
_MAX_LOBES = 6  # transparent, coat, metal, glass, specular, diffuse
CLOSURE = _LOBES + _MAX_LOBES * _LOBE

# Kinds are floats: they live in a float array, and numba would compile a function anew for each literal integer or boolean that it is called with.
_LAMBERT, _OREN_NAYAR, _TRANSLUCENT, _TRANSPARENT, _REFLECTION, _REFRACTION, _GLASS = 0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0
_CONSTANT, _SCHLICK, _F82 = 0.0, 1.0, 2.0
_DIFFUSE_RAYS, _GLOSSY_RAYS, _TRANSMISSION_RAYS = (1 << int(t) for t in (RayType.DIFFUSE, RayType.GLOSSY, RayType.TRANSMISSION))
_GLASS_RAYS = _GLOSSY_RAYS | _TRANSMISSION_RAYS

_CUTOFF = 1e-5  # lobes of less weight are dropped, as in Cycles
_SINGULAR_ALPHA2 = 2e-10
_DELTA = 1e6  # density that stands for a delta distribution

_PRINCIPLED, _DIFFUSE_SHADER, _GLOSSY_SHADER, _GLASS_SHADER, _TRANSPARENT_SHADER, _REFRACTION_SHADER, _TRANSLUCENT_SHADER = (
    int(Shader.PRINCIPLED),
    int(Shader.DIFFUSE),
    int(Shader.GLOSSY),
    int(Shader.GLASS),
    int(Shader.TRANSPARENT),
    int(Shader.REFRACTION),
    int(Shader.TRANSLUCENT),
)

# Energy tables, one after the other: a kernel holds one constant and one kind of lookup, which halves its compile time.
_NAMES = ("reflection", "reflection_mean", "glass", "glass_mean", "glass_inside", "glass_inside_mean", "schlick", "schlick_ior")
_loaded = ggx_albedo.load()
_TABLES = np.concatenate([_loaded[name].ravel() for name in _NAMES])
_SIZES = np.array([_loaded[name].shape for name in _NAMES])  # (8, 3) lengths of the axes z, cosine, roughness
_OFFSETS = np.concatenate(([0], np.cumsum(_SIZES.prod(axis=1))[:-1]))
_REFLECTION_E, _GLASS_E, _INSIDE_E, _SCHLICK_S, _SCHLICK_IOR_S = 0, 2, 4, 6, 7  # the mean of a table over cosines is the next one


@njit(**INNER)
def _clip(x: float) -> float:
    return min(max(x, 0.0), 1.0)


@njit(**INNER)
def _lookup(which: int, z: float, y: float, x: float) -> float:
    """Trilinear interpolation of a table at coordinates in [0, 1] per axis."""
    nz, ny, nx = _SIZES[which, 0], _SIZES[which, 1], _SIZES[which, 2]
    z, y, x = _clip(z) * (nz - 1), _clip(y) * (ny - 1), _clip(x) * (nx - 1)
    k, j, i = int(z), int(y), int(x)
    z, y, x = z - k, y - j, x - i
    value = 0.0
    for dk in range(min(2, nz - k)):
        for dj in range(min(2, ny - j)):
            row = _OFFSETS[which] + ((k + dk) * ny + j + dj) * nx
            w = abs(1.0 - dk - z) * abs(1.0 - dj - y)
            value += w * ((1.0 - x) * _TABLES[row + i] + x * _TABLES[row + min(i + 1, nx - 1)])
    return value


@njit(**INNER)
def _dielectric(cos: float, eta: float) -> tuple[float, float]:
    """Unpolarised Fresnel reflectance of a dielectric, and the cosine (negative: beyond the surface) of the refracted ray; 1, 0 at total reflection."""
    squared = eta * eta - (1.0 - cos * cos)
    if squared <= 0.0:
        return 1.0, 0.0
    cos = abs(cos)
    ct = math.sqrt(squared)  # eta * |cos_t|
    rs = (cos - ct) / (cos + ct)
    rp = (eta * eta * cos - ct) / (eta * eta * cos + ct)
    return 0.5 * (rs * rs + rp * rp), -ct / eta


@njit(**INNER)
def _f0(ior: float) -> float:
    return ((ior - 1.0) / (ior + 1.0)) ** 2


@njit(**INNER)
def _fresnel(c: Any, o: int, k: int, cos: float, dielectric: float) -> tuple[float, float]:
    """Reflectance and transmittance of lobe o in channel k at cosine cos to the microfacet, where the dielectric reflectance there is known."""
    kind = c[o + _FRESNEL]
    if kind == _SCHLICK:  # the true curve, remapped from [F0, 1] to [f0, 1]
        f0 = _f0(c[o + _ETA])
        f = c[o + _F0 + k] + (1.0 - c[o + _F0 + k]) * _clip((dielectric - f0) / (1.0 - f0))
        return f * c[o + _TINT_R + k], max(1.0 - f, 0.0) * c[o + _TINT_T + k]
    if kind == _F82:  # Kutz, Hasan, Edmondson, "Novel aspects of the Adobe Standard Material", 2023
        s = _clip(1.0 - cos)
        s5 = s * s * s * s * s
        return _clip(c[o + _F0 + k] + (1.0 - c[o + _F0 + k]) * s5 - c[o + _EDGE + k] * cos * s5 * s), 0.0
    if c[o + _KIND] == _REFRACTION:
        return 0.0, 0.0 if dielectric >= 1.0 else 1.0
    return 1.0, 0.0


@njit(**INNER)
def _smith(alpha2: float, cos: float) -> float:
    """Lambda of Smith's shadowing for GGX (Heitz, JCGT 3(2), 2014, equation 72)."""
    return 0.5 * (math.sqrt(1.0 + alpha2 * max(1.0 / (cos * cos) - 1.0, 0.0)) - 1.0)


@njit(**INNER)
def _oren_nayar_g(cos: float) -> float:
    """Direction-dependent part of the albedo of Fujii's Oren-Nayar model (as in the OpenPBR specification)."""
    if cos < 1e-6:
        return math.pi / 2.0 - 2.0 / 3.0 - cos
    cos = min(cos, 1.0)
    sin = math.sqrt(1.0 - cos * cos)
    return sin * (math.acos(cos) - 2.0 / 3.0 - sin * cos) + 2.0 / 3.0 * (sin / cos) * (1.0 - sin * sin * sin)


@njit(**INNER)
def _add_lobe(c: Any, kind: float, r: float, g: float, b: float, alpha: float, eta: float, n: Any) -> int:
    """Append a lobe of weight (r, g, b) with normal n; returns its offset in closure, -1 where it weighs too little to matter."""
    r, g, b = max(r, 0.0), max(g, 0.0), max(b, 0.0)
    pick = (r + g + b) / 3.0
    if not (pick >= _CUTOFF and pick < math.inf):
        return -1
    o = _LOBES + int(c[_COUNT]) * _LOBE
    c[_COUNT] += 1.0
    c[o + _KIND] = kind
    c[o + _WEIGHT], c[o + _WEIGHT + 1], c[o + _WEIGHT + 2] = r, g, b
    c[o + _PICK] = pick
    c[o + _N], c[o + _N + 1], c[o + _N + 2] = n
    c[o + _ALPHA] = alpha
    c[o + _ETA] = eta
    c[o + _SCALE] = 1.0
    c[o + _FRESNEL] = _CONSTANT
    same = n[0] == c[_FRAME + F_NS] and n[1] == c[_FRAME + F_NS + 1] and n[2] == c[_FRAME + F_NS + 2]
    c[o + _BUMPED] = 0.0 if same else 1.0
    return o


@njit(**INNER)
def _layer(c: Any, o: int, fss_r: float, fss_g: float, fss_b: float) -> float:
    """Finish GGX lobe o: sampling weight, energy preservation. Returns the share of light that layers below it keep.

    fss: mean single-scattering Fresnel reflectance, which colours what bounces between microfacets (Kulla, Conty, "Revisiting physically based shading
    at Imageworks", 2017, as a multiplier on single scattering).
    """
    cos = c[_FRAME] * c[o + _N] + c[_FRAME + 1] * c[o + _N + 1] + c[_FRAME + 2] * c[o + _N + 2]
    rough = math.sqrt(c[o + _ALPHA])
    eta = c[o + _ETA]
    z = math.sqrt(abs((eta - 1.0) / (eta + 1.0)))
    kind = c[o + _FRESNEL]
    s = _lookup(_SCHLICK_IOR_S if kind == _SCHLICK else _SCHLICK_S, z, cos, rough)
    table = _REFLECTION_E if c[o + _KIND] == _REFLECTION else (_INSIDE_E if eta < 1.0 else _GLASS_E)
    e, mean = _lookup(table, z, cos, rough), _lookup(table + 1, z, 0.0, rough)
    c[o + _SCALE] = 1.0 / e
    albedo_sum, darkening_sum, keep = 0.0, 0.0, 1.0
    for k in range(3):
        fss = fss_r if k == 0 else (fss_g if k == 1 else fss_b)
        darkening = e + fss * mean / max(1.0 - fss * (1.0 - mean), 1e-6) * (1.0 - e)
        reflectance, transmittance = 1.0, 0.0
        if kind != _CONSTANT:
            f = c[o + _F0 + k] + (1.0 - c[o + _F0 + k]) * s
            reflectance = f * c[o + _TINT_R + k]
            transmittance = (1.0 - f) * c[o + _TINT_T + k]
        albedo_sum += reflectance + transmittance
        darkening_sum += darkening
        if c[o + _WEIGHT + k] > 0.0:
            keep = min(keep, 1.0 - darkening * reflectance)
        c[o + _WEIGHT + k] *= darkening
    c[o + _PICK] *= albedo_sum / 3.0 * darkening_sum / 3.0
    return _clip(keep)


@njit(**INNER)
def _schlick(c: Any, o: int, f0: float, r: float, g: float, b: float) -> float:
    """Give lobe o Fresnel reflectance from f0 * (r, g, b) to 1 along the dielectric curve (tints set before), and finish it. Returns as `_layer`."""
    c[o + _FRESNEL] = _SCHLICK
    c[o + _F0], c[o + _F0 + 1], c[o + _F0 + 2] = _clip(f0 * r), _clip(f0 * g), _clip(f0 * b)
    eta = c[o + _ETA]
    # Mean of the dielectric reflectance over cosines, fitted by Kulla and Conty (2017).
    fss = 0.997118 + eta * (0.1014 - eta * (0.965241 + eta * 0.130607)) if eta < 1.0 else (eta - 1.0) / (4.08567 + 1.00071 * eta)
    real = _f0(eta)
    s = _clip((fss - real) / (1.0 - real))
    fr, fg, fb = c[o + _TINT_T], c[o + _TINT_T + 1], c[o + _TINT_T + 2]  # the colour of glass comes mostly from transmission
    if fr == 0.0 and fg == 0.0 and fb == 0.0:
        fr = c[o + _TINT_R] * (c[o + _F0] + (1.0 - c[o + _F0]) * s)
        fg = c[o + _TINT_R + 1] * (c[o + _F0 + 1] + (1.0 - c[o + _F0 + 1]) * s)
        fb = c[o + _TINT_R + 2] * (c[o + _F0 + 2] + (1.0 - c[o + _F0 + 2]) * s)
    return _layer(c, o, fr, fg, fb)


@njit(**INNER)
def _tints(c: Any, o: int, reflection: float, transmission: float) -> None:
    for k in range(3):
        c[o + _TINT_R + k], c[o + _TINT_T + k] = reflection, transmission


@njit(**INNER)
def _diffuse(c: Any, r: float, g: float, b: float, roughness: float, n: Any) -> None:
    """Lambert, or Fujii's Oren-Nayar with multiple scattering coloured by the base colour (https://mimosa-pudica.net/improved-oren-nayar.html)."""
    o = _add_lobe(c, _LAMBERT, r, g, b, 0.0, 1.0, n)
    if o < 0 or roughness < 1e-5:
        return
    a = 1.0 / (math.pi + roughness * (math.pi / 2.0 - 2.0 / 3.0))
    slope = roughness * a
    mean = a * math.pi + (2.0 * math.pi - 5.6) / 3.0 * slope
    cos = c[_FRAME] * n[0] + c[_FRAME + 1] * n[1] + c[_FRAME + 2] * n[2]
    lost = max(1.0 - a * math.pi - slope * _oren_nayar_g(max(cos, 0.0)), 0.0)
    c[o + _KIND] = _OREN_NAYAR
    c[o + _ALPHA], c[o + _ETA] = a, slope
    for k in range(3):
        albedo = _clip(c[_PARAMS + P_BASE + k])
        c[o + _F0 + k] = albedo * albedo / math.pi * (mean / (1.0 - mean)) / (1.0 - albedo * (1.0 - mean)) * lost


@njit(**INNER)
def _lift(c: Any, nx: float, ny: float, nz: float) -> tuple[float, float, float]:
    """The shading normal n, turned towards the geometric normal until the mirror direction of wi leaves the surface, as Cycles does for glossy lobes.

    In the plane of ng (z) and n (x), n' = (sin a, cos a) mirrors wi to height z' = 2 (n'.wi) cos a - wi.z; z' = t gives a quadratic in cos(a)**2.
    """
    ix, iy, iz = c[_FRAME + F_WI], c[_FRAME + F_WI + 1], c[_FRAME + F_WI + 2]
    gx, gy, gz = c[_FRAME + F_NG], c[_FRAME + F_NG + 1], c[_FRAME + F_NG + 2]
    if nx == gx and ny == gy and nz == gz:
        return nx, ny, nz
    cos_i = ix * gx + iy * gy + iz * gz
    cos_n = nx * gx + ny * gy + nz * gz
    cos_ni = nx * ix + ny * iy + nz * iz
    t = min(0.9 * cos_i, 0.01)
    if 2.0 * cos_ni * cos_n - cos_i >= t:
        return nx, ny, nz
    tx, ty, tz = nx - cos_n * gx, ny - cos_n * gy, nz - cos_n * gz
    length = math.sqrt(tx * tx + ty * ty + tz * tz)
    if length > 0.0:
        tx, ty, tz = tx / length, ty / length, tz / length
    else:
        tx, ty, tz = nx, ny, nz
    i_x = ix * tx + iy * ty + iz * tz
    p = max(i_x * i_x + cos_i * cos_i, 1e-20)
    q = 2.0 * (p + cos_i * t)
    root = math.sqrt(max(q * q - 4.0 * p * (t + cos_i) ** 2, 0.0))
    cos2 = _clip(0.25 * (q + root if i_x < 0.0 else q - root) / p)
    sine, cosine = math.sqrt(1.0 - cos2), math.sqrt(cos2)
    return sine * tx + cosine * gx, sine * ty + cosine * gy, sine * tz + cosine * gz


@njit(**INNER)
def _beer(tint: float, depth: float, weight: float) -> float:
    """What a coat of this weight lets through at optical depth `depth`; a tint above 1 at grazing angles is kept finite."""
    return max(0.0, 1.0 + weight * (min(max(tint, 0.0) ** depth, 1e6) - 1.0))


@njit(**INNER)
def _principled(c: Any, flags: int, n: Any, lifted: Any) -> None:
    """Lobes of the Principled BSDF, from the top: transparency, coat, metal | glass | specular over diffuse."""
    reflective, refractive = flags & NO_REFLECTIVE_CAUSTICS == 0, flags & NO_REFRACTIVE_CAUSTICS == 0
    alpha = _clip(c[_PARAMS + P_ALPHA])
    wr = wg = wb = alpha
    if alpha < 1.0:
        c[C_TRANSPARENCY] = c[C_TRANSPARENCY + 1] = c[C_TRANSPARENCY + 2] = 1.0 - alpha
        _add_lobe(c, _TRANSPARENT, 1.0 - alpha, 1.0 - alpha, 1.0 - alpha, 0.0, 1.0, n)

    coat = max(c[_PARAMS + P_COAT], 0.0)
    if coat > _CUTOFF:
        ior = max(c[_PARAMS + P_COAT_IOR], 1.0)
        smooth = _lift(c, c[_FRAME + F_NS], c[_FRAME + F_NS + 1], c[_FRAME + F_NS + 2])  # a normal map bends what lies below, not the coat
        cos = c[_FRAME] * smooth[0] + c[_FRAME + 1] * smooth[1] + c[_FRAME + 2] * smooth[2]
        if reflective:
            o = _add_lobe(c, _REFLECTION, coat * wr, coat * wg, coat * wb, _clip(c[_PARAMS + P_COAT_ROUGHNESS]) ** 2, ior, smooth)
            if o >= 0:
                _tints(c, o, 1.0, 0.0)
                keep = _clip(1.0 - coat * (1.0 - _schlick(c, o, _f0(ior), 1.0, 1.0, 1.0)))
                wr, wg, wb = wr * keep, wg * keep, wb * keep
        # Beer's law along the refracted ray; the tint is that of perpendicular light.
        depth = 1.0 / math.sqrt(1.0 - (1.0 - cos * cos) / (ior * ior))
        wr *= _beer(c[_PARAMS + P_COAT_TINT], depth, coat)
        wg *= _beer(c[_PARAMS + P_COAT_TINT + 1], depth, coat)
        wb *= _beer(c[_PARAMS + P_COAT_TINT + 2], depth, coat)
    c[C_EMISSION], c[C_EMISSION + 1], c[C_EMISSION + 2] = wr, wg, wb

    rough = _clip(c[_PARAMS + P_ROUGHNESS]) ** 2
    ior = max(c[_PARAMS + P_IOR], 1e-5)
    tint_r, tint_g, tint_b = max(c[_PARAMS + P_SPECULAR_TINT], 0.0), max(c[_PARAMS + P_SPECULAR_TINT + 1], 0.0), max(c[_PARAMS + P_SPECULAR_TINT + 2], 0.0)

    metallic = _clip(c[_PARAMS + P_METALLIC])
    if metallic > _CUTOFF:
        o = _add_lobe(c, _REFLECTION, metallic * wr, metallic * wg, metallic * wb, rough, 1.0, lifted) if reflective else -1
        if o >= 0:
            _metal(c, o)
        wr, wg, wb = wr * (1.0 - metallic), wg * (1.0 - metallic), wb * (1.0 - metallic)

    transmission = _clip(c[_PARAMS + P_TRANSMISSION])
    if transmission > _CUTOFF:
        eta = 1.0 / ior if flags & BACKFACING else ior
        o = -1
        if reflective or refractive:
            o = _add_lobe(c, _GLASS, transmission * wr, transmission * wg, transmission * wb, rough, eta, lifted)
        if o >= 0:
            for k in range(3):
                c[o + _TINT_R + k] = 1.0 if reflective else 0.0
                c[o + _TINT_T + k] = math.sqrt(_clip(c[_PARAMS + P_BASE + k])) if refractive else 0.0
            _schlick(c, o, _f0(ior), tint_r, tint_g, tint_b)
        wr, wg, wb = wr * (1.0 - transmission), wg * (1.0 - transmission), wb * (1.0 - transmission)

    level = max(c[_PARAMS + P_SPECULAR_LEVEL], 0.0)
    f0, eta = _f0(ior), ior
    if level != 0.5:
        f0 *= 2.0 * level
        root = math.sqrt(min(f0, 0.99))
        eta = (1.0 + root) / (1.0 - root)
        if ior < 1.0:
            eta = 1.0 / eta
    if reflective and eta != 1.0:
        o = _add_lobe(c, _REFLECTION, wr, wg, wb, rough, eta, lifted)
        if o >= 0:
            _tints(c, o, 1.0, 0.0)
            keep = _schlick(c, o, f0, tint_r, tint_g, tint_b)
            wr, wg, wb = wr * keep, wg * keep, wb * keep

    base_r, base_g, base_b = max(c[_PARAMS + P_BASE], 0.0), max(c[_PARAMS + P_BASE + 1], 0.0), max(c[_PARAMS + P_BASE + 2], 0.0)
    _diffuse(c, wr * base_r, wg * base_g, wb * base_b, _clip(c[_PARAMS + P_DIFFUSE_ROUGHNESS]), n)


@njit(**INNER)
def _metal(c: Any, o: int) -> None:
    """F82-tint Fresnel: base colour at normal incidence; the specular tint darkens Schlick's curve at acos(1/7)."""
    c[o + _FRESNEL] = _F82
    _tints(c, o, 1.0, 0.0)
    s = 6.0 / 7.0
    s5 = s * s * s * s * s
    for k in range(3):
        f0 = _clip(c[_PARAMS + P_BASE + k])
        c[o + _F0 + k] = f0
        c[o + _EDGE + k] = (f0 + (1.0 - f0) * s5) * (7.0 / (s5 * s)) * (1.0 - _clip(c[_PARAMS + P_SPECULAR_TINT + k]))
    # Mean reflectance: integral of 2 cos * F82(cos).
    r = c[o + _F0] + (1.0 - c[o + _F0]) / 21.0 - c[o + _EDGE] / 126.0
    g = c[o + _F0 + 1] + (1.0 - c[o + _F0 + 1]) / 21.0 - c[o + _EDGE + 1] / 126.0
    b = c[o + _F0 + 2] + (1.0 - c[o + _F0 + 2]) / 21.0 - c[o + _EDGE + 2] / 126.0
    _layer(c, o, r, g, b)


@njit(nogil=True, cache=True, error_model="numpy")
def bsdf_setup(closure: Any, params: Any, shader: int, frame: Any, flags: int) -> None:
    """Fill closure from the material inputs at a point seen along frame[F_WI].

    shader: `core.scene.Shader` (EMISSION and HOLDOUT scatter nothing); flags: BACKFACING and the caustics bits.
    """
    c = closure
    for k in range(3):
        c[C_EMISSION + k] = 1.0
        c[C_TRANSPARENCY + k] = 0.0
    for k in range(PARAMS):
        c[_PARAMS + k] = params[k]
    c[_COUNT] = 0.0
    # In float64 unit vectors are unit to 1e-16; 1e-7 would show in the sharpest lobes.
    for k in range(0, FRAME, 3):
        x, y, z = np.float64(frame[k]), np.float64(frame[k + 1]), np.float64(frame[k + 2])  # numba: float() keeps float32
        scale = 1.0 / math.sqrt(x * x + y * y + z * z)
        c[_FRAME + k], c[_FRAME + k + 1], c[_FRAME + k + 2] = x * scale, y * scale, z * scale
    n = (c[_FRAME + F_N], c[_FRAME + F_N + 1], c[_FRAME + F_N + 2])
    lifted = _lift(c, n[0], n[1], n[2])
    r, g, b = max(c[_PARAMS + P_BASE], 0.0), max(c[_PARAMS + P_BASE + 1], 0.0), max(c[_PARAMS + P_BASE + 2], 0.0)
    rough = _clip(c[_PARAMS + P_ROUGHNESS]) ** 2
    eta = max(c[_PARAMS + P_IOR], 1e-5)
    reflective, refractive = flags & NO_REFLECTIVE_CAUSTICS == 0, flags & NO_REFRACTIVE_CAUSTICS == 0
    if shader == _PRINCIPLED:
        _principled(c, flags, n, lifted)
    elif shader == _DIFFUSE_SHADER:
        _diffuse(c, r, g, b, _clip(c[_PARAMS + P_DIFFUSE_ROUGHNESS]), n)
    elif shader == _TRANSLUCENT_SHADER:
        _add_lobe(c, _TRANSLUCENT, r, g, b, 0.0, 1.0, lifted)
    elif shader == _TRANSPARENT_SHADER:
        c[C_TRANSPARENCY], c[C_TRANSPARENCY + 1], c[C_TRANSPARENCY + 2] = r, g, b
        _add_lobe(c, _TRANSPARENT, r, g, b, 0.0, 1.0, n)
    elif shader == _GLOSSY_SHADER and reflective:
        o = _add_lobe(c, _REFLECTION, r, g, b, rough, 1.0, lifted)
        if o >= 0:
            _layer(c, o, r, g, b)
    elif shader == _REFRACTION_SHADER and refractive:
        _add_lobe(c, _REFRACTION, r, g, b, rough, 1.0 / eta if flags & BACKFACING else eta, lifted)
    elif shader == _GLASS_SHADER and (reflective or refractive):
        o = _add_lobe(c, _GLASS, 1.0, 1.0, 1.0, rough, 1.0 / eta if flags & BACKFACING else eta, lifted)
        if o >= 0:
            for k in range(3):
                tint = max(c[_PARAMS + P_BASE + k], 0.0)
                c[o + _TINT_R + k], c[o + _TINT_T + k] = tint if reflective else 0.0, tint if refractive else 0.0
            _schlick(c, o, _f0(eta), 1.0, 1.0, 1.0)
    _mark(c)


@njit(**INNER)
def _mark(c: Any) -> None:
    """Set C_HAS_EVAL."""
    c[C_HAS_EVAL] = 0.0
    for o in range(_LOBES, _LOBES + int(c[_COUNT]) * _LOBE, _LOBE):
        kind = c[o + _KIND]
        if kind != _TRANSPARENT and (kind < _REFLECTION or c[o + _ALPHA] * c[o + _ALPHA] > _SINGULAR_ALPHA2):
            c[C_HAS_EVAL] = 1.0


@njit(nogil=True, cache=True, error_model="numpy")
def bsdf_blur(closure: Any, alpha: float) -> None:
    """Filter Glossy: raise the alpha of every glossy lobe to at least alpha.

    Cycles: alpha = sqrt(1 - p) / 2 with p = (least pdf of the path's bounces so far) / filter_glossy, where p < 1.
    """
    for o in range(_LOBES, _LOBES + int(closure[_COUNT]) * _LOBE, _LOBE):
        if closure[o + _KIND] >= _REFLECTION:
            closure[o + _ALPHA] = max(closure[o + _ALPHA], alpha)
    _mark(closure)


@njit(**INNER)
def _bump_shadowing(c: Any, o: int, wx: float, wy: float, wz: float, sampled: float) -> float:
    """What a bent normal leaves of light from w: none from behind the smooth surface, and for diffuse lobes a soft terminator.

    (Conty Estevez, Lecocq, Stein, "A microfacet-based shadowing function to solve the bump terminator problem", Ray Tracing Gems, 2019.)
    """
    sx, sy, sz = c[_FRAME + F_NS], c[_FRAME + F_NS + 1], c[_FRAME + F_NS + 2]
    nx, ny, nz = c[o + _N], c[o + _N + 1], c[o + _N + 2]
    cos_sw = sx * wx + sy * wy + sz * wz
    cos_sn = sx * nx + sy * ny + sz * nz
    cos_nw = nx * wx + ny * wy + nz * wz
    diffuse = c[o + _KIND] <= _TRANSLUCENT
    if cos_sw * cos_sn * cos_nw < 0.0 and (diffuse or sampled == 0.0):
        return 0.0
    cos_i, cos_d = abs(cos_sw), abs(cos_sn)
    if not diffuse or cos_d >= 1.0 or cos_i >= 1.0:
        return 1.0
    if cos_i < 1e-6:
        return 0.0
    return 1.0 / (1.0 + _smith(_clip(0.125 * (1.0 / (cos_d * cos_d) - 1.0)), cos_i))


@njit(**INNER)
def _add_eval(c: Any, o: int, wx: float, wy: float, wz: float, sampled: float, out: Any) -> float:
    """Add lobe o's weighted f * |cos| towards w to out[O_WEIGHT:]; returns its pdf. sampled: 1 where w was sampled from this lobe."""
    kind = c[o + _KIND]
    nx, ny, nz = c[o + _N], c[o + _N + 1], c[o + _N + 2]
    cos_o = nx * wx + ny * wy + nz * wz
    shadow = 1.0
    if c[o + _BUMPED] != 0.0 and not (sampled != 0.0 and cos_o < 0.0):
        shadow = _bump_shadowing(c, o, wx, wy, wz, sampled)
        if shadow == 0.0 and sampled == 0.0:
            return 0.0
    ix, iy, iz = c[_FRAME + F_WI], c[_FRAME + F_WI + 1], c[_FRAME + F_WI + 2]
    cos_i = nx * ix + ny * iy + nz * iz

    if kind < _TRANSPARENT:
        pdf = max(-cos_o if kind == _TRANSLUCENT else cos_o, 0.0) / math.pi
        if pdf <= 0.0:
            return 0.0
        if kind == _OREN_NAYAR:
            t = ix * wx + iy * wy + iz * wz - cos_o * max(cos_i, 0.0)
            if t > 0.0:
                t /= max(cos_o, cos_i)
            lost = max(1.0 - c[o + _ALPHA] * math.pi - c[o + _ETA] * _oren_nayar_g(cos_o), 0.0)
            single = c[o + _ALPHA] + c[o + _ETA] * t
            for k in range(3):
                out[O_WEIGHT + k] += c[o + _WEIGHT + k] * shadow * cos_o * (single + c[o + _F0 + k] * lost)
        else:
            for k in range(3):
                out[O_WEIGHT + k] += c[o + _WEIGHT + k] * shadow * pdf
        return pdf

    alpha2 = c[o + _ALPHA] * c[o + _ALPHA]
    transmit = cos_o < 0.0
    if kind == _TRANSPARENT or cos_i <= 0.0 or alpha2 <= _SINGULAR_ALPHA2 or kind == (_REFLECTION if transmit else _REFRACTION):
        return 0.0
    # Walter et al., "Microfacet models for refraction through rough surfaces", EGSR 2007.
    eta = c[o + _ETA]
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
    lambda_i, lambda_o = _smith(alpha2, cos_i), _smith(alpha2, cos_o)
    value = common / (1.0 + lambda_i + lambda_o) * c[o + _SCALE] * shadow

    dielectric, _ = _dielectric(cos_hi, eta)
    reflected, total = 0.0, 0.0
    for k in range(3):
        r, t = _fresnel(c, o, k, cos_hi, dielectric)
        out[O_WEIGHT + k] += c[o + _WEIGHT + k] * value * (t if transmit else r)
        reflected += r
        total += r + t
    if total <= 0.0:
        return 0.0
    return common / (1.0 + lambda_i) * ((total - reflected) if transmit else reflected) / total


@njit(nogil=True, cache=True, error_model="numpy")
def bsdf_eval(closure: Any, wx: float, wy: float, wz: float, out: Any, visibility: int = ALL_RAYS) -> None:
    """Value of the BSDF towards the unit direction w: out[0:3] = f * |cos|, out[O_PDF] = pdf. w below the surface means transmission.

    visibility: bit per RayType, of the light that is looked at: lobes whose rays do not see it count for nothing (glass needs but one of its two).
    Like Cycles, it tests w against the normals that the lobes use, not against the geometric normal: smooth shading would show the triangles.
    """
    out[O_WEIGHT] = out[O_WEIGHT + 1] = out[O_WEIGHT + 2] = 0.0
    pdf, picks = 0.0, 0.0
    for o in range(_LOBES, _LOBES + int(closure[_COUNT]) * _LOBE, _LOBE):
        picks += closure[o + _PICK]
        kind = closure[o + _KIND]
        rays = _GLASS_RAYS
        if kind <= _TRANSLUCENT:
            rays = _DIFFUSE_RAYS
        elif kind == _REFLECTION:
            rays = _GLOSSY_RAYS
        elif kind == _REFRACTION:
            rays = _TRANSMISSION_RAYS
        if visibility & rays:
            pdf += closure[o + _PICK] * _add_eval(closure, o, wx, wy, wz, 0.0, out)
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
    nx, ny, nz = c[o + _N], c[o + _N + 1], c[o + _N + 2]
    alpha = c[o + _ALPHA]
    if alpha * alpha <= _SINGULAR_ALPHA2:
        return nx, ny, nz
    x, y, z = _local(c[_FRAME + F_WI], c[_FRAME + F_WI + 1], c[_FRAME + F_WI + 2], nx, ny, nz)
    x, y = x * alpha, y * alpha
    scale = 1.0 / math.sqrt(x * x + y * y + z * z)
    x, y, z = x * scale, y * scale, z * scale
    phi = 2.0 * math.pi * u0
    height = (1.0 - u1) * (1.0 + z) - z
    sine = math.sqrt(max(0.0, 1.0 - height * height))
    x, y, z = alpha * (x + sine * math.cos(phi)), alpha * (y + sine * math.sin(phi)), max(z + height, 0.0)
    scale = 1.0 / math.sqrt(x * x + y * y + z * z)
    return _basis(x * scale, y * scale, z * scale, nx, ny, nz)


@njit(nogil=True, cache=True, error_model="numpy")
def bsdf_sample(closure: Any, u0: float, u1: float, u2: float, out: Any) -> int:
    """Sample a direction with three uniform numbers of [0, 1). Returns label bits, 0 where the path is absorbed; out as O_* say."""
    c = closure
    end = _LOBES + int(c[_COUNT]) * _LOBE
    picks = 0.0
    for o in range(_LOBES, end, _LOBE):
        picks += c[o + _PICK]
    if not picks > 0.0:
        return 0
    left = u2 * picks
    o = _LOBES
    while o + _LOBE < end and left >= c[o + _PICK]:
        left -= c[o + _PICK]
        o += _LOBE
    pick = c[o + _PICK]
    if pick <= 0.0:
        return 0
    u2 = min(left / pick, 1.0 - 1e-12)

    kind = c[o + _KIND]
    nx, ny, nz = c[o + _N], c[o + _N + 1], c[o + _N + 2]
    ix, iy, iz = c[_FRAME + F_WI], c[_FRAME + F_WI + 1], c[_FRAME + F_WI + 2]
    gx, gy, gz = c[_FRAME + F_NG], c[_FRAME + F_NG + 1], c[_FRAME + F_NG + 2]
    out[O_WEIGHT] = out[O_WEIGHT + 1] = out[O_WEIGHT + 2] = 0.0
    if kind == _TRANSPARENT:
        for k in range(3):
            out[O_WO + k] = -c[_FRAME + F_WI + k]
            out[O_WEIGHT + k] = c[o + _WEIGHT + k] * picks / pick
        out[O_PDF] = _DELTA * pick / picks
        out[O_ROUGHNESS] = 0.0
        return TRANSMIT | TRANSPARENT

    if kind < _TRANSPARENT:
        side = -1.0 if kind == _TRANSLUCENT else 1.0
        radius, phi = math.sqrt(u0), 2.0 * math.pi * u1
        wx, wy, wz = _basis(radius * math.cos(phi), radius * math.sin(phi), side * math.sqrt(max(0.0, 1.0 - u0)), nx, ny, nz)
        if side * (gx * wx + gy * wy + gz * wz) <= 0.0:
            return 0
        label = (TRANSMIT if kind == _TRANSLUCENT else REFLECT) | DIFFUSE
        out[O_ROUGHNESS] = 1.0
    else:
        if nx * ix + ny * iy + nz * iz <= 0.0:
            return 0
        hx, hy, hz = _microfacet(c, o, u0, u1)
        cos_hi = hx * ix + hy * iy + hz * iz
        eta = c[o + _ETA]
        dielectric, cos_ht = _dielectric(cos_hi, eta)
        reflected, total = 0.0, 0.0
        for k in range(3):
            r, t = _fresnel(c, o, k, cos_hi, dielectric)
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
        out[O_ROUGHNESS] = c[o + _ALPHA]
        if c[o + _ALPHA] * c[o + _ALPHA] <= _SINGULAR_ALPHA2 or (refract and abs(eta - 1.0) < 1e-4):
            for k in range(3):
                r, t = _fresnel(c, o, k, cos_hi, dielectric)
                out[O_WEIGHT + k] = c[o + _WEIGHT + k] * c[o + _SCALE] * (t if refract else r) / share * picks / pick
            out[O_WO], out[O_WO + 1], out[O_WO + 2] = wx, wy, wz
            out[O_PDF] = _DELTA * share * pick / picks
            return label | SINGULAR
        label |= GLOSSY

    pdf = 0.0
    for other in range(_LOBES, end, _LOBE):
        pdf += c[other + _PICK] * _add_eval(c, other, wx, wy, wz, 1.0 if other == o else 0.0, out)
    pdf /= picks
    if not pdf > 0.0:
        return 0
    out[O_WO], out[O_WO + 1], out[O_WO + 2] = wx, wy, wz
    for k in range(3):
        out[O_WEIGHT + k] /= pdf
    out[O_PDF] = pdf
    return label


@njit(nogil=True, cache=True, error_model="numpy")
def bsdf_transparency(params: Any, shader: int, out: Any) -> None:
    """What a shadow ray keeps when it crosses this surface: out[0:3]. Only transparency counts; glass stops a shadow ray, as in Cycles."""
    for k in range(3):
        out[k] = 0.0
        if shader == _TRANSPARENT_SHADER:
            out[k] = max(params[P_BASE + k], 0.0)
        elif shader == _PRINCIPLED:
            out[k] = 1.0 - _clip(params[P_ALPHA])
