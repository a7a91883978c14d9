"""The demo scene of large images."""

import bpy
import pytest

from lipac.core.errors import InputError
from lipac.lipac_addon.demo import build, textures
from lipac.lipac_addon.extract import extract_frame


def test_each_panel_has_an_image_of_its_own():
    textures.build(10, pixels=16)
    scene = extract_frame(bpy.context.scene).scene
    assert len(scene.instances) == 12
    assert len(scene.textures.records) == 10
    assert len(scene.lights) == 1
    assert not scene.approximated
    assert {tuple(image.size) for image in bpy.data.images if image.source == "GENERATED"} == {(16, 16)}


def test_unusable_numbers():
    with pytest.raises(InputError, match="1 to 512 images"):
        build("textures", 0)
