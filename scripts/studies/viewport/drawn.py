"""What a viewport shows, drawn by EEVEE into memory."""

from __future__ import annotations

import time

import numpy as np

from ....core.arrays import F32

SETTLED = 3  # successive pictures that are the same, after which all shaders are there


class Viewport:
    """A viewport in Rendered shading that looks through the camera, drawn into memory."""

    def __init__(self, size: tuple[int, int]) -> None:
        """size: width and height in pixels."""
        import bpy
        import gpu

        from ....lipac_addon.raster import opengl

        opengl.require()
        window = bpy.context.window_manager.windows[0]
        area = next(area for area in window.screen.areas if area.type == "VIEW_3D")
        self.space = area.spaces.active
        self.region = next(region for region in area.regions if region.type == "WINDOW")
        self.space.overlay.show_overlays = False
        self.size = size
        self.target = gpu.types.GPUOffScreen(*size, format="RGBA32F")

    def picture(self) -> F32:
        """(height, width, 3) float32, linear, rows bottom up: drawn until all shaders are compiled."""
        last, same = np.zeros((0, 0, 3), np.float32), 0
        while same < SETTLED:
            self.draw()
            now = self._read(*self.size)
            same = same + 1 if now.any() and np.array_equal(now, last) else 0
            last = now
            if not same:
                time.sleep(0.2)  # for the threads that compile
        return last

    def draw(self) -> None:
        """Evaluate what has changed, and draw once, by EEVEE; returns when that is done."""
        import bpy

        scene, layer = bpy.context.scene, bpy.context.view_layer
        scene.render.engine = "BLENDER_EEVEE"
        layer.update()
        camera = scene.camera
        view = camera.evaluated_get(layer.depsgraph).matrix_world.inverted()
        projection = camera.calc_matrix_camera(layer.depsgraph, x=self.size[0], y=self.size[1])
        self.target.draw_view3d(scene, layer, self.space, self.region, view, projection, do_color_management=False)
        self._read(1, 1)

    def _read(self, width: int, height: int) -> F32:
        """(height, width, 3) float32, from the lower left corner."""
        import gpu

        with self.target.bind():
            buffer = gpu.state.active_framebuffer_get().read_color(0, 0, width, height, 4, 0, "FLOAT")
        buffer.dimensions = width * height * 4  # Blender 5.0 hands out more dimensions in a wrong order
        return np.array(buffer, np.float32).reshape(height, width, 4)[:, :, :3]
