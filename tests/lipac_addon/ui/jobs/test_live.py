"""Live mode, tick by tick, without an event loop: it follows what the user does, and survives it."""

import subprocess
import sys
import threading
import time

import bpy
import numpy as np
import pytest

from lipac.lipac_addon import roles
from lipac.lipac_addon.ui.draw import overlay
from lipac.lipac_addon.ui.jobs import job, live
from lipac.lipac_addon.ui.jobs.analysis import AnalysisJob
from lipac.lipac_addon.ui.state import results
from lipac.tests.lipac_addon.writeback.conftest import link, points, scatter, triangle

FAR = {"box4", "box5", "box6", "box7"}


@pytest.fixture
def watched(scene):
    """Live mode over the scene, with a policy that is quick; the scene."""
    live.start()
    yield scene
    live.stop()


def settle(limit=10_000):
    """Tick until there is nothing to do; returns how many ticks brought something new."""
    new = 0
    for _ in range(limit):
        before = live.current and (live.current.rounds, live.current.error)
        live.tick()
        new += before != (live.current.rounds, live.current.error)
        if live.current.resting or live.current.closed:
            return new
        time.sleep(0.002)
    raise AssertionError(f"no rest: {live.current.message} {live.current.error}")


def kept():
    result = results.live[live.current.uid]
    return {ob.name for ob in bpy.data.objects if ob.type == "MESH" and result.reason(ob).kept}


def edit(change):
    """An edit, and what Blender does after it."""
    change()
    bpy.context.view_layer.update()


def test_it_finds_what_analyze_finds(watched):
    assert settle() > 0
    bpy.ops.lipac.analyze()
    analysed, seen = results.at(watched), results.live[live.current.uid]
    assert not seen.culled.all()
    for ob in bpy.data.objects:
        assert analysed.reason(ob).kept == seen.reason(ob).kept, ob.name


def test_light_paths_keep_what_they_meet(watched):
    watched.lipac.policy, watched.lipac.width = "light-paths", 64
    settle()
    assert {"box0", "wall", "Plane"} <= kept()
    assert not kept() & FAR
    assert (results.live[live.current.uid].state != results.PENDING).all()


def test_it_follows_edits_and_rests(watched):
    settle()
    assert settle() == 0  # nothing changed: nothing is done
    near, far = bpy.data.objects["box0"], bpy.data.objects["box5"]
    edit(lambda: setattr(far, "location", (0, 0, 0.5)))
    settle()
    assert "box5" in kept()
    edit(lambda: setattr(near, "location", (0, 500, 0)))
    settle()
    assert "box0" not in kept()
    edit(lambda: bpy.data.objects.remove(near))
    settle()
    assert len(results.live[live.current.uid].state) == 9
    edit(lambda: link(triangle("new"), at=(0, 0, 2)))
    settle()
    assert "new" in kept()
    edit(lambda: setattr(bpy.data.objects["new"], "name", "other"))
    settle()
    assert "other" in kept()


def test_playback(watched):
    near = bpy.data.objects["box0"]
    for frame, y in ((1, 0.0), (2, 500.0), (3, 0.0)):
        near.location.y = y
        near.keyframe_insert("location", frame=frame)
    for frame, there in ((1, True), (2, False), (3, True)):
        watched.frame_set(frame)
        settle()
        assert (results.live[live.current.uid].frame, "box0" in kept()) == (frame, there)
    assert results.at(watched) is None  # nothing is analysed by it


def test_pins_and_options(watched):
    settle()
    bpy.data.objects["box4"].lipac_role = roles.PIN
    settle()
    assert "box4" in kept()
    watched.lipac.distance = 1000.0
    settle()
    assert kept() >= FAR


def test_what_renders_hide_is_not_there(watched):
    hidden = bpy.data.collections.new("hidden")
    watched.collection.children.link(hidden)
    edit(
        lambda: (
            hidden.objects.link(bpy.data.objects["box1"]),
            watched.collection.objects.unlink(bpy.data.objects["box1"]),
        )
    )
    hidden.hide_render = bpy.data.objects["box0"].hide_render = True
    edit(lambda: bpy.data.objects["box2"].hide_set(True))
    settle()
    assert not {"box0", "box1", "box2"} & kept()
    assert len(results.live[live.current.uid].state) == 7


def test_undo_and_redo(watched):
    settle()
    bpy.ops.ed.undo_push(message="start")
    edit(lambda: setattr(bpy.data.objects["box0"], "location", (0, 500, 0)))
    bpy.ops.ed.undo_push(message="moved")
    settle()
    assert "box0" not in kept()
    for step, there in ((bpy.ops.ed.undo, True), (bpy.ops.ed.redo, False), (bpy.ops.ed.undo, True)):
        live.tick()
        step()
        live.tick()
        bpy.context.view_layer.update()
        settle()
        assert ("box0" in kept()) == there


def test_undo_in_the_midst_of_a_round(watched):
    watched.lipac.policy, watched.lipac.width = "light-paths", 240
    for n in range(12):
        bpy.ops.ed.undo_push(message="start")
        # has to be read and built
        edit(lambda: bpy.ops.mesh.primitive_uv_sphere_add(segments=64, ring_count=32, location=(0, 0, 2)))
        bpy.ops.ed.undo_push(message="added")
        for _ in range(n):
            live.tick()
        bpy.ops.ed.undo()
        bpy.context.view_layer.update()
    settle()
    assert {"box0", "wall", "Plane"} <= kept()


def test_another_file_and_another_scene(watched, boxes_file):
    for _ in range(3):
        live.tick()
    bpy.ops.wm.open_mainfile(filepath=str(boxes_file))
    assert live.current is None  # let go of
    assert live.is_on()
    settle()  # goes on with the new file
    assert live.current.uid == bpy.context.scene.session_uid
    other = bpy.data.scenes.new("other")
    bpy.context.window.scene = other
    settle()
    assert "camera" in live.current.error
    assert results.shown(other) is None
    other.collection.objects.link(bpy.data.objects["box0"])
    other.collection.objects.link(bpy.data.objects["Camera"])
    edit(lambda: setattr(other, "camera", bpy.data.objects["Camera"]))
    settle()
    assert live.current.error == ""
    assert len(results.shown(other).state) == 1
    bpy.data.scenes.remove(other)
    settle()


def test_it_follows_the_view_layer_of_the_window(watched):
    settle()
    second = watched.view_layers.new("second")
    second.objects.active = None
    bpy.data.objects["box1"].hide_set(True, view_layer=second)
    assert len(results.live[live.current.uid].state) == 10
    bpy.context.window.view_layer = second
    settle()
    assert live.current.layer == "second"
    assert len(results.live[live.current.uid].state) == 9


def test_no_camera_and_nothing_to_render_are_waited_out(watched):
    settle()
    camera = watched.camera
    edit(lambda: setattr(watched, "camera", None))
    settle()
    assert "camera" in live.current.error
    assert results.live == {}
    edit(lambda: setattr(watched, "camera", camera))
    settle()
    assert live.current.error == ""
    assert "box0" in kept()


def test_a_render_in_the_midst_of_it(watched, hidden):
    bpy.ops.lipac.analyze()
    watched.lipac.use_for_renders = True
    for n in range(4):
        edit(lambda: setattr(bpy.data.objects["box0"], "location", (0, 0, 0.5 + 0.1 * n)))  # noqa: B023
        for _ in range(n):
            live.tick()
        bpy.ops.render.render()
        assert hidden() == set()
    settle()
    assert len(results.live[live.current.uid].state) == 10


def test_edit_mode_is_waited_out(watched):
    settle()
    seen = results.live[live.current.uid]
    bpy.context.view_layer.objects.active = bpy.data.objects["wall"]
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.mesh.select_all(action="SELECT")
    bpy.ops.transform.translate(value=(0, -4, 0))
    for _ in range(50):
        live.tick()
    assert results.live[live.current.uid] is seen
    bpy.ops.object.mode_set(mode="OBJECT")
    bpy.context.view_layer.update()
    settle()
    assert results.live[live.current.uid] is not seen
    assert "wall" in kept()


def test_edit_mode_that_is_overlooked_is_waited_out_too(watched, monkeypatch):
    """Blender gives out no positions of what is edited, nor of what another object makes of it."""
    monkeypatch.setattr(live.session, "is_edited", lambda: False)
    wall, host = bpy.data.objects["wall"], link(points("host", 8), at=(0, -2, 0))
    wall.modifiers.new("bevel", "BEVEL")
    scatter(host, wall)
    host.modifiers[0].node_group.nodes["Object Info"].inputs["As Instance"].default_value = False
    wall.hide_render = True
    edit(lambda: None)
    settle()
    seen = kept()
    bpy.context.view_layer.objects.active = wall
    edit(lambda: bpy.ops.object.mode_set(mode="EDIT"))
    settle()
    assert "'host' shows a mesh that is in Edit Mode" in live.current.error
    edit(lambda: bpy.ops.object.mode_set(mode="OBJECT"))
    settle()
    assert (live.current.error, kept()) == ("", seen)


@pytest.mark.parametrize("kind", ["hair_curves", "pointclouds", "meshes"])
def test_what_has_no_points_comes_and_goes(watched, kind):
    """Curves, points and meshes that are added empty, or emptied."""
    settle()
    seen = kept()
    ob = bpy.data.objects.new("nothing", getattr(bpy.data, kind).new("nothing"))
    edit(lambda: link(ob))
    settle()
    assert (live.current.error, kept()) == ("", seen)
    ob.modifiers.new("nodes", "NODES").node_group = bpy.data.node_groups.new("nothing", "GeometryNodeTree")
    edit(bpy.data.objects["box0"].data.clear_geometry)
    settle()
    assert (live.current.error, "box0" in kept()) == ("", False)


def test_a_scatter_that_changes(watched):
    """Rows come and go, and their source."""
    source = link(triangle("source"), at=(0, 9, 0))
    host = link(points("host", 12, faces=True), at=(0, -2, 0))
    scatter(host, source)
    edit(lambda: None)
    settle()
    count = len(results.live[live.current.uid].state)
    edit(lambda: setattr(host.modifiers[0], "show_viewport", False))
    settle()
    assert len(results.live[live.current.uid].state) == count - 12
    edit(lambda: setattr(host.modifiers[0], "show_viewport", True))
    settle()
    for ob in bpy.context.view_layer.objects:
        ob.select_set(ob == source)
    edit(bpy.ops.object.delete)  # it goes, what nodes make of it stays
    settle()
    assert len(results.live[live.current.uid].state) == count - 1


def test_analyze_while_live(watched):
    running = job.start(lambda: AnalysisJob(watched))
    running.step()
    settled = live.current
    live.tick()
    assert live.is_busy()
    running.run()
    settle()
    assert results.at(watched) is not None
    assert settled is None or settled is live.current


def test_the_overlay_follows_and_freezes(watched):
    settle()
    first = overlay.source(watched)
    assert first is results.live[live.current.uid]
    watched.lipac.freeze = True
    edit(lambda: setattr(bpy.data.objects["box0"], "location", (0, 500, 0)))
    settle()
    assert overlay.source(watched) is first
    watched.lipac.freeze = False
    assert overlay.source(watched) is results.live[live.current.uid] is not first


def test_a_world_that_is_rendered(watched):
    tree = watched.world.node_tree
    sky = tree.nodes.new("ShaderNodeTexGradient")
    tree.links.new(sky.outputs[0], tree.nodes["Background"].inputs["Color"])
    edit(lambda: None)
    settle()
    world = live.current._world.world
    assert world.world.image is not None
    edit(lambda: setattr(bpy.data.objects["box0"], "location", (0, 1, 0.5)))
    settle()
    assert live.current._world.world is world  # rendered once
    edit(lambda: setattr(tree.nodes["Background"].inputs["Strength"], "default_value", 2.0))
    settle()
    np.testing.assert_allclose(live.current._world.world.world.image.mean(), 2 * world.world.image.mean(), rtol=0.05)


def test_the_operator_switches_it(scene):
    assert bpy.ops.lipac.live() == {"FINISHED"}
    assert live.is_on()
    assert bpy.app.timers.is_registered(live.tick)
    settle()
    assert bpy.ops.lipac.live() == {"FINISHED"}
    assert live.current is None
    assert results.live == {}
    assert not bpy.app.timers.is_registered(live.tick)
    assert not [t for t in threading.enumerate() if t.name == "LiPaC analysis"]


def fail(monkeypatch):
    """Let live mode run into an error of ours."""

    def broken(*_):
        raise ZeroDivisionError

    monkeypatch.setattr(live.Live, "_read", broken)
    with pytest.raises(ZeroDivisionError):
        settle()


def test_a_failure_is_said_once(watched, monkeypatch):
    fail(monkeypatch)
    assert "console" in live.current.error
    live.tick()
    assert live.current.closed


def test_after_a_failure_it_is_off_and_can_be_switched_on(watched, monkeypatch):
    """Blender does not call a timer again that has failed, so it must not look as if live mode went on."""
    fail(monkeypatch)
    assert not live.is_on()
    assert "console" in live.current.error  # still to be read
    monkeypatch.undo()
    assert bpy.ops.lipac.live() == {"FINISHED"}
    assert live.is_on()
    settle()
    assert live.current.error == ""
    assert "box0" in kept()


def test_while_culling_is_applied_it_waits(watched, analyzed):
    settle()
    bpy.ops.lipac.apply()
    edit(lambda: None)
    settle()
    assert "Restore" in live.current.error
    bpy.ops.lipac.restore()
    edit(lambda: None)
    settle()
    assert live.current.error == ""
    assert len(results.live[live.current.uid].state) == 10


def test_quitting_in_the_midst_of_a_round(boxes_file):
    code = f"""
import bpy, lipac, time
lipac.register()
bpy.ops.wm.open_mainfile(filepath={str(boxes_file)!r})
from lipac.lipac_addon.ui.jobs import live
live.start()
while live.current is None or live.current.rounds < 2:
    live.tick()
    time.sleep(0.002)
bpy.context.scene.lipac.width = 640
while live.current._steps.gi_yieldfrom is None:
    live.tick()
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=600)
    assert (done.returncode, done.stderr.count("Error: ") <= 1) == (0, True), done.stderr
