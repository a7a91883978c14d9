"""Hair, curves and points as faces."""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np
import pytest

from lipac.core.scene.mesh import Mesh
from lipac.lipac_addon.extract import extract_frame
from lipac.lipac_addon.extract.geometry import fibres
from lipac.lipac_addon.extract.geometry.fibres import Fibres, joined, octahedra, ribbons

from ..conftest import add, cube

DIRECTIONS = np.random.default_rng(1).normal(size=(400, 3))
DIRECTIONS /= np.linalg.norm(DIRECTIONS, axis=1, keepdims=True)


def covered(what: Fibres) -> float:
    """Mean area of its triangles' silhouettes, each for itself, over directions."""
    a, b, c = what.positions[what.triangles].transpose(1, 0, 2).astype(np.float64)
    return float(np.abs(np.cross(b - a, c - a) @ DIRECTIONS.T).sum(axis=0).mean()) / 2


def lines(count: int, steps: int, radius: float) -> tuple[Any, Any, Any]:
    """Straight strands of a metre in all directions."""
    rng = np.random.default_rng(2)
    way = rng.normal(size=(count, 1, 3))
    way /= np.linalg.norm(way, axis=2, keepdims=True)
    points = rng.uniform(-1, 1, (count, 1, 3)) + way * np.linspace(0, 1, steps)[None, :, None]
    return points.reshape(-1, 3).astype(np.float32), np.full(count * steps, radius, np.float32), np.full(count, steps)


@pytest.mark.parametrize("most", [200_000, 600])
def test_ribbons_cover_what_strands_cover(most: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """A cylinder's silhouette is its diameter times its length, times pi / 4 over directions; of fewer strands, too."""
    monkeypatch.setattr(fibres, "MOST", most)
    found = ribbons(*lines(400, 4, 0.01), slot=2)
    assert found is not None
    np.testing.assert_allclose(covered(found), 400 * 0.02 * np.pi / 4, rtol=0.02)
    strands = 400 if most > 1600 else 150
    assert (len(found.triangles), set(found.slots.tolist())) == (6 * strands, {2})
    assert len(found.positions) == len(found.normals) == 8 * strands


@pytest.mark.parametrize("most", [200_000, 100])
def test_octahedra_cover_what_balls_cover(most: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Half of the triangles of a closed surface lie behind the others."""
    monkeypatch.setattr(fibres, "MOST", most)
    found = octahedra(np.zeros((300, 3), np.float32), np.full(300, 0.5, np.float32))
    assert found is not None
    np.testing.assert_allclose(covered(found) / 2, 300 * np.pi / 4, rtol=0.02)
    normal = np.cross(*np.diff(found.positions[found.triangles], axis=1).transpose(1, 0, 2))
    assert ((normal * found.positions[found.triangles].mean(axis=1)).sum(axis=1) > 0).all()


def test_broken_strands_are_left_out() -> None:
    """Those with a place that is not finite, or with a single point; where none is left there are none."""
    points, radius, count = lines(4, 3, 0.1)
    points[4] = np.nan
    count = np.array([3, 3, 1, 2, 3])
    found = ribbons(points, radius, count)
    assert found is not None
    assert np.isfinite(found.positions).all()
    assert len(found.triangles) == 2 * (2 + 1 + 2)
    assert ribbons(points[3:6], radius[3:6], np.array([3])) is None
    assert octahedra(points[4:5], radius[:1]) is None


def test_behind_a_mesh() -> None:
    """Behind its triangles, with its attributes, in its place."""
    found = joined(
        (ribbons(*lines(2, 2, 0.1), slot=3), None, octahedra(np.ones((1, 3), np.float32), np.ones(1, np.float32)))
    )
    assert found is not None
    mesh = Mesh(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.uint32), uvs=np.ones((2, 1, 3, 2), np.float32))
    out = found.behind(mesh, np.array([1.0, 0, 0]), ("", "other"))
    assert out.uvs is not None
    assert out.slots is not None
    assert (len(out.triangles), out.uvs.shape, out.slots.tolist()) == (13, (2, 13, 3, 2), [0, *4 * [3], *8 * [0]])
    np.testing.assert_allclose(
        out.positions[out.triangles[1:]], found.positions[found.triangles] - (1, 0, 0), atol=1e-6
    )


def grown(**settings: Any) -> Any:
    """A cube with hair of 2 m in its second material, scaled and moved."""
    ob = add("grown", cube("grown"), location=(5, 0, 0), rotation=(0, 0, 0.5))
    ob.scale = (0.5, 0.5, 0.5)
    for name in ("skin", "hair"):
        ob.data.materials.append(bpy.data.materials.new(name))
    system = ob.modifiers.new("hair", "PARTICLE_SYSTEM").particle_system.settings
    values = {"type": "HAIR", "count": 50, "hair_length": 2.0, "material": 2, "root_radius": 2.0, "radius_scale": 0.1}
    for name, value in (values | settings).items():
        setattr(system, name, value)
    return ob


@pytest.mark.parametrize("children", [0, 3])
def test_hair_of_particles(children: int) -> None:
    """Strands with their material where they are rendered, in the box and in the mesh; thick at the root, thin at the
    tip."""
    grown(**({"child_type": "SIMPLE", "rendered_child_count": children} if children else {}))
    extraction = extract_frame(bpy.context.scene)
    scene = extraction.scene
    assert scene.approximated == ("object grown: hair strands rendered as faces",)
    mesh = scene.meshes[0]
    assert mesh.slots is not None
    strands = 50 * (children or 1)
    assert (np.bincount(mesh.slots).tolist(), len(scene.slot_materials)) == ([12, 2 * 8 * strands], 2)
    box = scene.mesh_bounds[0]
    np.testing.assert_allclose(box, [mesh.positions.min(axis=0), mesh.positions.max(axis=0)], atol=1e-5)
    np.testing.assert_allclose(box[1].max(), 5, atol=0.1)  # a metre of the cube, two of the world
    root, tip = (mesh.positions[8:].reshape(strands, 9, 2, 3)[:, k] for k in (0, -1))
    np.testing.assert_allclose(np.linalg.norm(root[:, 0] - root[:, 1], axis=1), 0.2 * np.pi / 2, rtol=1e-3)
    np.testing.assert_allclose(np.linalg.norm(tip[:, 0] - tip[:, 1], axis=1), 0, atol=1e-5)


def test_hair_that_is_not_rendered_is_not_there() -> None:
    """With a modifier that is off in renders; and as paths of an emitter that is hidden, which is said."""
    ob = grown()
    ob.modifiers[0].show_render = False
    assert len(extract_frame(bpy.context.scene).scene.meshes[0].triangles) == 12
    ob.modifiers[0].show_render = True
    ob.show_instancer_for_render = False
    add("other", cube("other"))
    assert "object grown: hair strands not rendered" in extract_frame(bpy.context.scene).scene.approximated


def test_curves_and_points_are_instances_like_others() -> None:
    """Objects of hair curves, and points that nodes make of meshes, with their own materials. Curves that nodes make of
    meshes are not rendered."""
    data = bpy.data.hair_curves.new("curves")
    data.add_curves([4, 4])
    data.attributes["position"].data.foreach_set("vector", np.linspace(0, 1, 24).astype(np.float32))
    data.materials.append(bpy.data.materials.new("fur"))
    ob = bpy.data.objects.new("curves", data)
    bpy.context.scene.collection.objects.link(ob)
    host = add("host", cube("host"))
    group = bpy.data.node_groups.new("points", "GeometryNodeTree")
    group.interface.new_socket("Geometry", in_out="INPUT", socket_type="NodeSocketGeometry")
    group.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    made, join = group.nodes.new("GeometryNodeMeshToPoints"), group.nodes.new("GeometryNodeJoinGeometry")
    curves = group.nodes.new("GeometryNodeCurvePrimitiveCircle")
    source, out = group.nodes.new("NodeGroupInput"), group.nodes.new("NodeGroupOutput")
    group.links.new(source.outputs[0], made.inputs[0])
    for node in (source, made, curves):
        group.links.new(node.outputs[0], join.inputs[0])
    group.links.new(join.outputs[0], out.inputs[0])
    host.modifiers.new("nodes", "NODES").node_group = group
    extraction = extract_frame(bpy.context.scene)
    scene = extraction.scene
    triangles = {
        extraction.keys.names[ob]: len(scene.meshes[mesh].triangles)
        for ob, mesh in zip(extraction.keys.records["object"], scene.instances.mesh, strict=True)
    }
    assert triangles == {"curves": 12, "host": 12 + 8 * 8}
    assert sorted(scene.approximated) == [
        "object curves: curves (hair) rendered as faces",
        "object host: point cloud rendered as faces",
    ]


@pytest.mark.parametrize("kind", ["hair_curves", "pointclouds", "meshes"])
def test_what_has_no_points_shows_nothing(kind: str) -> None:
    """An object of curves, points or a mesh without any, as Blender adds it."""
    data = getattr(bpy.data, kind).new("nothing")
    bpy.context.scene.collection.objects.link(bpy.data.objects.new("nothing", data))
    add("other", cube("other"))
    assert [len(mesh.triangles) for mesh in extract_frame(bpy.context.scene).scene.meshes] == [12]


def test_hair_of_what_is_nowhere_is_left_out_with_it() -> None:
    """A transform that is not finite: the object is left out, and that is said."""
    ob = grown()
    ob.location.x = float("nan")
    add("other", cube("other"))
    extraction = extract_frame(bpy.context.scene)
    assert len(extraction.scene.instances) == 1
    assert any("grown" in line and "left out" in line for line in extraction.warnings)


def test_a_layer_without_hair_has_none() -> None:
    """Neither strands of particles nor curves."""
    grown()
    data = bpy.data.hair_curves.new("curves")
    data.add_curves([4])
    data.attributes["position"].data.foreach_set("vector", np.linspace(0, 1, 12).astype(np.float32))
    bpy.context.scene.collection.objects.link(bpy.data.objects.new("curves", data))
    assert [len(mesh.triangles) > 12 for mesh in extract_frame(bpy.context.scene).scene.meshes] == [True, False]
    bpy.context.scene.view_layers[0].use_strand = False
    assert [len(mesh.triangles) for mesh in extract_frame(bpy.context.scene).scene.meshes] == [12]


def glowing_by(name: str, kind: str = "Attribute") -> Any:
    """A material that shows an attribute, or what an image has at a UV map."""
    out = bpy.data.materials.new("glow")
    tree = out.node_tree
    tree.nodes.clear()
    node, emission = tree.nodes.new(f"ShaderNode{kind}"), tree.nodes.new("ShaderNodeEmission")
    if kind == "Attribute":
        node.attribute_name = name
    else:
        node.image = bpy.data.images.new("halves", 2, 1, float_buffer=True)
        node.image.pixels.foreach_set(np.array([1, 0, 0, 1, 0, 0, 1, 1], np.float32))
        node.interpolation = "Closest"
    tree.links.new(node.outputs["Color"], emission.inputs["Color"])
    tree.links.new(emission.outputs[0], tree.nodes.new("ShaderNodeOutputMaterial").inputs[0])
    return out


def colors_shown(mesh: Mesh, scene: Any) -> Any:
    """(T, 3) of what triangles show by the only texture that there is."""
    (record,) = scene.textures.records
    size = int(record["width"]), int(record["height"])
    first = int(record["offset"])
    pixels = scene.textures.floats[first : first + 4 * size[0] * size[1]].reshape(size[1], size[0], 4)
    assert mesh.uvs is not None
    u, v = (mesh.uvs[record["uv_map"], :, 0] % 1).T
    return pixels[(v * size[1]).astype(int), (u * size[0]).astype(int), :3]


def test_points_and_strands_show_their_attributes() -> None:
    """Each point its own, each control point, or one of a curve; sparks are as bright as that says."""
    if "resize" not in bpy.types.PointCloud.bl_rna.functions:
        pytest.skip("Blender 5.1 and later can make points by a script")
    cloud = bpy.data.pointclouds.new("cloud")
    cloud.resize(3)
    values = np.array([[0.0, 0.0, 0.0, 1], [4.0, 0.5, 0.0625, 1], [1024.0, 0.0, 1.0, 1]], np.float32)
    cloud.attributes.new("heat", "FLOAT_COLOR", "POINT").data.foreach_set("color", values.ravel())
    cloud.materials.append(glowing_by("heat"))
    bpy.context.scene.collection.objects.link(bpy.data.objects.new("cloud", cloud))
    curves = bpy.data.hair_curves.new("curves")
    curves.add_curves([3, 3])
    curves.attributes["position"].data.foreach_set("vector", np.linspace(0, 1, 18).astype(np.float32))
    curves.attributes.new("heat", "FLOAT", "CURVE").data.foreach_set("value", np.array([2.0, 8.0], np.float32))
    curves.materials.append(cloud.materials[0])
    bpy.context.scene.collection.objects.link(bpy.data.objects.new("curves", curves))
    scene = extract_frame(bpy.context.scene).scene
    balls, ribbon = sorted((scene.meshes[m] for m in range(2)), key=lambda mesh: -len(mesh.triangles))
    np.testing.assert_allclose(colors_shown(balls, scene), np.repeat(values[:, :3], 8, axis=0), rtol=0.2)
    np.testing.assert_allclose(colors_shown(ribbon, scene)[:, 0], [2, 2, 8, 8] * 2, rtol=0.2)


def test_hair_shows_what_is_at_its_roots() -> None:
    """An image by the UVs of what it grows on, for parents and for children."""
    ob = grown(child_type="SIMPLE", rendered_child_count=3, roughness_1=0.0)
    by_image = glowing_by("", "TexImage")
    for slot in ob.material_slots:
        slot.material = by_image
    layer = ob.data.uv_layers.new(name="UVMap")
    high = [ob.data.vertices[loop.vertex_index].co.z > 0 for loop in ob.data.loops]
    layer.uv.foreach_set("vector", np.array([(0.25 + 0.5 * top, 0.5) for top in high], np.float32).ravel())
    scene = extract_frame(bpy.context.scene).scene
    mesh = scene.meshes[0]
    shown = colors_shown(mesh, scene)[12:].reshape(2, -1, 8, 3)  # halves of segments; strands, their segments
    assert (shown == shown[:, :, :1]).all()
    blue, root = shown[0, :, 0, 2], mesh.positions[8:].reshape(len(shown[0]), 9, 2, 3)[:, 0].mean(axis=1)
    assert 0.2 < blue.mean() < 0.8
    assert (blue[root[:, 2] > 0.9] == 1).all()
    assert (blue[root[:, 2] < -0.9] == 0).all()
