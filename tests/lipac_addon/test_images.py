"""Images are left in memory as they were found: an analysis looks at all of them, a render only at what it shows."""

from __future__ import annotations

from pathlib import Path

import bpy
import numpy as np
import pytest

from lipac.lipac_addon.extract import extract_frame
from lipac.lipac_addon.images import as_found, size_of

pytestmark = pytest.mark.blender
SIZE = 2048


@pytest.fixture
def image(tmp_path: Path) -> bpy.types.Image:
    """Of a file that was not read yet, on a plane that the camera sees."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    made = bpy.data.images.new("made", SIZE, SIZE)
    made.filepath_raw, made.file_format = str(tmp_path / "image.png"), "PNG"
    made.save()
    bpy.data.images.remove(made)
    image = bpy.data.images.load(str(tmp_path / "image.png"))
    bpy.ops.mesh.primitive_plane_add()
    material = bpy.data.materials.new("pictured")
    tree = material.node_tree
    texture = tree.nodes.new("ShaderNodeTexImage")
    texture.image = image
    tree.links.new(texture.outputs["Color"], tree.nodes["Principled BSDF"].inputs["Base Color"])
    bpy.context.object.data.materials.append(material)
    bpy.ops.object.camera_add(location=(0, 0, 3))
    bpy.context.scene.camera = bpy.context.object
    return image


def test_an_analysis_leaves_no_image_behind(image: bpy.types.Image) -> None:
    assert not image.has_data
    scene = extract_frame(bpy.context.scene).scene
    assert not image.has_data
    assert scene.textures.records["width"].max() == 1024  # read, and shrunk
    assert scene.textures.bytes.nbytes == 4 * 1024**2


def test_what_was_there_stays(image: bpy.types.Image) -> None:
    """Read before, or painted on: what a user did not save is not read again."""
    image.pixels[0] = 0.5
    image.update()
    assert image.is_dirty
    with as_found(image):
        pass
    extract_frame(bpy.context.scene)
    assert image.has_data
    assert abs(image.pixels[0] - 0.5) < 1 / 255
    fresh = bpy.data.images.load(image.filepath)
    with as_found(fresh):
        fresh.pixels[0] = 0.5
        fresh.update()
    assert fresh.is_dirty
    assert abs(fresh.pixels[0] - 0.5) < 1 / 255


def test_a_size_is_known_without_the_image(image: bpy.types.Image) -> None:
    assert (size_of(image).width, size_of(image).channels) == (SIZE, 4)
    assert not image.has_data
    image.scale(SIZE // 2, SIZE // 2)
    assert size_of(image).width == SIZE // 2


def test_what_is_missing_has_no_pixels(image: bpy.types.Image) -> None:
    image.filepath = "/nowhere/at/all.png"
    assert size_of(image).width == 0
    assert np.isfinite(extract_frame(bpy.context.scene).scene.textures.floats).all()
