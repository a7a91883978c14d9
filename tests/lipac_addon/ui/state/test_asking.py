"""Levels of detail and a limit to memory in Blender's window: what renders have is coarser and comes back exactly, what
was edited keeps its own, and what cannot fit is said with what it would take."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import bpy
import numpy as np
import pytest

from lipac.core.evaluation.judge import picture_change
from lipac.core.files.level import AnyLevel, Level, Steps
from lipac.lipac_addon.pictures import read_picture
from lipac.lipac_addon.ui import panel
from lipac.lipac_addon.ui.draw import figures, verdict
from lipac.lipac_addon.ui.jobs import background
from lipac.lipac_addon.ui.jobs.analysis import AnalysisJob
from lipac.lipac_addon.ui.jobs.background import for_thread
from lipac.lipac_addon.ui.state import applying, asking, preferences, props, results, session
from lipac.tests.lipac_addon.batch.test_levels import balls, fine  # noqa: F401

pytestmark = pytest.mark.slow
BALL, CUBE = 64 * 32, 5  # faces of the one, levels of the other


@pytest.fixture
def scene(ui: None, fine: bpy.types.Object) -> bpy.types.Scene:  # noqa: F811
    """A ball with a fine mesh, and a cube that is subdivided often, to be had coarser."""
    scene = bpy.context.scene
    scene.render.engine, scene.cycles.samples = "CYCLES", 32
    scene.cycles.use_adaptive_sampling = False
    scene.render.image_settings.file_format, scene.render.image_settings.color_depth = "OPEN_EXR", "32"
    scene.lipac.policy, scene.lipac.max_error, scene.lipac.worst_error = "light-paths", 3.0, 15.0
    scene.lipac.paths, scene.lipac.width, scene.lipac.levels = 32, 96, True
    return scene


@pytest.fixture
def analyzed(scene: bpy.types.Scene) -> results.FrameResult:
    """What an analysis of it found, with levels that do not depend on what was in the budget."""
    assert bpy.ops.lipac.analyze() == {"FINISHED"}
    found, ball = results.at(scene), bpy.data.objects["Sphere"]
    assert found is not None and found.levels and found.forms.keys() >= found.levels.keys()
    ball.data.calc_loop_triangles()
    half = list(ball.data.loop_triangles)[::2]
    corners = np.array([list(triangle.loops) for triangle in half], np.int32)
    level = Level(corners, np.array([triangle.polygon_index for triangle in half], np.int32))
    levels: dict[int, AnyLevel] = {ball.session_uid: level, bpy.data.objects["Cube"].session_uid: Steps(3)}
    results.put(scene, {1: replace(found, levels=levels, faces={})})
    result = results.at(scene)
    assert result is not None
    return result


def fineness() -> tuple[int, int]:
    """Faces of the ball, levels of the cube."""
    modifier = bpy.data.objects["Cube"].modifiers["Subdivision"]
    return len(bpy.data.objects["Sphere"].data.polygons), modifier.render_levels


COARSE = BALL - 64, CUBE - 3  # the same at the levels that were found: half of the triangles of as many quads


def test_they_go_into_renders_and_come_back(
    scene: bpy.types.Scene, analyzed: results.FrameResult, snapshot: Any, drawn: Callable[[Any], str]
) -> None:
    before = snapshot()
    assert bpy.ops.lipac.apply() == {"FINISHED"}
    assert fineness() == COARSE
    assert applying.notes == ("1 objects show a simplified mesh until Restore: edit them after that",)
    assert bpy.ops.lipac.restore() == {"FINISHED"}
    assert fineness() == (BALL, CUBE) and snapshot() == before
    meshes, less = int(analyzed.stats["levels"]), int(analyzed.stats["levels_triangles"])
    assert ("Levels of detail", f"{meshes} meshes, {less:,} triangles less") in figures.rows_of(analyzed)
    assert analyzed.taken is not None and analyzed.taken.culled < analyzed.taken.full - 100 * less
    assert "Render, predicted" in drawn(panel.LIPAC_PT_results)
    scene.lipac.levels = False
    assert bpy.ops.lipac.analyze() == {"FINISHED"}
    now = results.at(scene)
    assert now is not None and not now.levels and "levels" not in now.stats


def test_a_picture_at_its_levels_is_within_the_budget(scene: bpy.types.Scene, snapshot: Any, tmp_path: Path) -> None:
    """And each render puts all back."""
    pictures, seen = [], []
    assert bpy.ops.lipac.analyze() == {"FINISHED"}
    bpy.ops.render.render()  # the image of a render is there from then on
    before = snapshot()
    bpy.app.handlers.render_post.append(lambda *_: seen.append(fineness()))
    try:
        for on in (False, True):
            scene.lipac.use_for_renders, scene.render.filepath = on, str(tmp_path / f"{on}.exr")
            bpy.ops.render.render(write_still=True)
            pictures.append(read_picture(tmp_path / f"{on}.exr"))
            scene.lipac.use_for_renders = False
    finally:
        bpy.app.handlers.render_post.pop()
    assert seen[0] == (BALL, CUBE) and seen[1] != seen[0]
    mean, worst = picture_change(*pictures)
    assert 0 < mean <= 0.03 and worst <= 0.15
    assert snapshot() == before


def test_what_was_edited_keeps_its_own(analyzed: results.FrameResult) -> None:
    ball, modifier = bpy.data.objects["Sphere"], bpy.data.objects["Cube"].modifiers["Subdivision"]
    scene, (faces, levels) = bpy.context.scene, COARSE
    place = ball.data.vertices[7].co.copy()
    ball.data.vertices[7].co.x += 0.1
    applying.apply(scene, analyzed)
    assert fineness() == (BALL, levels)
    assert applying.notes == (f"1 objects keep their own level of detail in renders: {applying.REFORMED}",)
    applying.restore()
    ball.data.vertices[7].co = place
    modifier.render_levels = 4
    applying.apply(scene, analyzed)
    assert fineness() == (faces, 4)
    applying.restore()
    modifier.render_levels = CUBE
    modifier.levels, modifier.show_expanded = 2, False  # of the viewport
    applying.apply(scene, analyzed)
    assert fineness() == (faces, levels)
    applying.restore()
    bevel = bpy.data.objects["Cube"].modifiers.new("Bevel", "BEVEL")
    applying.apply(scene, analyzed)
    assert fineness() == (faces, CUBE)
    applying.restore()
    bpy.data.objects["Cube"].modifiers.remove(bevel)
    ball.lipac_role = "PIN"
    applying.apply(scene, analyzed)
    assert fineness() == (BALL, levels)


def test_a_file_that_is_saved_undone_and_opened(analyzed: results.FrameResult, tmp_path: Path) -> None:
    expected = COARSE
    bpy.ops.ed.undo_push(message="before")
    bpy.ops.lipac.apply("EXEC_DEFAULT", True)
    bpy.ops.ed.undo()
    assert fineness() == (BALL, CUBE)
    bpy.ops.ed.redo()
    assert fineness() == expected
    path = f"{tmp_path}/applied.blend"
    bpy.ops.wm.save_as_mainfile(filepath=path)
    bpy.ops.wm.open_mainfile(filepath=path)
    assert fineness() == expected
    assert bpy.ops.lipac.restore() == {"FINISHED"}
    assert fineness() == (BALL, CUBE)
    assert not any(mesh.name.startswith("LiPaC") for mesh in bpy.data.meshes)


def test_what_is_edited_of_a_simplified_mesh_is_not_lost(
    analyzed: results.FrameResult, capfd: pytest.CaptureFixture[str]
) -> None:
    ball = bpy.data.objects["Sphere"]
    bpy.ops.lipac.apply()
    bpy.context.view_layer.objects.active = ball
    bpy.ops.object.mode_set(mode="EDIT")
    assert not bpy.ops.lipac.restore.poll()
    assert applying.restore() and ball.mode == "EDIT"  # a render's handlers ask nobody
    bpy.ops.mesh.select_all(action="SELECT")
    bpy.ops.mesh.subdivide()
    bpy.ops.object.mode_set(mode="OBJECT")
    faces = len(ball.data.polygons)
    bpy.ops.lipac.restore()
    assert fineness() == (BALL, CUBE) and not ball.keys()
    kept = bpy.data.meshes["LiPaC edited level"]
    assert len(kept.polygons) == faces and kept.use_fake_user and not kept.keys()
    assert "LiPaC edited level" in capfd.readouterr().out


def test_a_baked_shot_has_one_level_of_each(scene: bpy.types.Scene) -> None:
    for frame, turn in ((1, 0.0), (2, 0.1)):
        scene.camera.rotation_euler.z = turn
        scene.camera.keyframe_insert("rotation_euler", frame=frame)
    scene.frame_end = 2
    job = AnalysisJob(scene, range(1, 3), bake=True)
    job.run()
    assert not job.error and job.baked is not None and job.baked[2] >= 1
    found = results.of(scene)
    uid = bpy.data.objects["Cube"].session_uid
    steps = min(level.steps for frame in found.values() if isinstance(level := frame.levels[uid], Steps))
    assert fineness()[1] == CUBE - steps
    assert all(frame.stats["certified_mean"] <= 0.03 for frame in found.values())
    scene.frame_set(2)
    assert fineness()[1] == CUBE - steps
    bpy.ops.lipac.restore()
    assert fineness() == (BALL, CUBE)


def test_the_scene_is_evaluated_at_its_frame_wherever_the_user_is(scene: bpy.types.Scene) -> None:
    """And not while Blender renders."""
    seen, at = [], []

    class Coarser:
        steps = np.ones(1, np.int64)

        def of(self, now: bpy.types.Scene) -> Coarser:
            return self

        def read(self, meshes: Any) -> str:
            at.append(scene.frame_current)
            return "read"

    scene.frame_set(9)
    frame: Any = SimpleNamespace(meshes=[], coarser=Coarser())
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(background, "replace", lambda _, **new: SimpleNamespace(**new))
        given, meshes = for_thread(frame, scene.session_uid, 3.0)
        asked: Any = given.coarser
        thread = threading.Thread(target=lambda: seen.append(asked.read([0])))
        thread.start()
        patch.setattr(session, "is_rendering", lambda: True)
        for _ in range(5):
            meshes.serve(0.01)
        assert not seen and thread.is_alive()
    while thread.is_alive():
        meshes.serve(0.01)
    assert (seen, at, scene.frame_current) == (["read"], [3], 9)


def limited(scene: bpy.types.Scene, gigabytes: float) -> AnalysisJob:
    """An analysis with a limit."""
    scene.lipac.limit_memory, scene.lipac.memory_limit = True, gigabytes
    job = AnalysisJob(scene)
    job.run()
    return job


def test_too_little_is_said_with_what_it_takes(scene: bpy.types.Scene) -> None:
    job = limited(scene, 0.2)
    assert job.error.startswith("a memory limit of 200 MB is too little: the render takes at least ")
    assert "what cannot be culled" in job.error and not results.of(scene)


def test_within_the_limit(scene: bpy.types.Scene, drawn: Callable[[Any], str]) -> None:
    job = limited(scene, 60.0)
    assert not job.error
    result = results.at(scene)
    assert result is not None and result.taken is not None
    assert result.taken.culled < result.taken.full and result.taken.most < 60e9
    assert result.stats["memory_limit_bytes"] == 60_000_000_000 and result.stats["certified_mean"] <= 0.03
    assert any(line.endswith("within the limit of 60 GB") for line in verdict.verdict(scene))
    assert "memory_limit" in drawn(panel.LIPAC_PT_main)
    object.__setattr__(result, "taken", results.Taken(70 * 10**9, 61 * 10**9, 62 * 10**9))
    result.stats["certified_mean"] = 0.2
    said = verdict.verdict(scene)
    assert "MORE than the limit of 60 GB" in said[-2] and "more than the error budget" in said[-1]


def test_less_stays_where_less_fits(scene: bpy.types.Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """More than the budget lets go, but nothing that is pinned; and where Blender has grown meanwhile, it is asked once
    more."""
    monkeypatch.setattr(asking, "_held", lambda: 500_000_000)
    scene.lipac.levels, scene.lipac.max_error, scene.lipac.worst_error = False, 0.0, 0.0
    bpy.data.objects["Plane"].lipac_role = "PIN"
    assert not limited(scene, 0.584).error
    all_of_it = results.at(scene)
    assert all_of_it is not None and all_of_it.stats["active"] == 3
    assert not limited(scene, 0.582).error
    less = results.at(scene)
    assert less is not None and less.taken is not None and less.taken.most <= 582_000_000
    assert less.stats["certified_mean"] > 0.01 > all_of_it.stats["certified_mean"]
    assert less.reason(bpy.data.objects["Plane"]).kept == 1
    held = iter([500_000_000, 510_000_000, *3 * [500_000_000]])
    monkeypatch.setattr(asking, "_held", lambda: next(held))
    assert not limited(scene, 0.584).error
    assert next(held, None) is None
    scene.lipac.limit_memory = False
    monkeypatch.setattr(asking, "_held", lambda: 10**12)  # when all has ended
    assert bpy.ops.lipac.analyze() == {"FINISHED"}
    free = results.at(scene)
    assert free is not None and free.taken is not None and 0 < free.taken.culled - 10**12 < 10**9


@pytest.mark.parametrize("role", ["PIN", "IGNORE"])
def test_what_is_marked_is_as_the_user_has_it(scene: bpy.types.Scene, role: str) -> None:
    bpy.data.objects["Sphere"].lipac_role = bpy.data.objects["Cube"].lipac_role = role
    assert bpy.ops.lipac.analyze() == {"FINISHED"}
    found = results.at(scene)
    assert found is not None and not found.levels


def test_what_does_not_go_together_is_said(scene: bpy.types.Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    scene.lipac.limit_memory = True
    assert not bpy.ops.lipac.bake_shot.poll()
    job = AnalysisJob(scene, range(1, 2), bake=True)
    job.run()
    assert job.error == asking.OF_FRAMES
    scene.render.engine = "BLENDER_EEVEE"
    assert limited(scene, 8.0).error == asking.OF_THE_CPU
    scene.lipac.limit_memory = False
    monkeypatch.setattr(preferences, "DEFAULTS", preferences.Defaults(memory=1.0))
    job = AnalysisJob(scene)
    job.run()
    assert job.error == asking.TWO_LIMITS
    scene.lipac.policy = "distance"  # which has neither
    assert not props.own_levels(scene.lipac) and not props.memory_limit(scene.lipac)


def test_a_farms_job_goes_without_and_says_so(
    scene: bpy.types.Scene, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "scene.blend"))
    assert bpy.ops.lipac.submit_shot(folder=str(tmp_path / "job")) == {"FINISHED"}
    assert "Levels of Detail" in capfd.readouterr().out
