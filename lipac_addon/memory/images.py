"""Images of materials, and what Cycles takes for each of them on the CPU."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import Any

import bpy

from ..images import size_of

HEADER = 1 << 16  # bytes of a file in which its size is told, behind what cameras write first
SAMPLED = {"ShaderNodeTexImage", "ShaderNodeTexEnvironment"}


def image_bytes(image: bpy.types.Image) -> int:
    """What Cycles keeps of an image: one or four channels, of one byte each, two of a PNG with 16 bits, four of other
    floats (of halves, which Blender does not tell from these, it is twice too much); the tiles of a UDIM each.

    What is missing takes one pixel. What Blender has not read is not read for it, where its header tells enough.
    """
    width, height, pixel = _shape(image)
    tiles = len(image.tiles) if image.source == "TILED" else 1
    return max(width * height, 1) * pixel * tiles


def _shape(image: bpy.types.Image) -> tuple[int, int, int]:
    """Width, height and bytes of a pixel."""
    if image.source == "GENERATED":
        return image.generated_width, image.generated_height, 16 if image.use_generated_float else 4
    if not image.has_data and (found := _header(_beginning(image))) is not None:
        return found
    size = size_of(image)
    each = 1 if not size.is_float else 2 if image.file_format == "PNG" and image.source == "FILE" else 4
    pixel = (1 if size.channels == 1 else 4) * each
    return (size.width, size.height, pixel) if size.width and size.height else (1, 1, 16)


def _beginning(image: bpy.types.Image) -> bytes:
    """The first bytes of an image's file, enough for its header; none where it is not there."""
    if image.packed_file is not None:
        return bytes(image.packed_file.data[:HEADER])
    try:
        with open(bpy.path.abspath(image.filepath, library=image.library), "rb") as file:
            return file.read(HEADER)
    except OSError:
        return b""


def _header(data: bytes) -> tuple[int, int, int] | None:
    """Width, height and bytes of a pixel of a PNG or JPEG that begins so; None for others."""
    if data[:8] == b"\x89PNG\r\n\x1a\n" and data[12:16] == b"IHDR":
        width, height, depth, kind = struct.unpack(">IIBB", data[16:26])
        return width, height, (1 if kind == 0 else 4) * (2 if depth == 16 else 1)
    at = 2
    while data[:2] == b"\xff\xd8" and at + 10 <= len(data) and data[at] == 0xFF:
        marker, size = data[at + 1], int.from_bytes(data[at + 2 : at + 4], "big")
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):  # frame headers
            height, width, channels = struct.unpack(">HHB", data[at + 5 : at + 10])
            return width, height, 1 if channels == 1 else 4
        at += 2 + size
    return None


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
