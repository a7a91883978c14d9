"""A terrain that is one object, the camera near its ground.

`python -m lipac.scripts.studies.memory.terrain FILE.blend N`: N x N vertices.
"""

from __future__ import annotations

import sys

import bpy
import numpy as np

SIZE, HEIGHT = 1000.0, 60.0  # metres


def main(path: str, n: int) -> None:
    """Save the scene."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    x, y = np.meshgrid(*[np.linspace(-SIZE / 2, SIZE / 2, n)] * 2, indexing="ij")
    z = sum(HEIGHT / 2**k * np.sin(x * 2**k / 160 + k) * np.cos(y * 2**k / 170 + 2 * k) for k in range(1, 8))
    points = np.stack([x, y, z], -1).reshape(-1, 3).astype(np.float32)
    i = np.arange((n - 1) * n).reshape(n - 1, n)[:, :-1].ravel()
    quads = np.stack([i, i + n, i + n + 1, i + 1], 1).astype(np.int32)
    mesh = bpy.data.meshes.new("Terrain")
    mesh.vertices.add(len(points))
    mesh.vertices.foreach_set("co", points.ravel())
    mesh.loops.add(quads.size)
    mesh.loops.foreach_set("vertex_index", quads.ravel())
    mesh.polygons.add(len(quads))
    mesh.polygons.foreach_set("loop_start", np.arange(0, quads.size, 4, dtype=np.int32))
    mesh.update()
    mesh.shade_smooth()
    scene.collection.objects.link(bpy.data.objects.new("Terrain", mesh))
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    ground = float(points[np.argmin(np.abs(points[:, :2]).sum(axis=1)), 2])
    camera.location, camera.rotation_euler = (0.0, 0.0, ground + 4.0), (1.5, 0.0, 0.4)
    sun = bpy.data.objects.new("Sun", bpy.data.lights.new("Sun", "SUN"))
    sun.rotation_euler, sun.data.energy = (0.9, 0.3, 0.0), 3.0
    for ob in (camera, sun):
        scene.collection.objects.link(ob)
    scene.camera, scene.world = camera, bpy.data.worlds.new("Sky")
    scene.render.engine, scene.cycles.use_denoising = "CYCLES", False
    bpy.ops.wm.save_as_mainfile(filepath=path)


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
