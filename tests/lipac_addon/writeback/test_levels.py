"""Simplified meshes: what they show is of the whole ones, corner for corner; and put back exactly."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import bmesh
import bpy
import numpy as np
import pytest

from lipac.core.culling.levels.stand_ins import stand_ins
from lipac.core.files.level import AnyLevel, Level, Steps
from lipac.lipac_addon import writeback
from lipac.lipac_addon.extract.geometry.meshes import corners_of, faces_of
from lipac.lipac_addon.extract.session import extract_frame
from lipac.lipac_addon.keys import full_name
from lipac.lipac_addon.writeback import marks
from lipac.lipac_addon.writeback.plan import DRIVES, LINKED, SHAPES

from .conftest import link, linked

ERROR = 0.02


@pytest.fixture
def ball(new_file: bpy.types.Scene) -> bpy.types.Object:
    """A smooth ball with UVs, two materials, colours of corners, numbers of points and flags of faces."""
    bpy.ops.mesh.primitive_uv_sphere_add(segments=48, ring_count=24)
    ob = bpy.context.object
    mesh, rng = ob.data, np.random.default_rng(2)
    mesh.shade_smooth()
    for name, kind, domain, width, value in (
        ("tint", "FLOAT_COLOR", "CORNER", 4, "color"),
        ("weight", "FLOAT", "POINT", 1, "value"),
        ("number", "INT", "FACE", 1, "value"),
    ):
        attribute = mesh.attributes.new(name, kind, domain)
        values = rng.integers(0, 100, len(attribute.data) * width).astype(np.float32 if kind != "INT" else np.int32)
        attribute.data.foreach_set(value, values)
    for name in "ab":
        mesh.materials.append(bpy.data.materials.new(name))
    index = np.zeros(len(mesh.polygons), np.int32)
    index[: len(index) // 2] = 1
    mesh.polygons.foreach_set("material_index", index)
    bpy.ops.object.camera_add(location=(0, -5, 0), rotation=(np.pi / 2, 0, 0))
    bpy.context.scene.camera = bpy.context.object
    return ob


def level_of(ob: bpy.types.Object) -> Level:
    """A level of an object's mesh as it is in a render."""
    extraction = extract_frame(bpy.context.scene)
    row = extraction.keys.names.index(ob.name)
    number = int(extraction.scene.instances.mesh[extraction.keys.records["object"] == row][0])
    (found,) = stand_ins(extraction.scene.meshes[number], [ERROR])
    mesh = extraction.scene.meshes.sources[number].geometry.mesh  # type: ignore[attr-defined]
    assert 100 < len(found) < 0.5 * len(extraction.scene.meshes[number].triangles)
    return Level(corners_of(mesh).reshape(-1)[found.corners], faces_of(mesh)[found.triangles])


def apply(levels: Mapping[str, AnyLevel], **more: object) -> writeback.WritebackResult:
    """Exchange meshes, cull nothing."""
    keys = extract_frame(bpy.context.scene).keys
    return writeback.apply(np.zeros(len(keys.records), bool), keys, levels=levels, **more)  # type: ignore[arg-type]


def values(mesh: bpy.types.Mesh, name: str, width: int, value: str = "value") -> np.ndarray:
    """(n, width) of an attribute."""
    data = mesh.attributes[name].data
    out = np.empty(len(data) * width, np.int32 if name == "number" else np.float32)
    data.foreach_get(value, out)
    return out.reshape(-1, width)


def normals(mesh: bpy.types.Mesh) -> np.ndarray:
    """(C, 3) of corners."""
    return np.array([normal.vector[:] for normal in mesh.corner_normals], np.float32)


def test_all_that_corners_bear_is_theirs(ball: bpy.types.Object, snapshot: Callable[[], dict]) -> None:
    whole, level = ball.data, level_of(ball)
    before, flat = snapshot(), level.corners.reshape(-1)
    assert apply({ball.name: level}).simplified == 1
    mesh = ball.data
    assert mesh != whole and len(mesh.polygons) == len(level.faces)
    assert not mesh.validate()
    of = np.array([loop.vertex_index for loop in whole.loops])[flat]
    now = np.array([loop.vertex_index for loop in mesh.loops])
    assert np.array_equal(values(mesh, "position", 3, "vector")[now], values(whole, "position", 3, "vector")[of])
    assert np.array_equal(values(mesh, "weight", 1)[now], values(whole, "weight", 1)[of])
    assert np.array_equal(values(mesh, "tint", 4, "color"), values(whole, "tint", 4, "color")[flat])
    assert np.array_equal(values(mesh, "number", 1), values(whole, "number", 1)[level.faces])
    assert np.array_equal(values(mesh, "UVMap", 2, "vector"), values(whole, "UVMap", 2, "vector")[flat])
    assert [p.material_index for p in mesh.polygons] == [whole.polygons[n].material_index for n in level.faces.tolist()]
    assert np.array_equal(normals(mesh), normals(whole)[flat])
    assert tuple(mesh.texspace_size) == tuple(whole.texspace_size)
    assert [m.name for m in mesh.materials] == ["a", "b"]
    writeback.restore()
    assert ball.data == whole
    assert snapshot() == before
    assert [m.name for m in bpy.data.meshes] == [whole.name]


def test_what_an_armature_deforms_is_deformed_as_before(ball: bpy.types.Object, snapshot: Callable[[], dict]) -> None:
    bpy.ops.object.armature_add()
    armature = bpy.context.object
    group = ball.vertex_groups.new(name="Bone")
    for vertex in ball.data.vertices:
        group.add([vertex.index], max(0.0, vertex.co.z), "REPLACE")
    ball.modifiers.new("Armature", "ARMATURE").object = armature
    armature.pose.bones["Bone"].location = (0.3, 0.2, 0.5)
    bpy.context.view_layer.update()
    level, whole = level_of(ball), ball.data

    def deformed() -> tuple[np.ndarray, np.ndarray]:
        mesh = ball.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
        corners = np.array([loop.vertex_index for loop in mesh.loops])
        return values(mesh, "position", 3, "vector")[corners], normals(mesh)

    (positions, directions), before = deformed(), snapshot()
    flat = level.corners.reshape(-1)
    assert apply({ball.name: level}).simplified == 1
    assert [g.name for g in ball.vertex_groups] == ["Bone"]
    now, turned = deformed()
    assert np.array_equal(now, positions[flat])
    assert np.median(np.abs(turned - directions[flat])) < 0.05
    writeback.restore()
    assert np.array_equal(deformed()[0], positions)
    assert ball.data == whole and snapshot() == before


def test_objects_with_one_mesh_get_one_level_or_none(ball: bpy.types.Object) -> None:
    other = ball.copy()
    bpy.context.scene.collection.objects.link(other)
    level = level_of(ball)
    assert apply({ball.name: level, other.name: level}).simplified == 2
    assert ball.data == other.data
    writeback.restore()
    user = bpy.data.objects.new("user", bpy.data.meshes.new("user"))
    bpy.context.scene.collection.objects.link(user)
    user.modifiers.new("Shrinkwrap", "SHRINKWRAP").target = other
    result = apply({ball.name: level, other.name: level})
    assert result.simplified == 0 and result.whole == {SHAPES: 2}
    assert ball.data == other.data and ball.data.name == "Sphere"


def test_a_saved_file_has_it_and_gives_it_back(ball: bpy.types.Object, tmp_path: Path) -> None:
    level, name = level_of(ball), ball.data.name
    apply({ball.name: level}, lasting=True)
    path = f"{tmp_path}/baked.blend"
    bpy.ops.wm.save_as_mainfile(filepath=path)
    bpy.ops.wm.open_mainfile(filepath=path)
    ob = bpy.data.objects["Sphere"]
    assert len(ob.data.polygons) == len(level.faces)
    assert writeback.restore()
    assert ob.data.name == name and len(bpy.data.meshes) == 1 and not ob.keys()


def test_what_the_user_set_meanwhile_stays(ball: bpy.types.Object) -> None:
    apply({ball.name: level_of(ball)})
    own = bpy.data.meshes.new("own")
    ball.data = own
    writeback.restore()
    assert ball.data == own
    assert not any(m.name.startswith("LiPaC") for m in bpy.data.meshes)


def test_linked_objects_keep_theirs(ball: bpy.types.Object, tmp_path: Path) -> None:
    level = level_of(ball)
    other, _ = linked(tmp_path, ball.name, bpy.context.scene.camera.name)
    result = apply({full_name(other): level})
    assert result.simplified == 0
    assert result.whole == {LINKED: 1}


def marked(ob: bpy.types.Object) -> bool:
    """Whether the mesh of an object may be exchanged, as the extraction sees it."""
    extraction = extract_frame(bpy.context.scene)
    scene, records = extraction.scene, extraction.keys.records
    number = scene.instances.mesh[records["object"] == extraction.keys.names.index(ob.name)][0]
    assert scene.simplifiable is not None
    return bool(scene.simplifiable[number])


def test_what_looks_at_its_mesh_stays_whole(ball: bpy.types.Object) -> None:
    assert marked(ball)
    modifier = ball.modifiers.new("Solidify", "SOLIDIFY")
    assert not marked(ball)
    modifier.show_render = False
    assert marked(ball)
    ball.modifiers.clear()
    ball.shape_key_add()
    assert not marked(ball)
    ball.shape_key_clear()
    assert marked(ball)
    material = bpy.data.materials["b"]
    material.use_nodes = True
    tree = material.node_tree
    wire = tree.nodes.new("ShaderNodeWireframe")
    assert not marked(ball)
    tree.nodes.remove(wire)
    tree.nodes["Principled BSDF"].inputs["Subsurface Weight"].default_value = 0.5
    assert not marked(ball)
    tree.nodes["Principled BSDF"].inputs["Subsurface Weight"].default_value = 0.0
    assert marked(ball)
    other = ball.copy()
    other.modifiers.new("Solidify", "SOLIDIFY")
    bpy.context.scene.collection.objects.link(other)
    assert marked(ball) and not marked(other)


@pytest.fixture
def fine(new_file: bpy.types.Scene) -> bpy.types.Object:
    """A cube that renders subdivide four times, behind another modifier, and before a third."""
    ob = link(bpy.data.objects.new("Fine", bpy.data.meshes.new("Fine")))
    bm = bmesh.new()
    bmesh.ops.create_cube(bm)
    bm.to_mesh(ob.data)
    bm.free()
    ob.modifiers.new("Bevel", "BEVEL")
    modifier = ob.modifiers.new("Subdivision", "SUBSURF")
    modifier.levels, modifier.render_levels = 1, 4
    ob.modifiers.new("Bend", "SIMPLE_DEFORM")
    bpy.context.view_layer.update()
    return ob


def test_fewer_levels_are_put_back(fine: bpy.types.Object, snapshot: Callable[[], dict]) -> None:
    before, modifier = snapshot(), fine.modifiers["Subdivision"]
    assert apply({"Fine": Steps(2)}).simplified == 1
    assert (modifier.levels, modifier.render_levels) == (1, 2)
    assert apply({"Fine": Steps(3)}).simplified == 1  # of what it was
    assert modifier.render_levels == 1
    writeback.restore()
    assert snapshot() == before and modifier.render_levels == 4


def test_a_saved_file_has_fewer_levels_and_gives_them_back(fine: bpy.types.Object, tmp_path: Path) -> None:
    apply({"Fine": Steps(1)}, lasting=True)
    fine.name, fine.modifiers["Subdivision"].name = "Renamed", "Smooth"
    path = f"{tmp_path}/baked.blend"
    bpy.ops.wm.save_as_mainfile(filepath=path)
    bpy.ops.wm.open_mainfile(filepath=path)
    ob = bpy.data.objects["Renamed"]
    assert ob.modifiers["Smooth"].render_levels == 3
    assert writeback.restore()
    assert ob.modifiers["Smooth"].render_levels == 4 and not ob.keys()


def test_levels_that_the_user_set_meanwhile_stay(fine: bpy.types.Object) -> None:
    apply({"Fine": Steps(2)})
    fine.modifiers["Subdivision"].render_levels = 5
    writeback.restore()
    assert fine.modifiers["Subdivision"].render_levels == 5 and not fine.keys()


@pytest.mark.parametrize("word", ["", "x", "1", "1:2", "1:4:9999", "-1:4:2", "1:4:2:1", "99:1:4"])
def test_marks_that_fit_nothing_do_nothing(fine: bpy.types.Object, word: str) -> None:
    number = fine.modifiers["Subdivision"].persistent_uid
    fine[marks.KEY] = marks.COARSER + word.replace("1:", f"{number}:", 1)
    writeback.restore()
    assert fine.modifiers["Subdivision"].render_levels == 4


def test_levels_that_something_else_looks_at_stay(fine: bpy.types.Object) -> None:
    modifier = fine.modifiers["Subdivision"]
    user = link(bpy.data.objects.new("user", bpy.data.meshes.new("user")))
    user.modifiers.new("Shrinkwrap", "SHRINKWRAP").target = fine
    assert apply({"Fine": Steps(1)}).whole == {SHAPES: 1}
    user.modifiers.clear()
    modifier.keyframe_insert("render_levels", frame=1)
    assert apply({"Fine": Steps(1)}).whole == {LINKED: 1}
    fine.animation_data_clear()
    curve = user.driver_add("location", 0)
    variable = curve.driver.variables.new()
    variable.targets[0].id = fine
    variable.targets[0].data_path = 'modifiers["Subdivision"].render_levels'
    assert apply({"Fine": Steps(1)}).whole == {DRIVES: 1}
    user.driver_remove("location", 0)
    assert apply({"Fine": Steps(1)}).simplified == 1
    assert modifier.render_levels == 3


def test_linked_objects_keep_their_levels(fine: bpy.types.Object, tmp_path: Path) -> None:
    other, _ = linked(tmp_path, "Fine", bpy.context.scene.camera.name)
    assert apply({full_name(other): Steps(1)}).whole == {LINKED: 1}
    assert other.modifiers["Subdivision"].render_levels == 4


def test_the_resolution_of_a_curve_is_put_back(
    new_file: bpy.types.Scene, snapshot: Callable[[], dict], tmp_path: Path
) -> None:
    bpy.ops.curve.primitive_bezier_circle_add()
    ob = bpy.context.object
    ob.name, ob.data.bevel_depth = "Ring", 0.1
    bpy.context.view_layer.update()
    before = snapshot()
    assert apply({"Ring": Steps(2)}).simplified == 1
    assert (ob.data.resolution_u, ob.data.render_resolution_u) == (12, 3)
    writeback.restore()
    assert snapshot() == before and ob.data.render_resolution_u == 0
    apply({"Ring": Steps(1)})
    bpy.ops.wm.save_as_mainfile(filepath=f"{tmp_path}/ring.blend")
    bpy.ops.wm.open_mainfile(filepath=f"{tmp_path}/ring.blend")
    ob = bpy.data.objects["Ring"]
    assert ob.data.render_resolution_u == 6
    writeback.restore()
    assert ob.data.render_resolution_u == 0 and not ob.keys()
