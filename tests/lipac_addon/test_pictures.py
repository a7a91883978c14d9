"""Pictures on disk."""

import bpy
import numpy as np
import pytest

from lipac.core.errors import InputError
from lipac.lipac_addon.pictures import read_picture, save_pixels, save_render_result


def test_linear_pixels_come_back_exactly(boxes, tmp_path):
    pixels = np.random.default_rng(0).random((5, 7, 4), np.float32) * 30
    pixels[..., 3] = 1
    save_pixels(pixels, boxes, tmp_path / "p")
    assert (read_picture(tmp_path / "p.exr")[..., :3] == pixels[..., :3]).all()
    assert read_picture(tmp_path / "p.png").shape[:2] == (5, 7)
    assert not list(tmp_path.glob(".*"))
    assert "p" not in bpy.data.images


@pytest.mark.parametrize("transform", ["Standard", "AgX"])
def test_displayed_as_blender_displays_it(boxes, tmp_path, transform):
    """A render saved by Blender, by us, and from its linear pixels: the same displayed picture (8 bits; the last may
    round once more)."""
    boxes.view_settings.view_transform = transform
    boxes.render.image_settings.file_format = "PNG"
    boxes.render.filepath = str(tmp_path / "blender.png")
    bpy.ops.render.render(write_still=True)
    settings = boxes.render.image_settings
    before = [settings.file_format, settings.color_mode, settings.color_depth]
    save_render_result(boxes, tmp_path / "ours")
    assert [settings.file_format, settings.color_mode, settings.color_depth] == before
    linear = read_picture(tmp_path / "ours.exr")
    full = np.ones((*linear.shape[:2], 4), np.float32)
    full[..., :3] = linear[..., :3]
    save_pixels(full, boxes, tmp_path / "again")
    blender, ours, again = (read_picture(tmp_path / f"{name}.png")[..., :3] for name in ("blender", "ours", "again"))
    assert (ours == blender).all()
    assert np.abs(again - blender).max() <= 1.01 / 255


def test_missing_picture(tmp_path):
    with pytest.raises(InputError, match="cannot read picture"):
        read_picture(tmp_path / "no.exr")
