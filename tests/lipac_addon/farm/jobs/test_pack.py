"""What is packed of a scene with textures and libraries, in full and culled."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import bpy
import numpy as np
import pytest

from lipac.core.errors import InputError
from lipac.lipac_addon.farm import analyse, unite
from lipac.lipac_addon.farm.jobs import pack
from lipac.lipac_addon.farm.jobs.writing import Wanted, write_shot
from lipac.lipac_addon.farm.layout import FarmShot
from lipac.lipac_addon.open import open_scene
from lipac.lipac_addon.pictures import read_picture

pytestmark = pytest.mark.slow
NEEDS = pytest.mark.skipif(
    bpy.app.version < (5, 1) or sys.version_info < (3, 13), reason="Blender Asset Tracer knows Blender 5.1 and later"
)


def texture(folder: Path, name: str, seed: int) -> Any:
    """A picture of noise as a file, 100 kB or so."""
    image = bpy.data.images.new(name, 192, 192)
    image.pixels.foreach_set(np.random.default_rng(seed).random(192 * 192 * 4, np.float32))
    image.filepath_raw, image.file_format = str(folder / f"{name}.png"), "PNG"
    image.save()
    return image


def wear(ob: Any, image: Any) -> None:
    """A mesh and a material of its own, with a texture."""
    ob.data = ob.data.copy()
    material = bpy.data.materials.new(ob.name)
    tree = material.node_tree
    node = tree.nodes.new("ShaderNodeTexImage")
    node.image = image
    tree.links.new(node.outputs[0], tree.nodes["Principled BSDF"].inputs[0])
    ob.data.materials.append(material)


@pytest.fixture
def textured(rising: Path, tmp_path: Path) -> FarmShot:
    """Every box of the scene has a texture, one before the wall and one behind it are linked from a library; the shot
    is of a frame before the wall."""
    scene = tmp_path / "project" / "scenes" / "textured.blend"
    textures = tmp_path / "project" / "textures"
    scene.parent.mkdir(parents=True)
    textures.mkdir()
    open_scene(rising)
    for k in range(8):
        wear(bpy.data.objects[f"box{k}"], texture(textures, f"texture{k}", k))
    library = tmp_path / "project" / "library.blend"
    bpy.data.libraries.write(
        str(library), {bpy.data.objects["box7"], bpy.data.objects["box0"]}, path_remap="RELATIVE_ALL"
    )
    for name in ("box7", "box0"):
        bpy.data.objects.remove(bpy.data.objects[name])
    bpy.data.orphans_purge(do_recursive=True)
    bpy.ops.wm.save_as_mainfile(filepath=str(scene))
    with bpy.data.libraries.load(str(library), link=True) as (_, into):
        into.objects = ["box0", "box7"]
    for ob in into.objects:
        bpy.context.scene.collection.objects.link(ob)
    bpy.ops.file.make_paths_relative()
    bpy.ops.wm.save_as_mainfile(filepath=str(scene))
    shot = write_shot(tmp_path / "project" / "shots" / "one", scene, Wanted(frames=(1,), paths=2))
    analyse.analyse(shot, shot.frames)
    unite.unite(shot)
    return shot


@NEEDS
def test_only_what_the_culled_file_needs(textured: FarmShot) -> None:
    """Textures of boxes behind the wall are left behind; the pack renders elsewhere as the file does here."""
    found = pack.pack(textured)
    packed = {path.name for path in (textured.folder / pack.PACKED).rglob("*") if path.is_file()}
    assert packed >= {"shot.blend", "library.blend", "texture1.png", "texture2.png", "texture3.png"}
    assert not packed & {"texture4.png", "texture5.png", "texture6.png", "texture7.png"}
    assert found["culled"]["missing"] == found["full"]["missing"] == []
    assert found["full"]["files"] - found["culled"]["files"] == 4
    assert found["full"]["bytes"] - found["culled"]["bytes"] > 4 * 50_000
    rendered = []
    for path in (textured.culled, next((textured.folder / pack.PACKED).rglob("shot.blend"))):
        bpy.ops.wm.open_mainfile(filepath=str(path))
        bpy.context.scene.frame_set(1)
        bpy.context.scene.render.filepath = str(textured.folder / "picture.png")
        bpy.ops.render.render(write_still=True)
        rendered.append(read_picture(textured.folder / "picture.png"))
        images = [image for image in bpy.data.images if image.source == "FILE"]
        assert images
        assert all(str(path.parents[2]) in bpy.path.abspath(image.filepath, library=image.library) for image in images)
    np.testing.assert_array_equal(rendered[0], rendered[1])


@NEEDS
def test_absolute_paths_elsewhere_take_a_blender(textured: FarmShot, tmp_path: Path) -> None:
    bpy.ops.wm.open_mainfile(filepath=str(textured.culled))
    bpy.ops.file.make_paths_absolute()
    bpy.ops.wm.save_mainfile()
    with pytest.raises(InputError, match="only a Blender rewrites these"):
        pack.pack(textured)


def test_before_there_is_a_set(shot: FarmShot) -> None:
    with pytest.raises(InputError, match="run lipac shot unite"):
        pack.pack(shot)


def test_without_the_tracer(textured: FarmShot, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "blender_asset_tracer.cli.pack", None)
    with pytest.raises(InputError, match="pip install"):
        pack.pack(textured)
