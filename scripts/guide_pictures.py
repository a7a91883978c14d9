"""The picture of docs/user-guide.md, from the demo city: `python -m lipac.scripts.guide_pictures -o docs/pictures`.

Needs Blender 5.2 and graphics; software ones will do.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from ..lipac_addon.ui.results import FrameResult

EYE, TARGET = (-150.0, -250.0, 210.0), (10.0, -25.0, 0.0)
FOCAL = 1.6  # distance to width of the view


def main(argv: Sequence[str] | None = None) -> int:
    """Analyse the city by the extension's operators and draw its overlay over the viewport; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--output", type=Path, default=Path("docs/pictures"))
    parser.add_argument("--instances", type=int, default=6000)
    parser.add_argument("--size", type=int, nargs=2, default=(960, 540))
    args = parser.parse_args(argv)
    args.output.mkdir(parents=True, exist_ok=True)
    import bpy
    from matplotlib.image import imsave

    from .. import register
    from ..lipac_addon.demo import mirror_city
    from ..lipac_addon.ui import panel, results

    register()
    mirror_city.build(args.instances, 0)
    bpy.ops.lipac.analyze()
    result = results.at(bpy.context.scene)
    if result is None:
        return 1
    for label, text in panel.rows_of(result):
        print(f"{label}: {text}")
    imsave(args.output / "overlay.png", overlay_picture(result, *args.size)[::-1])
    return 0


def overlay_picture(result: FrameResult, width: int, height: int) -> np.ndarray:
    """The solid viewport from outside with boxes and legend: (height, width, 3) uint8, rows bottom up."""
    import bpy
    import gpu
    from mathutils import Matrix, Vector

    from ..lipac_addon.ui import overlay

    gpu.init()
    offscreen = gpu.types.GPUOffScreen(width, height, format="RGBA8")
    turn = (Vector(TARGET) - Vector(EYE)).to_track_quat("-Z", "Y")
    view = (Matrix.Translation(EYE) @ turn.to_matrix().to_4x4()).inverted()
    projection = perspective(width / height)
    area = next(a for window in bpy.context.window_manager.windows for a in window.screen.areas if a.type == "VIEW_3D")
    space, region = area.spaces.active, next(r for r in area.regions if r.type == "WINDOW")
    space.shading.type, space.overlay.show_overlays, space.clip_end = "SOLID", False, 3000.0
    offscreen.draw_view3d(bpy.context.scene, bpy.context.view_layer, space, region, view, projection, do_color_management=True)
    with offscreen.bind():
        frame = gpu.state.active_framebuffer_get()
        frame.clear(depth=1.0)
        overlay.draw_boxes(result, ("active", "regions"), 0.8, projection @ view, in_front=True)
        with gpu.matrix.push_pop(), gpu.matrix.push_pop_projection():
            gpu.matrix.load_matrix(Matrix.Identity(4))
            gpu.matrix.load_projection_matrix(Matrix(((2 / width, 0, 0, -1), (0, 2 / height, 0, -1), (0, 0, -1, 0), (0, 0, 0, 1))))
            overlay.draw_legend(result, ("active", "regions"), 1.2)
        pixels = np.array(frame.read_color(0, 0, width, height, 4, 0, "UBYTE").to_list(), np.uint8)
    return np.ascontiguousarray(pixels.reshape(height, width, 4)[:, :, :3])


def perspective(aspect: float, near: float = 1.0, far: float = 3000.0) -> object:
    """OpenGL's projection matrix."""
    from mathutils import Matrix

    a, b = (far + near) / (near - far), 2 * far * near / (near - far)
    return Matrix(((2 * FOCAL, 0, 0, 0), (0, 2 * FOCAL * aspect, 0, 0), (0, 0, a, b), (0, 0, -1, 0)))


if __name__ == "__main__":
    sys.exit(main())
