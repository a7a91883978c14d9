"""What is hidden, for which frames, and by whom: said in every scene, and kept to in renders."""

import os
import runpy
import sys

import bpy
import numpy as np
import pytest

from lipac.lipac_addon import roles
from lipac.lipac_addon.ui import handlers, panel
from lipac.lipac_addon.ui.draw import figures
from lipac.lipac_addon.ui.jobs import difference, job, live
from lipac.lipac_addon.ui.jobs.analysis import AnalysisJob
from lipac.lipac_addon.ui.state import applying, results, session
from lipac.lipac_addon.writeback import apply as write_back
from lipac.lipac_addon.writeback import marks

FAR = {"box4", "box5", "box6", "box7"}


def said(scene):
    return applying.status(scene)


def reopen(path):
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    bpy.ops.wm.open_mainfile(filepath=str(path))
    return bpy.context.scene


@pytest.fixture
def rendered(analyzed, hidden):
    """Renders a frame as F12 does; what is hidden meanwhile."""

    def run(frame):
        analyzed.frame_set(frame)
        handlers.before_frame(analyzed)
        seen = hidden()
        handlers.after_render(analyzed)
        return seen

    return run


def test_what_is_applied_is_said_in_every_scene(analyzed, tmp_path):
    assert said(analyzed) == ("Renders show everything", False)
    other = bpy.data.scenes.new("other")
    bpy.ops.lipac.apply()
    assert said(analyzed) == ("Hidden from renders: 4 instances, for frame 1", False)
    line, alert = said(other)
    assert line.startswith("Hidden from renders: 4 instances, for frame 1 of scene Scene.")
    assert alert
    analyzed.frame_set(7)
    assert said(analyzed) == (
        "Hidden from renders: 4 instances, for frame 1. What frame 7 shows may be missing: Restore, or Bake Shot",
        True,
    )
    scene = reopen(tmp_path / "file.blend")
    assert said(scene)[1]
    scene.frame_set(1)
    assert said(scene) == ("Hidden from renders: 4 instances, for frame 1", False)
    bpy.ops.lipac.restore()
    assert said(scene) == ("Renders show everything", False)


def test_undo_is_noticed(analyzed):
    bpy.ops.ed.undo_push(message="start")
    bpy.ops.lipac.apply("EXEC_DEFAULT", True)
    assert "4 instances" in said(analyzed)[0]
    bpy.ops.ed.undo()
    assert said(bpy.context.scene) == ("Renders show everything", False)
    bpy.ops.ed.redo()
    assert "4 instances" in said(bpy.context.scene)[0]


def test_a_shot_holds_for_its_frames(scene):
    scene.frame_start, scene.frame_end, scene.frame_step = 1, 5, 2
    scene.frame_set(3, subframe=0.25)
    bpy.ops.lipac.bake_shot()
    assert (scene.frame_current, scene.frame_subframe) == (3, 0.25)
    assert said(scene) == ("Hidden from renders: 4 instances, for frames 1 to 5", False)
    scene.frame_set(4)
    assert said(scene)[1]


def test_use_for_renders_says_what_a_frame_gets(analyzed):
    analyzed.lipac.use_for_renders = True
    assert said(analyzed) == ("Renders hide what frame 1 does not need", False)
    analyzed.frame_set(2)
    assert said(analyzed) == ("Frame 2 is not analyzed: it renders in full", True)


def test_applied_for_one_frame_and_rendered_at_others(analyzed, rendered, hidden):
    """With Use for renders each frame gets what it needs; what was applied comes back."""
    analyzed.lipac.use_for_renders = True
    second = results.at(analyzed)
    state = second.state.copy()
    state[np.isin(second.keys.records["object"], [second.keys.names.index(n) for n in ("box4", "box5", "box6")])] = (
        results.ACTIVE
    )
    bpy.ops.lipac.apply()
    results.put(analyzed, {1: second, 3: results.replace(second, frame=3, state=state)})
    assert rendered(1) == FAR
    assert rendered(2) == set()  # in full
    assert hidden() == FAR
    assert rendered(3) == {"box7"}
    assert hidden() == FAR
    assert analyzed.lipac.applied
    assert applying.frames_of(analyzed) == range(1, 2)
    assert "for frame 1" in said(analyzed)[0]


def test_a_shot_comes_back_within_a_render(scene, hidden, tmp_path):
    """An animation that begins before the baked frames, and ends after them."""
    scene.frame_start, scene.frame_end = 2, 3
    bpy.ops.lipac.bake_shot()
    scene.lipac.use_for_renders = True
    results.put(scene, {})
    scene.frame_start, scene.frame_end, scene.render.filepath, scene.render.engine = (
        1, 4, str(tmp_path / "a"), "BLENDER_WORKBENCH"
    )
    found = {}

    def note(scene, *_):
        found[scene.frame_current] = hidden()

    bpy.app.handlers.render_post.append(note)
    bpy.ops.render.render(animation=True)
    bpy.app.handlers.render_post.remove(note)
    assert found == {1: set(), 2: FAR, 3: FAR, 4: set()}
    assert hidden() == FAR
    assert applying.frames_of(scene) == range(2, 4)


def test_what_is_not_known_any_more_is_shown_rather_than_missing(analyzed, tmp_path, hidden):
    bpy.ops.lipac.apply()
    analyzed.lipac.use_for_renders = True
    scene = reopen(tmp_path / "file.blend")
    assert hidden() == FAR
    scene.frame_set(2)
    handlers.before_frame(scene)
    assert hidden() == set()
    handlers.after_render(scene)
    assert said(scene) == ("Frame 2 is not analyzed: it renders in full", True)


# A file that is culled already, and no switch says so


def culled_by_someone(scene, result):
    write_back(result.culled, result.current_keys())


@pytest.mark.parametrize(
    ("word", "says"),
    [
        (marks.PARTICLES + "5", "1 particle systems"),
        (marks.EMPTIED, "1 sources"),
        (marks.SIMPLIFIED, "1 meshes, simplified"),
        (f"{marks.COARSER}5:3:1", "1 levels of subdivision"),
    ],
)
def test_each_mark_is_called_what_it_is(scene, word, says):
    bpy.data.objects["box0"][marks.KEY] = word
    applying.recount()
    assert said(scene) == (f"Hidden from renders, by another session or file: {says}. Restore shows all", True)
    assert figures.rows_of_renders([word])
    applying.restore()


def test_an_analysis_of_a_file_that_is_culled_already(scene, analyzed, hidden):
    """By the command, or by an object that was appended: all is shown before it is looked at."""
    culled_by_someone(scene, results.at(scene))
    results.clear()
    applying.recount()
    assert said(scene) == ("Hidden from renders, by another session or file: 4 objects. Restore shows all", True)
    bpy.context.scene.lipac.distance = 1000.0
    bpy.ops.lipac.bake_shot()
    assert len(results.at(scene).culled) == 10
    assert hidden() == set()


def test_that_is_said_when_it_is_not_hidden_any_more(scene, analyzed, hidden):
    culled_by_someone(scene, results.at(scene))
    job_ = job.start(lambda: AnalysisJob(scene))
    job_.run()
    assert job_.lost
    assert job_.was_applied  # a step of undo
    assert hidden() == set()


def test_a_difference_from_a_culled_file_is_refused(analyzed):
    culled_by_someone(analyzed, results.at(analyzed))
    applying.recount()
    assert not bpy.ops.lipac.difference.poll()


def test_live_waits_for_a_culled_file(analyzed):
    culled_by_someone(analyzed, results.at(analyzed))
    applying.recount()
    live.start()
    while live.current is None or not live.current.error:
        live.tick()
    assert "Restore" in live.current.error
    live.stop()


def test_a_cancelled_analysis_leaves_a_shot_as_it_was(scene, hidden):
    scene.frame_start, scene.frame_end = 1, 3
    bpy.ops.lipac.bake_shot()
    running = job.start(lambda: AnalysisJob(scene))
    while hidden():
        running.step()
    running.cancel()
    running.run()
    assert hidden() == FAR
    assert applying.frames_of(scene) == range(1, 4)


# Several cameras


def test_several_views(analyzed, rendered, hidden):
    """One camera is analysed, so nothing is hidden from the pictures of others."""
    analyzed.lipac.use_for_renders = True
    bpy.ops.lipac.apply()
    analyzed.render.use_multiview = True
    assert rendered(1) == set()
    assert said(analyzed)[1]
    assert "Stereoscopy" in said(analyzed)[0]
    for operator in (bpy.ops.lipac.analyze, bpy.ops.lipac.bake_shot, bpy.ops.lipac.apply, bpy.ops.lipac.difference):
        assert not operator.poll()
    bpy.ops.lipac.restore()
    assert rendered(1) == set()
    assert "Stereoscopy" in said(analyzed)[0]


# Pins, the object's own state


def test_pins_on_overrides_are_saved(scene, boxes_file, tmp_path):
    with bpy.data.libraries.load(str(boxes_file), link=True) as (_, to):
        to.objects = ["box4", "box5"]
    for ob in to.objects:
        scene.collection.objects.link(ob)  # Blender 5.3 overrides only what the file uses
    for ob, role in zip(
        [ob.override_create(remap_local_usages=True) for ob in to.objects], (roles.PIN, roles.IGNORE), strict=True
    ):
        ob.lipac_role = role
    names = [ob.name for ob in scene.objects if ob.override_library]
    reopen(tmp_path / "file.blend")
    assert [bpy.data.objects[name, None].lipac_role for name in names] == [roles.PIN, roles.IGNORE]


def test_what_is_pinned_is_never_culled(scene):
    """Also where an analysis has no memory for it."""
    bpy.ops.lipac.analyze()
    from types import SimpleNamespace

    result = results.at(scene)
    n = len(result.state)
    extraction = SimpleNamespace(
        scene=SimpleNamespace(instances=SimpleNamespace(bounds=result.bounds), approximated=(), origin=result.origin)
    )
    extraction.keys, extraction.scatters, extraction.warnings = result.keys, {}, ()
    pinned = result.of_objects({bpy.data.objects["box5"]})
    stats = result.stats | {"active": 0, "culled": n}
    found = SimpleNamespace(
        state=np.zeros(n, np.uint8),
        score=result.score,
        hits=result.hits,
        boxes=result.regions,
        stats=stats,
        warnings=("it is tight",),
    )
    seen = results.FrameResult.of(1, extraction, result.uids, found, pinned)
    assert (seen.state[pinned] == results.ACTIVE).all()
    assert (seen.stats["active"], seen.stats["culled"]) == (1, n - 1)
    assert dict(figures.rows_of_object(seen, bpy.data.objects["box5"]))["This frame"] == "kept"
    assert "it is tight" in seen.warnings


def test_an_object_says_that_it_is_hidden(analyzed):
    hidden = bpy.data.objects["box5"].session_uid
    assert figures.rows_of_renders(applying.marks().get(hidden, [])) == []
    bpy.ops.lipac.apply()
    assert figures.rows_of_renders(applying.marks()[hidden]) == [("In renders", "hidden until Restore: all of it")]
    assert "rows_of_renders" in panel.__dict__


# Small


def test_freeze_does_not_outlast_its_boxes(analyzed, tmp_path):
    analyzed.lipac.freeze = True
    scene = reopen(tmp_path / "file.blend")
    assert not scene.lipac.freeze


def test_edit_mode_of_an_object_that_is_not_active(scene):
    layer = bpy.context.view_layer
    layer.objects.active = bpy.data.objects["box0"]
    bpy.ops.object.mode_set(mode="EDIT")
    assert session.is_edited()
    layer.objects.active = bpy.data.objects["Camera"]
    assert bpy.data.objects["box0"].mode == "EDIT"
    assert session.is_edited()
    layer.objects.active = bpy.data.objects["box0"]
    bpy.ops.object.mode_set(mode="OBJECT")
    assert not session.is_edited()


def test_the_renders_of_a_difference_run_no_script(boxes_file, tmp_path, monkeypatch):
    """A text that asks to be run when its file is opened."""
    bpy.ops.wm.open_mainfile(filepath=str(boxes_file))
    marker, blend, out = tmp_path / "ran", tmp_path / "file.blend", tmp_path / "out.exr"
    text = bpy.data.texts.new("evil.py")
    text.use_module = True
    text.write(f"open({str(marker)!r}, 'w').close()\n")
    bpy.context.scene.render.engine = "BLENDER_WORKBENCH"
    bpy.ops.wm.save_as_mainfile(filepath=str(blend))
    monkeypatch.setattr(bpy.context.preferences.filepaths, "use_scripts_auto_execute", True)
    bpy.ops.wm.open_mainfile(filepath=str(blend), use_scripts=True)
    assert marker.exists()  # or the next assertion says nothing
    os.remove(marker)
    bpy.context.preferences.filepaths.use_scripts_auto_execute = True
    monkeypatch.setattr(sys, "argv", ["x", "--", str(blend), "Scene", "1", str(out)])
    runpy.run_path(str(difference._CHILD))
    assert out.exists()
    assert not marker.exists()
