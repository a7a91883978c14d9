"""Pictures on disk: frame_0001.exr (linear float) and frame_0001.png (as displayed, with the scene's view
transform)."""

from __future__ import annotations

import errno
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import bpy
import numpy as np

from ..core.arrays import F32
from ..core.errors import InputError
from ..core.files.atomic import replacing
from .depsgraph import changed, render_result

_FORMATS = {
    ".exr": {"file_format": "OPEN_EXR", "color_depth": "32", "exr_codec": "ZIP"},
    ".png": {"file_format": "PNG", "color_depth": "8"},
}


def save_render_result(scene: bpy.types.Scene, stem: Path) -> None:
    """Save what was rendered last as stem.exr and stem.png. Raises InputError where nothing was."""
    image = render_result()
    if image is None:
        raise InputError(f"scene {scene.name!r}: nothing was rendered")
    _save(image, scene, stem)


def save_pixels(pixels: F32, scene: bpy.types.Scene, stem: Path) -> None:
    """Save pixels (H, W, 4) float32, linear Rec.709, premultiplied alpha, rows bottom up, as stem.exr and stem.png."""
    height, width = pixels.shape[:2]
    image = bpy.data.images.new(stem.name, width, height, alpha=True, float_buffer=True)
    try:
        image.alpha_mode = "PREMUL"
        image.pixels.foreach_set(np.ascontiguousarray(pixels, np.float32).ravel())
        _save(image, scene, stem)
    finally:
        bpy.data.images.remove(image)


def read_picture(path: Path) -> F32:
    """A saved picture, (H, W, 4) float32, rows bottom up: an .exr in linear Rec.709, a .png as displayed (sRGB, 0 to
    1).

    Raises InputError where it cannot be read.
    """
    try:
        image = bpy.data.images.load(str(path.resolve()))
    except RuntimeError as error:
        raise InputError(f"cannot read picture {path}: no such file, or damaged; render it again") from error
    try:
        if path.suffix == ".png":
            image.colorspace_settings.name = "Non-Color"
        pixels = np.empty((image.size[1], image.size[0], image.channels), np.float32)
        image.pixels.foreach_get(pixels.ravel())
    finally:
        bpy.data.images.remove(image)
    return pixels


def _save(image: bpy.types.Image, scene: bpy.types.Scene, stem: Path) -> None:
    """Raises OSError where a picture cannot be written whole, which Blender does not say itself: a full disk, a folder
    that is gone."""
    for suffix in _FORMATS:
        path = stem.with_name(stem.name + suffix)
        with replacing(path) as part, saved_as(scene, suffix):
            try:
                image.save_render(str(part), scene=scene)
            except RuntimeError as error:
                raise OSError(
                    errno.EIO, str(error).strip().removeprefix("Error: ").splitlines()[0], str(path)
                ) from error


@contextmanager
def saved_as(scene: bpy.types.Scene, suffix: str) -> Iterator[None]:
    """The format of saved pictures is ours of that ending, whatever the file says, a film for example."""
    settings, values = scene.render.image_settings, _FORMATS[suffix]
    mode = "RGBA" if scene.render.film_transparent else "RGB"
    with changed(settings, media_type="IMAGE", **values, color_mode=mode, color_management="FOLLOW_SCENE"):
        yield
