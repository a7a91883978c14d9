"""Culled faces: gone from renders, the others as they were, and put back exactly."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import bpy
import numpy as np
import pytest

from lipac.lipac_addon import writeback
from lipac.lipac_addon.extract.session import extract_frame
from lipac.lipac_addon.pictures import read_picture
from lipac.lipac_addon.writeback.plan import FEEDS, LINKED, SHAPES, SIMULATION

SIDE = 24


@pytest.fixture
def terrain() -> bpy.types.Object:
    """A hill of quads with UVs, two materials, a sharp edge here and there, and random colours; camera and sun."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.mesh.primitive_grid_add(x_subdivisions=SIDE, y_subdivisions=SIDE, size=4)
    ob = bpy.context.object
    mesh, rng = ob.data, np.random.default_rng(1)
    positions = np.empty(3 * len(mesh.vertices), np.float32)
    mesh.vertices.foreach_get("co", positions)
    positions[2::3] = np.sin(2 * positions[::3]) * np.cos(3 * positions[1::3]) * 0.3
    mesh.vertices.foreach_set("co", positions)
    mesh.shade_smooth()
    mesh.attributes.new("sharp_edge", "BOOLEAN", "EDGE").data.foreach_set("value", rng.random(len(mesh.edges)) < 0.1)
    colors = mesh.attributes.new("tint", "FLOAT_COLOR", "CORNER")
    colors.data.foreach_set("color", rng.random(4 * len(mesh.loops)).astype(np.float32))
    for name in "ab":
        mesh.materials.append(material(name))
    mesh.polygons.foreach_set("material_index", rng.integers(0, 2, len(mesh.polygons)).astype(np.int32))
    bpy.ops.object.camera_add(location=(0, -5, 3), rotation=(1.0, 0, 0))
    bpy.context.scene.camera = bpy.context.object
    bpy.ops.object.light_add(type="SUN", rotation=(0.8, 0.3, 0))
    bpy.context.object.data.energy = 3
    return ob


def material(name: str) -> bpy.types.Material:
    """Coloured by an attribute and the object's random number, a little glossy."""
    out = bpy.data.materials.new(name)
    out.use_nodes = True
    tree = out.node_tree
    shader = tree.nodes["Principled BSDF"]
    tint, info, mix = (
        tree.nodes.new(kind) for kind in ("ShaderNodeAttribute", "ShaderNodeObjectInfo", "ShaderNodeMixRGB")
    )
    tint.attribute_name = "tint"
    for source, target in (
        (tint.outputs["Color"], mix.inputs[1]),
        (info.outputs["Random"], mix.inputs[2]),
        (mix.outputs[0], shader.inputs["Base Color"]),
    ):
        tree.links.new(source, target)
    shader.inputs["Roughness"].default_value = 0.3
    return out


def corners(ob: bpy.types.Object) -> dict[bytes, tuple[float, ...]]:
    """Of the mesh as it renders: normal, colour, UV and material of each corner by where it and its face are."""

    class Look(bpy.types.RenderEngine):
        bl_idname, bl_label = "LIPAC_LOOK", "Look"
        found: dict[bytes, tuple[float, ...]] = {}  # noqa: RUF012

        def render(self, depsgraph: bpy.types.Depsgraph) -> None:
            mesh = ob.evaluated_get(depsgraph).data
            normals, tint, uv = mesh.corner_normals, mesh.attributes["tint"].data, mesh.uv_layers[0].uv
            for face in mesh.polygons:
                center = np.array(face.center[:], np.float32).tobytes()
                for k in face.loop_indices:
                    place = np.array(mesh.vertices[mesh.loops[k].vertex_index].co[:], np.float32).tobytes()
                    Look.found[center + place] = (
                        *normals[k].vector,
                        *tint[k].color,
                        *uv[k].vector,
                        face.material_index,
                    )

    bpy.utils.register_class(Look)
    scene = bpy.context.scene
    engine, scene.render.engine = scene.render.engine, Look.bl_idname
    try:
        bpy.ops.render.render()
    finally:
        scene.render.engine = engine
        bpy.utils.unregister_class(Look)
    return Look.found


def cut(ob: bpy.types.Object, stay: np.ndarray) -> writeback.WritebackResult:
    """Write back that only some faces, (F,) bool, of an object stay."""
    keys = extract_frame(bpy.context.scene, 1).keys
    return writeback.apply(np.zeros(len(keys.records), bool), keys, faces={ob.name: stay})


def half(ob: bpy.types.Object) -> np.ndarray:
    """(F,) bool: faces on one side, and some others."""
    centers = np.array([face.center[:] for face in ob.data.polygons])
    return np.asarray((centers[:, 0] < 0.1) | (np.random.default_rng(2).random(len(centers)) < 0.2))


def test_what_stays_is_as_it_was(terrain: bpy.types.Object) -> None:
    """Normals at the cut too, which would be those of fewer faces. Blender keeps custom normals as they are given, to
    the last bits."""
    before, stay = corners(terrain), half(terrain)
    done = cut(terrain, stay)
    assert (done.face_hosts, done.faces_removed, done.whole) == (1, int((~stay).sum()), {})
    after = corners(terrain)
    assert len(after) == 4 * stay.sum()
    assert after.keys() < before.keys()
    for key, values in after.items():
        assert values[3:] == before[key][3:]
        assert np.allclose(values[:3], before[key][:3], atol=1e-6)
    assert writeback.restore()
    assert corners(terrain) == before
    assert not terrain.modifiers and not bpy.data.node_groups and len(bpy.data.meshes) == 1


def test_behind_other_modifiers_and_by_their_numbers(terrain: bpy.types.Object) -> None:
    terrain.modifiers.new("fine", "SUBSURF").render_levels = 1
    terrain.modifiers["fine"].use_pin_to_last = True
    before = corners(terrain)
    faces = 4 * len(terrain.data.polygons)
    stay = np.arange(faces) % 3 != 0
    cut(terrain, stay)
    assert terrain.modifiers[-1].type == "NODES"
    after = corners(terrain)
    assert len(before) == 4 * faces
    assert len(after) == 4 * stay.sum()


def test_what_is_not_seen_changes_no_pixel(terrain: bpy.types.Object, tmp_path: Path) -> None:
    """Faces under a lid that nothing passes, in Cycles by the same random numbers."""
    bpy.ops.mesh.primitive_cube_add(size=1, location=(1, 0, 0), scale=(2, 4.2, 1.5))
    scene, pictures = bpy.context.scene, []
    scene.render.engine = "CYCLES"
    scene.cycles.samples, scene.cycles.use_denoising = 4, False
    scene.render.resolution_x, scene.render.resolution_y = 64, 36
    scene.render.image_settings.file_format = "OPEN_EXR"
    hidden = np.array([0.2 < face.center[0] < 1.8 and abs(face.center[1]) < 1.9 for face in terrain.data.polygons])
    for culled in (False, True):
        if culled:
            assert cut(terrain, ~hidden).faces_removed > 100
        scene.render.filepath = str(tmp_path / f"{culled}.exr")
        bpy.ops.render.render(write_still=True)
        pictures.append(read_picture(Path(scene.render.filepath)))
    assert np.array_equal(pictures[0], pictures[1])


def shrinkwrap(ob: bpy.types.Object) -> None:
    bpy.ops.mesh.primitive_cube_add()
    bpy.context.object.modifiers.new("wrap", "SHRINKWRAP").target = ob


def on_its_faces(ob: bpy.types.Object) -> None:
    tree = bpy.data.node_groups.new("scatter", "GeometryNodeTree")
    tree.nodes.new("GeometryNodeObjectInfo").inputs["Object"].default_value = ob


def collides(ob: bpy.types.Object) -> None:
    ob.modifiers.new("collision", "COLLISION")


def on_a_vertex(ob: bpy.types.Object) -> None:
    bpy.ops.mesh.primitive_cube_add()
    bpy.context.object.parent, bpy.context.object.parent_type = ob, "VERTEX"


def under_a_foot(ob: bpy.types.Object) -> None:
    bpy.ops.object.armature_add()
    bpy.context.object.pose.bones[0].constraints.new("SHRINKWRAP").target = ob


def of_a_collection(ob: bpy.types.Object) -> None:
    bpy.ops.mesh.primitive_cube_add()
    modifier = bpy.context.object.modifiers.new("without", "BOOLEAN")
    modifier.operand_type, modifier.collection = "COLLECTION", bpy.data.collections.new("others")
    modifier.collection.objects.link(ob)


@pytest.mark.parametrize(
    ("use", "why"),
    [
        (shrinkwrap, SHAPES),
        (on_its_faces, SHAPES),
        (on_a_vertex, SHAPES),
        (under_a_foot, SHAPES),
        (of_a_collection, FEEDS),
        (collides, SIMULATION),
    ],
)
def test_faces_that_something_else_needs_stay(
    terrain: bpy.types.Object, use: Callable[[bpy.types.Object], None], why: str
) -> None:
    use(terrain)
    done = cut(terrain, half(terrain))
    assert (done.face_hosts, done.whole) == (0, {why: 1})
    assert not any(m.name.startswith("LiPaC") for ob in bpy.data.objects for m in ob.modifiers)


def test_a_child_and_a_camera_that_looks_at_it_do_not_mind(terrain: bpy.types.Object) -> None:
    bpy.ops.mesh.primitive_cube_add()
    bpy.context.object.parent = terrain
    bpy.context.scene.camera.data.dof.focus_object = terrain
    assert cut(terrain, half(terrain)).face_hosts == 1


def test_linked_objects_keep_all(terrain: bpy.types.Object, tmp_path: Path) -> None:
    stay = half(terrain)
    bpy.data.libraries.write(str(tmp_path / "terrain.blend"), {terrain})
    bpy.ops.wm.read_factory_settings(use_empty=True)
    with bpy.data.libraries.load(str(tmp_path / "terrain.blend"), link=True) as (found, asked):
        asked.objects = found.objects
    ob = bpy.data.objects[terrain_name(asked.objects)]
    bpy.context.scene.collection.objects.link(ob)
    bpy.ops.object.camera_add(location=(0, -5, 3), rotation=(1.0, 0, 0))
    bpy.context.scene.camera = bpy.context.object
    keys = extract_frame(bpy.context.scene, 1).keys
    done = writeback.apply(
        np.zeros(len(keys.records), bool), keys, faces={name: stay for name in keys.names if ob.name in name}
    )
    assert (done.face_hosts, done.whole) == (0, {LINKED: 1})


def terrain_name(objects: list[bpy.types.Object]) -> str:
    return next(ob.name for ob in objects if ob is not None and ob.type == "MESH")


def test_saved_with_faces_culled_and_restored_later(terrain: bpy.types.Object, tmp_path: Path) -> None:
    cut(terrain, half(terrain))
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "culled.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "culled.blend"))
    assert writeback.restore()
    assert not any(ob.modifiers for ob in bpy.data.objects) and not bpy.data.node_groups
    assert not any(block.get("lipac") for block in (*bpy.data.objects, *bpy.data.meshes))
