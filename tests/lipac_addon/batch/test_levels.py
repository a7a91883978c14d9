"""Simplified meshes from Blender to Blender: Cycles' own pictures are within the budget, and the file is left as it
was."""

from __future__ import annotations

from pathlib import Path

import bpy
import pytest

from lipac.core.culling.options import CullOptions
from lipac.core.error_budget.budget import Budget
from lipac.core.files.report import Report, load_states
from lipac.lipac_addon.batch.job import Job
from lipac.lipac_addon.batch.pipeline import run
from lipac.lipac_addon.batch.verify import GRID

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
