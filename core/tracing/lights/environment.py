"""The world: constant or image radiance from infinity, importance sampling by a piecewise-constant density (pbrt-v4
sections 12.5 and A.5)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from ...arrays import F32
from ...jit.pointers import load_f32
from ...jit.sampling import OPTIONS
from ...scene.film import LUMINANCE
from ...scene.model import World

_ZERO, _ONE, _HALF = np.float32(0.0), np.float32(1.0), np.float32(0.5)
_PI, _TWO_PI = np.float32(math.pi), np.float32(2 * math.pi)


@dataclass(frozen=True)
class Environment:
    """image: (H, W, 3) float32, finite, rows bottom up. marginal: (H + 1,) cumulative share of rows; conditional: (H, W
    + 1) of columns within a row."""

    image: F32
    marginal: F32
    conditional: F32


def build_environment(world: World) -> Environment | None:
    """Sampling tables of a world image, None for a constant world (sampling the BSDF does as well there, and Cycles
    does so)."""
    if world.image is None:
        return None
    image = np.ascontiguousarray(world.image, np.float32)
    broken = ~np.isfinite(image)
    if broken.any():
        image = np.where(broken, np.float32(0.0), image)  # Cycles drops the light of a path that is not finite
    h, w = image.shape[:2]
    value = np.maximum(image.astype(np.float64), 0) @ LUMINANCE
    # A lookup interpolates: what a pixel's area shows is near the mean of its neighbourhood.
    value = (np.roll(value, 1, 1) + 2 * value + np.roll(value, -1, 1)) / 4
    padded = np.pad(value, ((1, 1), (0, 0)), mode="edge")
    value = (padded[:-2] + 2 * padded[1:-1] + padded[2:]) / 4
    value *= np.cos((np.arange(h) + 0.5) / h * np.pi - np.pi / 2)[:, None]
    row = value.sum(1)
    if not row.sum() > 0:
        return None
    conditional = np.zeros((h, w + 1))
    conditional[:, 1:] = np.where(
        row[:, None] > 0, np.cumsum(value, 1) / np.maximum(row, 1e-300)[:, None], np.arange(1, w + 1) / w
    )
    marginal = np.append(0, np.cumsum(row) / row.sum())
    conditional[:, -1] = marginal[-1] = 1
    return Environment(image, marginal.astype(np.float32), conditional.astype(np.float32))


@njit(**OPTIONS)
def direction_uv(dx, dy, dz):
    """Place of a direction in the equirectangular image: u, v in [0, 1]."""
    u = math.atan2(dy, -dx) * np.float32(0.5 / math.pi) + _HALF
    v = math.asin(min(max(dz, -_ONE), _ONE)) * np.float32(1 / math.pi) + _HALF
    return u, v


@njit(**OPTIONS)
def uv_direction(u, v):
    """Unit direction of a place in the image."""
    phi = (u - _HALF) * _TWO_PI
    theta = (v - _HALF) * _PI
    c = math.cos(theta)
    return -math.cos(phi) * c, math.sin(phi) * c, math.sin(theta)


@njit(**OPTIONS)
def environment_radiance(image, width, height, dx, dy, dz):
    """Bilinear lookup; image: address of the (H, W, 3) float32 pixels. 3 float32."""
    u, v = direction_uv(dx, dy, dz)
    fx = u * np.float32(width) - _HALF
    fy = v * np.float32(height) - _HALF
    x0 = np.int64(math.floor(fx))
    y0 = np.int64(math.floor(fy))
    fx -= np.float32(x0)
    fy -= np.float32(y0)
    r = g = b = _ZERO
    for k in range(4):
        x = x0 + (k & 1)
        x = x + width if x < 0 else (x - width if x >= width else x)
        y = min(max(y0 + (k >> 1), 0), height - 1)
        weight = (fx if k & 1 else _ONE - fx) * (fy if k & 2 else _ONE - fy)
        i = 3 * (y * width + x)
        r += weight * load_f32(image, i)
        g += weight * load_f32(image, i + 1)
        b += weight * load_f32(image, i + 2)
    return r, g, b


@njit(**OPTIONS)
def find_interval(cdf, offset, size, u):
    """Largest i < size with cdf[offset + i] <= u; cdf: address of float32."""
    low = np.int64(0)
    high = np.int64(size)
    while high - low > 1:
        middle = (low + high) >> 1
        if load_f32(cdf, offset + middle) <= u:
            low = middle
        else:
            high = middle
    return low


@njit(**OPTIONS)
def sample_environment(marginal, conditional, width, height, u0, u1):
    """Sample a direction by brightness: (direction, density per solid angle); marginal and conditional: addresses."""
    y = find_interval(marginal, np.int64(0), height, u1)
    a, b = load_f32(marginal, y), load_f32(marginal, y + 1)
    v = (np.float32(y) + min((u1 - a) / max(b - a, np.float32(1e-30)), np.float32(0.9999999))) / np.float32(height)
    row = y * (width + 1)
    x = find_interval(conditional, row, width, u0)
    c, d = load_f32(conditional, row + x), load_f32(conditional, row + x + 1)
    u = (np.float32(x) + min((u0 - c) / max(d - c, np.float32(1e-30)), np.float32(0.9999999))) / np.float32(width)
    dx, dy, dz = uv_direction(u, v)
    cos = math.sqrt(max(_ONE - dz * dz, np.float32(1e-12)))
    pdf = (b - a) * (d - c) * np.float32(width) * np.float32(height) / (_TWO_PI * _PI * cos)
    return dx, dy, dz, pdf


@njit(**OPTIONS)
def environment_pdf(marginal, conditional, width, height, dx, dy, dz):
    """Density per solid angle with which `sample_environment` makes a direction."""
    u, v = direction_uv(dx, dy, dz)
    x = min(max(np.int64(u * np.float32(width)), 0), width - 1)
    y = min(max(np.int64(v * np.float32(height)), 0), height - 1)
    row = y * (width + 1)
    p = (load_f32(marginal, y + 1) - load_f32(marginal, y)) * (
        load_f32(conditional, row + x + 1) - load_f32(conditional, row + x)
    )
    return (
        p * np.float32(width) * np.float32(height) / (_TWO_PI * _PI * math.sqrt(max(_ONE - dz * dz, np.float32(1e-12))))
    )
