"""Hard cases that need Blender: places far from the world's origin, cameras of all kinds, Cycles in the same
process."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import bpy
import numpy as np

from lipac.core.arrays import F32
from lipac.core.errors import InputError
from lipac.core.scene.model import Scene
from lipac.lipac_addon.console import muted
from lipac.lipac_addon.extract import extract_frame

from ..core.scenes import render
from .case import Figure, case
from .places import changed

GROUP = "Inside Blender"


def stage(offset: tuple[float, float, float] = (0.0, 0.0, 0.0), scale: float = 1.0) -> bpy.types.Scene:
    """Cubes and a smooth ball on a floor, a sun, a camera; all of it moved by offset. Its coordinates are multiples of
    64: exact in float32 up to 10^9."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene

    def add(data: bpy.types.ID, place: tuple[float, float, float]) -> bpy.types.Object:
        item = bpy.data.objects.new(data.name, data)
        scene.collection.objects.link(item)
        item.location = np.add(np.multiply(place, scale), offset)
        item.scale = (scale,) * 3 if item.type == "MESH" else (1, 1, 1)
        return item

    corners = [(x, y, z) for x in (-64, 64) for y in (-64, 64) for z in (-64, 64)]
    cube, floor = bpy.data.meshes.new("cube"), bpy.data.meshes.new("floor")
    cube.from_pydata(corners, [], [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)])
    floor.from_pydata([(-1024, -1024, 0), (1024, -1024, 0), (1024, 1024, 0), (-1024, 1024, 0)], [], [(0, 1, 2, 3)])
    add(floor, (0, 0, 0))
    for k in range(5):
        add(cube, (256.0 * (k - 2), 128.0 * (k % 2), 64.0))
    sun = add(bpy.data.lights.new("sun", "SUN"), (0, 0, 512))
    sun.rotation_euler, sun.data.energy = (0.6, 0.3, 0), 3.0
    camera = bpy.data.cameras.new("camera")
    camera.clip_start, camera.clip_end = scale, 1e5 * scale
    scene.camera = add(camera, (0, -1024, 512))
    scene.camera.rotation_euler = (1.1, 0, 0)
    scene.world = bpy.data.worlds.new("world")
    settings = scene.render
    settings.engine, settings.resolution_x, settings.resolution_y, settings.resolution_percentage = (
        "CYCLES", 64, 36, 100
    )
    scene.cycles.samples, scene.cycles.use_denoising, scene.cycles.use_adaptive_sampling = 4, False, False
    return scene


def extracted(scene: bpy.types.Scene) -> Scene:
    """The core scene of the open file."""
    with muted():
        return extract_frame(scene).scene


@case(GROUP)
def moved() -> Iterator[Figure]:
    """The same scene further and further from the world's origin."""
    reference = render(extracted(stage()), 4).mean
    for distance in (2**10, 2**17, 2**20, 2**24, 2**27):
        picture = render(extracted(stage((distance, -distance, distance / 4))), 4).mean
        yield Figure(
            f"scene moved by {distance:.0e} m along x and y",
            "pixels that differ in any bit",
            changed(reference, picture, 0.0),
            0.0,
        )


def cycles() -> F32:
    """Pixels of a render by Cycles, through a file."""
    import tempfile
    from pathlib import Path

    from lipac.lipac_addon.batch.engines.blender import render_blender
    from lipac.lipac_addon.pictures import read_picture

    with tempfile.TemporaryDirectory() as folder:
        render_blender("cycles", Path(folder) / "picture", samples=4, seed=3, threads=1)
        return read_picture(Path(folder) / "picture.exr")


@case(GROUP)
def beside_cycles() -> Iterator[Figure]:
    """Cycles before, during and after our tracing, each with its own Embree and threads: both give what they give
    alone."""
    scene = stage()
    alone = cycles()
    core = extracted(scene)
    ours = render(core, 4).mean
    during: list[F32] = []
    stop = threading.Event()

    def trace_on() -> None:
        while not stop.is_set():
            during.append(render(core, 4).mean)

    worker = threading.Thread(target=trace_on)
    worker.start()
    meanwhile = cycles()
    stop.set()
    worker.join()
    after = cycles()
    yield Figure(
        "Cycles while we trace, and after",
        "pixels that differ in any bit",
        changed(alone, meanwhile, 0.0) + changed(alone, after, 0.0),
        0.0,
    )
    yield Figure(
        f"our tracing while Cycles renders ({'once or more' if during else 'never'})",
        "pixels that differ in any bit",
        max(changed(ours, p, 0.0) for p in during),
        0.0,
    )


def no_border(scene: bpy.types.Scene) -> None:
    """Set a render border of no area."""
    scene.render.use_border, scene.render.border_min_x, scene.render.border_max_x = True, 0.5, 0.5


@case(GROUP)
def cameras_of_blender() -> Iterator[Figure]:
    """Panoramic and custom cameras are refused in one line that says so; sizes and borders at their limits give the
    picture that was asked for."""
    for what, change, says in (
        (
            "panoramic camera",
            lambda scene: setattr(scene.camera.data, "type", "PANO"),
            "only perspective and orthographic",
        ),
        ("camera scaled to 0", lambda scene: setattr(scene.camera, "scale", (0, 0, 0)), "singular"),
        ("camera at NaN", lambda scene: setattr(scene.camera, "location", (float("nan"), 0, 0)), "not finite"),
        (
            "a picture of 1 % of 64 x 36 pixels",
            lambda scene: setattr(scene.render, "resolution_percentage", 1),
            "too small",
        ),
        ("a render border without area", no_border, "too small"),
    ):
        scene, said = stage(), ""
        change(scene)
        try:
            extracted(scene)
        except InputError as error:
            said = str(error)
        yield Figure(
            what, "no message in one line that says so", float(says not in said or "\n" in said), 0.0, "not supported"
        )
    scene = stage()
    whole = render(extracted(scene), 1).mean
    scene.render.use_border, scene.render.border_min_x, scene.render.border_max_x = True, 0.25, 0.5
    yield Figure(
        "a render border",
        "pixels that differ from the whole picture",
        changed(whole, render(extracted(scene), 1).mean, 0.0),
        0.0,
        "the analysis sees the whole picture",
    )
