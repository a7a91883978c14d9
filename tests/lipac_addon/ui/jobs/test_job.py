"""The job beside Blender: stepped on the main thread, meshes loaded there and nowhere else, cancelled, failing, with
the file changing under it."""

import threading
import time

import bpy
import numpy as np
import pytest

from lipac.core.errors import Cancelled, InputError
from lipac.lipac_addon.ui.jobs import job
from lipac.lipac_addon.ui.jobs.analysis import AnalysisJob
from lipac.lipac_addon.ui.jobs.background import AskedMeshes
from lipac.lipac_addon.ui.state import results, session

FAR = {"box4", "box5", "box6", "box7"}


def test_light_paths_keep_what_they_meet(scene):
    scene.lipac.policy, scene.lipac.width = "light-paths", 64
    done = AnalysisJob(scene)
    said = set()
    while done.step():
        said.add(done.message)
    assert (done.error, done.progress) == ("", 1.0)
    assert len(said) > 2
    result = results.at(scene)
    for name, kept in (("box0", 1), ("wall", 1), ("box5", 0)):
        reason = result.reason(bpy.data.objects[name])
        assert (reason.instances, reason.kept) == (1, kept)
        assert bool(reason.paths.any()) == bool(kept)
    assert result.reason(scene.camera).instances == 0


def test_meshes_are_loaded_on_the_main_thread():
    class Meshes(list):
        def __getitem__(self, index):
            loaded.append(threading.current_thread())
            return super().__getitem__(index)

    loaded, got = [], []
    meshes = AskedMeshes(Meshes(["a", "b"]))
    worker = threading.Thread(target=lambda: got.extend([meshes[0], meshes[1]]))
    worker.start()
    while worker.is_alive():
        meshes.serve(0.01)
    assert got == ["a", "b"]
    assert loaded == [threading.main_thread()] * 2
    assert len(meshes) == 2


def test_a_mesh_that_fails_fails_in_the_worker():
    meshes, caught = AskedMeshes([]), []

    def ask():
        try:
            meshes[3]
        except IndexError as error:
            caught.append(error)

    worker = threading.Thread(target=ask)
    worker.start()
    while worker.is_alive():
        meshes.serve(0.01)
    assert caught
    meshes.close()
    with pytest.raises(Cancelled):
        meshes[0]


@pytest.mark.parametrize("steps", [0, 1, 3, 8])
def test_cancel_keeps_the_earlier_result(analyzed, steps):
    before = results.at(analyzed)
    analyzed.lipac.policy, analyzed.lipac.width, analyzed.lipac.paths = "light-paths", 640, 64
    running = AnalysisJob(analyzed)
    for _ in range(steps):
        assert running.step()
    running.cancel()
    running.run()
    assert "cancelled" in running.error
    assert results.at(analyzed) is before
    assert not [t for t in threading.enumerate() if t.name == "LiPaC analysis"]


def test_errors_of_input_are_one_line(scene):
    bpy.data.objects.remove(scene.camera)
    failed = AnalysisJob(scene)
    failed.run()
    assert "camera" in failed.error
    assert results.of(scene) == {}


def test_only_one_at_a_time(scene):
    first = job.start(lambda: AnalysisJob(scene))
    first.step()
    with pytest.raises(InputError, match="running"):
        job.start(lambda: AnalysisJob(scene))
    job.stop()
    assert not job.is_running()
    job.start(lambda: AnalysisJob(scene)).run()
    assert results.at(scene) is not None


def test_opening_a_file_ends_it(scene, boxes_file):
    running = job.start(lambda: AnalysisJob(scene))
    for _ in range(3):
        running.step()
    bpy.ops.wm.open_mainfile(filepath=str(boxes_file))
    assert running.done
    assert job.running is None


def test_a_scene_removed_meanwhile(scene):
    other = bpy.data.scenes.new("other")
    running = AnalysisJob(scene)
    running.step()
    bpy.context.window.scene = other
    bpy.data.scenes.remove(scene)
    running.run()
    assert "removed" in running.error


def test_frames_of_a_range(scene):
    scene.frame_start, scene.frame_end, scene.frame_step = 1, 5, 2
    scene.lipac.frames = "RANGE"
    near = bpy.data.objects["box0"]
    for frame, y in ((1, 0.0), (3, 100.0), (5, 0.0)):
        near.location.y = y
        near.keyframe_insert("location", frame=frame)
    scene.frame_set(2)
    AnalysisJob(scene).run()
    assert scene.frame_current == 2
    assert sorted(results.of(scene)) == [1, 3, 5]
    assert [results.of(scene)[f].reason(near).kept for f in (1, 3, 5)] == [1, 0, 1]
    assert results.at(scene) is None


def test_pin_of_an_object_and_of_a_collection(scene):
    bpy.data.objects["box4"].lipac_role = "PIN"
    outer, inner = bpy.data.collections.new("outer"), bpy.data.collections.new("inner")
    scene.collection.children.link(outer)
    outer.children.link(inner)
    inner.objects.link(bpy.data.objects["box5"])
    outer.lipac_role = "PIN"
    AnalysisJob(scene).run()
    result = results.at(scene)
    kept = {name: result.reason(bpy.data.objects[name]).kept for name in ("box4", "box5", "box6")}
    assert kept == {"box4": 1, "box5": 1, "box6": 0}


def test_names_that_change_and_objects_that_go(analyzed):
    result = results.at(analyzed)
    bpy.data.objects["box4"].name = "renamed"
    bpy.data.objects["box0"].name = "box4"  # one that stays takes the name of one that goes
    bpy.data.objects.remove(bpy.data.objects["box7"])
    names = result.current_keys().names
    assert "" in names
    assert bpy.ops.lipac.apply() == {"FINISHED"}
    assert {ob.name for ob in bpy.data.objects if ob.hide_render} == {"renamed", "box5", "box6"}


def test_two_scenes_have_results_of_their_own(analyzed):
    other = bpy.data.scenes.new("other")
    assert results.at(other) is None
    other.collection.objects.link(bpy.data.objects["box0"])
    other.collection.objects.link(bpy.data.objects["Camera"])
    other.camera = bpy.data.objects["Camera"]
    other.lipac.policy = "frustum"
    AnalysisJob(other).run()
    assert len(results.at(other).culled) == 1
    assert len(results.at(analyzed).culled) == 10
    np.testing.assert_array_equal(results.at(analyzed).culled.sum(), 4)


def test_where_the_user_went_meanwhile(scene):
    """The playhead goes back to where the analysis took it from, and not from where the user put it."""
    scene.frame_start, scene.frame_end, scene.lipac.frames = 1, 3, "RANGE"
    scene.frame_set(9)
    AnalysisJob(scene).run()
    assert scene.frame_current == 9
    scene.lipac.frames = "CURRENT"
    running = AnalysisJob(scene)
    while running.step() and not running.message.startswith("reading"):
        pass
    running.step()
    scene.frame_set(20)
    running.run()
    assert running.error == ""
    assert scene.frame_current == 20
    assert list(results.of(scene)) == [9]


@pytest.mark.parametrize("when", ["at its start", "at its end"])
def test_a_render_meanwhile_is_waited_out(analyzed, hidden, monkeypatch, when):
    """What it renders stays as it is, cancelled or not."""
    bpy.ops.lipac.apply()
    analyzed.lipac.distance = 1000.0
    rendering = when == "at its start"
    monkeypatch.setattr(session, "is_rendering", lambda: rendering)
    running = AnalysisJob(analyzed)
    while when == "at its end" and not running.message.startswith("reading"):
        running.step()
    running.step()
    before, rendering = hidden(), True
    assert before == (FAR if when == "at its start" else set())
    for _ in range(200):  # while it computes, and well after
        assert running.step()
        assert hidden() == before
        time.sleep(0.002)
    rendering = False
    running.run()
    assert (running.error, hidden(), analyzed.lipac.applied) == ("", set(), True)


def test_a_render_meanwhile_and_cancelled(analyzed, hidden, monkeypatch):
    bpy.ops.lipac.apply()
    rendering = False
    monkeypatch.setattr(session, "is_rendering", lambda: rendering)
    running = AnalysisJob(analyzed)
    while not running.message.startswith("reading"):
        running.step()
    rendering = True
    running.cancel()
    for _ in range(50):
        assert running.step()
        assert hidden() == set()
    rendering = False
    running.run()
    assert "cancelled" in running.error
    assert hidden() == FAR


def test_edit_mode_meanwhile_is_waited_out(scene):
    scene.frame_start, scene.frame_end, scene.lipac.frames = 1, 2, "RANGE"
    running = AnalysisJob(scene)
    while not running.message.startswith("frame 2"):
        running.step()
    bpy.context.view_layer.objects.active = bpy.data.objects["wall"]
    bpy.ops.object.mode_set(mode="EDIT")
    for _ in range(50):
        assert running.step()
    assert "Edit Mode" in running.message
    bpy.ops.object.mode_set(mode="OBJECT")
    running.run()
    assert [len(results.of(scene)[f].state) for f in (1, 2)] == [10, 10]


def test_an_error_of_the_disk_is_not_one_of_the_libraries(scene, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(AnalysisJob, "_extract", full)
    failed = AnalysisJob(scene)
    failed.run()
    assert "No space left" in failed.error
    assert "libraries" not in failed.error


@pytest.mark.parametrize("when", ["before the scene is read", "while paths are traced"])
def test_names_that_change_while_it_runs(scene, hidden, when):
    """The box that is renamed takes its state along; one of another mesh takes its name; one goes."""
    scene.lipac.policy, scene.lipac.width = "light-paths", 64
    running = job.start(lambda: AnalysisJob(scene))
    while running.step() and ("reading" if when.startswith("before") else "light paths") not in running.message:
        pass
    assert not running.done
    bpy.data.objects["box4"].name = "renamed"
    bpy.data.objects["box0"].name = "box4"
    bpy.data.objects.remove(bpy.data.objects["box6"])
    running.run()
    assert running.error == ""
    bpy.ops.lipac.apply()
    assert hidden() == {"renamed", "box5", "box7"}
    assert results.at(scene).reason(bpy.data.objects["box4"]).kept == 1


def test_undo_while_it_runs(scene, hidden):
    """All references die; what was read goes on to be traced, and a later frame is read from the new ones."""
    scene.lipac.frames, scene.frame_start, scene.frame_end = "RANGE", 1, 3
    bpy.ops.ed.undo_push(message="start")
    bpy.data.objects["box0"].location.y = 500.0
    bpy.ops.ed.undo_push(message="moved")
    running = job.start(lambda: AnalysisJob(scene))
    while running.step() and not running.message.startswith("frame 2"):
        pass
    bpy.ops.ed.undo()
    running.run()
    assert running.error == ""
    scene = bpy.context.scene
    near = bpy.data.objects["box0"]
    assert [results.of(scene)[f].reason(near).kept for f in (1, 3)] == [0, 1]


def test_local_view_hides_nothing_from_it(scene):
    """What is isolated in a viewport is no matter of renders."""
    area = next(a for a in bpy.context.screen.areas if a.type == "VIEW_3D")
    for ob in scene.objects:
        ob.select_set(ob.name == "box1")
    with bpy.context.temp_override(area=area, region=next(r for r in area.regions if r.type == "WINDOW")):
        bpy.ops.view3d.localview()
    assert area.spaces.active.local_view is not None
    AnalysisJob(scene).run()
    assert len(results.at(scene).culled) == 10


def test_a_second_view_layer_has_what_the_first_hides(scene):
    """The first that is rendered is analysed, whichever the window shows; live mode follows the window."""
    first, second = scene.view_layers[0], scene.view_layers.new("second")
    only = bpy.data.collections.new("only")
    scene.collection.children.link(only)
    only.objects.link(bpy.data.objects["box1"])
    scene.collection.objects.unlink(bpy.data.objects["box1"])
    first.layer_collection.children["only"].exclude = True
    bpy.context.window.view_layer = second
    AnalysisJob(scene).run()
    assert len(results.at(scene).culled) == 9
    first.use = False
    AnalysisJob(scene).run()
    assert len(results.at(scene).culled) == 10
