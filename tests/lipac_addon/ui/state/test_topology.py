"""Parts of large meshes in Blender's window: faces that no light path needs are gone from renders, those of a mesh that
was edited are not, and everything comes back."""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np
import pytest

from lipac.core.evaluation.judge import picture_change
from lipac.lipac_addon.pictures import read_picture
from lipac.lipac_addon.ui.draw.figures import rows_of
from lipac.lipac_addon.ui.jobs.analysis import AnalysisJob
from lipac.lipac_addon.ui.state import applying, results

from ...hills import hills as grid

pytestmark = pytest.mark.slow
SIDE = 80


@pytest.fixture
def hills(ui: None) -> bpy.types.Object:
    """A camera low over hills that are one mesh of quads, decided by light paths; most of it is far, behind hills, or
    behind the camera, which turns."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    ob = grid(SIDE, 300)
    bpy.ops.object.camera_add(location=(0, 0, 4), rotation=(1.5, 0, 0.4))
    scene = bpy.context.scene
    scene.camera = bpy.context.object
    for frame, angle in ((1, 0.4), (2, 1.2)):
        scene.camera.rotation_euler[2] = angle
        scene.camera.keyframe_insert("rotation_euler", frame=frame)
    bpy.ops.object.light_add(type="SUN", rotation=(0.9, 0.3, 0))
    bpy.context.object.data.energy = 3
    scene.render.engine, scene.cycles.samples, scene.cycles.use_denoising = "CYCLES", 4, False
    scene.render.resolution_x, scene.render.resolution_y = 64, 36
    scene.render.image_settings.file_format = "OPEN_EXR"
    scene.lipac.policy, scene.lipac.width = "light-paths", 64
    scene.lipac.max_error, scene.lipac.worst_error = 2.0, 10.0
    scene.frame_end = 2
    scene.frame_set(1)
    return ob


def analyse(frames: tuple[int, ...] | None = None, bake: bool = False) -> results.FrameResult:
    scene = bpy.context.scene
    job = AnalysisJob(scene, frames, bake=bake)
    job.run()
    assert not job.error
    return results.of(scene)[scene.frame_current]


def faces_in_render(ob: bpy.types.Object) -> int:
    """As an engine sees it."""
    found: list[int] = []

    class Count(bpy.types.RenderEngine):
        bl_idname, bl_label = "LIPAC_COUNT", "Count"

        def render(self, depsgraph: bpy.types.Depsgraph) -> None:
            found.append(len(ob.evaluated_get(depsgraph).data.polygons))

    bpy.utils.register_class(Count)
    engine, scene = bpy.context.scene.render.engine, bpy.context.scene
    try:
        scene.render.engine = Count.bl_idname
        bpy.ops.render.render()
    finally:
        scene.render.engine = engine
        bpy.utils.unregister_class(Count)
    return found[0]


def test_faces_go_from_renders_and_come_back(hills: bpy.types.Object, snapshot: Any) -> None:
    assert faces_in_render(hills) == SIDE**2
    before = snapshot()
    result = analyse()
    mask = result.faces[hills.session_uid]
    assert SIDE < mask.sum() < 0.6 * len(mask) == 0.6 * SIDE**2
    assert result.stats["parts_active"] < result.stats["parts"]
    assert ("Parts of meshes", f"{result.stats['parts_active']} of {result.stats['parts']}") in rows_of(result)
    assert bpy.ops.lipac.apply() == {"FINISHED"}
    assert faces_in_render(hills) == mask.sum()
    assert bpy.ops.lipac.restore() == {"FINISHED"}
    assert faces_in_render(hills) == SIDE**2
    assert snapshot() == before


def test_a_picture_that_culls_for_itself(hills: bpy.types.Object, snapshot: Any, tmp_path: Any) -> None:
    """Within the budget, and nothing is left of it."""
    scene, pictures, seen = bpy.context.scene, [], list[int]()
    faces_in_render(hills)  # the image of a render is there from then on
    scene.cycles.samples = 256
    analyse()
    before = snapshot()

    def note(scene: bpy.types.Scene, *_: object) -> None:
        seen.append(len(hills.evaluated_get(bpy.context.evaluated_depsgraph_get()).modifiers))

    bpy.app.handlers.render_post.append(note)
    try:
        for on in (False, True):
            scene.lipac.use_for_renders = on
            scene.render.filepath = str(tmp_path / f"{on}.exr")
            bpy.ops.render.render(write_still=True)
            pictures.append(read_picture(tmp_path / f"{on}.exr"))
    finally:
        bpy.app.handlers.render_post.remove(note)
    scene.lipac.use_for_renders = False
    assert seen == [0, 1]
    mean, worst = picture_change(*pictures)
    assert 0 < mean <= 0.02
    assert worst <= 0.1
    assert snapshot() == before


def test_a_mesh_that_was_edited_keeps_its_faces(hills: bpy.types.Object) -> None:
    """As many faces as before, numbered anew; and sculpting numbers nothing."""
    result = analyse()
    for vertex in hills.data.vertices:
        vertex.co.z += 0.1
    applying.apply(bpy.context.scene, result)
    assert faces_in_render(hills) == result.faces[hills.session_uid].sum()
    bpy.ops.lipac.restore()
    bpy.context.view_layer.objects.active = hills
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.mesh.select_all(action="SELECT")
    bpy.ops.mesh.sort_elements(type="REVERSE", elements={"FACE"})
    bpy.ops.object.mode_set(mode="OBJECT")
    applying.apply(bpy.context.scene, result)
    assert faces_in_render(hills) == SIDE**2
    assert applying.notes == (f"1 objects keep all faces in renders: {applying.RESHAPED}",)


def test_a_mesh_that_is_edited_after_it_was_applied(hills: bpy.types.Object) -> None:
    analyse()
    bpy.ops.lipac.apply()
    bpy.context.view_layer.objects.active = hills
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.mesh.select_all(action="SELECT")
    bpy.ops.mesh.subdivide()
    bpy.ops.object.mode_set(mode="OBJECT")
    assert faces_in_render(hills) == 4 * SIDE**2


def test_what_is_pinned_since_stays_whole(hills: bpy.types.Object) -> None:
    analyse()
    hills.lipac_role = "PIN"
    bpy.ops.lipac.apply()
    assert faces_in_render(hills) == SIDE**2


def test_a_baked_shot_keeps_the_faces_of_all_its_frames(hills: bpy.types.Object) -> None:
    one = analyse().faces[hills.session_uid]
    analyse((1, 2), bake=True)
    found = [results.of(bpy.context.scene)[frame] for frame in (1, 2)]
    masks = [frame.faces[hills.session_uid] for frame in found]
    assert np.array_equal(masks[0], one)
    assert not np.array_equal(masks[0], masks[1])
    assert all(frame.stats["certified_mean"] <= 0.02 for frame in found)
    assert faces_in_render(hills) == (masks[0] | masks[1]).sum() < SIDE**2


def test_frames_that_go_on_from_one_another_keep_meshes_whole(hills: bpy.types.Object) -> None:
    analyse((1, 2))
    assert not any(frame.faces for frame in results.of(bpy.context.scene).values())
