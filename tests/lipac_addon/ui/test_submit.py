"""Submit Shot: what is written, what is told, and what stands in its way."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import bpy
import pytest

from lipac.core.errors import InputError
from lipac.lipac_addon.farm.jobs.writing import Wanted, write_shot
from lipac.lipac_addon.farm.layout import FarmShot
from lipac.lipac_addon.ui.submit import LIPAC_OT_submit_shot


@pytest.fixture
def saved(scene: Any, tmp_path: Path) -> Any:
    """A file with settings of its own for a shot of twelve frames."""
    scene.lipac.policy = "light-paths"
    scene.lipac.max_error, scene.lipac.worst_error, scene.lipac.seed = 2.0, 7.0, 3
    scene.frame_start, scene.frame_end = 3, 14
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "shot 7.blend"))
    return bpy.context.scene


@pytest.mark.parametrize(("farm", "file"), [("OPENJD", "template.json"), ("FLAMENCO", "flamenco_job.json")])
def test_a_job_is_written(saved: Any, tmp_path: Path, farm: str, file: str, capfd: pytest.CaptureFixture[str]) -> None:
    before = (tmp_path / "shot 7.blend").read_bytes()
    assert bpy.ops.lipac.submit_shot(farm=farm, chunk=5, blender="/opt/blender", lipac="/opt/lipac") == {"FINISHED"}
    assert "shot 7_shot holds the job" in capfd.readouterr().out
    shot = FarmShot.load(tmp_path / "shot 7_shot")
    assert (shot.first, shot.last, shot.seed, shot.scene) == (3, 14, 3, tmp_path / "shot 7.blend")
    assert (shot.mean, shot.worst) == pytest.approx((0.02, 0.07))
    text = (shot.folder / file).read_text()
    assert json.loads(text)
    assert "chunk" in text.lower()
    assert (tmp_path / "shot 7.blend").read_bytes() == before
    if farm == "OPENJD":
        values = json.loads((shot.folder / "parameters.json").read_text())
        assert (values["LiPaC"], values["Blender"]) == ("/opt/lipac", "/opt/blender")


def test_a_folder_that_cannot_be_written(saved: Any, tmp_path: Path) -> None:
    """Whatever the system says of it is told, and is no traceback."""
    (tmp_path / "out" / "job.json").mkdir(parents=True)
    with pytest.raises(RuntimeError) as told:
        bpy.ops.lipac.submit_shot(folder=str(tmp_path / "out"))
    assert "job.json" in str(told.value)
    assert "Traceback" not in str(told.value)


def test_what_stands_in_its_way(saved: Any) -> None:
    obstacle = LIPAC_OT_submit_shot.obstacle
    assert obstacle(bpy.context) == ""
    saved.lipac.policy = "distance"
    assert "light paths" in obstacle(bpy.context)
    bpy.ops.lipac.analyze()
    bpy.ops.lipac.apply()
    saved.lipac.policy = "light-paths"
    bpy.ops.wm.save_mainfile()
    assert "Restore first" in obstacle(bpy.context)
    with pytest.raises(InputError, match="restore first"):
        write_shot(Path(bpy.data.filepath).parent / "out", Path(bpy.data.filepath), Wanted())
    bpy.ops.lipac.restore()
    bpy.ops.wm.save_mainfile()
    saved.camera = None
    assert "camera" in obstacle(bpy.context)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    assert "Save the file first" in obstacle(bpy.context)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ("film", "choose PNG or OpenEXR"),
        ("step", "one frame in 2"),
        ("views", "several cameras"),
        ("camera", "has no camera"),
    ],
)
def test_what_cannot_be_a_shot(saved: Any, tmp_path: Path, change: str, says: str) -> None:
    if change == "film":
        saved.render.image_settings.media_type = "VIDEO"
    elif change == "step":
        saved.frame_step = 2
    elif change == "views":
        saved.render.use_multiview = True
    else:
        saved.camera = None
    with pytest.raises(InputError, match=says):
        write_shot(tmp_path / "out", Path(bpy.data.filepath), Wanted())
    assert not (tmp_path / "out" / "job.json").exists()
