"""First hits by the graphics card against rays over everything."""

import bpy
import gpu
import numpy as np
import pytest

from lipac.core.accel.blas import BlasCache
from lipac.core.accel.tlas import Tlas
from lipac.core.errors import InputError
from lipac.core.hybrid.first_hits import trace_primary
from lipac.core.scene.mesh import MeshTable
from lipac.lipac_addon.depsgraph import with_render_depsgraph
from lipac.lipac_addon.extract import extract_frame
from lipac.lipac_addon.raster import opengl

SIZE = (96, 54)

if not opengl.has_opengl():
    pytest.skip(opengl.NO_OPENGL, allow_module_level=True)


def traced(scene, camera, size):
    blas = BlasCache(scene.meshes)
    blas.need(scene.instances.mesh)
    return trace_primary(
        Tlas(scene.instances, blas, np.ones(len(scene.instances), bool)),
        MeshTable(scene.meshes),
        camera,
        size,
        scene.instances.mesh,
    )


def positions(primary, scene):
    """(n, 3) of the hits, world."""
    out = []
    for hit in primary.hits[primary.hits["instance"] >= 0]:
        mesh = scene.meshes[scene.instances.mesh[hit["instance"]]]
        a, b, c = mesh.positions[mesh.triangles[hit["triangle"]]].astype(float)
        p = a + hit["b1"] * (b - a) + hit["b2"] * (c - a)
        out.append(scene.instances.transform[hit["instance"]] @ np.append(p, 1))
    return np.array(out)


@pytest.mark.parametrize("view", ["perspective", "jittered", "orthographic", "far"])
def test_against_rays(boxes, view):
    """Instance and triangle of nearly every pixel are those that a ray meets: the graphics card snaps corners to 1/256
    pixel, so edges may differ, 1 % of the pixels of this picture at most. Where both agree, positions do, to what that
    snap means at their distance: the footprint of 1/256 pixel, twice."""
    from lipac.lipac_addon.raster.gbuffer import GBuffer

    camera = boxes.camera.data
    camera.shift_x = 0.05
    bpy.data.objects["wall"].scale.z = 1  # the sky shows above it
    if view == "orthographic":
        camera.type, camera.ortho_scale = "ORTHO", 12
    if view == "far":
        for item in boxes.objects:
            item.location.x += 1e5
    scene = extract_frame(boxes).scene
    opengl.require()
    buffer = GBuffer(scene)
    primary = buffer.draw(SIZE, 3, 8) if view == "jittered" else buffer.draw(SIZE)
    truth = traced(scene, primary.camera, SIZE)
    same = (primary.hits["instance"] == truth.hits["instance"]) & (primary.hits["triangle"] == truth.hits["triangle"])
    assert same.mean() > 0.99
    assert (primary.hits["instance"] >= 0).mean() > 0.3
    assert len(np.unique(primary.hits["instance"])) > 5
    both = same & (truth.hits["instance"] >= 0)
    for p in (primary, truth):
        p.hits["instance"][~both] = -1
    a, b = positions(primary, scene), positions(truth, scene)
    distance = np.linalg.norm(b - primary.camera.to_world[:, 3], axis=1) if view != "orthographic" else 1.0
    pixel = (primary.camera.frame[1] - primary.camera.frame[0]) / SIZE[0] * distance
    eye = primary.camera.to_world[:, 2]
    # across the view: along it, slanted surfaces stretch it
    off = np.linalg.norm((a - b) - ((a - b) @ eye)[:, None] * eye, axis=1)
    assert (off < 2 * pixel / 256 + 1e-5).mean() > 0.99


def test_culled_or_not_everything_that_camera_rays_see(boxes):
    """An object invisible to the camera is not drawn; thousands of instances of one mesh are told apart."""
    from lipac.lipac_addon.raster.gbuffer import GBuffer

    bpy.data.objects["wall"].visible_camera = False
    mesh = bpy.data.objects["box0"].data
    for k in range(1100):  # more than a row of the texture of transforms
        ob = bpy.data.objects.new("more", mesh)
        ob.location, ob.scale = (0.4 * (k % 40) - 8, 2 + 0.4 * (k // 40), 0.2), (0.15, 0.15, 0.15)
        boxes.collection.objects.link(ob)
    extraction = extract_frame(boxes)
    scene = extraction.scene
    opengl.require()
    primary = GBuffer(scene).draw(SIZE)
    truth = traced(scene, primary.camera, SIZE)
    assert (primary.hits["instance"] == truth.hits["instance"]).mean() > 0.97  # boxes of a few pixels: mostly edges
    names = {extraction.keys.names[k] for k in extraction.keys.records["object"][np.unique(primary.hits["instance"])]}
    assert "wall" not in names
    assert len(np.unique(primary.hits["instance"])) > 300


def test_more_than_pixels_can_tell(boxes, monkeypatch):
    """What a pixel's numbers cannot tell apart is refused in one line, not drawn as something else."""
    from lipac.lipac_addon.raster import gbuffer

    opengl.require()
    scene = extract_frame(boxes).scene
    most = max(len(scene.meshes[mesh].triangles) for mesh in np.unique(scene.instances.mesh))
    assert 4 < len(scene.instances) < most
    for limit, said in ((4, "instances in view"), (most, "triangles of a mesh")):
        monkeypatch.setattr(gbuffer, "EXACT", limit)
        with pytest.raises(InputError, match=f"{said} are more than .*--primary traced"):
            gbuffer.GBuffer(scene)


def test_after_a_render_with_grease_pencil() -> None:
    """It leaves Python without a graphics context."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    bpy.ops.mesh.primitive_cube_add()
    scene.collection.objects.link(bpy.data.objects.new("drawing", bpy.data.grease_pencils.new("drawing")))
    scene.collection.objects.link(bpy.data.objects.new("camera", bpy.data.cameras.new("camera")))
    scene.camera = bpy.data.objects["camera"]
    opengl.require()
    with_render_depsgraph(scene, None, lambda _depsgraph: None)
    opengl.require()
    gpu.types.GPUOffScreen(4, 4).free()
