"""Culled files lose what nothing in them needs, and render the same."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import bpy
import numpy as np
import pytest

from lipac.lipac_addon.batch.baked import save_copy
from lipac.lipac_addon.extract import extract_frame
from lipac.lipac_addon.farm.stripping import drop_linked, strip
from lipac.lipac_addon.pictures import read_picture
from lipac.lipac_addon.writeback import apply, restore

FAR = {"box4", "box5", "box6", "box7"}


def hide(names: set[str]) -> None:
    """As write-back does for culled instances of these objects."""
    restore()
    keys = extract_frame(bpy.context.scene).keys
    apply(np.isin(np.array(keys.names)[keys.records["object"]], list(names)), keys, lasting=True)


def rendered(folder: Path, name: str) -> Any:
    bpy.context.scene.render.filepath = str(folder / name)
    bpy.ops.render.render(write_still=True)
    return read_picture(folder / name)


def names() -> set[str]:
    return {ob.name for ob in bpy.data.objects}


def test_objects_data_and_pictures_go(boxes: Any, tmp_path: Path) -> None:
    """With a mesh and a texture of its own; one that only a fake user holds goes, too. What is rendered does not
    change, and the file is smaller."""
    box = bpy.data.objects["box5"]
    box.data = box.data.copy()
    image = bpy.data.images.new("wood", 64, 64)
    material = bpy.data.materials.new("wooden")
    node = material.node_tree.nodes.new("ShaderNodeTexImage")
    node.image = image
    box.data.materials.append(material)
    bpy.data.images.new("kept by nothing", 8, 8).use_fake_user = True
    hide(FAR)
    before = rendered(tmp_path, "before.png")
    save_copy(tmp_path / "hidden.blend")
    assert strip() == 4
    save_copy(tmp_path / "stripped.blend")
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "stripped.blend"))
    assert not names() & FAR
    assert {image.name for image in bpy.data.images} <= {"Render Result"}
    assert not bpy.data.materials.get("wooden")
    np.testing.assert_array_equal(rendered(tmp_path, "after.png"), before)
    assert (tmp_path / "stripped.blend").stat().st_size < (tmp_path / "hidden.blend").stat().st_size


@pytest.mark.parametrize("use", ["constraint", "driver", "child", "modifier", "collection", "geometry nodes"])
def test_what_something_else_uses_stays(boxes: Any, use: str) -> None:
    near, far = bpy.data.objects["box0"], bpy.data.objects["box5"]
    if use == "constraint":
        near.constraints.new("TRACK_TO").target = far
    elif use == "driver":
        variable = near.driver_add("location", 0).driver.variables.new()
        variable.type = "TRANSFORMS"
        variable.targets[0].id = far
    elif use == "child":
        near.parent = far
    elif use == "modifier":
        near.modifiers.new("s", "SHRINKWRAP").target = far
    else:
        collection = bpy.data.collections.new("picked")
        inner = bpy.data.collections.new("inner")
        collection.children.link(inner)
        inner.objects.link(far)
        if use == "collection":
            empty = bpy.data.objects.new("empty", None)
            empty.instance_type, empty.instance_collection = "COLLECTION", collection
            boxes.collection.objects.link(empty)
        else:
            group = bpy.data.node_groups.new("reads", "GeometryNodeTree")
            group.nodes.new("GeometryNodeCollectionInfo").inputs["Collection"].default_value = collection
            near.modifiers.new("nodes", "NODES").node_group = group
    hide(FAR)
    assert far.hide_render or use == "collection"
    strip()
    assert names() & FAR == {"box5"}


def test_of_a_family_that_is_hidden_all_goes(boxes: Any) -> None:
    """A parent, its child, and a third that follows the child: they use each other alone."""
    parent, child, third = (bpy.data.objects[name] for name in ("box4", "box5", "box6"))
    child.parent = parent
    third.constraints.new("COPY_LOCATION").target = child
    hide(FAR)
    assert strip() == 4


def link_far(boxes_file: Path, names: Sequence[str] = ("box4", "box5")) -> list[Any]:
    """Boxes of the file that is open go, and come back from a library."""
    for name in names:
        bpy.data.objects.remove(bpy.data.objects[name])
    with bpy.data.libraries.load(str(boxes_file), link=True) as (_, into):
        into.objects = list(names)
    for ob in into.objects:
        bpy.context.scene.collection.objects.link(ob)
    return list(into.objects)


def culled(names: set[str]) -> tuple[Any, Any]:
    """What says that all of these are culled, and the keys."""
    restore()
    keys = extract_frame(bpy.context.scene).keys
    plain = [name.rpartition("\n")[2] for name in keys.names]
    return np.isin(np.array(plain)[keys.records["object"]], list(names)), keys


def test_linked_objects_are_linked_no_more(boxes: Any, boxes_file: Path, tmp_path: Path) -> None:
    """Blender would not save that they are hidden. What is rendered does not change."""
    link_far(boxes_file)
    cull, keys = culled({"box4", "box5"})
    gone = drop_linked(cull, keys)
    assert (gone == cull).all()
    assert cull.sum() == 2
    strip()
    save_copy(tmp_path / "stripped.blend")
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "stripped.blend"))
    assert not names() & {"box4", "box5"}
    assert not list(bpy.data.libraries)


@pytest.mark.parametrize("use", ["constraint", "shown elsewhere", "linked collection", "light inside"])
def test_linked_objects_that_something_uses_stay(boxes: Any, boxes_file: Path, tmp_path: Path, use: str) -> None:
    if use == "linked collection":
        bpy.ops.wm.open_mainfile(filepath=str(boxes_file))
        collection = bpy.data.collections.new("of the library")
        collection.objects.link(bpy.data.objects["box4"])
        bpy.context.scene.collection.children.link(collection)
        bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "library.blend"))
        bpy.ops.wm.open_mainfile(filepath=str(boxes_file))
        bpy.data.objects.remove(bpy.data.objects["box4"])
        with bpy.data.libraries.load(str(tmp_path / "library.blend"), link=True) as (_, into):
            into.collections = ["of the library"]
        bpy.context.scene.collection.children.link(into.collections[0])
    else:
        (box,) = link_far(boxes_file, ["box4"])
        if use == "constraint":
            bpy.data.objects["box0"].constraints.new("TRACK_TO").target = box
        elif use == "light inside":
            lamp = bpy.data.objects.new("lamp", bpy.data.lights.new("lamp", "POINT"))
            bpy.context.scene.collection.objects.link(lamp)
            lamp.parent = box
    cull, keys = culled({"box4"})
    assert cull.sum() == 1
    if use == "shown elsewhere":
        cull[:] = False
    assert not drop_linked(cull, keys).any()
    assert "box4" in names()


def test_nothing_hidden(boxes: Any) -> None:
    before = names()
    assert strip() == 0
    assert names() == before
