"""Blender's lamps in compiled kernels: sampling, density, radiance and intersection, with Cycles' units and falloffs
(kernel/light/*.h, scene/light.cpp)."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from ...arrays import F32, Records
from ...jit.sampling import OPTIONS, basis, cone, disk, normalize, sphere
from ...scene.model import AreaShape, LightKind

# Lamp constants, float32[LAMP]
# K_RADIANCE: radiance; intensity of a lamp without size, irradiance of a sun without angle
K_KIND, K_P, K_X, K_Y, K_Z, K_RADIANCE = 0, 1, 4, 7, 10, 13
K_RADIUS, K_COS_HALF, K_SMOOTH = 16, 17, 18  # spot: smoothstep((cos - K_COS_HALF) K_SMOOTH)
# of a spot: by how much its cone is narrower across than along
K_LENGTH_X, K_LENGTH_Y, K_ELLIPSE, K_TAN_SPREAD, K_SPREAD_SCALE = 19, 20, 21, 22, 23  # K_SPREAD_SCALE: 0 without spread
# K_CONE: 1 - cos of the half angle of a sun
K_VISIBILITY, K_SHADOW, K_MIS, K_BOUNCES, K_SPHERE, K_CONE = 24, 25, 26, 27, 28, 29
LAMP = 30
FAR = np.float32(1e30)
POINT, SUN, SPOT, AREA = (int(k) for k in (LightKind.POINT, LightKind.SUN, LightKind.SPOT, LightKind.AREA))

_ZERO, _ONE, _HALF, _TWO = np.float32(0.0), np.float32(1.0), np.float32(0.5), np.float32(2.0)
_PI, _TWO_PI, _INV_2PI = np.float32(math.pi), np.float32(2 * math.pi), np.float32(0.5 / math.pi)
_MIN_HALF_SPREAD = 5e-4  # radians; a spread of exactly 0 would be a delta direction


def lamp_constants(lights: Records) -> F32:
    """(L, LAMP) float32 for the records (scene.LIGHT) of L lamps.

    A lamp's power becomes radiance as in Cycles: P / (4 pi^2 r^2) for spheres, P / (pi A) for areas, E / (pi
    sin^2(angle / 2)) for suns, each without the division by the shape where `normalize` is off.
    """
    out = np.zeros((len(lights), LAMP), np.float32)
    kind = lights["kind"]
    out[:, K_KIND] = kind
    for name, slot in (("position", K_P), ("axis_x", K_X), ("axis_y", K_Y), ("axis_z", K_Z)):
        out[:, slot : slot + 3] = lights[name]
    radius = lights["radius"].astype(np.float64)
    half = lights["angle"].astype(np.float64) / 2
    size = np.abs(lights["size"].astype(np.float64))
    ellipse = lights["shape"] == AreaShape.ELLIPSE
    sphere_area = np.where(radius > 0, 4 * np.pi * radius**2, 4.0)
    rect_area = np.maximum(size[:, 0] * size[:, 1] * np.where(ellipse, np.pi / 4, 1.0), 1e-30)
    sun_area = np.where(half > 0, np.pi * np.sin(half) ** 2, 1.0)
    area = np.select([kind == SUN, kind == AREA], [sun_area, rect_area], sphere_area)
    area = np.where(lights["normalize"] != 0, area, 1.0)
    factor = np.where(kind == SUN, 1.0 / area, 1 / (np.pi * area))
    out[:, K_RADIANCE : K_RADIANCE + 3] = lights["power"] * factor[:, None]
    out[:, K_RADIUS] = np.where((kind == POINT) | (kind == SPOT), radius, 0)
    cos_half = np.cos(lights["spot_size"].astype(np.float64) / 2)
    out[:, K_COS_HALF] = cos_half
    out[:, K_SMOOTH] = 1 / np.maximum((1 - cos_half) * lights["spot_blend"], 1e-7)
    size[kind == SPOT] = 1 / np.where(size[kind == SPOT] > 0, size[kind == SPOT], 1.0)
    out[:, K_LENGTH_X], out[:, K_LENGTH_Y], out[:, K_ELLIPSE] = size[:, 0], size[:, 1], ellipse
    spread = lights["spread"].astype(np.float64)
    a = np.maximum(np.minimum(spread, np.pi) / 2, _MIN_HALF_SPREAD)
    spreads = spread < np.pi - 1e-4
    tan = np.tan(np.minimum(a, np.pi / 2 - 1e-5))
    out[:, K_TAN_SPREAD] = tan
    out[:, K_SPREAD_SCALE] = np.where(spreads, np.where(a > 0.05, 1 / np.maximum(tan - a, 1e-30), 3 / a**3), 0)
    for name, slot in (
        ("visibility", K_VISIBILITY),
        ("cast_shadow", K_SHADOW),
        ("use_mis", K_MIS),
        ("max_bounces", K_BOUNCES),
    ):
        out[:, slot] = lights[name]
    out[:, K_SPHERE] = lights["soft_falloff"] == 0
    out[:, K_CONE] = 2 * np.sin(half / 2) ** 2
    delta = np.select([kind == SUN, kind == AREA], [half <= 0, False], radius <= 0)
    out[delta, K_MIS] = 0
    return out


@njit(**OPTIONS)
def one_minus_cos(sin2):
    """1 - cos of an angle from its squared sine, without cancellation."""
    return sin2 / (_ONE + math.sqrt(max(_ONE - sin2, _ZERO)))


@njit(**OPTIONS)
def spot_falloff(k, dx, dy, dz):
    """Share of a spot's light that leaves along direction d (unit, away from the lamp)."""
    c = -(k[10] * dx + k[11] * dy + k[12] * dz)
    if k[19] != _ONE or k[20] != _ONE:
        a = (k[4] * dx + k[5] * dy + k[6] * dz) * k[19]
        b = (k[7] * dx + k[8] * dy + k[9] * dz) * k[20]
        c /= math.sqrt(max(a * a + b * b + c * c, np.float32(1e-30)))
    x = min(max((c - k[17]) * k[18], _ZERO), _ONE)
    return x * x * (np.float32(3.0) - _TWO * x)


@njit(**OPTIONS)
def spread_falloff(k, dx, dy, dz):
    """Share of an area lamp's light that leaves along direction d: a grid of slats in front of it hides the rest."""
    c = -(k[10] * dx + k[11] * dy + k[12] * dz)
    if c <= _ZERO:
        return _ZERO
    if k[23] == _ZERO:
        return _ONE
    t = math.sqrt(max(_ONE - c * c, _ZERO)) / c
    return max((k[22] - t) * k[23], _ZERO)


@njit(**OPTIONS)
def rectangle(k, px, py, pz, u0, u1):
    """Sample a rectangle uniformly in solid angle (Urena, Fajardo, King, "An area-preserving parametrization for
    spherical rectangles", EGSR 2013).

    Returns a point in the lamp's plane (x, y along its axes, from its centre) and the density per solid angle, 0 where
    the solid angle is too small to compute: then sample by area.
    """
    # In float64: a solid angle is the small difference of angles.
    cx, cy, cz = float(k[1] - px), float(k[2] - py), float(k[3] - pz)
    x = cx * k[4] + cy * k[5] + cz * k[6]
    y = cx * k[7] + cy * k[8] + cz * k[9]
    z = -abs(cx * k[10] + cy * k[11] + cz * k[12])
    hx, hy = 0.5 * k[19], 0.5 * k[20]
    x0, x1, y0, y1 = x - hx, x + hx, y - hy, y + hy
    if not z < 0.0:
        return _ZERO, _ZERO, _ZERO
    # z components of the normals of the four planes through the edges.
    n0 = -y0 / math.sqrt(z * z + y0 * y0)
    n1 = x1 / math.sqrt(z * z + x1 * x1)
    n2 = y1 / math.sqrt(z * z + y1 * y1)
    n3 = -x0 / math.sqrt(z * z + x0 * x0)
    g0 = math.acos(min(max(-n0 * n1, -1.0), 1.0))
    g1 = math.acos(min(max(-n1 * n2, -1.0), 1.0))
    g2 = math.acos(min(max(-n2 * n3, -1.0), 1.0))
    g3 = math.acos(min(max(-n3 * n0, -1.0), 1.0))
    solid = g0 + g1 + g2 + g3 - 2.0 * math.pi
    if not solid > 1e-5:
        return _ZERO, _ZERO, _ZERO
    a = u0 * solid + 2.0 * math.pi - g2 - g3
    f = (math.cos(a) * n0 - n2) / math.sin(a)
    c = min(max((1.0 if f > 0.0 else -1.0) / math.sqrt(f * f + n0 * n0), -1.0), 1.0)
    sx = min(max(-(c * z) / max(math.sqrt(max(1.0 - c * c, 0.0)), 1e-12), x0), x1)
    d2 = sx * sx + z * z
    h0 = y0 / math.sqrt(d2 + y0 * y0)
    h1 = y1 / math.sqrt(d2 + y1 * y1)
    h = h0 + u1 * (h1 - h0)
    sy = h * math.sqrt(d2 / (1.0 - h * h)) if h * h < 1.0 - 1e-12 else y1
    return np.float32(sx - x), np.float32(min(max(sy, y0), y1) - y), np.float32(1.0 / solid)


@njit(**OPTIONS)
def sample_lamp(k, px, py, pz, u0, u1, out):
    """Sample a lamp from a point p. k: lamp constants; out float32[8]: unit direction, distance, density per solid
    angle (1 for a lamp without size), and the share of K_RADIANCE that arrives (the inverse square included for a lamp
    without size). False where nothing arrives."""
    kind = k[0]
    if kind == SUN:
        if k[29] > _ZERO:
            out[0], out[1], out[2] = cone(k[10], k[11], k[12], k[29], u0, u1)
            out[4] = _INV_2PI / k[29]
        else:
            out[0], out[1], out[2] = k[10], k[11], k[12]
            out[4] = _ONE
        out[3] = FAR
        out[5] = _ONE
        return True
    cx, cy, cz = k[1] - px, k[2] - py, k[3] - pz
    if kind == AREA:
        if cx * k[10] + cy * k[11] + cz * k[12] <= _ZERO:
            return False
        pdf = _ZERO
        x = y = _ZERO
        if k[21] == _ZERO:
            x, y, pdf = rectangle(k, px, py, pz, u0, u1)
            if pdf == _ZERO:
                x = (u0 - _HALF) * k[19]
                y = (u1 - _HALF) * k[20]
        else:
            x, y = disk(u0, u1)
            x *= _HALF * k[19]
            y *= _HALF * k[20]
        dx, dy, dz, t = normalize(cx + x * k[4] + y * k[7], cy + x * k[5] + y * k[8], cz + x * k[6] + y * k[9])
        out[0], out[1], out[2], out[3] = dx, dy, dz, t
        out[5] = spread_falloff(k, -dx, -dy, -dz)
        if pdf == _ZERO:
            cos = dx * k[10] + dy * k[11] + dz * k[12]
            pdf = t * t / max(cos * area_of(k), np.float32(1e-30))
        out[4] = pdf
        return out[5] > _ZERO
    radius = k[16]
    lx, ly, lz, d = normalize(cx, cy, cz)
    if radius == _ZERO:
        out[0], out[1], out[2], out[3] = lx, ly, lz, d
        out[4] = _ONE
        out[5] = _ONE / max(d * d, np.float32(1e-30))
    elif k[28] == _ZERO:  # a disk that faces the point
        x, y = disk(u0, u1)
        tx, ty, tz, bx, by, bz = basis(lx, ly, lz)
        x *= radius
        y *= radius
        dx, dy, dz, t = normalize(cx + x * tx + y * bx, cy + x * ty + y * by, cz + x * tz + y * bz)
        out[0], out[1], out[2], out[3] = dx, dy, dz, t
        out[4] = t * t / max((dx * lx + dy * ly + dz * lz) * _PI * radius * radius, np.float32(1e-30))
        out[5] = _ONE
    elif d > radius:
        s = radius / d
        h = one_minus_cos(s * s)
        dx, dy, dz = cone(lx, ly, lz, h, u0, u1)
        c = _ONE - u0 * h
        out[0], out[1], out[2] = dx, dy, dz
        out[3] = d * c - math.sqrt(max(radius * radius - d * d * (u0 * h) * (_TWO - u0 * h), _ZERO))
        out[4] = _INV_2PI / h
        out[5] = _ONE
    else:
        dx, dy, dz = sphere(u0, u1)
        c = dx * lx + dy * ly + dz * lz
        out[0], out[1], out[2] = dx, dy, dz
        out[3] = d * c + math.sqrt(max(radius * radius - d * d * (_ONE - c * c), _ZERO))
        out[4] = _INV_2PI * _HALF
        out[5] = _ONE
    if kind == SPOT and (d > radius or k[28] == _ZERO):
        out[5] *= spot_falloff(k, -out[0], -out[1], -out[2])
    return out[5] > _ZERO


@njit(**OPTIONS)
def area_of(k):
    """Area of an area lamp, m2."""
    return k[19] * k[20] * (np.float32(math.pi / 4) if k[21] != _ZERO else _ONE)


@njit(**OPTIONS)
def lamp_hit(k, ox, oy, oz, dx, dy, dz, far):
    """Distance at which a ray (unit direction) meets a lamp before far, or -1. A sun is met at FAR."""
    kind = k[0]
    if kind == SUN:
        x, y, z = dx - k[10], dy - k[11], dz - k[12]
        return FAR if k[29] > _ZERO and far >= FAR and _HALF * (x * x + y * y + z * z) <= k[29] else -_ONE
    cx, cy, cz = k[1] - ox, k[2] - oy, k[3] - oz
    if kind == AREA:
        cos = dx * k[10] + dy * k[11] + dz * k[12]
        if cos <= _ZERO:  # it shines against its z axis
            return -_ONE
        t = (cx * k[10] + cy * k[11] + cz * k[12]) / cos
        if not (t > _ZERO and t < far):
            return -_ONE
        x = ((t * dx - cx) * k[4] + (t * dy - cy) * k[5] + (t * dz - cz) * k[6]) / k[19]
        y = ((t * dx - cx) * k[7] + (t * dy - cy) * k[8] + (t * dz - cz) * k[9]) / k[20]
        if k[21] != _ZERO:
            return t if x * x + y * y <= np.float32(0.25) else -_ONE
        return t if abs(x) <= _HALF and abs(y) <= _HALF else -_ONE
    radius = k[16]
    if radius == _ZERO:
        return -_ONE
    b = cx * dx + cy * dy + cz * dz
    d2 = cx * cx + cy * cy + cz * cz
    if kind == SPOT and b <= _ZERO:
        return -_ONE
    if k[28] == _ZERO:
        # Plane through the centre, facing the origin.
        if b <= _ZERO:
            return -_ONE
        t = d2 / b
        x, y, z = t * dx - cx, t * dy - cy, t * dz - cz
        return t if t < far and x * x + y * y + z * z <= radius * radius else -_ONE
    x, y, z = cx - b * dx, cy - b * dy, cz - b * dz
    h = radius * radius - (x * x + y * y + z * z)
    if h < _ZERO:
        return -_ONE
    h = math.sqrt(h)
    t = b - h if d2 > radius * radius else b + h
    return t if t > _ZERO and t < far else -_ONE


@njit(**OPTIONS)
def lamp_share(k, ox, oy, oz, dx, dy, dz):
    """Share of K_RADIANCE that a ray from o along d, which meets the lamp, sees."""
    kind = k[0]
    if kind == SPOT:
        cx, cy, cz = k[1] - ox, k[2] - oy, k[3] - oz
        if k[28] == _ZERO or cx * cx + cy * cy + cz * cz > k[16] * k[16]:
            return spot_falloff(k, -dx, -dy, -dz)
    elif kind == AREA:
        return spread_falloff(k, -dx, -dy, -dz)
    return _ONE


@njit(**OPTIONS)
def lamp_pdf(k, px, py, pz, dx, dy, dz, t):
    """Density per solid angle with which `sample_lamp` makes direction d from p; t: distance to the lamp along d."""
    kind = k[0]
    if kind == SUN:
        return _INV_2PI / k[29]
    if kind == AREA:
        if k[21] == _ZERO:
            _, _, pdf = rectangle(k, px, py, pz, _HALF, _HALF)
            if pdf > _ZERO:
                return pdf
        cos = dx * k[10] + dy * k[11] + dz * k[12]
        return t * t / max(cos * area_of(k), np.float32(1e-30))
    cx, cy, cz = k[1] - px, k[2] - py, k[3] - pz
    d2 = cx * cx + cy * cy + cz * cz
    r2 = k[16] * k[16]
    if k[28] == _ZERO:
        cos = (dx * cx + dy * cy + dz * cz) / math.sqrt(max(d2, np.float32(1e-30)))
        return t * t / max(cos * _PI * r2, np.float32(1e-30))
    if d2 > r2:
        return _INV_2PI / one_minus_cos(r2 / d2)
    return _INV_2PI * _HALF
