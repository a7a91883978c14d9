"""What is written to the file: one set for a shot, and never by the rows of a scatter that has changed."""

import bpy
import numpy as np
import pytest

from lipac.lipac_addon.ui.jobs import job
from lipac.lipac_addon.ui.jobs.analysis import AnalysisJob
from lipac.lipac_addon.ui.state import applying, results
from lipac.tests.lipac_addon.writeback.conftest import Census, link, points, scatter, triangle

FAR = {"box4", "box5", "box6", "box7"}


def test_bake_shot_keeps_what_any_frame_needs(scene, hidden):
    scene.frame_start, scene.frame_end = 1, 3
    for name, frames in (("box4", {2}), ("box0", {1}), ("box5", set())):
        ob = bpy.data.objects[name]
        for frame in (1, 2, 3):
            ob.location.y = 0.0 if frame in frames else 500.0
            ob.keyframe_insert("location", frame=frame)
    scene.frame_set(3)
    bpy.ops.ed.undo_push(message="start")
    assert bpy.ops.lipac.bake_shot() == {"FINISHED"}
    assert scene.frame_current == 3
    assert hidden() == {"box5", "box6", "box7"}
    assert scene.lipac.applied
    assert sorted(results.of(scene)) == [1, 2, 3]
    assert job.running.baked == (7, 10, 0)
    bpy.ops.ed.undo()
    assert hidden() == set()
    bpy.ops.ed.redo()
    assert hidden() == {"box5", "box6", "box7"}
    bpy.ops.lipac.restore()
    assert hidden() == set()


def test_frames_of_a_range_go_on_from_one_another(scene):
    """What was built for a frame is there in the next: only the first reads meshes."""
    scene.lipac.policy, scene.lipac.width = "light-paths", 64
    scene.frame_start, scene.frame_end, scene.lipac.frames = 1, 3, "RANGE"
    AnalysisJob(scene).run()
    built = [results.of(scene)[f].stats["blas_built"] for f in (1, 2, 3)]
    assert built[0] > 0
    assert built[1:] == [0, 0]
    states = [results.of(scene)[f].state for f in (1, 2, 3)]
    assert all((s == states[0]).all() for s in states)


def test_a_union_finds_instances_by_who_they_are(analyzed):
    """Of frames whose instances differ in number and order, and objects that were renamed in between."""
    first = results.at(analyzed)
    near, far = bpy.data.objects["box0"], bpy.data.objects["box4"]
    near.name, far.name = "zz", "aa"
    bpy.data.objects["box1"].hide_render = True
    far.location.y = 0.0
    bpy.ops.lipac.analyze()
    both = results.union([first, results.at(analyzed)])
    assert len(both.state) == 10
    names = both.current_keys().names
    assert {names[k] for k in both.keys.records["object"][both.culled]} == FAR - {"box4"}


@pytest.fixture
def census():
    bpy.utils.register_class(Census)
    yield
    bpy.utils.unregister_class(Census)


@pytest.fixture
def meadow(scene, census):
    """A scatter of 40 triangles in two rows; a policy by distance keeps the near row. Returns the host."""
    host = link(points("host", 40), at=(-2, -2, 0))
    for k, v in enumerate(host.data.vertices):
        v.co = (0.1 * (k // 2), 30.0 * (k % 2), 0.0)
    scatter(host, link(triangle("source"), at=(0, 900, 0)))
    bpy.context.view_layer.update()
    return host


def met(scene):
    """Where a render meets instances of the scatter: (n,) y, in metres."""
    engine, scene.render.engine = scene.render.engine, Census.bl_idname
    bpy.ops.render.render()
    scene.render.engine = engine
    return np.array([i.place[7] for i in Census.met if i.host is not None and i.host.name == "host"])


def test_rows_that_are_as_they_were_are_culled(scene, meadow):
    bpy.ops.lipac.analyze()
    bpy.ops.lipac.apply()
    assert applying.notes == ()
    assert len(met(scene)) == 20
    assert met(scene).max() < 0


def reorder(host):
    """The same places, in another order."""
    places = [v.co.copy() for v in host.data.vertices]
    for v, place in zip(host.data.vertices, places[::-1], strict=True):
        v.co = place
    host.data.update()
    bpy.context.view_layer.update()


def test_a_scatter_that_changed_after_the_analysis_is_left_alone(scene, meadow):
    bpy.ops.lipac.analyze()
    reorder(meadow)
    bpy.ops.lipac.apply()
    assert applying.notes == (f"20 culled instances stay in renders: {applying.CHANGED}",)
    assert len(met(scene)) == 40
    scene.lipac.use_for_renders = True
    bpy.ops.lipac.restore()
    assert len(met(scene)) == 40  # the same while rendering
    bpy.ops.lipac.analyze()
    bpy.ops.lipac.apply()
    assert applying.notes == ()
    assert len(met(scene)) == 20


def test_a_scatter_that_changes_after_it_was_applied(scene, meadow):
    """Nobody looks any more: the mask itself finds nothing where its rows were."""
    bpy.ops.lipac.analyze()
    bpy.ops.lipac.apply()
    reorder(meadow)
    seen = met(scene)
    assert (np.sort(seen)[:20] < 0).all()  # all that is near is still there
    assert len(seen) == 40


def test_a_scatter_that_the_viewport_hides(scene, meadow):
    """No digest of it: the mask alone."""
    meadow.hide_viewport = True
    bpy.context.view_layer.update()
    bpy.ops.lipac.analyze()
    assert results.at(scene).prints == {}
    meadow.hide_viewport = False
    reorder(meadow)
    meadow.hide_viewport = True
    bpy.ops.lipac.apply()
    assert (np.sort(met(scene))[:20] < 0).all()


def test_motion_blur_looks_between_frames(scene, meadow):
    """The instances of a moving scatter are elsewhere there, so places do not count."""
    scene.render.use_motion_blur = True
    bpy.ops.lipac.analyze()
    bpy.ops.lipac.apply()
    reorder(meadow)
    assert len(met(scene)) == 20


def rise(host):
    """The scatter rises by a metre from frame 1 to frame 2."""
    host.shape_key_add(name="rest")
    key = host.shape_key_add(name="up")
    for point in key.data:
        point.co.z += 1.0
    for frame in (1, 2):
        key.value = frame - 1.0
        key.keyframe_insert("value", frame=frame)


def test_a_scatter_that_moves_is_culled_in_each_frame_where_it_is_then(scene, meadow, tmp_path):
    scene.frame_start, scene.frame_end, scene.lipac.frames = 1, 2, "RANGE"
    rise(meadow)
    bpy.ops.lipac.analyze()
    scene.lipac.use_for_renders = True
    scene.render.engine, scene.render.filepath = Census.bl_idname, str(tmp_path / "a")
    found = {}

    def note(scene, *_):
        found[scene.frame_current] = sum(i.host is not None and i.host.name == "host" for i in Census.met)

    bpy.app.handlers.render_post.append(note)
    bpy.ops.render.render(animation=True)
    bpy.app.handlers.render_post.remove(note)
    scene.render.engine = "CYCLES"
    assert found == {1: 20, 2: 20}
    scene.lipac.use_for_renders = False
    bpy.ops.lipac.apply()  # for the present frame: in another one its rows are elsewhere
    there = scene.frame_current
    assert len(met(scene)) == 20
    scene.frame_set(3 - there)
    assert len(met(scene)) == 40


def test_a_scatter_that_moves_over_the_frames_is_culled_by_a_baked_shot(scene, meadow):
    scene.frame_start, scene.frame_end = 1, 2
    rise(meadow)
    bpy.ops.lipac.bake_shot()
    for frame in (1, 2):
        scene.frame_set(frame)
        assert len(met(scene)) == 20
