"""What paths say of a shot's set, frame by frame."""

from __future__ import annotations

from pathlib import Path

import bpy
import pytest

from lipac.core.error_budget.budget import Budget
from lipac.lipac_addon.farm import analyse, judge, unite
from lipac.lipac_addon.farm.jobs.writing import Wanted, write_shot
from lipac.lipac_addon.farm.layout import FarmShot
from lipac.lipac_addon.open import open_scene

pytestmark = pytest.mark.slow


@pytest.fixture
def fog(rising: Path, tmp_path: Path) -> FarmShot:
    """A shot of three frames, of which the second shows nothing but a volume, and the third nothing."""
    open_scene(rising)
    bpy.context.scene.collection.objects.link(bpy.data.objects.new("fog", bpy.data.volumes.new("fog")))
    for ob in [ob for ob in bpy.data.objects if ob.type in ("MESH", "VOLUME")]:
        for frame in (1, 2, 3):
            ob.hide_render = frame == 3 or (frame == 2 and ob.type == "MESH")
            ob.keyframe_insert("hide_render", frame=frame)
    path = tmp_path / "fog.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    return write_shot(tmp_path / "shot", path, Wanted((1, 2, 3), Budget(0.05, 0.3), 4))


def test_where_nothing_can_be_traced_nothing_holds_and_no_step_ends(fog: FarmShot) -> None:
    """Of such frames paths say nothing, neither that the set holds nor how far; of the others what they say."""
    assert analyse.analyse(fog, fog.frames) == 3
    unite.unite(fog)
    told = judge.judge(fog, fog.frames)
    assert [(one["frame"], one["holds"]) for one in told] == [(1, True), (2, False), (3, False)]
    assert [{one[name] is None for name in judge.FIGURES} for one in told] == [{False}, {True}, {True}]
    assert judge.of_frames(fog, fog.frames) == told
