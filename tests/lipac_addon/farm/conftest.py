"""A shot of a few boxes, of which the camera sees more and more over a wall; as a job in a folder."""

from pathlib import Path

import bpy
import pytest

from lipac.core.error_budget.budget import Budget
from lipac.lipac_addon.farm.jobs.writing import Wanted, write_shot
from lipac.lipac_addon.farm.layout import FarmShot
from lipac.lipac_addon.open import open_scene

from ..conftest import save_rising


@pytest.fixture(scope="session")
def rising(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The scene, as a .blend, with one more box below the ground, which no frame shows."""
    path = save_rising(tmp_path_factory.mktemp("scene"))
    open_scene(path)
    hidden = bpy.data.objects["box0"].copy()
    hidden.name, hidden.location.z = "box8", -40.0
    bpy.context.scene.collection.objects.link(hidden)
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    return path


@pytest.fixture
def shot(rising: Path, tmp_path: Path) -> FarmShot:
    """The job, written."""
    open_scene(rising)
    return write_shot(tmp_path / "shot", rising, Wanted(budget=Budget(0.05, 0.3), paths=4))
