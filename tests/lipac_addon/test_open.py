"""Opening and importing scenes: what works, and one line for what does not."""

import json
import os
import struct

import bpy
import numpy as np
import pytest

from lipac.core.errors import InputError
from lipac.lipac_addon.open import frame_everything, open_scene, use_camera

CIRCLE = {"scenes": [{"nodes": [0]}], "nodes": [{"children": [0]}]}
TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"


def damaged(tmp_path, boxes_file):
    """Files that cannot be used, by what their error must say."""
    whole = boxes_file.read_bytes()
    document = {
        "asset": {"version": "2.0"},
        "extensionsRequired": ["KHR_draco_mesh_compression"],
        "extensionsUsed": ["KHR_draco_mesh_compression"],
    }
    meshopt = document | {"extensionsRequired": ["EXT_meshopt_compression"]}
    chunk = json.dumps(document).encode().ljust(256)
    files = {
        "half.blend": (whole[: len(whole) // 2], "cannot read"),
        "start.blend": (whole[:100], "cannot read"),
        "text.blend": (b"hello" * 100, "not supported"),
        "empty.blend": (b"", "is empty"),
        "empty.obj": (b"", "is empty"),
        "noface.obj": (b"v 0 0 0\n", "nothing to render"),
        "bad.ply": (b"ply\nformat ascii 1.0\n", "cannot read"),
        "half.glb": (struct.pack("<4sII", b"glTF", 2, 5000) + struct.pack("<II", 256, 0x4E4F534A) + chunk, "truncated"),
        "start.glb": (b"glTF", "truncated"),
        "draco.glb": (struct.pack("<4sII", b"glTF", 2, 276) + struct.pack("<II", 256, 0x4E4F534A) + chunk, "Draco"),
        "meshopt.gltf": (json.dumps(meshopt).encode(), "meshopt"),
        "list.gltf": (b"[1, 2]", "not glTF"),
        "word.gltf": (json.dumps(document | {"extensionsRequired": "KHR"}).encode(), "not glTF"),
        "table.gltf": (json.dumps(document | {"extensionsRequired": [{}, []]}).encode(), "not glTF"),
        "circle.gltf": (json.dumps({**CIRCLE, "asset": {"version": "2.0"}}).encode(), "RecursionError"),
        "deep.gltf": (b"[" * 100_000, "not glTF"),
        "note.txt": (b"hello", "cannot read '.txt'"),
    }
    for name, (data, says) in files.items():
        (tmp_path / name).write_bytes(data)
        yield tmp_path / name, says
    yield tmp_path / "missing.blend", "no such file"
    yield tmp_path, "is a folder"


def test_what_cannot_be_used_is_said_in_one_line(tmp_path, boxes_file):
    for path, says in damaged(tmp_path, boxes_file):
        with pytest.raises(InputError) as error:
            open_scene(path)
        assert says in str(error.value), path
        assert "\n" not in str(error.value), path
        assert "Traceback" not in str(error.value), path


def test_blend_is_opened_as_it_is(boxes_file):
    open_scene(boxes_file)
    assert len(bpy.context.scene.objects) == 12
    assert bpy.context.scene.camera is not None


def test_scripts_in_a_file_do_not_run(boxes_file, tmp_path):
    bpy.ops.wm.open_mainfile(filepath=str(boxes_file))
    text = bpy.data.texts.new("run.py")
    text.write("import bpy\nbpy.context.scene['ran'] = 1\n")
    text.use_module = True
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "script.blend"))
    open_scene(tmp_path / "script.blend")
    assert "ran" not in bpy.context.scene


def test_imports_get_camera_and_light(tmp_path):
    (tmp_path / "t.obj").write_text(TRIANGLE)
    open_scene(tmp_path / "t.obj")
    scene = bpy.context.scene
    assert scene.camera is not None
    assert [ob.type for ob in scene.objects].count("LIGHT") == 1
    assert scene.world is not None


@pytest.mark.parametrize("size", [1e-3, 1.0, 1e6])
def test_framing_camera_sees_everything(tmp_path, size):
    (tmp_path / "t.obj").write_text(
        "".join(f"v {x * size} {y * size} {z * size}\n" for x in (5, 6) for y in (0, 3) for z in (0, 1))
        + "f 1 2 3\nf 6 7 8\n"
    )
    open_scene(tmp_path / "t.obj")
    from bpy_extras.object_utils import world_to_camera_view

    scene = bpy.context.scene
    bpy.context.view_layer.update()
    ob = next(ob for ob in scene.objects if ob.type == "MESH")
    seen = np.array([world_to_camera_view(scene, scene.camera, ob.matrix_world @ v.co) for v in ob.data.vertices])
    assert (seen[:, :2] > 0).all()
    assert (seen[:, :2] < 1).all()
    assert (seen[:, 2] > scene.camera.data.clip_start).all()
    assert (seen[:, 2] < scene.camera.data.clip_end).all()


def test_absurd_coordinates_do_not_move_the_framing_camera(tmp_path):
    (tmp_path / "t.obj").write_text("o a\n" + TRIANGLE + "o b\nv 3e38 3e38 3e38\nv 3e38 0 0\nv 0 3e38 0\nf 4 5 6\n")
    open_scene(tmp_path / "t.obj")
    assert bpy.context.scene.camera.location.length < 10


def test_camera_by_name(boxes):
    data = bpy.data.cameras.new("second")
    second = bpy.data.objects.new("second", data)
    boxes.collection.objects.link(second)
    use_camera(boxes, "second")
    assert boxes.camera == second
    with pytest.raises(InputError, match=r"its cameras: Camera, second"):
        use_camera(boxes, "third")
    with pytest.raises(InputError, match="no camera 'wall'"):
        use_camera(boxes, "wall")
    use_camera(boxes, "auto")
    assert boxes.camera not in (None, second)


def test_nothing_to_frame():
    bpy.ops.wm.read_factory_settings(use_empty=True)
    with pytest.raises(InputError, match="nothing to render"):
        frame_everything(bpy.context.scene)


@pytest.mark.parametrize("mode", ["EDIT", "SCULPT"])
def test_other_modes_are_left(boxes_file, tmp_path, mode):
    bpy.ops.wm.open_mainfile(filepath=str(boxes_file))
    bpy.context.view_layer.objects.active = bpy.data.objects["wall"]
    bpy.ops.object.mode_set(mode=mode)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "edited.blend"))
    open_scene(tmp_path / "edited.blend")
    assert {ob.mode for ob in bpy.data.objects} == {"OBJECT"}
    assert len(bpy.data.objects["wall"].data.polygons) == 6


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="pipes with names")
def test_a_pipe_in_the_place_of_a_picture(boxes_file, tmp_path):
    """Reading it would wait for ever."""
    bpy.ops.wm.open_mainfile(filepath=str(boxes_file))
    image = bpy.data.images.new("pipe", 4, 4)
    image.filepath_raw, image.file_format = str(tmp_path / "pipe.png"), "PNG"
    image.save()
    image.source, image.use_fake_user = "FILE", True
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "pipe.blend"))
    open_scene(tmp_path / "pipe.blend")
    (tmp_path / "pipe.png").unlink()
    os.mkfifo(tmp_path / "pipe.png")
    with pytest.raises(InputError, match="image 'pipe' is no picture but a pipe"):
        open_scene(tmp_path / "pipe.blend")
