"""Meshes with fewer levels of subdivision: as Blender would render them, and the file stays as it was."""

from __future__ import annotations

import bpy
import numpy as np
import pytest

from lipac.core.scene.mesh import Mesh
from lipac.lipac_addon.coarsening import STEPS
from lipac.lipac_addon.extract import Extraction, extract_frame

from ...writeback.conftest import new_file  # noqa: F401


@pytest.fixture
def ball(new_file: bpy.types.Scene) -> bpy.types.Object:  # noqa: F811
    """A cube with UVs and two materials, of which one has an image, subdivided four times in renders, and bent."""
    bpy.ops.mesh.primitive_cube_add(location=(3, 2, 1))
    ob = bpy.context.object
    for name in "ab":
        ob.data.materials.append(bpy.data.materials.new(name))
    ob.data.polygons[0].material_index = 1
    tree = bpy.data.materials["b"].node_tree
    image = tree.nodes.new("ShaderNodeTexImage")
    image.image = bpy.data.images.new("image", 4, 4)
    tree.links.new(image.outputs[0], tree.nodes["Principled BSDF"].inputs["Base Color"])
    modifier = ob.modifiers.new("Subdivision", "SUBSURF")
    modifier.levels, modifier.render_levels = 1, 4
    ob.modifiers.new("Bend", "SIMPLE_DEFORM").angle = 0.3
    return ob


def row_of(extraction: Extraction, ob: bpy.types.Object) -> int:
    """The number of an object's mesh."""
    row = extraction.keys.records["object"] == extraction.keys.names.index(ob.name)
    return int(extraction.scene.instances.mesh[row][0])


def steps_of(ob: bpy.types.Object) -> int:
    """By how many an object can be coarser."""
    extraction = extract_frame(bpy.context.scene)
    coarser = extraction.scene.coarser
    assert coarser is not None
    return int(coarser.steps[row_of(extraction, ob)])


def same(a: Mesh, b: Mesh) -> bool:
    return all(
        np.array_equal(x, y) if x is not None and y is not None else x is y
        for x, y in zip(
            (a.positions, a.triangles, a.normals, a.uvs, a.slots),
            (b.positions, b.triangles, b.normals, b.uvs, b.slots),
            strict=True,
        )
    )


def test_steps_are_what_blender_renders_with_fewer_levels(ball: bpy.types.Object) -> None:
    extraction, modifier = extract_frame(bpy.context.scene), ball.modifiers["Subdivision"]
    number, coarser = row_of(extraction, ball), extraction.scene.coarser
    assert coarser is not None
    assert coarser.steps[number] == STEPS and coarser.steps.sum() == STEPS
    found = coarser.read([number])
    assert modifier.render_levels == 4 and list(found) == [number]
    for step, mesh in enumerate(found[number], 1):
        modifier.render_levels = 4 - step
        again = extract_frame(bpy.context.scene)
        assert same(mesh, again.scene.meshes[row_of(again, ball)])
        assert len(mesh.triangles) == 12 * 4 ** (4 - step)
        assert mesh.uvs is not None and mesh.slots is not None
    assert len(found[number]) == STEPS


def test_simplify_says_how_fine_it_is(ball: bpy.types.Object) -> None:
    render = bpy.context.scene.render
    render.use_simplify, render.simplify_subdivision_render = True, 1
    extraction = extract_frame(bpy.context.scene)
    number, coarser = row_of(extraction, ball), extraction.scene.coarser
    assert coarser is not None
    (mesh,) = coarser.read([number])[number]
    assert len(mesh.triangles) == 12
    assert ball.modifiers["Subdivision"].render_levels == 4


def test_multires(new_file: bpy.types.Scene) -> None:  # noqa: F811
    bpy.ops.mesh.primitive_cube_add()
    ob = bpy.context.object
    modifier = ob.modifiers.new("Multires", "MULTIRES")
    for _ in range(3):
        bpy.ops.object.multires_subdivide(modifier="Multires")
    assert modifier.render_levels == 3
    extraction = extract_frame(bpy.context.scene)
    number, coarser = row_of(extraction, ob), extraction.scene.coarser
    assert coarser is not None
    found = coarser.read([number])[number]
    assert [len(mesh.triangles) for mesh in found] == [12 * 16, 12 * 4, 12]
    assert modifier.render_levels == 3


def test_what_keeps_its_levels(ball: bpy.types.Object) -> None:
    modifier = ball.modifiers["Subdivision"]
    assert steps_of(ball) == STEPS
    modifier.render_levels = 0
    assert steps_of(ball) == 0
    modifier.render_levels = 2
    assert steps_of(ball) == 2
    modifier.keyframe_insert("render_levels", frame=1)
    assert steps_of(ball) == 0
    ball.animation_data_clear()
    assert steps_of(ball) == 2
    driver = modifier.driver_add("render_levels")
    driver.driver.expression = "2"
    assert steps_of(ball) == 0
    modifier.driver_remove("render_levels")
    assert steps_of(ball) == 2
    ball.modifiers.new("Hair", "PARTICLE_SYSTEM")
    assert steps_of(ball) == 0
    ball.modifiers.remove(ball.modifiers["Hair"])
    wire = bpy.data.materials["b"].node_tree.nodes.new("ShaderNodeWireframe")
    assert steps_of(ball) == 0
    bpy.data.materials["b"].node_tree.nodes.remove(wire)
    modifier.show_render = False
    assert steps_of(ball) == 0
    modifier.show_render = True
    if hasattr(modifier, "use_adaptive_subdivision"):
        modifier.use_adaptive_subdivision = True
        assert steps_of(ball) == 0
        modifier.use_adaptive_subdivision = False
    ball.visible_camera, ball.is_holdout = True, True
    assert steps_of(ball) == 0
    ball.is_holdout = False
    assert steps_of(ball) == 2


@pytest.mark.parametrize("kind", ["CURVE", "FONT"])
def test_curves_and_text(new_file: bpy.types.Scene, kind: str) -> None:  # noqa: F811
    """By half, a quarter and an eighth of their points, as Blender renders them."""
    if kind == "CURVE":
        bpy.ops.curve.primitive_bezier_circle_add()
        bpy.context.object.data.bevel_depth = 0.1
    else:
        bpy.ops.object.text_add()
        bpy.context.object.data.extrude = 0.1
    ob, data = bpy.context.object, bpy.context.object.data
    data.resolution_u = 12
    assert data.render_resolution_u == 0
    extraction = extract_frame(bpy.context.scene)
    number, coarser = row_of(extraction, ob), extraction.scene.coarser
    assert coarser is not None
    found = coarser.read([number])[number]
    assert data.render_resolution_u == 0
    sizes = [len(extraction.scene.meshes[number].triangles), *(len(mesh.triangles) for mesh in found)]
    assert len(sizes) == 4 and sizes == sorted(set(sizes), reverse=True)
    data.render_resolution_u = 6
    again = extract_frame(bpy.context.scene)
    assert same(found[0], again.scene.meshes[row_of(again, ob)])
    assert steps_of(ob) == 2
    data.keyframe_insert("render_resolution_u", frame=1)
    assert steps_of(ob) == 0
    data.animation_data_clear()
    other = ob.copy()
    bpy.context.scene.collection.objects.link(other)
    assert steps_of(ob) == 0
