"""Attributes of meshes as images: what they are on a triangle is the place of that colour in a palette, so that what
nodes make of them is made of the palette's pixels.

A triangle has the mean of its corners. Each channel has `LEVELS` steps, a quarter of an octave apart.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import F32

NAME = "\nattribute "  # begins the name of what is a UV map of such places; none of Blender's has a line's end
LEVELS = 64
SIZE = 512  # pixels a side: LEVELS**3 in all
LOWEST, STEPS = 2.0**-10, 4  # the least level but 0; to an octave


def palette() -> F32:
    """(SIZE, SIZE, 4) float32, linear."""
    level = np.append(0.0, LOWEST * 2.0 ** (np.arange(LEVELS - 1) / STEPS)).astype(np.float32)
    number = np.arange(SIZE * SIZE)
    out = np.ones((SIZE * SIZE, 4), np.float32)
    for channel in range(3):
        out[:, channel] = level[number // LEVELS**channel % LEVELS]
    return out.reshape(SIZE, SIZE, 4)


def places(colors: NDArray[np.floating]) -> F32:
    """(..., 2) float32, where colours (..., 3) lie in the palette, as UVs. What is negative or not a number counts as
    0."""
    known = np.maximum(np.nan_to_num(np.asarray(colors, np.float64)), 0.0)
    step = 1 + np.rint(STEPS * np.log2(np.maximum(known, 1e-30) / LOWEST))
    level = np.where(known < LOWEST / 2, 0, np.clip(step, 1, LEVELS - 1)).astype(np.int64)
    number = level[..., 0] + LEVELS * level[..., 1] + LEVELS**2 * level[..., 2]
    return np.stack(((number % SIZE + 0.5) / SIZE, (number // SIZE + 0.5) / SIZE), axis=-1).astype(np.float32)
