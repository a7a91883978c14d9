"""Parts of meshes from Blender to Blender: Cycles' own pictures are within the budget, and the file is left as it
was."""

from __future__ import annotations

from pathlib import Path

import bpy
import numpy as np
import pytest

from lipac.core.culling.options import CullOptions
from lipac.core.error_budget.budget import Budget
from lipac.core.files.report import Report, load_states
from lipac.lipac_addon.batch.job import FRAME, SHOT, Job
from lipac.lipac_addon.batch.pipeline import run
from lipac.lipac_addon.batch.verify import GRID

from ..hills import hills

SIDE = 120


@pytest.fixture
def terrain() -> bpy.types.Object:
    """A camera low over hills that are one mesh of quads; most of it is far, behind hills, or behind the camera."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    ob = hills(SIDE, 400)
    bpy.ops.object.camera_add(location=(0, 0, 4), rotation=(1.5, 0, 0.4))
    scene = bpy.context.scene
    scene.camera = bpy.context.object
    scene.camera.keyframe_insert("rotation_euler", frame=1)
    scene.camera.rotation_euler[2] = 0.9
    scene.camera.keyframe_insert("rotation_euler", frame=2)
    bpy.ops.object.light_add(type="SUN", rotation=(0.9, 0.3, 0))
    bpy.context.object.data.energy = 3
    scene.render.resolution_x, scene.render.resolution_y = 96, 54
    scene.cycles.use_denoising = False
    return ob


def test_the_budget_holds_in_cycles(terrain: bpy.types.Object, tmp_path: Path) -> None:
    budget = Budget(0.02, 0.1)
    report = Report("terrain", "", "", "light-paths", "cycles", 0, 2)
    run(
        Job(tmp_path, (1,), CullOptions(max_error=budget, parts=True), "cycles", samples=32, verify=GRID[0] * GRID[1]),
        report,
    )
    frame = report.frames[0]
    assert frame["writeback"]["face_hosts"] == 1
    assert frame["writeback"]["faces_removed"] > 0.5 * SIDE**2
    assert frame["verified_mean"] <= budget.mean
    assert frame["verified_worst"] <= budget.worst
    assert not terrain.modifiers
    assert len(bpy.data.meshes) == 1
    assert not bpy.data.node_groups


def test_a_shot_keeps_the_faces_of_all_its_frames(terrain: bpy.types.Object, tmp_path: Path) -> None:
    """And no more than it needs; the same by one process, and by one that does the second frame alone."""
    options, kept = CullOptions(max_error=Budget(0.02, 0.1), parts=True), {}
    for name, bake, frames in (("frames", FRAME, (1, 2)), ("shot", SHOT, (1, 2)), ("part", SHOT, (2,))):
        run(
            Job(tmp_path / name, frames, options, bake=bake, shot=(1, 2)),
            Report("terrain", "", "", "light-paths", "", 0, 2),
        )
        kept[name] = {
            frame: load_states(tmp_path / name / "states" / f"frame_{frame:04}.npz").faces["Grid"] for frame in frames
        }
    first, *others = (*kept["shot"].values(), *kept["part"].values())
    for faces in others:
        assert np.array_equal(faces, first)
    assert max(faces.sum() for faces in kept["frames"].values()) < first.sum() < first.size
