"""The pictures of docs/user-guide.md, from the demo city: `python -m lipac.scripts.dev.guide_pictures -o
docs/pictures`.

All by the extension's operators, as an artist would. Needs Blender 5.2 and graphics; software ones will do.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from ...lipac_addon.ui.state.results import FrameResult

EYE, TARGET = (-150.0, -250.0, 210.0), (10.0, -25.0, 0.0)
FOCAL = 1.6  # distance to width of the view
STRIP = (480, 270)  # size of a picture in a row of several
ROUNDS = (4, 9)  # of live mode that are shown, before the one at rest
VIEWPORT_SAMPLES, DRAWS = 4, 4  # of EEVEE in the viewport, and how often it is drawn at most
VIEWPORT = (320, 180)
RENDER = (320, 180, 16)  # width, height, samples


def main(argv: Sequence[str] | None = None) -> int:
    """Analyse the city, watch it live, render the difference; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--output", type=Path, default=Path("docs/pictures"))
    parser.add_argument("--instances", type=int, default=6000)
    parser.add_argument("--size", type=int, nargs=2, default=(960, 540))
    args = parser.parse_args(argv)
    args.output.mkdir(parents=True, exist_ok=True)
    import bpy

    from ... import register
    from ...lipac_addon.demo import mirror_city
    from ...lipac_addon.ui.draw import figures
    from ...lipac_addon.ui.state import results
    from ..studies.pictures.strips import save

    register()
    mirror_city.build(args.instances, 0)
    scene = bpy.context.scene
    save(live_picture(), args.output / "live.jpg")
    save(viewport_picture(), args.output / "viewport.jpg")
    bpy.ops.lipac.analyze()
    result = results.at(scene)
    if result is None:
        return 1
    for label, text in figures.rows_of(result):
        print(f"{label}: {text}")
    width, height = args.size
    save(overlay_picture(result, width, height)[::-1], args.output / "overlay.jpg")
    hot = overlay_picture(result, width, height, ("active", "culled"), heat_map=True)
    save(hot[::-1], args.output / "heat.jpg")
    save(tiles_picture(result, width)[::-1], args.output / "tiles.jpg")
    scene.render.resolution_x, scene.render.resolution_y, scene.cycles.samples = RENDER
    bpy.ops.lipac.difference()
    for label, text in figures.rows_of_difference(results.differences[scene.session_uid, scene.frame_current]):
        print(f"{label}: {text}")
    save(difference_picture(), args.output / "difference.jpg")
    return 0


def live_picture() -> np.ndarray:
    """Live mode from its start to its rest, three pictures in a row, from the top."""
    import bpy

    from ...lipac_addon.ui.jobs import live
    from ...lipac_addon.ui.state import results
    from ..studies.pictures.strips import strip

    uid, pictures = bpy.context.scene.session_uid, []
    bpy.ops.lipac.live()
    while live.current is None or not live.current.resting:
        rounds = 0 if live.current is None else live.current.rounds
        live.tick()
        if live.current is not None and live.current.rounds > rounds and live.current.rounds in ROUNDS:
            pictures.append(overlay_picture(results.live[uid], *STRIP))
        time.sleep(0.005)
    pictures.append(overlay_picture(results.live[uid], *STRIP))
    bpy.ops.lipac.live()
    labels = *(f"round {k}" for k in ROUNDS), "at rest"
    return strip([picture[::-1] for picture in pictures], labels)


def viewport_picture() -> np.ndarray:
    """What the viewport has, in full and with Cull Viewport: through the camera by EEVEE, and from outside; rows from
    the top."""
    import bpy

    from ...lipac_addon.ui.jobs import live
    from ..studies.pictures.strips import strip
    from ..studies.viewport.clock import Clock, look, settle

    scene, shown = bpy.context.scene, []
    scene.render.resolution_x, scene.render.resolution_y = VIEWPORT
    look()
    for culled in (False, True):
        scene.lipac.cull_viewport = culled
        with Clock() as clock:
            if culled:
                live.start()
                settle(clock)
            shown.append((through_the_camera(*VIEWPORT), solid_picture(*VIEWPORT)))
            if culled:
                print(f"Cull Viewport: {live.current.culling.message if live.current else ''}")
                live.stop()
    scene.lipac.cull_viewport = False
    rows = [
        strip([full[::-1], culled[::-1]], [f"{where}: everything", f"{where}: Cull Viewport"])
        for where, full, culled in zip(("through the camera", "from outside"), *shown, strict=True)
    ]
    return np.concatenate(rows)


def through_the_camera(width: int, height: int) -> np.ndarray:
    """The viewport in Rendered shading by EEVEE: (height, width, 3) uint8, rows bottom up; drawn until all shaders are
    there."""
    import bpy

    scene, last = bpy.context.scene, np.zeros(0, np.uint8)
    camera, engine, samples = scene.camera, scene.render.engine, scene.eevee.taa_samples
    scene.render.engine, scene.eevee.taa_samples = "BLENDER_EEVEE", VIEWPORT_SAMPLES
    try:
        for _ in range(DRAWS):
            layer = bpy.context.view_layer
            layer.update()
            view = camera.evaluated_get(layer.depsgraph).matrix_world.inverted()
            now = drawn(width, height, view, camera.calc_matrix_camera(layer.depsgraph, x=width, y=height), "RENDERED")
            if now.any() and np.array_equal(now, last):
                break
            last = now
            time.sleep(0.2)
    finally:
        scene.render.engine, scene.eevee.taa_samples = engine, samples
    return last


def solid_picture(width: int, height: int) -> np.ndarray:
    """The viewport in Solid shading from outside: (height, width, 3) uint8, rows bottom up."""
    return drawn(width, height, *outside(width / height), "SOLID")


def drawn(width: int, height: int, view: Any, projection: Any, shading: str) -> np.ndarray:
    """The viewport, drawn into memory by Blender: (height, width, 3) uint8, rows bottom up."""
    import bpy
    import gpu

    from ...lipac_addon.raster import opengl

    opengl.require()
    area = next(a for window in bpy.context.window_manager.windows for a in window.screen.areas if a.type == "VIEW_3D")
    space, region = area.spaces.active, next(r for r in area.regions if r.type == "WINDOW")
    before = space.shading.type
    space.shading.type, space.overlay.show_overlays, space.clip_end = shading, False, 3000.0
    offscreen = gpu.types.GPUOffScreen(width, height, format="RGBA8")
    scene, layer = bpy.context.scene, bpy.context.view_layer
    offscreen.draw_view3d(scene, layer, space, region, view, projection, do_color_management=True)
    with offscreen.bind():
        pixels = gpu.state.active_framebuffer_get().read_color(0, 0, width, height, 4, 0, "UBYTE").to_list()
    offscreen.free()
    space.shading.type = before
    return np.ascontiguousarray(np.array(pixels, np.uint8).reshape(height, width, 4)[:, :, :3])


def tiles_picture(result: FrameResult, width: int) -> np.ndarray:
    """The camera's view in Solid shading, with the worst tiles and the list of memory: (H, width, 3) uint8, rows bottom
    up."""
    import bpy
    import gpu
    from gpu_extras.presets import draw_texture_2d
    from mathutils import Matrix

    from ...lipac_addon.ui.draw import picture

    height, scene = round(width * 9 / 16), bpy.context.scene
    layer = bpy.context.view_layer
    view = scene.camera.evaluated_get(layer.depsgraph).matrix_world.inverted()
    under = drawn(width, height, view, scene.camera.calc_matrix_camera(layer.depsgraph, x=width, y=height), "SOLID")
    light = np.ones((height, width, 4), np.float32)
    light[..., :3] = under / 255
    data = gpu.types.Buffer("FLOAT", light.size, light.ravel())
    ground = gpu.types.GPUTexture((width, height), format="RGBA32F", data=data)
    offscreen = gpu.types.GPUOffScreen(width, height, format="RGBA8")
    with offscreen.bind(), gpu.matrix.push_pop(), gpu.matrix.push_pop_projection():
        frame = gpu.state.active_framebuffer_get()
        frame.clear(color=(0, 0, 0, 1))
        gpu.matrix.load_matrix(Matrix.Identity(4))
        flat = ((2 / width, 0, 0, -1), (0, 2 / height, 0, -1), (0, 0, -1, 0), (0, 0, 0, 1))
        gpu.matrix.load_projection_matrix(Matrix(flat))
        draw_texture_2d(ground, (0, 0), width, height)
        if result.tiles is not None:
            picture.draw_tiles(result.tiles, (0, 0, width, height), width / 960)
        picture.draw_takers(picture.takers(result), width - 10, height - 10, width / 960)
        pixels = np.array(frame.read_color(0, 0, width, height, 4, 0, "UBYTE").to_list(), np.uint8)
    offscreen.free()
    return np.ascontiguousarray(pixels.reshape(height, width, 4)[:, :, :3])


def difference_picture() -> np.ndarray:
    """The frame in full and culled, as displayed, and the image that Render Difference left, so bright that the largest
    difference but for one pixel in a thousand is white; rows from the top."""
    import bpy

    from ...lipac_addon.pictures import read_picture
    from ...lipac_addon.ui.jobs.difference import IMAGE
    from ..studies.pictures.strips import strip

    scene, pictures = bpy.context.scene, []
    for culled in (False, True):
        scene.lipac.use_for_renders = culled
        scene.render.image_settings.file_format = "PNG"
        scene.render.filepath = str(Path(bpy.app.tempdir) / "guide.png")
        bpy.ops.render.render(write_still=True)
        pictures.append(np.rint(255 * read_picture(Path(scene.render.filepath))[:, :, :3]).astype(np.uint8))
    image = bpy.data.images[IMAGE]
    pixels = np.empty(len(image.pixels), np.float32)
    image.pixels.foreach_get(pixels)
    difference = pixels.reshape(*pictures[0].shape[:2], 4)[:, :, :3]
    times = 1 / max(float(np.quantile(difference, 0.999)), 1e-6)
    shown = np.rint(255 * np.clip(times * difference, 0, 1) ** (1 / 2.2)).astype(np.uint8)
    scene.lipac.use_for_renders = False
    labels = "everything", "culled", f"their difference, {times:.2g} times as bright"
    return strip([picture[::-1] for picture in (*pictures, shown)], labels)


def overlay_picture(
    result: FrameResult,
    width: int,
    height: int,
    kinds: tuple[str, ...] = ("active", "pending", "regions"),
    heat_map: bool = False,
    opacity: float = 0.8,
) -> np.ndarray:
    """The solid viewport from outside with boxes and legend: (height, width, 3) uint8, rows bottom up."""
    import bpy
    import gpu
    from mathutils import Matrix

    from ...lipac_addon.raster import opengl
    from ...lipac_addon.ui.draw import overlay

    opengl.require()
    offscreen = gpu.types.GPUOffScreen(width, height, format="RGBA8")
    view, projection = outside(width / height)
    area = next(a for window in bpy.context.window_manager.windows for a in window.screen.areas if a.type == "VIEW_3D")
    space, region = area.spaces.active, next(r for r in area.regions if r.type == "WINDOW")
    space.shading.type, space.overlay.show_overlays, space.clip_end = "SOLID", False, 3000.0
    offscreen.draw_view3d(
        bpy.context.scene, bpy.context.view_layer, space, region, view, projection, do_color_management=True
    )
    with offscreen.bind():
        frame = gpu.state.active_framebuffer_get()
        frame.clear(depth=1.0)
        overlay.draw_boxes(result, kinds, opacity, projection @ view, in_front=True, heat_map=heat_map)
        with gpu.matrix.push_pop(), gpu.matrix.push_pop_projection():
            gpu.matrix.load_matrix(Matrix.Identity(4))
            gpu.matrix.load_projection_matrix(
                Matrix(((2 / width, 0, 0, -1), (0, 2 / height, 0, -1), (0, 0, -1, 0), (0, 0, 0, 1)))
            )
            overlay.draw_legend(result, kinds, 1.2 * width / 960, heat_map)
        pixels = np.array(frame.read_color(0, 0, width, height, 4, 0, "UBYTE").to_list(), np.uint8)
    offscreen.free()
    return np.ascontiguousarray(pixels.reshape(height, width, 4)[:, :, :3])


def outside(aspect: float, near: float = 1.0, far: float = 3000.0) -> tuple[Any, Any]:
    """The view of the city from above its roofs, and OpenGL's projection matrix."""
    from mathutils import Matrix, Vector

    turn = (Vector(TARGET) - Vector(EYE)).to_track_quat("-Z", "Y")
    view = (Matrix.Translation(EYE) @ turn.to_matrix().to_4x4()).inverted()
    a, b = (far + near) / (near - far), 2 * far * near / (near - far)
    return view, Matrix(((2 * FOCAL, 0, 0, 0), (0, 2 * FOCAL * aspect, 0, 0), (0, 0, a, b), (0, 0, -1, 0)))


if __name__ == "__main__":
    sys.exit(main())
