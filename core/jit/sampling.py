"""Counter-based random numbers and warps of the unit square.

Every number is a hash of (seed, pixel, sample, dimension): no state, so results depend on nothing but these four. The
hash is SplitMix64's finaliser (Steele, Lea, Flood, "Fast splittable pseudorandom number generators", OOPSLA 2014),
whose 64 bits give two numbers of 24 bits.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

# No C wrapper, which nobody calls: faster to compile
OPTIONS: dict[str, Any] = {
    "nogil": True,
    "cache": True,
    "error_model": "numpy",
    "fastmath": False,
    "no_cfunc_wrapper": True,
}
# only for kernels to call: faster to compile, fatal from Python
INNER: dict[str, Any] = OPTIONS | {"no_cpython_wrapper": True}

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_MIX1 = np.uint64(0xBF58476D1CE4E5B9)
_MIX2 = np.uint64(0x94D049BB133111EB)
_S30, _S27, _S31 = np.uint64(30), np.uint64(27), np.uint64(31)
_S40, _S16, _LOW24 = np.uint64(40), np.uint64(16), np.uint64(0xFFFFFF)
_UNIT = np.float32(2.0**-24)
_ONE = np.float32(1.0)
_PI = np.float32(math.pi)
_TWO_PI = np.float32(2 * math.pi)
_TINY = np.float32(1e-30)


@njit(**OPTIONS)
def mix(x):
    """SplitMix64 finaliser, uint64 -> uint64."""
    x = (x ^ (x >> _S30)) * _MIX1
    x = (x ^ (x >> _S27)) * _MIX2
    return x ^ (x >> _S31)


@njit(**OPTIONS)
def path_key(seed, pixel, sample):
    """Key of one path: uint64 seed, pixel number and sample number -> uint64."""
    return mix(mix(mix(seed + _GOLDEN) ^ pixel * _GOLDEN) ^ (sample + np.uint64(1)) * _MIX1)


@njit(**OPTIONS)
def uniform2(key, dimension):
    """Two float32 numbers in [0, 1) of dimension `dimension` (uint64) of a path."""
    x = mix(key + (dimension + np.uint64(1)) * _GOLDEN)
    return np.float32(x >> _S40) * _UNIT, np.float32((x >> _S16) & _LOW24) * _UNIT


@njit(**OPTIONS)
def disk(u0, u1):
    """Uniform point of the unit disk, concentric map (Shirley, Chiu 1997)."""
    a = np.float32(2.0) * u0 - _ONE
    b = np.float32(2.0) * u1 - _ONE
    if a == 0.0 and b == 0.0:
        return np.float32(0.0), np.float32(0.0)
    if abs(a) > abs(b):
        r = a
        phi = np.float32(math.pi / 4) * (b / a)
    else:
        r = b
        phi = np.float32(math.pi / 2) - np.float32(math.pi / 4) * (a / b)
    return r * math.cos(phi), r * math.sin(phi)


@njit(**OPTIONS)
def basis(x, y, z):
    """Two unit vectors that complete a unit vector to a right-handed frame (Duff et al. 2017): (tx, ty, tz, bx, by,
    bz)."""
    s = _ONE if z >= 0.0 else -_ONE
    a = -_ONE / (s + z)
    b = x * y * a
    return _ONE + s * x * x * a, s * b, -s * x, b, s + y * y * a, -y


@njit(**OPTIONS)
def sphere(u0, u1):
    """Uniform unit direction."""
    z = _ONE - np.float32(2.0) * u0
    r = math.sqrt(max(_ONE - z * z, np.float32(0.0)))
    phi = _TWO_PI * u1
    return r * math.cos(phi), r * math.sin(phi), z


@njit(**OPTIONS)
def cone(ax, ay, az, one_minus_cos, u0, u1):
    """Uniform direction within a cone around the unit axis (ax, ay, az); pdf = 1 / (2 pi one_minus_cos). one_minus_cos
    keeps narrow cones exact."""
    h = u0 * one_minus_cos
    c = _ONE - h
    s = math.sqrt(max(h * (np.float32(2.0) - h), np.float32(0.0)))
    phi = _TWO_PI * u1
    x = s * math.cos(phi)
    y = s * math.sin(phi)
    tx, ty, tz, bx, by, bz = basis(ax, ay, az)
    return x * tx + y * bx + c * ax, x * ty + y * by + c * ay, x * tz + y * bz + c * az


@njit(**OPTIONS)
def normalize(x, y, z):
    """(unit vector, length); a zero vector gives zeros."""
    length = math.sqrt(x * x + y * y + z * z)
    f = _ONE / max(length, _TINY)
    return x * f, y * f, z * f, length


@njit(**OPTIONS)
def power_heuristic(a, b):
    """Weight of the strategy with density `a` against one with density `b` (Veach 1995, beta = 2). Infinite `a` weighs
    1."""
    if a > np.float32(1e18):
        return _ONE
    a2 = a * a
    return a2 / max(a2 + b * b, _TINY)
