"""Simplified meshes from Blender to Blender: Cycles' own pictures are within the budget, and the file is left as it
was."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import bpy
import numpy as np
import pytest

from lipac.core.culling.options import CullOptions, State
from lipac.core.error_budget.budget import Budget
from lipac.core.files.level import AnyLevel, Level, Steps
from lipac.core.files.report import Report, States, load_states
from lipac.lipac_addon.batch.job import SHOT, Job
from lipac.lipac_addon.batch.pipeline import run
from lipac.lipac_addon.batch.shots.shot_set import ShotSet
from lipac.lipac_addon.batch.verify import GRID
from lipac.lipac_addon.writeback import restore

OPTIONS = CullOptions(max_error=Budget(0.03, 0.15), parts=True, levels=True, paths=64)


@pytest.fixture
def balls() -> bpy.types.Object:
    """Finely divided balls with one mesh on a plate, far from the camera."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.mesh.primitive_plane_add(size=60)
    bpy.ops.mesh.primitive_uv_sphere_add(segments=64, ring_count=32, location=(-1.5, 8, 1))
    ob = bpy.context.object
    ob.data.shade_smooth()
    other = ob.copy()
    other.location.x = 1.5
    scene = bpy.context.scene
    scene.collection.objects.link(other)
    bpy.ops.object.camera_add(location=(0, -6, 2), rotation=(1.5, 0, 0))
    scene.camera = bpy.context.object
    bpy.ops.object.light_add(type="SUN", rotation=(0.9, 0.3, 0))
    bpy.context.object.data.energy = 3
    scene.world = bpy.data.worlds.new("sky")
    scene.world.color = (0.6, 0.6, 0.6)
    scene.render.resolution_x, scene.render.resolution_y = 96, 54
    scene.cycles.use_denoising = False
    return ob


def test_the_budget_holds_in_cycles(balls: bpy.types.Object, tmp_path: Path) -> None:
    report = Report("balls", "", "", "light-paths", "cycles", 0, 2)
    run(Job(tmp_path, (1,), OPTIONS, "cycles", samples=32, verify=GRID[0] * GRID[1]), report)
    frame = report.frames[0]
    assert frame["writeback"]["simplified_objects"] == 2
    assert frame["levels"] == 1
    assert frame["triangles"] < 0.67 * (2 + len(balls.data.loop_triangles))
    assert frame["verified_mean"] <= OPTIONS.max_error.mean
    assert frame["verified_worst"] <= OPTIONS.max_error.worst
    levels = load_states(tmp_path / "states" / "frame_0001.npz").levels
    assert set(levels) == {"Sphere", "Sphere.001"} and levels["Sphere"] is levels["Sphere.001"]
    rows = {(row.kind, row.name): row for row in report.memory}
    assert "by a simplified mesh" in rows["object", balls.name].why
    assert 0 < rows["mesh", balls.data.name].bvh_bytes < 0.67 * 84 * len(balls.data.loop_triangles)
    assert len(bpy.data.meshes) == 2 and not balls.keys() and not balls.data.keys()


@pytest.fixture
def fine(balls: bpy.types.Object) -> bpy.types.Object:
    """One of the balls is a cube that renders subdivide five times, nearer to the camera, with a mesh of its own."""
    bpy.data.objects.remove(bpy.data.objects["Sphere.001"])
    bpy.ops.mesh.primitive_cube_add(location=(1.5, 4, 1))
    ob = bpy.context.object
    modifier = ob.modifiers.new("Subdivision", "SUBSURF")
    modifier.levels, modifier.render_levels = 0, 5
    ob.data.shade_smooth()
    return ob


def test_fewer_levels_of_subdivision_hold_in_cycles(fine: bpy.types.Object, tmp_path: Path) -> None:
    report, modifier = Report("balls", "", "", "light-paths", "cycles", 0, 2), fine.modifiers["Subdivision"]
    options = replace(OPTIONS, parts=False)  # which would be had for about the same change
    run(Job(tmp_path, (1,), options, "cycles", samples=32, verify=GRID[0] * GRID[1]), report)
    frame = report.frames[0]
    levels = load_states(tmp_path / "states" / "frame_0001.npz").levels
    assert isinstance(levels["Cube"], Steps) and isinstance(levels["Sphere"], Level)
    assert frame["writeback"]["simplified_objects"] == frame["levels"] == 2
    left = 12 * 4 ** (5 - levels["Cube"].steps)
    assert frame["triangles"] <= 2 + left + 0.67 * len(bpy.data.objects["Sphere"].data.loop_triangles)
    assert frame["verified_mean"] <= OPTIONS.max_error.mean
    assert frame["verified_worst"] <= OPTIONS.max_error.worst
    rows = {(row.kind, row.name): row for row in report.memory}
    assert "by a simplified mesh" in rows["object", "Cube"].why
    assert rows["mesh", fine.data.name].bvh_bytes == pytest.approx(84 * left, abs=1)
    assert (modifier.levels, modifier.render_levels) == (0, 5) and not fine.keys()


def test_a_shot_has_one_level_of_each_in_all_frames(fine: bpy.types.Object, tmp_path: Path) -> None:
    """Certified in each, in the baked file too, and the open one is as it was."""
    camera, baked = bpy.context.scene.camera, tmp_path / "baked.blend"
    for frame, turn in ((1, 0.0), (2, 0.1)):
        camera.rotation_euler.z = turn
        camera.keyframe_insert("rotation_euler", frame=frame)
    report = Report("balls", "", "", "light-paths", "", 0, 2)
    run(Job(tmp_path, (1, 2), OPTIONS, bake=SHOT, save=baked), report)
    first, second = (load_states(tmp_path / "states" / f"frame_{frame:04}.npz").levels for frame in (1, 2))
    cube = first["Cube"]
    assert isinstance(cube, Steps) and cube == second["Cube"]
    assert first.keys() == second.keys()
    for entry in report.frames:
        assert entry["certified_mean"] <= OPTIONS.max_error.mean
        assert entry["certified_worst"] <= OPTIONS.max_error.worst
        assert entry["levels"] == len(first)
    assert fine.modifiers["Subdivision"].render_levels == 5 and not fine.keys()
    bpy.ops.wm.open_mainfile(filepath=str(baked))
    assert bpy.data.objects["Cube"].modifiers["Subdivision"].render_levels == 5 - cube.steps
    ball, level = bpy.data.objects["Sphere"], first.get("Sphere")
    assert len(ball.data.polygons) == (len(level.faces) if isinstance(level, Level) else 64 * 32)
    restore()
    assert bpy.data.objects["Cube"].modifiers["Subdivision"].render_levels == 5
    assert len(ball.data.polygons) == 64 * 32


def states(levels: dict[str, AnyLevel], kept: str = "ab", faces: str = "") -> States:
    """A frame of objects a and b, by names that stay."""
    state = np.array([State.ACTIVE if name in kept else State.CULLED for name in "ab"], np.uint8)
    nowhere = np.full((2, 1), -1, np.int32)
    keys: dict[str, np.ndarray] = {"kind": np.zeros(2, np.uint8), "host": nowhere[:, 0], "path": nowhere}
    keys["object"] = np.arange(2, dtype=np.int32)
    score, hits = np.zeros(2, np.float32), np.zeros((2, 5), np.int64)
    return States(state, score, hits, keys, ("a", "b"), "", dict.fromkeys(faces, np.ones(4, bool)), levels)


@pytest.mark.parametrize(
    ("frames", "left"),
    [
        ([{"a": Steps(3)}, {"a": Steps(1)}], {"a": 1}),
        ([{"a": Steps(3)}, {}, {"a": Steps(1)}], {}),
        ([{}, {"a": Steps(1)}], {}),
        ([{"a": Steps(2), "b": Steps(1)}, {"b": Steps(2)}], {"b": 1}),
    ],
)
def test_a_set_has_the_finest_level_of_its_frames(frames: list[dict[str, AnyLevel]], left: dict[str, int]) -> None:
    together, without = ShotSet(), ShotSet()
    for levels in frames:
        together.add(states(levels))
        without.add(states({}))
    assert {name: level.steps for name, level in together.levels.items() if isinstance(level, Steps)} == left
    assert (together.digest != without.digest) == bool(left)


def test_a_frame_that_does_not_show_an_object_says_nothing_of_it() -> None:
    together = ShotSet()
    for one in (states({"a": Steps(2)}, kept="a"), states({}, kept="b")):
        together.add(one)
    assert together.levels == {"a": Steps(2)}


def test_faces_of_what_has_a_level_are_not_cut() -> None:
    together = ShotSet()
    together.add(states({"a": Steps(2)}, faces="ab"))
    active, _ = together.found(together.keys)
    together.faces["a"][0] = together.faces["b"][0] = False
    assert list(together.faces_of(together.keys, active)) == [1]
