"""Pixel filter by importance sampling, and the picture that tiles accumulate into."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from ..arrays import F32
from ..errors import InputError
from ..jit.sampling import OPTIONS
from .model import Film

FILTER_SIZE = 1024
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])  # Rec.709


@dataclass(frozen=True)
class Picture:
    """Sums over samples of one `trace` call.

    sums: (H, W, 4) float32, linear radiance times exposure and alpha, added over `samples` samples; rows bottom up, as
    in Blender.
    samples: per pixel. paths, rays: counts of camera paths, and of rays traced in all. parts: (H, W, path_kernel.PARTS)
    float32, sums of parts of the light, where paths started at given hits. looks, coincident: at how many places paths
    looked for surfaces of several instances in one place, and found them.
    """

    sums: F32
    samples: int
    paths: int
    rays: int
    parts: F32 | None = None
    looks: int = 0
    coincident: int = 0

    @property
    def mean(self) -> F32:
        """(H, W, 4) float32: the picture, premultiplied alpha."""
        return self.sums / np.float32(max(self.samples, 1))


def filter_offsets(film: Film) -> F32:
    """(FILTER_SIZE + 1,) float32: inverse cumulative filter, offset from the pixel centre in pixels at u = i /
    FILTER_SIZE.

    The separable filters and their widths are Cycles' (scene/film.cpp): sampling by the filter makes every sample weigh
    the same (Ernst et al. 2006).
    """
    width = film.filter_width
    if film.filter == "BOX":
        return np.linspace(-0.5, 0.5, FILTER_SIZE + 1).astype(np.float32)
    if film.filter == "GAUSSIAN":
        radius = 1.5 * width
        x = np.linspace(-radius, radius, 16 * FILTER_SIZE + 1)
        f = np.exp(-2.0 * (6.0 * x / (3.0 * width)) ** 2)
    elif film.filter == "BLACKMAN_HARRIS":
        radius = width
        x = np.linspace(-radius, radius, 16 * FILTER_SIZE + 1)
        a = 2.0 * np.pi * (x / (2.0 * width) + 0.5)
        f = 0.35875 - 0.48829 * np.cos(a) + 0.14128 * np.cos(2.0 * a) - 0.01168 * np.cos(3.0 * a)
    else:
        raise InputError(f"pixel filter '{film.filter}' is unknown: use BLACKMAN_HARRIS, GAUSSIAN or BOX")
    cumulative = np.concatenate([[0.0], np.cumsum((f[1:] + f[:-1]) * 0.5)])
    return np.interp(np.linspace(0.0, 1.0, FILTER_SIZE + 1), cumulative / cumulative[-1], x).astype(np.float32)


@njit(**OPTIONS)
def filter_offset(table, u):
    """Offset in pixels for a uniform number u in [0, 1); table: `filter_offsets`."""
    x = u * np.float32(1024.0)
    i = min(np.int64(x), 1023)
    f = x - np.float32(i)
    return table[i] + f * (table[i + 1] - table[i])
