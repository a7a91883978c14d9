"""Images of materials, and what Cycles takes for each of them on the CPU."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import bpy

from ..images import size_of

SAMPLED = {"ShaderNodeTexImage", "ShaderNodeTexEnvironment"}


def image_bytes(image: bpy.types.Image) -> int:
    """What Cycles keeps of an image: one or four channels, of one byte each, two of a PNG with 16 bits, four of other
    floats (of halves, which Blender does not tell from these, it is twice too much); the tiles of a UDIM each.

    What is missing takes one pixel. Reads the image where Blender never has.
    """
    size = size_of(image)
    if not size.width or not size.height:
        return 16
    channels = 1 if size.channels == 1 else 4
    each = 1 if not size.is_float else 2 if image.file_format == "PNG" and image.source == "FILE" else 4
    tiles = len(image.tiles) if image.source == "TILED" else 1
    return size.width * size.height * channels * each * tiles


def images_of(tree: Any) -> set[bpy.types.Image]:
    """Images that nodes of a shader tree sample, those of its groups included."""
    return set(_images(tree, set()))


def _images(tree: Any, seen: set[Any]) -> Iterator[bpy.types.Image]:
    if tree is None or tree in seen:
        return
    seen.add(tree)
    for node in tree.nodes:
        if node.bl_idname in SAMPLED and node.image is not None:
            yield node.image
        yield from _images(getattr(node, "node_tree", None), seen)
