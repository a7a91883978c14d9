"""The frames of a job: states, write-back and report, and what is left when it ends early."""

import json
from dataclasses import replace

import bpy
import numpy as np
import pytest

from lipac.core.accel.blas import BlasCache
from lipac.core.culling.options import CullOptions, State
from lipac.core.errors import Cancelled
from lipac.core.files.atomic import is_whole
from lipac.core.files.report import Report, load_states
from lipac.lipac_addon.batch.engines.hybrid_frame import HybridOptions
from lipac.lipac_addon.batch.job import FRAME, SHOT, Job
from lipac.lipac_addon.batch.pipeline import STEREO, run
from lipac.lipac_addon.batch.shots import shot
from lipac.lipac_addon.extract import extract_frame
from lipac.lipac_addon.pictures import read_picture
from lipac.lipac_addon.writeback import apply

DISTANCE = CullOptions(policy="distance", setting=19.5)  # the boxes behind the wall are further


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


@pytest.mark.parametrize("bake", [FRAME, SHOT])
def test_a_frame_that_shows_nothing_is_rendered_as_it_is(boxes, tmp_path, bake):
    """Between others, whose sets it leaves alone."""
    for ob in [ob for ob in bpy.data.objects if ob.type == "MESH"]:
        for frame in (1, 2, 3):
            ob.hide_render = frame == 2
            ob.keyframe_insert("hide_render", frame=frame)
    r = report()
    run(Job(tmp_path, (1, 2, 3), CullOptions(paths=2), "cycles", samples=1, bake=bake), r)
    assert [frame.get("active") for frame in r.frames] == [6, 0, 6]
    assert [line for line in r.warnings if line.startswith("frame 2: nothing to render")]
    picture = read_picture(tmp_path / "frame_0002.exr")[..., :3]
    assert (picture == picture[0, 0]).all() and (picture > 0).all()  # the world alone


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


@pytest.fixture
def layers(boxes):
    """The boxes with a second view layer that lacks the wall, and so shows the boxes behind it; a third one that
    nothing is in; a fourth that is not used."""
    hidden = bpy.data.collections.new("wall")
    boxes.collection.children.link(hidden)
    wall = bpy.data.objects["wall"]
    boxes.collection.objects.unlink(wall)
    hidden.objects.link(wall)
    second = boxes.view_layers.new("second")
    second.layer_collection.children["wall"].exclude = True
    third = boxes.view_layers.new("nothing")
    third.layer_collection.exclude = True
    for child in third.layer_collection.children:
        child.exclude = True
    boxes.view_layers.new("unused").use = False
    return boxes


def stays(path):
    states = load_states(path)
    return {states.names[k] for k in states.keys["object"][states.state == State.ACTIVE]}


@pytest.mark.parametrize(("engine", "bake"), [("cycles", FRAME), ("cycles", SHOT), ("", FRAME)])
def test_all_view_layers_that_render_are_analysed(layers, tmp_path, engine, bake):
    """What one of them needs stays for all; their use is as it was."""
    r = report()
    run(Job(tmp_path, (1, 2), CullOptions(width=48), engine, samples=1, bake=bake), r)
    for frame in (1, 2):
        kept = stays(tmp_path / "states" / f"frame_000{frame}.npz")
        assert {"wall", "box0", "box4", "box7"} <= kept
    assert [f["instances"] for f in r.frames] == [10, 10]
    assert [v.use for v in layers.view_layers] == [True, True, True, False]
    alone = Job(tmp_path / "one", (1,), CullOptions(width=48), "path", samples=1)
    run(alone, r)
    assert not {"box4", "box7"} & stays(tmp_path / "one" / "states" / "frame_0001.npz")
    assert any("view layers" in line for line in r.approximated)


@pytest.mark.parametrize(("engine", "culled"), [("", 0), ("cycles", 4)])
def test_an_analysis_of_several_views_culls_nothing(boxes, tmp_path, engine, culled):
    """It may be for a file that renders them all; a picture of the command's own is of one."""
    boxes.render.use_multiview = True
    r = report()
    run(Job(tmp_path, (1,), DISTANCE, engine, samples=1), r)
    assert r.frames[0]["culled"] == culled
    assert (STEREO in r.warnings) == (not engine)


def test_a_file_that_is_culled_already(boxes, tmp_path):
    """By an earlier version, or with an object that was appended: all is shown before it is looked at."""
    keys = extract_frame(boxes).keys
    apply(np.arange(len(keys.records)) % 2 == 0, keys)
    assert any(ob.hide_render for ob in bpy.data.objects)
    r = report()
    run(Job(tmp_path, (1,), DISTANCE), r)
    assert (r.frames[0]["instances"], r.frames[0]["culled"]) == (10, 4)
    assert not any(ob.hide_render for ob in bpy.data.objects)


def test_a_rule_reads_no_mesh_for_blenders_engines(boxes, tmp_path, monkeypatch):
    """Blender builds its own structures; ours would be for the report alone."""
    monkeypatch.setattr(BlasCache, "_load", lambda *_: pytest.fail("a mesh was read"))
    r = report()
    run(Job(tmp_path, (1,), DISTANCE, "cycles", samples=1), r)
    assert (r.frames[0]["active"], r.frames[0]["culled"]) == (6, 4)


@pytest.mark.parametrize(("engine", "more"), [("path", 0), ("hybrid", 1)])
def test_nothing_is_built_twice(boxes, tmp_path, monkeypatch, engine, more):
    """The picture is made of what the analysis has built; traced first hits, of everything, take structures of their
    own."""
    caches, build = [], BlasCache._build
    monkeypatch.setattr(
        BlasCache, "_build", lambda self, index, mesh: (caches.append(self), build(self, index, mesh))[1]
    )
    job = Job(
        tmp_path, (1,), CullOptions(width=48), engine, samples=1, hybrid=HybridOptions(primary="traced", denoise=False)
    )
    run(job, report())
    assert len({id(cache) for cache in caches}) == 1 + more


def test_half_pictures_are_made_again(boxes, tmp_path):
    """Those of an earlier version, or of a disk that lost them."""
    job = Job(tmp_path, (1, 2, 3, 4), DISTANCE, "cycles", samples=1)
    run(job, report())
    whole = {p: p.read_bytes() for p in tmp_path.rglob("frame_*")}
    for name in ("frame_0001.exr", "frame_0002.png", "states/frame_0003.npz"):
        path = tmp_path / name
        path.write_bytes(path.read_bytes()[:-100])
    r = report()
    run(replace(job, resume=True), r)
    assert [f["frame"] for f in r.frames] == [1, 2, 3]
    assert all(is_whole(path) for path in whole)


def test_damaged_or_missing_analyses_of_a_shot_are_made_again(boxes, tmp_path, monkeypatch):
    """Damaged before, and removed by another command between two looks."""
    job = Job(tmp_path, (1, 2), DISTANCE, bake=SHOT)
    run(job, report())
    before = [job.states(k).read_bytes() for k in (1, 2)]
    job.analysis(1).write_bytes(job.analysis(1).read_bytes()[:200])
    r, loads = report(), []

    def load(path):
        loads.append(path)
        if len(loads) == 2:
            job.analysis(2).unlink()
        return load_states(path)

    monkeypatch.setattr(shot, "load_states", load)
    run(replace(job, resume=True, frames=(1,), shot=(1, 2)), r)
    assert [job.states(k).read_bytes() for k in (1, 2)] == before


def test_a_report_stays_until_there_is_something_to_say(boxes, tmp_path):
    """Another command that ends before its first frame changes nothing; afterwards the earlier report is kept
    beside."""
    run(Job(tmp_path, (1, 2), DISTANCE), report())
    before = (tmp_path / "report.json").read_bytes()
    other = Report("boxes", "", "", "distance", "cycles", 7, 1)
    with pytest.raises(Cancelled):
        run(Job(tmp_path, (1,), DISTANCE), other, cancelled=lambda: True)
    assert (tmp_path / "report.json").read_bytes() == before
    run(Job(tmp_path, (1,), DISTANCE), other)
    assert json.loads((tmp_path / "report.json").read_text())["seed"] == 7
    assert (tmp_path / "report_earlier_1.json").read_bytes() == before


def test_frames_before_zero(boxes, tmp_path):
    """The current frame is -5, where the camera looks away: that is what all ways to render show, and where the scene
    stays."""
    boxes.camera.rotation_euler.x = -1.25
    boxes.camera.keyframe_insert("rotation_euler", frame=-5)
    boxes.camera.rotation_euler.x = 1.25
    boxes.camera.keyframe_insert("rotation_euler", frame=0)
    boxes.frame_set(-5)
    pictures = []
    for policy, bake in (("none", "frame"), ("light-paths", "frame"), ("light-paths", "shot")):
        folder = tmp_path / (policy + bake)
        run(
            Job(folder, (-5,), CullOptions(policy=policy), "cycles", 1, bake=bake),
            Report("boxes", "", "", policy, "cycles", 0, 1),
        )
        pictures.append(read_picture(next(folder.glob("frame_*.exr"))))
        assert boxes.frame_float == -5
    boxes.frame_set(0)
    run(
        Job(tmp_path / "other", (0,), CullOptions(policy="none"), "cycles", 1),
        Report("boxes", "", "", "none", "cycles", 0, 1),
    )
    assert np.abs(pictures[0] - read_picture(tmp_path / "other" / "frame_0000.exr")).mean() > 0.1
    for picture in pictures[1:]:
        assert np.abs(picture - pictures[0]).mean() < 0.01 * pictures[0].mean()
