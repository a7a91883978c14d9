"""Triangles as they are read on demand."""

from __future__ import annotations

import gc
import sys
from typing import Any

import bpy
import numpy as np
import pytest

from lipac.core.errors import InputError
from lipac.lipac_addon.extract import extract_frame, with_render_depsgraph
from lipac.lipac_addon.extract.geometry import meshes
from lipac.lipac_addon.extract.geometry.meshes import read

from ..conftest import add, cube, wedge


def test_normals_slots_and_uvs() -> None:
    """Flat meshes have no normals, smooth ones one per vertex, and one per corner where edges are sharp; slots and UVs
    follow their triangles; UVs only where a texture needs them."""
    mesh = cube()
    plain, textured = (bpy.data.materials.new(n) for n in ("plain", "textured"))
    tree = textured.node_tree
    image = tree.nodes.new("ShaderNodeTexImage")
    image.image = bpy.data.images.new("i", 2, 2)
    place = tree.nodes.new("ShaderNodeUVMap")
    place.uv_map = "second"
    tree.links.new(place.outputs[0], image.inputs[0])
    tree.links.new(image.outputs[0], next(n for n in tree.nodes if n.type == "BSDF_PRINCIPLED").inputs["Base Color"])
    mesh.materials.append(plain)
    mesh.materials.append(textured)
    mesh.polygons[3].material_index = 1
    first, second = mesh.uv_layers.new(name="first"), mesh.uv_layers.new(name="second")
    uv = np.random.default_rng(0).random((24, 2)).astype(np.float32)
    first.uv.foreach_set("vector", np.zeros(48, np.float32))
    second.uv.foreach_set("vector", uv.ravel())
    add("cube", mesh)
    smooth, sharp = wedge(), wedge()
    for tetrahedron in (smooth, sharp):
        tetrahedron.polygons.foreach_set("use_smooth", [True] * 4)
        tetrahedron.update()
    add("wedge", smooth)
    sharp.attributes.new("sharp_edge", "BOOLEAN", "EDGE").data.foreach_set("value", [e < 4 for e in range(6)])
    add("sharp", sharp)
    extraction = extract_frame(bpy.context.scene)
    scene = extraction.scene
    names = [extraction.keys.names[k] for k in extraction.keys.records["object"]]
    box, tetra, edged = (scene.meshes[scene.instances.mesh[names.index(n)]] for n in ("cube", "wedge", "sharp"))
    assert scene.uv_maps == ("", "second")
    assert box.normals is None
    assert box.slots is not None and box.uvs is not None
    assert box.slots.tolist().count(1) == 2
    of_slot = box.triangles[box.slots == 1].astype(int)
    assert set(of_slot.ravel()) == set(mesh.polygons[3].vertices)
    loops = {mesh.loops[i].vertex_index: i for i in mesh.polygons[3].loop_indices}
    np.testing.assert_array_equal(box.uvs[1][box.slots == 1], uv[[[loops[v] for v in t] for t in of_slot]])
    assert not box.uvs[0].any()
    assert tetra.uvs is None
    assert tetra.normals is not None
    np.testing.assert_allclose(np.linalg.norm(tetra.normals, axis=1), 1, atol=1e-6)
    corners = np.array([tuple(t.loops) for t in smooth.loop_triangles])
    of_blender = np.array([n.vector for n in smooth.corner_normals])[corners]
    np.testing.assert_allclose(tetra.normals[tetra.triangles], of_blender, atol=5e-4)  # Blender rounds its own
    assert edged.normals is not None
    np.testing.assert_array_equal(edged.normals, np.array([n.vector for n in sharp.corner_normals])[corners])
    assert (edged.normals != tetra.normals[tetra.triangles]).any()


@pytest.mark.parametrize("most", [3, 4])
def test_small_faces_are_cut_and_smoothed_as_blender_does(most: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without asking it, which would leave triangles and normals in its memory: warped and hollow faces too."""
    rng, mesh = np.random.default_rng(1), bpy.data.meshes.new("faces")
    count = 300
    points = rng.normal(size=(4 * count, 3)) * (1, 1, 0.2)
    faces = [tuple(range(4 * k, 4 * k + (most if k % 3 else 3))) for k in range(count)]
    mesh.from_pydata(points.tolist(), [], faces)
    mesh.shade_smooth()
    asked: list[str] = []

    def noted(collection: Any, name: str, *more: Any, **how: Any) -> np.ndarray:
        asked.append(name)
        return read(collection, name, *more, **how)

    monkeypatch.setattr(meshes, "read", noted)
    corners, normals = meshes.corners_of(mesh), meshes._normals(mesh)
    owners = meshes.faces_of(mesh)
    assert set(asked) == {"loop_total", "vector", "value"}
    triangles = mesh.loop_triangles
    assert corners.tolist() == [list(t.loops) for t in triangles]
    assert owners.tolist() == [t.polygon_index for t in triangles]
    assert most == 3 or (np.diff(corners, axis=1) > 1).any()
    np.testing.assert_allclose(normals, [n.vector for n in mesh.vertex_normals], atol=5e-4)


def test_triangles_are_those_that_blender_gives_out() -> None:
    """Read in one piece: as one by one, for triangles, quads and n-gons, with slots, of a mesh by itself and of one
    that a modifier makes."""
    mesh = bpy.data.meshes.new("mixed")
    rng = np.random.default_rng(0)
    mesh.from_pydata(rng.random((40, 3)).tolist(), [], [tuple(range(k, k + 3 + k % 5)) for k in range(0, 30, 3)])
    for k in range(3):
        mesh.materials.append(bpy.data.materials.new(str(k)))
    mesh.polygons.foreach_set("material_index", rng.integers(0, 3, len(mesh.polygons)))
    add("mixed", mesh)
    add("array", mesh).modifiers.new("a", "ARRAY").count = 3
    scene = extract_frame(bpy.context.scene).scene
    for k, copies in enumerate((1, 3)):
        loaded, triangles = scene.meshes[scene.instances.mesh[k]], mesh.loop_triangles
        assert loaded.slots is not None
        vertices = np.array([tuple(t.vertices) for t in triangles])
        np.testing.assert_array_equal(loaded.triangles, np.concatenate([vertices + 40 * c for c in range(copies)]))
        np.testing.assert_array_equal(loaded.slots, np.tile([t.material_index for t in triangles], copies))


def test_not_finite_vertices() -> None:
    """Triangles with NaN, infinite or absurd vertices are left out with a warning, bounds and the rest stand; a mesh of
    nothing else is no mesh."""
    mesh = cube("broken")
    mesh.vertices[0].co = (float("nan"), 0, 0)
    mesh.vertices[1].co = (0, 3e38, 0)
    add("broken", mesh)
    lost = wedge("lost")
    for v in lost.vertices:
        v.co = (float("inf"), 0, 0)
    add("lost", lost)
    add("empty", bpy.data.meshes.new("empty"))
    extraction = extract_frame(bpy.context.scene)
    scene = extraction.scene
    assert len(scene.instances) == 1
    loaded = scene.meshes[0]
    assert np.isfinite(loaded.positions).all()
    assert 0 < len(loaded.triangles) < 12
    assert not np.isin(loaded.triangles, (0, 1)).any()
    np.testing.assert_array_equal(scene.mesh_bounds[0], [[-1, -1, -1], [1, 1, 1]])
    assert any("not finite" in w for w in extraction.warnings)


def test_meshes_outlive_the_graph() -> None:
    """What is extracted can be read after the render, another extraction, and the loss of the file."""
    add("cube", cube()).modifiers.new("s", "SUBSURF").render_levels = 2
    extraction = extract_frame(bpy.context.scene)
    before = extraction.scene.meshes[0]
    extract_frame(bpy.context.scene)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    gc.collect()
    after = extraction.scene.meshes[0]
    np.testing.assert_array_equal(before.positions, after.positions)
    np.testing.assert_array_equal(before.triangles, after.triangles)


def test_what_blender_copies_of_a_large_mesh_goes_once_it_is_read() -> None:
    """And it can be read again."""
    bpy.ops.mesh.primitive_grid_add(x_subdivisions=100, y_subdivisions=100)
    extraction = extract_frame(bpy.context.scene, world=None)
    sources = extraction.scene.meshes.sources  # type: ignore[attr-defined]
    (large,) = [k for k, source in enumerate(sources) if source is not None and source.spare is not None]
    first = sources[large].geometry
    once, again = (extraction.scene.meshes[large] for _ in range(2))
    assert sys.getrefcount(first) == 2  # here, and where it is counted
    assert len(once.triangles) == 20_000
    assert np.array_equal(once.triangles, again.triangles)
    assert np.array_equal(once.positions, again.positions)


def test_nothing_to_render() -> None:
    """A scene without faces is refused in one line."""
    add("empty")
    with pytest.raises(InputError, match="nothing to render"):
        extract_frame(bpy.context.scene)


def test_extraction_changes_nothing() -> None:
    """Settings and datablocks are as before, also when the callback fails."""
    add("cube", cube())
    scene = bpy.context.scene
    scene.camera = None

    def state() -> tuple[object, ...]:
        names = ("objects", "cameras", "scenes", "worlds", "meshes", "images", "collections")
        render = scene.render
        return (
            render.engine,
            render.use_compositing,
            render.use_sequencer,
            scene.camera,
            scene.frame_current,
            *[len(getattr(bpy.data, n)) for n in names],
        )

    before = state()
    extract_frame(scene, allow_no_camera=True)
    assert state() == before

    def fail(_: object) -> None:
        raise KeyError("mine")

    with pytest.raises(KeyError, match="mine"):
        with_render_depsgraph(scene, None, fail)
    assert state() == before
