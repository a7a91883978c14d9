"""Blender's texture cache: files where they are asked for, nothing beside the user's images, settings put back, and a
line where it does not work."""

from pathlib import Path

import bpy
import numpy as np
import pytest

from lipac.core.errors import InputError
from lipac.lipac_addon.batch.engines import texture_cache as module
from lipac.lipac_addon.batch.engines.blender import render_blender
from lipac.lipac_addon.batch.engines.texture_cache import texture_cache
from lipac.scripts.lipac import main

needs_cache = pytest.mark.skipif(bpy.app.version < module.SINCE, reason="Blender has a texture cache from 5.2 on")


@pytest.fixture
def scene(tmp_path):
    """A lit plane with an image from a file, before the camera."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    scene.camera.location = (0, 0, 4)
    scene.collection.objects.link(scene.camera)
    scene.world = bpy.data.worlds.new("World")
    bpy.ops.mesh.primitive_plane_add()
    (tmp_path / "images").mkdir()
    made = bpy.data.images.new("made", 256, 256)
    made.pixels.foreach_set(np.random.default_rng(0).random(256 * 256 * 4, np.float32))
    made.filepath_raw, made.file_format = str(tmp_path / "images" / "noise.png"), "PNG"
    made.save()
    bpy.data.images.remove(made)
    material = bpy.data.materials.new("material")
    if bpy.app.version < (5, 0, 0):
        material.use_nodes = True
    node = material.node_tree.nodes.new("ShaderNodeTexImage")
    node.image = bpy.data.images.load(str(tmp_path / "images" / "noise.png"))
    shader = next(n for n in material.node_tree.nodes if n.type == "BSDF_PRINCIPLED")
    material.node_tree.links.new(node.outputs["Color"], shader.inputs["Base Color"])
    bpy.context.object.data.materials.append(material)
    scene.render.resolution_x, scene.render.resolution_y = 32, 18
    yield scene
    bpy.ops.wm.read_factory_settings(use_empty=True)


def settings(scene):
    render, paths = scene.render, bpy.context.preferences.filepaths
    return render.use_texture_cache, render.use_auto_generate_texture_cache, paths.texture_cache_directory


@needs_cache
def test_files_are_made_where_asked(scene, tmp_path):
    before, folder = settings(scene), tmp_path / "shared" / "tiles"
    with texture_cache(scene, folder) as lines:
        render_blender("cycles", tmp_path / "first", samples=1)
        made = {path.name: path.stat().st_mtime_ns for path in folder.iterdir()}
        render_blender("cycles", tmp_path / "second", samples=1)
        assert {path.name: path.stat().st_mtime_ns for path in folder.iterdir()} == made
    assert lines == []
    assert len(made) == 1
    assert next(iter(made)).startswith("noise.png")
    assert [path.name for path in (tmp_path / "images").iterdir()] == ["noise.png"]
    assert settings(scene) == before


@needs_cache
@pytest.mark.parametrize("whole", ["packed", "generated"])
def test_images_without_a_file_are_named(whole, scene, tmp_path):
    if whole == "packed":
        bpy.data.images["noise.png"].pack()
    else:
        node = next(n for n in bpy.data.materials["material"].node_tree.nodes if n.type == "TEX_IMAGE")
        node.image = bpy.data.images.new("generated", 8, 8)
    with texture_cache(scene, tmp_path / "tiles") as lines:
        render_blender("cycles", tmp_path / "picture", samples=1)
    assert [line.partition(":")[0] for line in lines] == ["texture cache"]
    assert lines[0].startswith("texture cache: 1 images are packed or made in Blender")
    assert not list((tmp_path / "tiles").iterdir())


def test_an_older_blender_says_so(scene, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "SINCE", (99, 0, 0))
    with texture_cache(scene, tmp_path / "tiles") as lines:
        assert lines == ["texture cache: Blender has one from 99.0 on; images are loaded whole"]
    assert not (tmp_path / "tiles").exists()


@needs_cache
def test_nothing_is_changed_where_nobody_asks(scene):
    before = settings(scene)
    with texture_cache(scene, None) as lines:
        assert (settings(scene), lines) == (before, [])


@needs_cache
def test_a_folder_that_cannot_be(scene, tmp_path):
    (tmp_path / "file").write_text("")
    with (
        pytest.raises(InputError, match=r"^--texture-cache .*file/tiles: cannot make it: Not a directory"),
        texture_cache(scene, tmp_path / "file" / "tiles"),
    ):
        pass


@needs_cache
def test_the_command(scene, tmp_path):
    """Without a folder: within the output's."""
    path, out = str(tmp_path / "scene.blend"), Path(tmp_path / "out")
    bpy.ops.wm.save_as_mainfile(filepath=path)
    assert main(["render", path, "-o", str(out), "--texture-cache", "--samples", "1", "--paths", "2", "--quiet"]) == 0
    assert [file.suffix for file in (out / "texture_cache").iterdir()] == [".tx"]
