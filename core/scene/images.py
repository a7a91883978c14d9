"""Pixels of images as paths look them up: four channels, and no more of them than an analysis can tell apart."""

from __future__ import annotations

from enum import IntEnum

import numpy as np
from numba import njit

from ..arrays import F32, U8
from ..threads import over_parts

LARGEST = 1024  # pixels of a side that are kept: an analysis is some hundred pixels wide
PIXELS = 1 << 16  # that are worth a thread
_BYTES = (np.arange(256) / 255.0).astype(np.float32)
# IEC 61966-2-1
_DECODED = np.where(_BYTES <= 0.04045, _BYTES / 12.92, ((_BYTES + 0.055) / 1.055) ** 2.4).astype(np.float32)


class Alpha(IntEnum):
    """What becomes of an image's alpha."""

    KEPT = 0
    IGNORED = 1  # 1 everywhere
    MULTIPLIED = 2  # with the colour, as that is stored


IGNORED, MULTIPLIED = int(Alpha.IGNORED), int(Alpha.MULTIPLIED)


def texels(
    values: F32, height: int, width: int, alpha: Alpha, is_float: bool, srgb: bool, largest: int = LARGEST
) -> U8 | F32:
    """(h, w, 4) pixels, float32 where is_float, else uint8, of the values of an image: (height * width * channels)
    float32, bytes / 255 unless is_float; one channel is grey.

    Where a side is longer than largest, pixels are means of boxes: of light, so that of srgb bytes what they encode is
    averaged.
    """
    shape = height, width, len(values) // (height * width)
    h, w = min(height, largest), min(width, largest)
    out = np.empty((h, w, 4), np.float32 if is_float else np.uint8)
    kernel, decoded = _floats if is_float else _bytes, _DECODED if srgb else _BYTES
    rows = max(1, PIXELS * h // (height * width))
    over_parts(lambda a, b: kernel(values, shape, int(alpha), decoded, srgb, out, a, b), h, worth_while=rows)
    return out


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _pixel(values, i, channels, alpha):
    """Red, green, blue and alpha of the pixel whose values begin at i."""
    r = values[i]
    g = b = r
    if channels >= 3:
        g, b = values[i + 1], values[i + 2]
    a = values[i + 3] if channels >= 4 and alpha != IGNORED else np.float32(1.0)
    if alpha == MULTIPLIED:
        r, g, b = r * a, g * a, b * a
    return r, g, b, a


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _box(k, size, kept):
    """Where the pixels begin, and end, that become the k-th of those kept."""
    return np.uint64(k * size // kept), np.uint64((k + 1) * size // kept)


@njit(cache=True, nogil=True, error_model="numpy")
def _floats(values, shape, alpha, _decoded, _srgb, out, first, stop):
    """Rows first to stop of out (h, w, 4): means of boxes of an image of shape (height, width, channels)."""
    height, width, channels = shape
    h, w = out.shape[:2]
    for j in range(first, stop):
        y0, y1 = _box(j, height, h)
        for i in range(w):
            x0, x1 = _box(i, width, w)
            red = green = blue = through = 0.0
            for y in range(y0, y1):
                for x in range(x0, x1):
                    r, g, b, a = _pixel(values, (y * np.uint64(width) + x) * np.uint64(channels), channels, alpha)
                    red, green, blue, through = red + r, green + g, blue + b, through + a
            share = 1.0 / ((y1 - y0) * (x1 - x0))
            out[j, i, 0], out[j, i, 1] = red * share, green * share
            out[j, i, 2], out[j, i, 3] = blue * share, through * share


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _byte(value):
    return np.uint64(value * np.float32(255.0) + np.float32(0.5))


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _encoded(light, srgb):
    """The byte of a mean of light."""
    if srgb:
        light = light * 12.92 if light <= 0.0031308 else 1.055 * light ** (1.0 / 2.4) - 0.055
    return np.uint64(light * 255.0 + 0.5)


@njit(cache=True, nogil=True, error_model="numpy")
def _bytes(values, shape, alpha, decoded, srgb, out, first, stop):
    """`_floats` for bytes, of which decoded (256,) float32 is the light of a colour."""
    height, width, channels = shape
    h, w = out.shape[:2]
    for j in range(first, stop):
        y0, y1 = _box(j, height, h)
        for i in range(w):
            x0, x1 = _box(i, width, w)
            red = green = blue = np.float32(0.0)
            through = np.uint64(0)
            r = g = b = np.uint64(0)
            for y in range(y0, y1):
                for x in range(x0, x1):
                    at = (y * np.uint64(width) + x) * np.uint64(channels)
                    r, g, b, a = _pixel(values, at, channels, alpha)
                    r, g, b = _byte(r), _byte(g), _byte(b)
                    red, green, blue = red + decoded[r], green + decoded[g], blue + decoded[b]
                    through += _byte(a)
            count = (y1 - y0) * (x1 - x0)
            if count > 1:
                r, g, b = _encoded(red / count, srgb), _encoded(green / count, srgb), _encoded(blue / count, srgb)
            out[j, i, 0], out[j, i, 1], out[j, i, 2] = r, g, b
            out[j, i, 3] = (through + count // np.uint64(2)) // count
