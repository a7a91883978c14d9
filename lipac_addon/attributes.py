"""Attributes of meshes as images: what they are on a triangle is the place of that colour in a palette, so that what
nodes make of them is made of the palette's pixels.

A triangle has the mean of its corners, a strand or point its own. Each channel has `LEVELS` steps: a quarter of an
octave apart where colours are, half of one where only what glows is.

Besides, a pattern by the place on a mesh, which stands for procedural textures: what they are where is not followed,
but that they differ from place to place is.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from functools import cache
from typing import Any

import bpy
import numpy as np
from idprop.types import IDPropertyArray
from numpy.typing import NDArray

from ..core.arrays import F32

Bounds = tuple[float, float]
NAME = "\nattribute "  # begins the name of what is a UV map of such places; none of Blender's has a line's end
PLACE = "\nplace"  # the name of what is a UV map of the pattern
PATTERN, PERIODS = 256, 16.0  # pixels of a side; how often the pattern repeats along a mesh's diagonal
_AXES = np.array([(0.79, 0.31, 0.53), (-0.37, 0.83, 0.42)])  # of the pattern in a mesh: along none of its own
LEVELS = 64
SIZE = 512  # pixels a side: LEVELS**3 in all
_OCTAVES = np.concatenate((np.arange(-9, -6), np.arange(-6, 2, 0.25), np.arange(2, 16, 0.5)))
LEVEL = np.append(0.0, 2.0**_OCTAVES).astype(np.float32)  # 0, then from 0.002 to 46,000
assert len(LEVEL) == LEVELS
_BETWEEN = np.append(LEVEL[1] / 2, np.sqrt(LEVEL[1:-1].astype(np.float64) * LEVEL[2:]))  # where the next is nearer
FIELDS: dict[str, tuple[str, int, type]] = {  # by type of an attribute: the field of its data, how wide, and of what
    "FLOAT_COLOR": ("color", 4, np.float32),
    "BYTE_COLOR": ("color", 4, np.float32),
    "FLOAT_VECTOR": ("vector", 3, np.float32),
    "FLOAT": ("value", 1, np.float32),
    "INT": ("value", 1, np.int32),
    "BOOLEAN": ("value", 1, np.bool_),
}


def palette() -> F32:
    """(SIZE, SIZE, 4) float32, linear."""
    number = np.arange(SIZE * SIZE)
    out = np.ones((SIZE * SIZE, 4), np.float32)
    for channel in range(3):
        out[:, channel] = LEVEL[number // LEVELS**channel % LEVELS]
    return out.reshape(SIZE, SIZE, 4)


def places(colors: NDArray[np.floating]) -> F32:
    """(..., 2) float32, where colours (..., 3) lie in the palette, as UVs. What is negative or not a number counts as
    0."""
    level = np.searchsorted(_BETWEEN, np.maximum(np.nan_to_num(np.asarray(colors, np.float64)), 0.0))
    number = level[..., 0] + LEVELS * level[..., 1] + LEVELS**2 * level[..., 2]
    return np.stack(((number % SIZE + 0.5) / SIZE, (number // SIZE + 0.5) / SIZE), axis=-1).astype(np.float32)


def colors_of(attribute: Any) -> F32 | None:
    """(n, 3) of a bpy.types.Attribute, a number as three of the same; None where it is neither colour nor number."""
    found = FIELDS.get(attribute.data_type)
    if found is None:
        return None
    field, width, dtype = found
    out: NDArray[Any] = np.empty(len(attribute.data) * width, dtype)
    attribute.data.foreach_get(field, out)
    return np.broadcast_to(out.reshape(-1, width)[:, : min(width, 3)], (len(attribute.data), 3)).astype(np.float32)


@dataclass(frozen=True)
class Owners:
    """What materials may ask for attributes: objects (bpy.types.Object) of a graph, and instances, within what whose
    attributes lie, by name."""

    objects: Sequence[Any]
    instances: Mapping[str, Bounds]


_OWNERS: ContextVar[Owners | None] = ContextVar("owners", default=None)


@contextmanager
def owned_by(owners: Owners) -> Iterator[None]:
    """Materials are of these; else they are of all objects of the file."""
    token = _OWNERS.set(owners)
    try:
        yield
    finally:
        _OWNERS.reset(token)


def bounds_of(name: str) -> Bounds | None:
    """Within what a property or an attribute lies that a material asks its objects or instances for, by name; those
    that lack it have 0. None where nothing has it."""
    owners = _OWNERS.get() or Owners(bpy.data.objects, {})
    found = [owners.instances[name]] if name in owners.instances else []
    for item in owners.objects:
        for block in (item, item.data):
            value = _property(block, name)
            if value is not None:
                found.append((min(value), max(value)))
    return (min(0.0, *(low for low, _ in found)), max(0.0, *(high for _, high in found))) if found else None


def _property(block: Any, name: str) -> list[float] | None:
    """The numbers of a property of a data-block: a custom one, or one of Blender's (Cycles' `lookup_property`)."""
    if block is None:
        return None
    value = block.get(name)
    if value is None and name.isidentifier():
        value = getattr(block, name, None)
    if isinstance(value, (bool, int, float)):
        return [float(value)]
    numbers = list(value) if isinstance(value, (IDPropertyArray, bpy.types.bpy_prop_array)) else []
    return numbers if numbers and all(isinstance(one, (int, float)) for one in numbers) else None


@cache
def pattern() -> F32:
    """(PATTERN, PATTERN, 4) float32 from 0 to 1, each value as often as another: patches of all sizes, from two pixels
    to a quarter of the side."""
    rng, total = np.random.default_rng(0), np.zeros((PATTERN, PATTERN))
    for cells in (4, 8, 16, 32, 64, 128):
        coarse = np.repeat(np.repeat(rng.normal(size=(cells, cells)), PATTERN // cells, 0), PATTERN // cells, 1)
        total += np.roll(coarse, tuple(rng.integers(0, PATTERN, 2)), (0, 1))
    rank = np.argsort(np.argsort(total, axis=None, kind="stable"), kind="stable").reshape(total.shape)
    out = np.ones((PATTERN, PATTERN, 4), np.float32)
    out[..., :3] = ((rank + 0.5) / rank.size)[..., None]
    return out


def places_in_pattern(points: NDArray[np.floating], box: NDArray[np.floating]) -> F32:
    """(..., 2) float32, where points (..., 3) of a mesh with a box (2, 3) lie in the pattern, as UVs."""
    diagonal = max(float(np.linalg.norm(np.subtract(*box[::-1].astype(np.float64)))), 1e-30)
    return ((points - box[0]) @ (_AXES.T * (PERIODS / diagonal))).astype(np.float32)
