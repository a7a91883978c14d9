"""Textures: panels that each have an image of their own, a few before a wall and most behind it. What images cost, and
what culling saves of that."""

from __future__ import annotations

import bpy

from ...core.errors import InputError
from .builders import material

DEFAULT_IMAGES, MOST_IMAGES, PIXELS = 48, 512, 4096  # 64 MiB each, as bytes in RGBA
ROW = 8


def build(images: int | None = None, _seed: int = 0, pixels: int = PIXELS) -> None:
    """Replace what Blender has open by the scene: so many images of pixels x pixels, which Blender generates when they
    are used (nothing on disk).

    The first row of panels stands before the wall, all others behind it; nothing in it is random. Raises InputError for
    an unusable number.
    """
    count = DEFAULT_IMAGES if images is None else images
    if not 1 <= count <= MOST_IMAGES:
        raise InputError(f"--instances {count}: textures has 1 to {MOST_IMAGES} images")
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    bpy.ops.mesh.primitive_plane_add(size=120, location=(0, 40, 0))
    bpy.context.object.data.materials.append(material("Floor", (0.4, 0.4, 0.4)))
    bpy.ops.mesh.primitive_cube_add(size=1, location=(0, 3, 6))
    bpy.context.object.scale = (80, 0.4, 12)
    bpy.context.object.data.materials.append(material("Wall", (0.7, 0.68, 0.62)))
    bpy.ops.mesh.primitive_plane_add(size=2.4, rotation=(1.5708, 0, 0))
    panel = bpy.context.object.data
    bpy.data.objects.remove(bpy.context.object)
    for k in range(count):
        item = bpy.data.objects.new(f"Panel {k}", panel.copy())
        item.data.materials.append(_painted(k, pixels))
        item.location = (3.0 * (k % ROW - (ROW - 1) / 2), 5.0 * (k // ROW), 1.3)
        item.rotation_euler = (1.5708, 0.0, 0.0)
        scene.collection.objects.link(item)
    _light_and_camera(scene)


def _painted(k: int, pixels: int) -> bpy.types.Material:
    """A material with an image of its own."""
    image = bpy.data.images.new(f"Image {k}", pixels, pixels)
    image.source, image.generated_type = "GENERATED", "COLOR_GRID"
    image.use_fake_user = True
    out = material(f"Panel {k}", (0.8, 0.8, 0.8))
    tree = out.node_tree
    texture = tree.nodes.new("ShaderNodeTexImage")
    texture.image = image
    tree.links.new(texture.outputs["Color"], tree.nodes["Principled BSDF"].inputs["Base Color"])
    return out


def _light_and_camera(scene: bpy.types.Scene) -> None:
    sun = bpy.data.objects.new("Sun", bpy.data.lights.new("Sun", "SUN"))
    sun.data.energy, sun.rotation_euler = 3.0, (0.9, 0.2, 0.0)
    scene.collection.objects.link(sun)
    scene.world = bpy.data.worlds.new("Sky")
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    camera.location, camera.rotation_euler = (0.0, -16.0, 3.0), (1.5, 0.0, 0.0)
    camera.data.lens = 28.0
    scene.collection.objects.link(camera)
    scene.camera = camera
    scene.render.engine, scene.cycles.device, scene.cycles.samples = "CYCLES", "CPU", 64
    scene.cycles.use_denoising = scene.cycles.use_adaptive_sampling = False
    scene.render.resolution_x, scene.render.resolution_y = 960, 540
