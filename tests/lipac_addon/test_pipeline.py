"""The frames of a job: states, write-back and report, and what is left when it ends early."""

import json

import bpy
import pytest

from lipac.core.culling import CullOptions
from lipac.core.errors import Cancelled
from lipac.core.report import Report
from lipac.lipac_addon.pipeline import Job, run

DISTANCE = CullOptions(policy="distance", distance=19.5)  # the boxes behind the wall are further


def report():
    return Report("boxes", "", "", "distance", "cycles", 0, 1)


def test_visibility_is_put_back(boxes, tmp_path):
    r = report()
    run(Job(tmp_path, (1, 2), DISTANCE, "cycles", samples=1), r)
    assert [f["frame"] for f in r.frames] == [1, 2]
    for frame in r.frames:
        assert frame["writeback"]["removed"] == frame["culled"] == 4
        assert min(frame[name] for name in ("sync_s", "writeback_s", "render_s")) > 0
    assert not any(ob.hide_render for ob in bpy.data.objects)
    assert json.loads((tmp_path / "report.json").read_text())["frames"] == json.loads(json.dumps(r.frames))


def test_what_cannot_be_removed_is_a_warning(boxes, tmp_path):
    bpy.data.objects["box5"].keyframe_insert("hide_render", frame=1)
    r = report()
    run(Job(tmp_path, (1,), DISTANCE, "cycles", samples=1), r)
    assert r.warnings == ["1 culled instances stay in the render: render visibility is animated"]
    assert r.frames[0]["writeback"]["kept"] == {"render visibility is animated": 1}


def test_stop_keeps_what_is_finished(boxes, tmp_path):
    """Asked to stop once the second frame's extraction is done."""
    r = report()
    with pytest.raises(Cancelled):
        run(Job(tmp_path, (1, 2, 3), DISTANCE, "cycles", samples=1), r, cancelled=lambda: boxes.frame_current == 2)
    assert [f["frame"] for f in json.loads((tmp_path / "report.json").read_text())["frames"]] == [1]
    assert sorted(p.name for p in tmp_path.glob("*.png")) == ["frame_0001.png"]
    assert not any(ob.hide_render for ob in bpy.data.objects)


@pytest.mark.parametrize("engine", ["", "path"])
def test_stop_of_analysis_and_path(boxes, tmp_path, engine):
    asked = iter([False, False, True])  # after the extraction, then within the analysis or the render
    with pytest.raises(Cancelled):
        run(Job(tmp_path, (1,), CullOptions(), engine, samples=1), report(), cancelled=lambda: next(asked, True))
    assert not list(tmp_path.glob("*.png"))
