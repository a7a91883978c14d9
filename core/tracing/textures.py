"""Texture lookups in compiled kernels, with Cycles' conventions (pixel centres at half integers, sRGB decoded after
interpolation)."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from ..jit.pointers import load_f32, load_i32, load_i64, load_u8, offset
from ..jit.sampling import OPTIONS
from ..scene.model import TEXTURE, Extension

TEXTURE_SIZE = np.uint64(TEXTURE.itemsize)
_OFFSET = offset(TEXTURE, "offset")
_WIDTH = offset(TEXTURE, "width")
_HEIGHT = offset(TEXTURE, "height")
_IS_FLOAT = offset(TEXTURE, "is_float")
_SRGB = offset(TEXTURE, "srgb")
_EXTENSION = offset(TEXTURE, "extension")
_CLOSEST = offset(TEXTURE, "closest")
_UV_MAP = offset(TEXTURE, "uv_map")
_UV_MATRIX = offset(TEXTURE, "uv_matrix")
_REPEAT, _EXTEND, _CLIP, _MIRROR = (
    int(e) for e in (Extension.REPEAT, Extension.EXTEND, Extension.CLIP, Extension.MIRROR)
)
_BYTE = np.float32(1.0 / 255.0)
_ONE, _HALF = np.float32(1.0), np.float32(0.5)


@njit(**OPTIONS)
def texture_uv_map(textures, index):
    """Which UV map a texture reads; textures: address of the records, index: int."""
    return load_i32(textures + np.uint64(index) * TEXTURE_SIZE + _UV_MAP, 0)


@njit(**OPTIONS)
def srgb_to_linear(c):
    """Decode one sRGB channel (IEC 61966-2-1)."""
    if c < np.float32(0.04045):
        return max(c, np.float32(0.0)) * np.float32(1.0 / 12.92)
    return ((c + np.float32(0.055)) * np.float32(1.0 / 1.055)) ** np.float32(2.4)


@njit(**OPTIONS)
def wrap(i, size, extension):
    """Pixel index inside the image, or -1 where a clipped texture ends."""
    if 0 <= i < size:
        return i
    if extension == _REPEAT:
        i %= size
        return i + size if i < 0 else i
    if extension == _EXTEND:
        return 0 if i < 0 else size - 1
    if extension == _MIRROR:
        i %= 2 * size
        if i < 0:
            i += 2 * size
        return i if i < size else 2 * size - 1 - i
    return -1


@njit(**OPTIONS)
def texel(pool, is_float, base, width, x, y):
    """RGBA of one pixel; transparent black at a negative index."""
    if x < 0 or y < 0:
        return np.float32(0.0), np.float32(0.0), np.float32(0.0), np.float32(0.0)
    i = base + 4 * (y * width + x)
    if is_float:
        return load_f32(pool, i), load_f32(pool, i + 1), load_f32(pool, i + 2), load_f32(pool, i + 3)
    return (
        load_u8(pool, i) * _BYTE,
        load_u8(pool, i + 1) * _BYTE,
        load_u8(pool, i + 2) * _BYTE,
        load_u8(pool, i + 3) * _BYTE,
    )


@njit(**OPTIONS)
def lookup(textures, byte_pool, float_pool, index, u, v):
    """Colour of texture `index` at (u, v), before its uv_matrix: linear RGBA, 4 float32."""
    t = textures + np.uint64(index) * TEXTURE_SIZE
    m = t + _UV_MATRIX
    s = load_f32(m, 0) * u + load_f32(m, 1) * v + load_f32(m, 2)
    w = load_f32(m, 3) * u + load_f32(m, 4) * v + load_f32(m, 5)
    width = np.int64(load_i32(t + _WIDTH, 0))
    height = np.int64(load_i32(t + _HEIGHT, 0))
    extension = load_u8(t + _EXTENSION, 0)
    is_float = load_u8(t + _IS_FLOAT, 0) != 0
    base = load_i64(t + _OFFSET, 0)
    pool = float_pool if is_float else byte_pool
    if not (abs(s) < np.float32(1e9) and abs(w) < np.float32(1e9)):  # also NaN
        s = np.float32(0.0)
        w = np.float32(0.0)
    if load_u8(t + _CLOSEST, 0) != 0:
        x = np.int64(math.floor(s * np.float32(width)))
        y = np.int64(math.floor(w * np.float32(height)))
        r, g, b, a = texel(pool, is_float, base, width, wrap(x, width, extension), wrap(y, height, extension))
    else:
        fx = s * np.float32(width) - _HALF
        fy = w * np.float32(height) - _HALF
        x0 = np.int64(math.floor(fx))
        y0 = np.int64(math.floor(fy))
        fx -= np.float32(x0)
        fy -= np.float32(y0)
        xa = wrap(x0, width, extension)
        xb = wrap(x0 + 1, width, extension)
        ya = wrap(y0, height, extension)
        yb = wrap(y0 + 1, height, extension)
        r = g = b = a = np.float32(0.0)
        for k in range(4):
            weight = (fx if k & 1 else _ONE - fx) * (fy if k & 2 else _ONE - fy)
            tr, tg, tb, ta = texel(pool, is_float, base, width, xb if k & 1 else xa, yb if k & 2 else ya)
            r += weight * tr
            g += weight * tg
            b += weight * tb
            a += weight * ta
    if load_u8(t + _SRGB, 0) != 0:
        r = srgb_to_linear(r)
        g = srgb_to_linear(g)
        b = srgb_to_linear(b)
    return r, g, b, a
