"""Images, left in memory as they were found: an analysis looks at all of them, a render only at what it shows."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import bpy


@dataclass(frozen=True)
class ImageSize:
    """Of the first picture of an image; 0 pixels where it is missing."""

    width: int
    height: int
    channels: int
    is_float: bool


_sizes: dict[tuple[object, ...], ImageSize] = {}  # of images that were read before, and are not in memory any more


@contextmanager
def as_found(image: bpy.types.Image) -> Iterator[None]:
    """Blender reads an image when something of it is asked for. What it reads within the block, it forgets after it,
    where it can read that again."""
    there = image.has_data
    try:
        yield
    finally:
        if not there and image.has_data and image.source in {"FILE", "GENERATED"} and not image.is_dirty:
            _remember(image)
            image.buffers_free()


def size_of(image: bpy.types.Image) -> ImageSize:
    """The size of an image, which is read for it where it never was."""
    known = None if image.has_data else _sizes.get(_stamp(image))
    if known is not None:
        return known
    with as_found(image):
        return _remember(image)


def _remember(image: bpy.types.Image) -> ImageSize:
    width, height = image.size
    size = _sizes[_stamp(image)] = ImageSize(width, height, image.channels, image.is_float)
    return size


def _stamp(image: bpy.types.Image) -> tuple[object, ...]:
    """What tells an image from others, and from what it was."""
    generated = (image.generated_type, image.generated_width, image.generated_height, image.use_generated_float)
    return image.session_uid, image.source, image.filepath, *generated
