"""Who takes the memory of a render: objects, meshes and images of the open file."""

import bpy
import numpy as np
import pytest

from lipac.core.culling.options import CullOptions
from lipac.core.files.memory_table import read_rows
from lipac.core.files.report import Report
from lipac.core.scene.render_costs import OBJECT, RenderCosts
from lipac.lipac_addon.batch.job import Job
from lipac.lipac_addon.batch.pipeline import run
from lipac.lipac_addon.extract import extract_frame
from lipac.lipac_addon.memory.costs import costs_of, film_bytes
from lipac.lipac_addon.memory.images import image_bytes, images_of
from lipac.lipac_addon.memory.rows import NOT_ASKED, Weighed

DISTANCE = CullOptions(policy="distance", setting=19.5)  # the boxes behind the wall are further


def textured(name, *images):
    """A material that mixes images, the last within a group."""
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    group = bpy.data.node_groups.new(name, "ShaderNodeTree")
    trees = [*[material.node_tree] * (len(images) - 1), group]
    for tree, image in zip(trees, images, strict=True):
        tree.nodes.new("ShaderNodeTexImage").image = image
    material.node_tree.nodes.new("ShaderNodeGroup").node_tree = group
    return material


@pytest.fixture
def images(boxes):
    """Images of 8 x 4: bytes, and floats; box0 has both, box1 and box5 the first."""
    plain, deep = bpy.data.images.new("plain", 8, 4), bpy.data.images.new("deep", 8, 4, float_buffer=True)
    for name, material in (("box0", textured("both", plain, deep)), ("box1", textured("one", plain))):
        ob = bpy.data.objects[name]
        ob.data = ob.data.copy()
        ob.data.materials.append(material)
    bpy.data.objects["box5"].data = bpy.data.objects["box1"].data
    return plain, deep


def rows_after(tmp_path, options, engine="cycles"):
    report = Report("boxes", "", "", options.policy, engine, 0, 1)
    run(Job(tmp_path, (1,), options, engine, samples=1), report)
    return {(row.kind, row.name): row for row in read_rows(tmp_path)}


def test_images_by_the_engine_s_rules(images):
    plain, deep = images
    assert image_bytes(plain) == 8 * 4 * 4
    assert image_bytes(deep) == 8 * 4 * 4 * 4
    assert images_of(bpy.data.objects["box0"].data.materials[0].node_tree) == {plain, deep}
    missing = bpy.data.images.new("missing", 8, 4)
    missing.source, missing.filepath = "FILE", "/nowhere.png"
    assert image_bytes(missing) == 16


def test_costs_of_a_frame(images, boxes):
    extraction = extract_frame(boxes)
    named = costs_of(extraction, boxes)
    n = len(extraction.scene.instances)
    triangles = np.array([len(mesh.triangles) for mesh in extraction.scene.meshes])
    vertices = np.array([len(mesh.positions) for mesh in extraction.scene.meshes])
    geometry, bvh, _ = RenderCosts.of_meshes(triangles, vertices, np.ones(len(triangles), bool))
    assert named.costs.geometry.tolist() == geometry.tolist()
    assert named.costs.bvh.tolist() == bvh.tolist()
    assert named.costs.instance.tolist() == [OBJECT] * n
    assert dict(zip(named.images, named.costs.image.tolist(), strict=True)) == {"plain": 128, "deep": 512}


def test_a_larger_picture_with_more_passes_takes_more(boxes):
    before = film_bytes(boxes)
    boxes.view_layers[0].use_pass_normal = True
    passes = film_bytes(boxes)
    boxes.render.resolution_x *= 2
    larger = film_bytes(boxes)
    boxes.cycles.use_denoising = True
    assert before < passes < larger < film_bytes(boxes)
    assert larger == 2 * passes


def test_objects_and_images_together_are_what_the_render_takes(images, boxes):
    weighed = Weighed.whole(
        costs_of(extraction := extract_frame(boxes), boxes), extraction.scene.instances, extraction.keys
    )
    for removed in (np.zeros(10, bool), np.arange(10) % 3 == 0):
        rows = weighed.rows(removed)
        objects, meshes, textures = (
            sum(row.bytes for row in rows if row.kind == kind) for kind in ("object", "mesh", "image")
        )
        assert objects == pytest.approx(weighed.total(removed) - weighed.named.costs.fixed, abs=10)
        assert meshes + textures == pytest.approx(objects, abs=10)
        assert all(abs(row.bytes - row.geometry_bytes - row.bvh_bytes - row.image_bytes) <= 2 for row in rows)


def test_beside_the_report_of_a_render(images, tmp_path):
    bpy.data.objects["box5"].keyframe_insert("hide_render", frame=1)
    rows = rows_after(tmp_path, DISTANCE)
    assert rows["object", "box5"].why == "cannot be culled: render visibility is animated"
    assert (rows["object", "box6"].bytes, rows["object", "box6"].kept, rows["object", "box6"].why) == (0, 0, "culled")
    assert rows["object", "box0"].kept == 1
    assert rows["object", "box0"].image_bytes > 0
    assert rows["image", "plain"].why == "in materials of 3 objects"
    assert (rows["image", "plain"].instances, rows["image", "plain"].kept) == (3, 3)
    assert rows["object", "box0"].camera is None and rows["object", "box0"].worth is None


def test_of_a_render_in_which_nothing_is_culled(images, tmp_path):
    rows = rows_after(tmp_path, CullOptions(policy="none"))
    assert rows["object", "box5"].why == NOT_ASKED
    assert rows["object", "box5"].bytes == rows["object", "box5"].full_bytes > 0


def test_of_an_analysis_by_light_paths(images, tmp_path):
    rows = rows_after(tmp_path, CullOptions(width=64, max_iterations=4), "")
    plane, hidden = rows["object", "Plane"], rows["object", "box6"]
    assert plane.camera > 0 and plane.diffuse > 0 and plane.worth > 0.1
    assert plane.why == "light paths meet it"
    assert hidden.kept == hidden.bytes == 0 and hidden.why.startswith("culled")
