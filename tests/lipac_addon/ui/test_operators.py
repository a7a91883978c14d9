"""Analyze, Apply, Restore and Mark, with undo, saving and loading."""

from types import SimpleNamespace

import bpy
import pytest

from lipac.core.errors import InputError
from lipac.lipac_addon.ui import handlers, operators
from lipac.lipac_addon.ui.jobs import engine, job, live
from lipac.lipac_addon.ui.jobs.analysis import AnalysisJob
from lipac.lipac_addon.ui.state import applying, results, session

FAR = {"box4", "box5", "box6", "box7"}


def test_apply_and_restore_are_exact(analyzed, hidden, snapshot):
    before = snapshot()
    assert bpy.ops.lipac.apply() == {"FINISHED"}
    assert hidden() == FAR
    assert analyzed.lipac.applied
    assert bpy.ops.lipac.restore() == {"FINISHED"}
    assert not analyzed.lipac.applied
    assert snapshot() == before
    assert bpy.ops.lipac.restore() == {"CANCELLED"}


def test_undo_and_redo(analyzed, hidden):
    bpy.ops.ed.undo_push(message="start")
    bpy.ops.lipac.apply("EXEC_DEFAULT", True)
    assert hidden() == FAR
    bpy.ops.ed.undo()
    assert (hidden(), bpy.context.scene.lipac.applied) == (set(), False)
    bpy.ops.ed.redo()
    assert (hidden(), bpy.context.scene.lipac.applied) == (FAR, True)
    bpy.ops.lipac.restore("EXEC_DEFAULT", True)
    assert hidden() == set()
    bpy.ops.ed.undo()
    assert hidden() == FAR
    assert bpy.ops.lipac.restore() == {"FINISHED"}
    assert hidden() == set()
    assert bpy.ops.lipac.apply() == {"FINISHED"}  # the result outlives undo
    assert hidden() == FAR


def test_save_and_load(analyzed, hidden, tmp_path):
    bpy.ops.lipac.apply()
    path = str(tmp_path / "applied.blend")
    bpy.ops.wm.save_as_mainfile(filepath=path)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.wm.open_mainfile(filepath=path)
    assert hidden() == FAR  # as it was saved
    assert bpy.context.scene.lipac.applied
    assert results.of(bpy.context.scene) == {}
    assert not bpy.ops.lipac.apply.poll()
    assert bpy.ops.lipac.restore() == {"FINISHED"}
    assert hidden() == set()


def test_analyze_sees_what_was_hidden_and_hides_anew(analyzed, hidden):
    bpy.ops.lipac.apply()
    assert bpy.ops.lipac.analyze() == {"FINISHED"}
    assert len(results.at(analyzed).culled) == 10
    assert hidden() == FAR
    analyzed.lipac.distance = 1000.0
    bpy.ops.lipac.analyze()
    assert hidden() == set()
    assert analyzed.lipac.applied


def test_ignored_and_pinned_objects_stay_as_the_user_set_them(analyzed, hidden):
    bpy.data.objects["box4"].lipac_role = "IGNORE"
    bpy.data.objects["box5"].lipac_role = "PIN"  # after the analysis
    bpy.ops.lipac.apply()
    assert hidden() == FAR - {"box4", "box5"}
    assert results.at(analyzed).reason(bpy.data.objects["box4"]).kept == 0  # the analysis still says what it would do


def test_mark_selected(scene):
    for ob in bpy.data.objects:
        ob.select_set(ob.name in FAR)
    bpy.ops.ed.undo_push(message="start")
    bpy.ops.lipac.mark("EXEC_DEFAULT", True, role="PIN")
    assert {ob.name for ob in bpy.data.objects if ob.lipac_role == "PIN"} == FAR
    bpy.ops.ed.undo()
    assert not [ob for ob in bpy.data.objects if ob.lipac_role == "PIN"]
    for ob in bpy.context.selected_objects:
        ob.select_set(False)
    assert not bpy.ops.lipac.mark.poll()


def test_linked_objects_and_overrides(scene, boxes_file, hidden):
    with bpy.data.libraries.load(str(boxes_file), link=True) as (_, to):
        to.objects = ["box4", "box5"]
    for ob in to.objects:
        scene.collection.objects.link(ob)  # Blender 5.3 overrides only what the file uses
    linked, override = to.objects[0], to.objects[1].override_create(remap_local_usages=True)
    override.lipac_role = "PIN"
    assert bpy.ops.lipac.analyze() == {"FINISHED"}
    result = results.at(scene)
    assert [result.reason(ob).kept for ob in (linked, override, bpy.data.objects["box4", None])] == [0, 1, 0]
    for ob in bpy.data.objects:
        ob.select_set(ob in {linked, override}) if ob.name in bpy.context.view_layer.objects else None
    bpy.ops.lipac.apply()
    assert not linked.hide_render  # which Blender would not save
    assert any("linked" in line for line in applying.notes)
    assert not override.hide_render
    bpy.ops.lipac.restore()
    scene.lipac.use_for_renders = True
    handlers.before_frame(scene)
    assert linked.hide_render
    handlers.after_render(scene)
    assert not linked.hide_render


def test_polls(scene, monkeypatch):
    assert bpy.ops.lipac.analyze.poll()
    assert not bpy.ops.lipac.apply.poll()
    job.start(lambda: AnalysisJob(scene)).step()
    assert not any(op.poll() for op in (bpy.ops.lipac.analyze, bpy.ops.lipac.apply, bpy.ops.lipac.restore))
    assert bpy.ops.lipac.cancel.poll()
    job.stop()
    assert not bpy.ops.lipac.cancel.poll()
    assert bpy.ops.lipac.restore.poll()
    monkeypatch.setattr(engine, "missing", lambda: ("numba",))
    assert not bpy.ops.lipac.analyze.poll()
    monkeypatch.undo()
    scene.camera = None
    assert not bpy.ops.lipac.analyze.poll()


def refusal(operator):
    """What the tooltip of an operator that cannot run says."""
    with pytest.raises(RuntimeError) as error:
        operator()
    return str(error.value)


def test_why_an_operator_cannot_run(scene, boxes_file, monkeypatch):
    lipac = bpy.ops.lipac
    assert "Analyze this frame first" in refusal(lipac.apply)
    assert "Analyze this frame first" in refusal(lipac.difference)
    lipac.analyze()
    job.start(lambda: AnalysisJob(scene)).step()
    for operator in (lipac.analyze, lipac.bake_shot, lipac.apply, lipac.restore, lipac.difference, lipac.clear_cache):
        assert operators.BUSY in refusal(operator)
    job.stop()
    lipac.apply()
    assert "Restore first" in refusal(lipac.difference)
    for ob in bpy.context.selected_objects:
        ob.select_set(False)
    assert "Select objects" in refusal(lipac.mark)
    camera, scene.camera = scene.camera, None
    assert "no active camera" in refusal(lipac.analyze)
    scene.camera = camera
    monkeypatch.setattr(session, "is_rendering", lambda: True)
    for operator in (lipac.apply, lipac.restore):
        assert "render is running" in refusal(operator)
    monkeypatch.setattr(engine, "missing", lambda: ("numba",))
    for operator in (lipac.analyze, lipac.live):
        assert "missing: numba" in refusal(operator)
    monkeypatch.undo()
    with bpy.data.libraries.load(str(boxes_file), link=True) as (_, to):
        to.scenes = ["Scene"]
    other = bpy.data.scenes.new("other")
    other.camera = camera
    bpy.context.window.scene = other
    assert "another scene" in refusal(lipac.analyze)  # of which culling is applied
    lipac.restore()
    assert lipac.analyze.poll()
    bpy.context.window.scene = to.scenes[0]
    assert "linked" in refusal(lipac.analyze)


def test_edit_mode_is_left_first(scene):
    """Blender gives out no faces of a mesh that is edited: the wall would be missing."""
    bpy.context.view_layer.objects.active = bpy.data.objects["wall"]
    bpy.ops.object.mode_set(mode="EDIT")
    assert "Edit Mode" in refusal(bpy.ops.lipac.analyze)
    with pytest.raises(InputError, match="Edit Mode"):
        AnalysisJob(scene)
    bpy.ops.object.mode_set(mode="OBJECT")
    assert bpy.ops.lipac.analyze() == {"FINISHED"}


class Modal:
    """The modal operator without an event loop: its methods on a plain object."""

    modal, finish = operators.LIPAC_OT_analyze.modal, operators.LIPAC_OT_analyze.finish
    needs_undo_step, success_message = (
        operators.LIPAC_OT_analyze.needs_undo_step,
        operators.LIPAC_OT_analyze.success_message,
    )
    bl_label = operators.LIPAC_OT_analyze.bl_label

    def __init__(self, scene):
        self.job, self.timer, self.heard = job.start(lambda: AnalysisJob(scene)), None, []
        manager = SimpleNamespace(event_timer_remove=lambda timer: self.heard.append("timer removed"))
        self.context = SimpleNamespace(window_manager=manager, scene=scene)

    def report(self, kind, text):
        self.heard.append(text)

    def event(self, kind, value="PRESS"):
        return self.modal(self.context, SimpleNamespace(type=kind, value=value))

    def until_done(self):
        while (answer := self.event("TIMER")) == {"PASS_THROUGH"}:
            pass
        return answer


def test_modal_runs_to_its_end(scene):
    modal = Modal(scene)
    assert modal.event("MOUSEMOVE") == {"PASS_THROUGH"}  # the viewport stays usable
    assert modal.until_done() == {"FINISHED"}
    assert modal.heard == ["timer removed", "The picture needs 6 of 10 instances"]


def test_modal_cancel(scene):
    scene.lipac.policy, scene.lipac.width, scene.lipac.paths = "light-paths", 640, 64
    modal = Modal(scene)
    assert modal.event("TIMER") == {"PASS_THROUGH"}
    assert modal.event("ESC") == {"PASS_THROUGH"}  # meant for something else
    assert not modal.job.cancelled
    assert bpy.ops.lipac.cancel() == {"FINISHED"}
    assert modal.until_done() == {"CANCELLED"}
    assert modal.heard == ["timer removed", "the analysis was cancelled"]
    assert results.of(scene) == {}


def test_modal_ends_when_a_file_is_opened(scene, boxes_file):
    modal = Modal(scene)
    modal.event("TIMER")
    bpy.ops.wm.open_mainfile(filepath=str(boxes_file))
    assert modal.event("TIMER") == {"CANCELLED"}


def test_what_was_hidden_and_is_not_any_more_is_said(analyzed, boxes_file, hidden, tmp_path):
    """Saved with culling applied, opened again: nothing is known that a cancelled analysis could apply again."""
    bpy.ops.lipac.apply()
    path = str(tmp_path / "applied.blend")
    bpy.ops.wm.save_as_mainfile(filepath=path)
    bpy.ops.wm.open_mainfile(filepath=path)
    modal = Modal(bpy.context.scene)
    while not modal.job.message.startswith("reading"):
        modal.event("TIMER")
    bpy.ops.lipac.cancel()
    assert modal.until_done() == {"CANCELLED"}
    assert hidden() == set()
    assert "Nothing is hidden from renders any more" in modal.heard[-1]
    bpy.ops.wm.open_mainfile(filepath=path)
    # not the current one
    bpy.context.scene.lipac.frames, bpy.context.scene.frame_start, bpy.context.scene.frame_end = "RANGE", 5, 6
    modal = Modal(bpy.context.scene)
    assert modal.until_done() == {"FINISHED"}
    assert hidden() == set()
    assert "Nothing is hidden from renders any more" in modal.heard[-1]
    bpy.context.scene.lipac.frames = "CURRENT"
    bpy.ops.lipac.analyze()
    bpy.ops.lipac.apply()
    again = Modal(bpy.context.scene)
    again.job.cancel()
    again.until_done()
    assert hidden() == FAR
    assert again.heard[-1] == "the analysis was cancelled"


@pytest.mark.parametrize("operator", ["restore", "analyze"])
def test_what_comes_back_from_a_library_is_said(operator, analyzed, hidden, tmp_path):
    """Blender saves nothing that is set on linked objects."""
    bpy.ops.lipac.apply()
    library, host = str(tmp_path / "library.blend"), str(tmp_path / "host.blend")
    bpy.ops.wm.save_as_mainfile(filepath=library)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    with bpy.data.libraries.load(library, link=True) as (found, wanted):
        wanted.objects = found.objects
    scene = bpy.context.scene
    for ob in wanted.objects:
        scene.collection.objects.link(ob)
    scene.camera = next(ob for ob in scene.objects if ob.type == "CAMERA")
    bpy.ops.wm.save_as_mainfile(filepath=host)
    bpy.ops.wm.open_mainfile(filepath=host)
    scene = bpy.context.scene
    scene.lipac.policy, scene.lipac.distance = "distance", 1000.0
    assert getattr(bpy.ops.lipac, operator)() == {"FINISHED"}
    assert hidden() == set()
    line, alert = applying.status(scene)
    assert alert
    assert "Until this file is opened again" in line
    assert "library.blend" in line
    bpy.ops.wm.open_mainfile(filepath=host)
    assert hidden() == FAR
    assert "Until" not in applying.status(bpy.context.scene)[0]


@pytest.mark.parametrize("wreck", [ImportError("numba"), OSError("libembree4.so")])
def test_a_broken_library_is_one_line(scene, monkeypatch, wreck):
    def broken():
        raise wreck

    monkeypatch.setattr(engine, "_import", broken)
    with pytest.raises(RuntimeError, match="made for this platform"):
        bpy.ops.lipac.analyze()


def test_an_error_of_ours_leaves_no_timer(scene, monkeypatch):
    def broken():
        raise ZeroDivisionError

    monkeypatch.setattr(engine, "_import", broken)
    modal = Modal(scene)
    with pytest.raises(ZeroDivisionError):
        modal.until_done()
    assert modal.heard == ["timer removed"]
    assert not job.is_running()
    assert "console" in modal.job.error


def test_what_live_switches_on_can_be_undone(scene):
    bpy.ops.ed.undo_push(message="start")
    assert bpy.ops.lipac.live("EXEC_DEFAULT", True) == {"FINISHED"}
    try:
        assert scene.lipac.show_overlay
        bpy.ops.ed.undo()
        assert not bpy.context.scene.lipac.show_overlay
        assert live.is_on()
    finally:
        live.stop()
