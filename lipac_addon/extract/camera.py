"""Camera, film and path limits of a scene."""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np

from ...core.arrays import F32, F64
from ...core.errors import InputError
from ...core.scene.model import Camera, Film, PathLimits, Shading

VIEW_DIRECTION = np.array([-0.6, 0.7, -0.4])  # of a framing camera: from the front, a little from the right and above
NEWEST = (5, 3)  # Blender that the tests have run on
NO_CAMERA = "the scene has no camera: add one and make it the scene's active camera"


def extract_film(scene: Any) -> Film:
    """Film of `bpy.types.Scene`: size (percentage applied, border ignored), Cycles' pixel filter and exposure."""
    render, cycles = scene.render, getattr(scene, "cycles", None)
    width = max(render.resolution_x * render.resolution_percentage // 100, 1)
    height = max(render.resolution_y * render.resolution_percentage // 100, 1)
    if cycles is None:
        return Film(width, height, transparent=render.film_transparent)
    # as of Principled's roughness, which GGX squares
    glass = cycles.film_transparent_roughness**2 if cycles.film_transparent_glass else -1.0
    return Film(
        width,
        height,
        cycles.pixel_filter_type,
        cycles.filter_width,
        cycles.film_exposure,
        render.film_transparent,
        glass,
    )


def extract_limits(scene: Any) -> PathLimits:
    """Bounce limits and clamps from `scene.cycles`, and the surface models of the Cycles that runs."""
    c = getattr(scene, "cycles", None)
    if c is None:
        return PathLimits(shading=Shading.of(bpy.app.version))
    fast, world = c.use_fast_gi and c.fast_gi_method == "REPLACE", scene.world
    ambient = None if world is None else world.light_settings
    return PathLimits(
        c.max_bounces,
        c.diffuse_bounces,
        c.glossy_bounces,
        c.transmission_bounces,
        c.transparent_max_bounces,
        c.caustics_reflective,
        c.caustics_refractive,
        c.sample_clamp_direct,
        c.sample_clamp_indirect,
        c.blur_glossy,
        Shading.of(bpy.app.version),
        c.ao_bounces_render if fast else 0,
        ambient.distance if ambient is not None else 10.0,
        ambient.ao_factor if ambient is not None else 1.0,
        world.cycles.max_bounces if world is not None else 1024,
    )


def newer_than_tested() -> list[str]:
    """One line where the Blender that runs is newer than all that we know."""
    if bpy.app.version[:2] <= NEWEST:
        return []
    known = ".".join(map(str, NEWEST))
    return [
        f"Blender {bpy.app.version_string} is newer than those that this was tested with (up to {known}): surfaces are "
        f"taken to scatter as in {known}"
    ]


def far_from_origin(camera: Camera, film: Film, places: F64) -> list[str]:
    """One line where Blender, which places things by 32 bits, rounds their places to more than a pixel of the picture,
    so that its picture is not the one that was analysed. places: (N, 3) of what is seen, relative to the camera."""
    step = float(np.spacing(np.float32(np.abs(camera.to_world[:, 3]).max())))
    distance = 1.0 if camera.orthographic else float(np.median(np.linalg.norm(places, axis=1)))
    pixel = abs(float(camera.frame[1] - camera.frame[0])) * distance / film.width
    if step <= pixel:
        return []
    return [
        f"so far from the origin Blender rounds places to {step:.2g} m, and a pixel is {pixel:.2g} m: its picture is "
        "not the one that was analysed; move the scene to the origin"
    ]


def what_draws_lines(depsgraph: Any, freestyle: bool) -> tuple[str, bool]:
    """What draws lines of all that is in view, whatever light it gets, "" for nothing; and whether lines may come of
    what is not in view, too. freestyle: whether the scene has it on."""
    found = ["Freestyle"] if freestyle and depsgraph.view_layer_eval.use_freestyle else []
    pencils = [item for item in depsgraph.ids if item.id_type == "OBJECT" and item.type == "GREASEPENCIL"]
    art = [m for item in pencils for m in item.modifiers if m.type == "LINEART" and m.show_render]
    elsewhere = any(m.light_contour_object is not None or m.use_custom_camera for m in art)
    return " and ".join([*found, *(["Line Art"] if art else [])]), elsewhere


def camera_matrix(camera: Any) -> F64:
    """(3, 4) float64 camera to world without scale. Raises InputError when it is not usable."""
    m = np.array(camera.matrix_world, np.float64)[:3]
    lengths = np.linalg.norm(m[:, :3], axis=0)
    if not np.isfinite(m).all() or lengths.min() < 1e-18:
        raise InputError(
            f"camera {camera.name!r} has a singular or not finite transform: give it a scale that is not zero"
        )
    m[:, :3] /= lengths
    return m


def frame_of(camera: Any, film: Film, pixel_aspect: tuple[float, float]) -> F64:
    """Left, right, bottom, top of the picture at distance 1 (perspective) or in metres (orthographic): sensor fit, lens
    shift and pixel aspect as in Cycles' `blender/camera.cpp`. camera: bpy.types.Camera."""
    x, y = film.width * pixel_aspect[0], film.height * pixel_aspect[1]
    horizontal = camera.sensor_fit == "HORIZONTAL" or (camera.sensor_fit == "AUTO" and x > y)
    if camera.type == "ORTHO":
        half = camera.ortho_scale / 2
    else:
        half = (camera.sensor_height if camera.sensor_fit == "VERTICAL" else camera.sensor_width) / (2 * camera.lens)
    width, height = (half, half * y / x) if horizontal else (half * x / y, half)
    dx, dy = 2 * half * camera.shift_x, 2 * half * camera.shift_y
    return np.array([dx - width, dx + width, dy - height, dy + height])


def extract_camera(item: Any, scene: Any, film: Film) -> Camera:
    """Core camera in world space (origin not subtracted). item: evaluated camera object. Raises InputError on panoramic
    and custom cameras."""
    data = item.data
    if item.type != "CAMERA" or data.type not in {"PERSP", "ORTHO"}:
        what = f"type {data.type.lower()}" if item.type == "CAMERA" else f"a {item.type.lower()} object"
        raise InputError(f"camera {item.name!r} is {what}: only perspective and orthographic cameras are supported")
    to_world = camera_matrix(item)
    frame = frame_of(data, film, (scene.render.pixel_aspect_x, scene.render.pixel_aspect_y))
    orthographic = data.type == "ORTHO"
    if not data.dof.use_dof:
        return Camera(to_world, frame, orthographic, data.clip_start, data.clip_end)
    dof = data.dof
    fstop = max(dof.aperture_fstop, 1e-5)
    aperture = 1 / (2 * fstop) if orthographic else data.lens * 1e-3 / (2 * fstop)
    focus = dof.focus_distance
    if dof.focus_object is not None:
        target = np.array(dof.focus_object.matrix_world, np.float64)
        if dof.focus_object.pose is not None and dof.focus_subtarget in dof.focus_object.pose.bones:
            target = target @ np.array(dof.focus_object.pose.bones[dof.focus_subtarget].matrix, np.float64)
        focus = abs(float(to_world[:, 2] @ (to_world[:, 3] - target[:3, 3])))
    blades = dof.aperture_blades if dof.aperture_blades >= 3 else 0
    return Camera(
        to_world, frame, orthographic, data.clip_start, data.clip_end, aperture, focus, blades, dof.aperture_rotation,
        dof.aperture_ratio
    )


def frame_camera(bounds: F32 | F64, film: Film) -> Camera:
    """A perspective camera (50 mm on a 36 mm sensor) that sees all of a box: for files that bring none. bounds: (2, 3)
    low, high."""
    low, high = np.asarray(bounds, np.float64)
    center, radius = (low + high) / 2, max(float(np.linalg.norm(high - low)) / 2, 1e-3)
    half = 36 / (2 * 50)
    width, height = (
        (half, half * film.height / film.width) if film.width > film.height else (half * film.width / film.height, half)
    )
    distance = radius / np.sin(np.arctan(min(width, height)))
    z = -VIEW_DIRECTION / np.linalg.norm(VIEW_DIRECTION)
    x = np.cross([0.0, 0.0, 1.0], z)
    x /= np.linalg.norm(x)
    to_world = np.stack((x, np.cross(z, x), z, center + z * distance), axis=1)
    return Camera(
        to_world, np.array([-width, width, -height, height]), clip_start=distance * 1e-3, clip_end=distance + 4 * radius
    )


def add_framing_camera(scene: Any, bounds: F32 | F64) -> Any:
    """Adds `frame_camera` to a Blender scene as its active camera, so that Blender's engines render the same view.
    Returns the object."""
    import bpy
    from mathutils import Matrix

    camera = frame_camera(bounds, extract_film(scene))
    data = bpy.data.cameras.new("Framing camera")
    data.lens, data.sensor_width, data.sensor_fit = 50, 36, "AUTO"
    data.clip_start, data.clip_end = camera.clip_start, camera.clip_end
    item = bpy.data.objects.new("Framing camera", data)
    item.matrix_world = Matrix([*camera.to_world.tolist(), [0, 0, 0, 1]])
    scene.collection.objects.link(item)
    scene.camera = item
    return item
