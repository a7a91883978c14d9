"""A small scene that most tests of Blender's side can use."""

from pathlib import Path

import bpy
import pytest

from lipac.lipac_addon.raster import opengl


def ground_and_boxes() -> None:
    """A plane, a wall, four cubes of one mesh before it and four behind, one of them above; a sun, a grey world, a
    camera."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    bpy.ops.mesh.primitive_plane_add(size=40)
    bpy.ops.mesh.primitive_cube_add(size=1, location=(0, 6, 4))
    bpy.context.object.name, bpy.context.object.scale = "wall", (30, 0.2, 8)
    bpy.ops.mesh.primitive_cube_add(size=1)
    cube = bpy.context.object
    for k in range(8):
        ob = bpy.data.objects.new(f"box{k}", cube.data)
        ob.location = (2.0 * (k % 4) - 3, 9.0 if k > 3 else 0.0, 0.5)
        scene.collection.objects.link(ob)
    bpy.data.objects.remove(cube)
    bpy.ops.object.light_add(type="SUN", rotation=(0.6, 0.2, 0))
    bpy.ops.object.camera_add(location=(0, -12, 5), rotation=(1.25, 0, 0))
    scene.camera = bpy.context.object
    scene.world = bpy.data.worlds.new("World")
    draw_quickly(scene)
    render = scene.render
    render.engine, render.resolution_x, render.resolution_y, render.resolution_percentage = "CYCLES", 64, 36, 100
    scene.cycles.samples, scene.cycles.use_denoising, scene.cycles.use_adaptive_sampling = 2, False, False
    scene.cycles.max_bounces = 2


def draw_quickly(scene: bpy.types.Scene) -> None:
    """Have EEVEE prepare a map of the world that is as large as small pictures of a plain one need: it does so for
    every render, by the processor where there is no graphics card. (Shadows in less memory are not the same twice.)"""
    scene.world.probe_resolution = "128"


def save_rising(folder: Path) -> Path:
    """The same, whose camera goes up from frame 1 to 6 and then sees over the wall, as a .blend in a folder; its
    path."""
    ground_and_boxes()
    camera = bpy.context.scene.camera
    for frame, height, tilt in ((1, 5.0, 1.25), (6, 60.0, 0.26)):
        camera.location.z, camera.rotation_euler.x = height, tilt
        camera.keyframe_insert("location", frame=frame)
        camera.keyframe_insert("rotation_euler", frame=frame)
    bpy.context.scene.frame_end = 6
    path = folder / "rising.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    bpy.ops.wm.read_factory_settings(use_empty=True)
    return path


@pytest.fixture
def boxes():
    """The scene above, open; bpy.types.Scene."""
    ground_and_boxes()
    yield bpy.context.scene
    bpy.ops.wm.read_factory_settings(use_empty=True)


@pytest.fixture(scope="session")
def boxes_file(tmp_path_factory):
    """The scene above as a .blend; its path."""
    ground_and_boxes()
    path = tmp_path_factory.mktemp("scene") / "boxes.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    bpy.ops.wm.read_factory_settings(use_empty=True)
    return path


def need_graphics() -> None:
    """Skip a test where Blender cannot draw."""
    import gpu

    if not hasattr(gpu, "init"):
        pytest.skip("this Blender cannot draw without a window")
    try:
        gpu.init()
    except Exception as error:
        pytest.skip(f"no graphics here: {error}")
    opengl.require()
