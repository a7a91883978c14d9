"""Lobes of a surface: the arrays of one shading point, energy tables, and how lobes are added with their colours,
Fresnel terms and albedo. See `bsdf`."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from ...jit.sampling import INNER
from ...scene.model import RayType, Shader, Shading
from . import ggx_albedo

# params: evaluated material inputs. Each is the MATERIAL field of that name (times its texture); nothing is squared or
# premultiplied.
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

# frame: directions at the point, 3 floats each. All normals face the side that the path came from (dot(ng, wi) >= 0; n
# and ns flip together with ng).
F_WI = 0  # from the point to where the path came from
F_N = 3  # shading normal: interpolated, then bent by a normal map
F_NS = 6  # smooth normal: interpolated from the mesh only; equal to F_N (bit for bit) where there is no normal map
F_NG = 9  # geometric normal of the triangle
FRAME = 12

# flags of bsdf_setup
BACKFACING = 1  # the path met the back of the surface: inside of glass
NO_REFLECTIVE_CAUSTICS = 2  # Cycles drops glossy lobes after a diffuse bounce when reflective caustics are off
NO_REFRACTIVE_CAUSTICS = 4
BLENDER_5_3 = 8  # Cycles' surface models as of Blender 5.3
SHADING_FLAGS = {Shading.BLENDER_5_0: 0, Shading.BLENDER_5_3: BLENDER_5_3}

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
C_COUNT = 7  # lobes in use
C_MODEL = 8  # 1: the surface models of Blender 5.3, 0: those before
C_FRAME = 9  # copy of frame
C_PARAMS = C_FRAME + FRAME  # copy of params
C_LOBES = C_PARAMS + PARAMS

# A lobe, from C_LOBES + k * LOBE
LOBE_KIND = 0
LOBE_WEIGHT = 1  # 3 floats
LOBE_PICK = 4  # unnormalised probability of sampling this lobe
LOBE_N = 5  # 3 floats, its own normal
LOBE_ALPHA = 8  # GGX roughness; Oren-Nayar's A
LOBE_ETA = 9  # index of refraction, transmitted over incident side; Oren-Nayar's B
LOBE_SCALE = 10  # energy preservation
LOBE_FRESNEL = 11
LOBE_F0 = 12  # 3 floats; Oren-Nayar's multiple scattering term
LOBE_EDGE = 15  # 3 floats, F82 darkening
LOBE_TINT_R = 18  # 3 floats, of reflection
LOBE_TINT_T = 21  # 3 floats, of transmission
LOBE_BUMPED = 24  # 1 where the lobe's normal is not the smooth normal
LOBE_ALBEDO = 25  # largest reflectance of a channel, energy preservation left out
LOBE = 26
_MAX_LOBES = 6  # transparent, coat, metal, glass, specular, diffuse
CLOSURE = C_LOBES + _MAX_LOBES * LOBE

# Kinds are floats: they live in a float array, and numba would compile a function anew for each literal integer or
# boolean that it is called with.
LAMBERT, OREN_NAYAR, TRANSLUCENT, TRANSPARENT_LOBE, REFLECTION, REFRACTION, GLASS = 0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0
CONSTANT, SCHLICK, F82 = 0.0, 1.0, 2.0
DIFFUSE_RAYS, GLOSSY_RAYS, TRANSMISSION_RAYS = (
    1 << int(t) for t in (RayType.DIFFUSE, RayType.GLOSSY, RayType.TRANSMISSION)
)
GLASS_RAYS = GLOSSY_RAYS | TRANSMISSION_RAYS

CUTOFF = 1e-5  # lobes of less weight are dropped, as in Cycles
SINGULAR_ALPHA2 = 2e-10
DELTA = 1e6  # density that stands for a delta distribution

PRINCIPLED, DIFFUSE_SHADER, GLOSSY_SHADER, GLASS_SHADER, TRANSPARENT_SHADER, REFRACTION_SHADER, TRANSLUCENT_SHADER = (
    int(Shader.PRINCIPLED), int(Shader.DIFFUSE), int(Shader.GLOSSY), int(Shader.GLASS), int(Shader.TRANSPARENT),
    int(Shader.REFRACTION), int(Shader.TRANSLUCENT)
)

# Energy tables, one after the other: a kernel holds one constant and one kind of lookup, which halves its compile time.
_COARSE = (
    "reflection", "reflection_mean", "glass", "glass_mean", "glass_inside", "glass_inside_mean", "schlick",
    "schlick_ior"
)
_NAMES = (*_COARSE, *(f"fine_{name}" for name in _COARSE))
_loaded = ggx_albedo.load()
_TABLES = np.concatenate([_loaded[name].ravel() for name in _NAMES])
_SIZES = np.array([_loaded[name].shape for name in _NAMES])  # (16, 3) lengths of the axes z, y, roughness
_OFFSETS = np.concatenate(([0], np.cumsum(_SIZES.prod(axis=1))[:-1]))
# the mean of a table over cosines is the next one
_REFLECTION_E, _GLASS_E, _INSIDE_E, _SCHLICK_S, _SCHLICK_IOR_S = 0, 2, 4, 6, 7
_FINE = len(_COARSE)  # from a table to its finer one


@njit(**INNER)
def clip(x: float) -> float:
    return min(max(x, 0.0), 1.0)


@njit(**INNER)
def _lookup(which: int, z: float, y: float, x: float) -> float:
    """Trilinear interpolation of a table at coordinates in [0, 1] per axis."""
    nz, ny, nx = _SIZES[which, 0], _SIZES[which, 1], _SIZES[which, 2]
    z, y, x = clip(z) * (nz - 1), clip(y) * (ny - 1), clip(x) * (nx - 1)
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
def dielectric_fresnel(cos: float, eta: float) -> tuple[float, float]:
    """Unpolarised Fresnel reflectance of a dielectric, and the cosine (negative: beyond the surface) of the refracted
    ray; 1, 0 at total reflection."""
    squared = eta * eta - (1.0 - cos * cos)
    if squared <= 0.0:
        return 1.0, 0.0
    cos = abs(cos)
    ct = math.sqrt(squared)  # eta * |cos_t|
    rs = (cos - ct) / (cos + ct)
    rp = (eta * eta * cos - ct) / (eta * eta * cos + ct)
    return 0.5 * (rs * rs + rp * rp), -ct / eta


@njit(**INNER)
def normal_reflectance(ior: float) -> float:
    return ((ior - 1.0) / (ior + 1.0)) ** 2


@njit(**INNER)
def fresnel(c: Any, o: int, k: int, cos: float, dielectric: float) -> tuple[float, float]:
    """Reflectance and transmittance of lobe o in channel k at cosine cos to the microfacet, where the dielectric
    reflectance there is known."""
    kind = c[o + LOBE_FRESNEL]
    if kind == SCHLICK:  # the true curve, remapped from [F0, 1] to [f0, 1]
        f0 = normal_reflectance(c[o + LOBE_ETA])
        f = c[o + LOBE_F0 + k] + (1.0 - c[o + LOBE_F0 + k]) * clip((dielectric - f0) / (1.0 - f0))
        return f * c[o + LOBE_TINT_R + k], max(1.0 - f, 0.0) * c[o + LOBE_TINT_T + k]
    if kind == F82:  # Kutz, Hasan, Edmondson, "Novel aspects of the Adobe Standard Material", 2023
        s = clip(1.0 - cos)
        s5 = s * s * s * s * s
        return clip(c[o + LOBE_F0 + k] + (1.0 - c[o + LOBE_F0 + k]) * s5 - c[o + LOBE_EDGE + k] * cos * s5 * s), 0.0
    if c[o + LOBE_KIND] == REFRACTION:
        return 0.0, 0.0 if dielectric >= 1.0 else 1.0
    return 1.0, 0.0


@njit(**INNER)
def smith(alpha2: float, cos: float) -> float:
    """Lambda of Smith's shadowing for GGX (Heitz, JCGT 3(2), 2014, equation 72)."""
    return 0.5 * (math.sqrt(1.0 + alpha2 * max(1.0 / (cos * cos) - 1.0, 0.0)) - 1.0)


@njit(**INNER)
def oren_nayar_g(cos: float) -> float:
    """Direction-dependent part of the albedo of Fujii's Oren-Nayar model (as in the OpenPBR specification)."""
    if cos < 1e-6:
        return math.pi / 2.0 - 2.0 / 3.0 - cos
    cos = min(cos, 1.0)
    sin = math.sqrt(1.0 - cos * cos)
    return sin * (math.acos(cos) - 2.0 / 3.0 - sin * cos) + 2.0 / 3.0 * (sin / cos) * (1.0 - sin * sin * sin)


@njit(**INNER)
def add_lobe(c: Any, kind: float, r: float, g: float, b: float, alpha: float, eta: float, n: Any) -> int:
    """Append a lobe of weight (r, g, b) with normal n; returns its offset in closure, -1 where it weighs too little to
    matter."""
    r, g, b = max(r, 0.0), max(g, 0.0), max(b, 0.0)
    pick = (r + g + b) / 3.0
    if not (pick >= CUTOFF and pick < math.inf):
        return -1
    o = C_LOBES + int(c[C_COUNT]) * LOBE
    c[C_COUNT] += 1.0
    c[o + LOBE_KIND] = kind
    c[o + LOBE_WEIGHT], c[o + LOBE_WEIGHT + 1], c[o + LOBE_WEIGHT + 2] = r, g, b
    c[o + LOBE_PICK] = pick
    c[o + LOBE_N], c[o + LOBE_N + 1], c[o + LOBE_N + 2] = n
    c[o + LOBE_ALPHA] = alpha
    c[o + LOBE_ETA] = eta
    c[o + LOBE_SCALE] = 1.0
    c[o + LOBE_FRESNEL] = CONSTANT
    same = n[0] == c[C_FRAME + F_NS] and n[1] == c[C_FRAME + F_NS + 1] and n[2] == c[C_FRAME + F_NS + 2]
    c[o + LOBE_BUMPED] = 0.0 if same else 1.0
    return o


@njit(**INNER)
def layer(c: Any, o: int, fss_r: float, fss_g: float, fss_b: float) -> tuple[float, float, float]:
    """Finish GGX lobe o: sampling weight, energy preservation. Returns the share of light that layers below it keep, by
    channel.

    fss: mean single-scattering Fresnel reflectance, which colours what bounces between microfacets (Kulla, Conty,
    "Revisiting physically based shading at Imageworks", 2017, as a multiplier on single scattering).
    """
    cos = c[C_FRAME] * c[o + LOBE_N] + c[C_FRAME + 1] * c[o + LOBE_N + 1] + c[C_FRAME + 2] * c[o + LOBE_N + 2]
    rough = math.sqrt(c[o + LOBE_ALPHA])
    eta = c[o + LOBE_ETA]
    z = math.sqrt(abs((eta - 1.0) / (eta + 1.0)))
    kind = c[o + LOBE_FRESNEL]
    y, first = (math.sqrt(max(cos, 0.0)), _FINE) if c[C_MODEL] != 0.0 else (cos, 0)
    s = _lookup(first + (_SCHLICK_IOR_S if kind == SCHLICK else _SCHLICK_S), z, y, rough)
    table = first + (_REFLECTION_E if c[o + LOBE_KIND] == REFLECTION else (_INSIDE_E if eta < 1.0 else _GLASS_E))
    e, mean = _lookup(table, z, y, rough), _lookup(table + 1, z, 0.0, rough)
    c[o + LOBE_SCALE] = 1.0 / e
    albedo_sum, darkening_sum, albedo, most = 0.0, 0.0, 0.0, 0.0
    dark_r = dark_g = dark_b = 1.0
    for k in range(3):
        fss = fss_r if k == 0 else (fss_g if k == 1 else fss_b)
        darkening = e + fss * mean / max(1.0 - fss * (1.0 - mean), 1e-6) * (1.0 - e)
        reflectance, transmittance = 1.0, 0.0
        if kind != CONSTANT:
            f = c[o + LOBE_F0 + k] + (1.0 - c[o + LOBE_F0 + k]) * s
            reflectance = f * c[o + LOBE_TINT_R + k]
            transmittance = (1.0 - f) * c[o + LOBE_TINT_T + k]
        albedo_sum += reflectance + transmittance
        darkening_sum += darkening
        albedo = max(albedo, reflectance)
        if c[o + LOBE_WEIGHT + k] > 0.0:
            most = max(most, darkening * reflectance)
        c[o + LOBE_WEIGHT + k] *= darkening
        if k == 0:
            dark_r = darkening
        elif k == 1:
            dark_g = darkening
        else:
            dark_b = darkening
    c[o + LOBE_PICK] *= albedo_sum / 3.0 * darkening_sum / 3.0
    c[o + LOBE_ALBEDO] = albedo
    if c[C_MODEL] != 0.0:
        return clip(1.0 - dark_r * albedo), clip(1.0 - dark_g * albedo), clip(1.0 - dark_b * albedo)
    keep = clip(1.0 - most)
    return keep, keep, keep


@njit(**INNER)
def set_schlick(c: Any, o: int, f0: float, r: float, g: float, b: float) -> tuple[float, float, float]:
    """Give lobe o Fresnel reflectance from f0 * (r, g, b) to 1 along the dielectric curve (tints set before), and
    finish it. Returns as `layer`."""
    c[o + LOBE_FRESNEL] = SCHLICK
    c[o + LOBE_F0], c[o + LOBE_F0 + 1], c[o + LOBE_F0 + 2] = clip(f0 * r), clip(f0 * g), clip(f0 * b)
    eta = c[o + LOBE_ETA]
    # Mean of the dielectric reflectance over cosines, fitted by Kulla and Conty (2017).
    fss = (
        0.997118 + eta * (0.1014 - eta * (0.965241 + eta * 0.130607))
        if eta < 1.0
        else (eta - 1.0) / (4.08567 + 1.00071 * eta)
    )
    real = normal_reflectance(eta)
    s = clip((fss - real) / (1.0 - real))
    # the colour of glass comes mostly from transmission
    fr, fg, fb = c[o + LOBE_TINT_T], c[o + LOBE_TINT_T + 1], c[o + LOBE_TINT_T + 2]
    if fr == 0.0 and fg == 0.0 and fb == 0.0:
        fr = c[o + LOBE_TINT_R] * (c[o + LOBE_F0] + (1.0 - c[o + LOBE_F0]) * s)
        fg = c[o + LOBE_TINT_R + 1] * (c[o + LOBE_F0 + 1] + (1.0 - c[o + LOBE_F0 + 1]) * s)
        fb = c[o + LOBE_TINT_R + 2] * (c[o + LOBE_F0 + 2] + (1.0 - c[o + LOBE_F0 + 2]) * s)
    return layer(c, o, fr, fg, fb)


@njit(**INNER)
def set_tints(c: Any, o: int, reflection: float, transmission: float) -> None:
    for k in range(3):
        c[o + LOBE_TINT_R + k], c[o + LOBE_TINT_T + k] = reflection, transmission


@njit(**INNER)
def add_diffuse(c: Any, r: float, g: float, b: float, roughness: float, n: Any) -> None:
    """Lambert, or Fujii's Oren-Nayar with multiple scattering coloured by the base colour
    (https://mimosa-pudica.net/improved-oren-nayar.html).

    Cycles before Blender 5.3 takes the colour of what scatters more than once to a higher power.
    """
    o = add_lobe(c, LAMBERT, r, g, b, 0.0, 1.0, n)
    if o < 0 or roughness < 1e-5:
        return
    a = 1.0 / (math.pi + roughness * (math.pi / 2.0 - 2.0 / 3.0))
    slope = roughness * a
    mean = a * math.pi + (2.0 * math.pi - 5.6) / 3.0 * slope
    cos = c[C_FRAME] * n[0] + c[C_FRAME + 1] * n[1] + c[C_FRAME + 2] * n[2]
    lost = max(1.0 - a * math.pi - slope * oren_nayar_g(max(cos, 0.0)), 0.0)
    c[o + LOBE_KIND] = OREN_NAYAR
    c[o + LOBE_ALPHA], c[o + LOBE_ETA] = a, slope
    for k in range(3):
        albedo = clip(c[C_PARAMS + P_BASE + k])
        tint = albedo if c[C_MODEL] != 0.0 else albedo * albedo
        c[o + LOBE_F0 + k] = tint / math.pi * (mean / (1.0 - mean)) / (1.0 - albedo * (1.0 - mean)) * lost


@njit(**INNER)
def lift(c: Any, nx: float, ny: float, nz: float) -> tuple[float, float, float]:
    """The shading normal n, turned towards the geometric normal until the mirror direction of wi leaves the surface, as
    Cycles does for glossy lobes.

    In the plane of ng (z) and n (x), n' = (sin a, cos a) mirrors wi to height z' = 2 (n'.wi) cos a - wi.z; z' = t gives
    a quadratic in cos(a)**2.
    """
    ix, iy, iz = c[C_FRAME + F_WI], c[C_FRAME + F_WI + 1], c[C_FRAME + F_WI + 2]
    gx, gy, gz = c[C_FRAME + F_NG], c[C_FRAME + F_NG + 1], c[C_FRAME + F_NG + 2]
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
    cos2 = clip(0.25 * (q + root if i_x < 0.0 else q - root) / p)
    sine, cosine = math.sqrt(1.0 - cos2), math.sqrt(cos2)
    return sine * tx + cosine * gx, sine * ty + cosine * gy, sine * tz + cosine * gz
