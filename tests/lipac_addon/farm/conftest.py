"""A shot of a few boxes, of which the camera sees more and more over a wall; as a job in a folder."""

from pathlib import Path

import bpy
import pytest

from lipac.core.error_budget.budget import Budget
from lipac.lipac_addon.farm.jobs.writing import Wanted, write_shot
from lipac.lipac_addon.farm.layout import FarmShot
from lipac.lipac_addon.open import open_scene

from ..conftest import ground_and_boxes


@pytest.fixture(scope="session")
def rising(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The scene, as a .blend."""
    ground_and_boxes()
    camera = bpy.context.scene.camera
    for frame, height, tilt in ((1, 5.0, 1.25), (6, 60.0, 0.26)):
        camera.location.z, camera.rotation_euler.x = height, tilt
        camera.keyframe_insert("location", frame=frame)
        camera.keyframe_insert("rotation_euler", frame=frame)
    bpy.context.scene.frame_end = 6
    path = tmp_path_factory.mktemp("scene") / "rising.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    bpy.ops.wm.read_factory_settings(use_empty=True)
    return path


@pytest.fixture
def shot(rising: Path, tmp_path: Path) -> FarmShot:
    """The job, written."""
    open_scene(rising)
    return write_shot(tmp_path / "shot", rising, Wanted(budget=Budget(0.05, 0.3), paths=2))
