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
    from matplotlib.image import imsave

    from ... import register
    from ...lipac_addon.demo import mirror_city
    from ...lipac_addon.ui.draw import figures
    from ...lipac_addon.ui.state import results

    register()
    mirror_city.build(args.instances, 0)
    scene = bpy.context.scene
    imsave(args.output / "live.png", live_picture()[::-1])
    bpy.ops.lipac.analyze()
    result = results.at(scene)
    if result is None:
        return 1
    for label, text in figures.rows_of(result):
        print(f"{label}: {text}")
    width, height = args.size
    imsave(args.output / "overlay.png", overlay_picture(result, width, height)[::-1])
    imsave(args.output / "heat.png", overlay_picture(result, width, height, ("active", "culled"), heat_map=True)[::-1])
    scene.render.resolution_x, scene.render.resolution_y, scene.cycles.samples = RENDER
    bpy.ops.lipac.difference()
    for label, text in figures.rows_of_difference(results.differences[scene.session_uid, scene.frame_current]):
        print(f"{label}: {text}")
    imsave(args.output / "difference.png", difference_picture()[::-1])
    return 0


def live_picture() -> np.ndarray:
    """Live mode from its start to its rest, three pictures in a row."""
    import bpy

    from ...lipac_addon.ui.jobs import live
    from ...lipac_addon.ui.state import results

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
    return np.concatenate(pictures, axis=1)


def difference_picture() -> np.ndarray:
    """The frame in full and culled, as displayed, and the image that Render Difference left, four times as bright."""
    import bpy

    from ...lipac_addon.pictures import read_picture
    from ...lipac_addon.ui.jobs.difference import IMAGE

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
    shown = np.clip(4 * pixels.reshape(*pictures[0].shape[:2], 4)[:, :, :3], 0, 1) ** (1 / 2.2)
    return np.concatenate([*pictures, np.rint(255 * shown).astype(np.uint8)], axis=1)


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

    from ...lipac_addon.ui.draw import overlay

    gpu.init()
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
