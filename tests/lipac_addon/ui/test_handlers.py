"""Renders with culling on: what they show, and that all is as before when they end, in whatever way."""

import bpy
import numpy as np
import pytest

from lipac.lipac_addon.pictures import read_picture
from lipac.lipac_addon.ui import handlers
from lipac.lipac_addon.ui.state import applying, results

FAR = {"box4", "box5", "box6", "box7"}


@pytest.fixture
def seen(analyzed, hidden):
    """What is hidden during each frame that is rendered: [(frame, names)]."""
    found = []

    def note(scene, *_):
        found.append((scene.frame_current, hidden()))

    bpy.app.handlers.render_post.append(note)
    yield found
    bpy.app.handlers.render_post.remove(note)


def test_a_still(analyzed, seen, hidden, snapshot):
    bpy.ops.render.render()
    assert seen.pop() == (1, set())  # off by default
    analyzed.lipac.use_for_renders = True
    before = snapshot()
    bpy.ops.render.render()
    assert seen.pop() == (1, FAR)
    assert snapshot() == before
    assert not analyzed.lipac.in_render


def test_the_picture_is_that_of_the_culled_scene(analyzed, tmp_path):
    """The culled boxes are made the only thing in sight."""
    for name in ("wall", "box0", "box1", "box2", "box3"):
        bpy.data.objects[name].hide_render = True
    analyzed.render.image_settings.file_format = "PNG"
    pictures = []
    for on in (False, True, False):
        analyzed.lipac.use_for_renders = on
        analyzed.render.filepath = str(tmp_path / f"{len(pictures)}.png")
        bpy.ops.render.render(write_still=True)
        pictures.append(read_picture(tmp_path / f"{len(pictures)}.png"))
    np.testing.assert_array_equal(pictures[0], pictures[2])
    assert np.abs(pictures[0] - pictures[1]).max() > 0.1


def test_an_animation_culls_the_frames_that_were_analysed(analyzed, seen, hidden, tmp_path):
    analyzed.frame_start, analyzed.frame_end = 1, 3
    results.put(analyzed, {f: results.at(analyzed) for f in (1, 3)})
    analyzed.lipac.use_for_renders = True
    analyzed.render.filepath = str(tmp_path / "a")
    bpy.ops.render.render(animation=True)
    assert seen == [(1, FAR), (2, set()), (3, FAR)]
    assert hidden() == set()


def test_a_render_that_fails(analyzed, hidden):
    analyzed.lipac.use_for_renders = True
    analyzed.render.filepath = "/proc/nowhere/a.png"
    with pytest.raises(RuntimeError):
        bpy.ops.render.render(write_still=True)
    assert hidden() == set()
    handlers.before_frame(analyzed)
    assert hidden() == FAR
    handlers.after_render(analyzed)  # as render_cancel calls it
    assert hidden() == set()
    assert handlers.after_render in bpy.app.handlers.render_cancel


def test_what_is_applied_stays_so(analyzed, seen, hidden):
    analyzed.lipac.use_for_renders = True
    bpy.ops.lipac.apply()
    bpy.ops.render.render()
    assert seen == [(1, FAR)]
    assert hidden() == FAR


def test_what_is_applied_is_in_no_other_frame(analyzed, hidden, tmp_path):
    """The picture has what is hidden for the frame before, although Blender has evaluated the scene without it."""
    for name in ("wall", "box0", "box1", "box2", "box3"):
        bpy.data.objects[name].hide_render = True
    analyzed.render.image_settings.file_format = "PNG"
    pictures = []
    for on in (False, True):
        if on:
            analyzed.frame_set(1)
            bpy.ops.lipac.apply()
        analyzed.lipac.use_for_renders = on
        analyzed.frame_set(2)
        analyzed.render.filepath = str(tmp_path / f"{on}.png")
        bpy.ops.render.render(write_still=True)
        pictures.append(read_picture(tmp_path / f"{on}.png"))
    np.testing.assert_array_equal(*pictures)
    assert hidden() >= FAR


@pytest.mark.parametrize("known", [True, False])
def test_what_undo_showed_comes_back_after_a_render(analyzed, hidden, known):
    """Not what was applied after it. known: the result is still there, else nothing comes back."""
    bpy.ops.lipac.apply()
    bpy.ops.ed.undo_push(message="applied")
    analyzed.lipac.distance = 1.0
    bpy.ops.lipac.analyze()
    bpy.ops.lipac.apply()
    bpy.ops.ed.undo_push(message="applied anew")
    assert hidden() > FAR
    while hidden() != FAR:
        bpy.ops.ed.undo()
    if not known:
        applying.forget()
    scene = bpy.context.scene
    scene.lipac.use_for_renders = True
    scene.frame_set(2)
    bpy.ops.render.render()
    assert hidden() == (FAR if known else set())


def test_analysis_while_culling_for_renders_is_on(analyzed, hidden):
    analyzed.lipac.use_for_renders = True
    assert bpy.ops.lipac.analyze() == {"FINISHED"}
    assert len(results.at(analyzed).culled) == 10


@pytest.mark.parametrize("locked", [True, False])
def test_the_interface_lock_comes_back(scene, locked):
    scene.render.use_lock_interface = locked
    scene.lipac.use_for_renders = True
    assert scene.render.use_lock_interface
    scene.lipac.use_for_renders = False
    assert scene.render.use_lock_interface == locked


def test_the_lock_comes_back_when_the_switch_is_set_twice(scene):
    scene.lipac.use_for_renders = scene.lipac.use_for_renders = True
    scene.lipac.use_for_renders = False
    assert not scene.render.use_lock_interface


def test_what_stays_is_said_of_this_file_alone(analyzed, boxes_file):
    analyzed.lipac.use_for_renders = True
    applying.notes = ("3 culled instances stay in renders: they are shy",)
    bpy.ops.wm.open_mainfile(filepath=str(boxes_file))
    assert applying.notes == ()


def test_recovery_of_a_file_saved_in_a_render(analyzed, hidden, tmp_path):
    """As if Blender had ended within a render, after a save."""
    applying.apply(analyzed, results.at(analyzed), in_render=True)
    path = str(tmp_path / "crashed.blend")
    bpy.ops.wm.save_as_mainfile(filepath=path)
    bpy.ops.wm.open_mainfile(filepath=path)
    assert hidden() == set()
    assert not bpy.context.scene.lipac.in_render
    assert not any("lipac_writeback" in ob for ob in bpy.data.objects)
