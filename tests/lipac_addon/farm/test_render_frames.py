"""What a render node runs, without LiPaC."""

from pathlib import Path

import bpy
import pytest

from lipac.lipac_addon.farm import render_frames


@pytest.mark.parametrize("folder", ["a {shot} b", "{blend_name}", "{{x}}", "#1 é"])
def test_a_picture_is_where_it_should_be_whatever_its_folder_is_called(
    folder: str, boxes: bpy.types.Scene, tmp_path: Path
) -> None:
    """Blender takes what is in braces for a template."""
    boxes.render.resolution_percentage, boxes.cycles.samples = 25, 1
    boxes.render.image_settings.file_format = "PNG"
    (tmp_path / folder).mkdir()
    render_frames.render(boxes, tmp_path / folder / "frame_0001.png")
    assert [str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*.png")] == [f"{folder}/frame_0001.png"]
