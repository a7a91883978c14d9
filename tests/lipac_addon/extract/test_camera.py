"""Camera frames against Blender's own projection."""

from __future__ import annotations

import itertools

import bpy
import numpy as np
import pytest
from bpy_extras.object_utils import world_to_camera_view
from mathutils import Vector

from lipac.core.errors import InputError
from lipac.core.scene.model import Camera
from lipac.lipac_addon.extract import add_framing_camera, extract_frame, frame_camera
from lipac.lipac_addon.extract.camera import extract_camera, extract_film
from lipac.lipac_addon.extract.scene import CATCHERS

from .conftest import add, cube


def project(camera: Camera, points: np.ndarray) -> np.ndarray:
    """(n, 2) picture coordinates in [0, 1] of world points, from the fields that the tracer uses."""
    local = (points - camera.to_world[:, 3]) @ camera.to_world[:, :3]
    xy = local[:, :2] if camera.orthographic else local[:, :2] / -local[:, 2:]
    left, right, bottom, top = camera.frame
    return (xy - [left, bottom]) / [right - left, top - bottom]


@pytest.mark.parametrize(
    ("kind", "fit", "size"),
    list(
        itertools.product(("PERSP", "ORTHO"), ("AUTO", "HORIZONTAL", "VERTICAL"), ((320, 180), (180, 320), (200, 200)))
    ),
)
def test_projection_is_blenders(kind: str, fit: str, size: tuple[int, int]) -> None:
    """Points project where `world_to_camera_view` and `view_frame` put them, whatever the shift, fit, aspect and object
    scale."""
    scene = bpy.context.scene
    render, item = scene.render, scene.camera
    render.resolution_x, render.resolution_y, render.resolution_percentage = 2 * size[0], 2 * size[1], 50
    item.scale = (2, 2, 2)
    data = item.data
    data.type, data.sensor_fit, data.lens, data.ortho_scale, data.shift_x, data.shift_y = kind, fit, 35, 7, 0.1, -0.2
    data.sensor_width, data.sensor_height = 30, 22
    for aspect in ((1, 1), (2, 1), (1, 1.5)):
        render.pixel_aspect_x, render.pixel_aspect_y = aspect
        bpy.context.view_layer.update()
        film = extract_film(scene)
        assert (film.width, film.height) == size
        camera = extract_camera(item, scene, film)
        corners = np.array(data.view_frame(scene=scene))
        depth = 1.0 if kind == "ORTHO" else -corners[0, 2]
        expected = (
            np.array([corners[:, 0].min(), corners[:, 0].max(), corners[:, 1].min(), corners[:, 1].max()]) / depth
        )
        np.testing.assert_allclose(camera.frame, expected, rtol=1e-5, atol=1e-6)  # float32 of values around 1
        points = np.random.default_rng(1).uniform(-4, 4, (20, 3))
        blender = np.array([world_to_camera_view(scene, item, Vector(p))[:2] for p in points])
        np.testing.assert_allclose(project(camera, points), blender, atol=2e-5)


def test_depth_of_field() -> None:
    """Aperture radius, focus object along the axis, blades."""
    item = bpy.context.scene.camera
    item.location, item.rotation_euler = (0, 0, 10), (0, 0, 0)
    dof = item.data.dof
    dof.use_dof, dof.aperture_fstop, dof.aperture_blades, item.data.lens = True, 2.0, 5, 50
    dof.focus_object = add("target", None, location=(3, 1, 4))
    bpy.context.view_layer.update()
    camera = extract_camera(item, bpy.context.scene, extract_film(bpy.context.scene))
    assert camera.aperture == pytest.approx(0.050 / 4)
    assert camera.focus == pytest.approx(6.0)
    assert camera.blades == 5


def test_unusable_cameras() -> None:
    """None, panoramic: one clear line each; allowed to be missing, everything is framed."""
    scene = bpy.context.scene
    add("cube", cube(size=3.0), location=(50, 0, 0))
    scene.camera.data.type = "PANO"
    with pytest.raises(InputError, match="perspective and orthographic"):
        extract_frame(scene)
    scene.camera = None
    with pytest.raises(InputError, match="no camera"):
        extract_frame(scene)
    objects = set(bpy.data.objects)
    extraction = extract_frame(scene, allow_no_camera=True)
    assert set(bpy.data.objects) == objects
    assert scene.camera is None
    seen = project(extraction.scene.camera, extraction.scene.instances.bounds[0].astype(float))
    assert (seen > 0).all()
    assert (seen < 1).all()


def test_framing_camera_in_blender() -> None:
    """The camera added to the file sees what `frame_camera` sees."""
    scene = bpy.context.scene
    bounds = np.array([[-1.0, 2, 3], [4, 5, 10]])
    scene.camera = None
    item = add_framing_camera(scene, bounds)
    bpy.context.view_layer.update()
    film = extract_film(scene)
    camera = extract_camera(item, scene, film)
    np.testing.assert_allclose(camera.frame, frame_camera(bounds, film).frame, rtol=1e-6)
    np.testing.assert_allclose(camera.to_world, frame_camera(bounds, film).to_world, atol=1e-5)
    corners = np.array(list(itertools.product(*bounds.T)))
    assert (np.abs(project(camera, corners) - 0.5) < 0.5).all()


def test_far_from_the_origin_blender_rounds_places() -> None:
    """Said where that is more than a pixel, and not before."""
    item = add("camera", bpy.data.cameras.new("camera"), location=(0, -5, 0), rotation=(np.pi / 2, 0, 0))
    thing = add("thing", cube())
    scene = bpy.context.scene
    scene.camera = item
    for x, said in ((0.0, False), (1e4, False), (1e7, True)):
        item.location.x = thing.location.x = x
        lines = [line for line in extract_frame(scene).warnings if "rounds places" in line]
        assert bool(lines) == said


@pytest.mark.parametrize("kind", ["freestyle", "layer without", "line art", "own camera", "nothing"])
def test_what_draws_lines_keeps_what_is_in_view(kind: str) -> None:
    """Lines are drawn of what no light shows; where they are drawn as another camera sees them, of all."""
    scene = bpy.context.scene
    add("seen", cube())
    add("behind", cube(), location=(3.0, -60.0, 8.0))
    scene.render.use_freestyle = kind in {"freestyle", "layer without"}
    bpy.context.view_layer.use_freestyle = kind == "freestyle"
    if kind in {"line art", "own camera"}:
        art = add("art", bpy.data.grease_pencils.new("art")).modifiers.new("art", "LINEART")
        art.use_custom_camera = kind == "own camera"
    extraction = extract_frame(scene)
    stays, names = extraction.scene.stays, extraction.keys.names
    shown = [names[k] for k in extraction.keys.records["object"]]
    if kind in {"layer without", "nothing"}:
        assert stays is None
    else:
        assert stays is not None
        assert dict(zip(shown, stays.tolist(), strict=True)) == {"seen": True, "behind": kind == "own camera"}
    assert any("draws lines" in line for line in extraction.scene.approximated) == (stays is not None)
    assert scene.render.use_freestyle == (kind in {"freestyle", "layer without"})


@pytest.mark.parametrize("catcher", [False, True])
def test_light_on_shadow_catchers_is_said_to_have_no_bound(catcher: bool) -> None:
    scene = bpy.context.scene
    scene.camera = add("camera", bpy.data.cameras.new("camera"), location=(0, -5, 0), rotation=(np.pi / 2, 0, 0))
    add("thing", cube()).is_shadow_catcher = catcher
    assert (CATCHERS in extract_frame(scene).warnings) == catcher
