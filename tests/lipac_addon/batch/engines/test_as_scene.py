"""Renders as the scene says write what `blender -b -f` writes: the same files, layers, metadata and pixels, where
nothing visible is culled."""

import struct
from pathlib import Path

import bpy
import numpy as np
import pytest

from lipac.core.culling.options import CullOptions
from lipac.core.errors import InputError
from lipac.core.files.report import Report
from lipac.lipac_addon.batch.engines.as_scene import engine_of, files_of, render_as_scene
from lipac.lipac_addon.batch.job import SHOT, Job
from lipac.lipac_addon.batch.pipeline import REGION, STEREO, run
from lipac.lipac_addon.pictures import read_picture
from lipac.scripts.lipac import main

OpenEXR = pytest.importorskip("OpenEXR")
pytestmark = [pytest.mark.slow, pytest.mark.blender]
FAR = CullOptions(policy="distance", setting=19.5)  # the boxes behind the wall, which nothing shows
# of each run its own
OF_THE_RUN = (
    "Date", "DateTime", "RenderTime", "render_time", "synchronization_time", "total_time", "Memory", "Hostname"
)


def values(thing):
    return {
        p.identifier: str(getattr(thing, p.identifier))
        for p in thing.bl_rna.properties
        if p.type not in ("POINTER", "COLLECTION")
    }


def images(folder):
    """Of each picture below a folder what it says of itself, without what differs from run to run, and its channels'
    pixels."""
    out = {}
    for path in sorted(p for p in folder.rglob("*") if p.is_file()):
        parts = exr_parts(path) if path.suffix == ".exr" else [(png_head(path), {"all": read_picture(path)})]
        out[str(path.relative_to(folder))] = [
            ({k: v for k, v in head.items() if not any(word in k for word in OF_THE_RUN)}, pixels)
            for head, pixels in parts
        ]
    return out


def exr_parts(path):
    with OpenEXR.File(str(path), separate_channels=True) as file:
        parts = [
            (
                {k: str(v) for k, v in part.header.items()},
                {name: np.array(c.pixels) for name, c in part.channels.items()},
            )
            for part in file.parts
        ]
    return [
        (head | {f"type of {name}": str(pixels.dtype) for name, pixels in planes.items()}, planes)
        for head, planes in parts
    ]


def png_head(path):
    """IHDR and texts of a PNG."""
    data, at, head = path.read_bytes(), 8, {}
    while at < len(data):
        length, kind = struct.unpack_from(">I4s", data, at)
        body = data[at + 8 : at + 8 + length]
        if kind == b"IHDR":
            head["IHDR"] = body
        elif kind == b"tEXt":
            key, _, value = body.partition(b"\0")
            head[key.decode()] = value
        at += 12 + length
    return head


def assert_same(ours, theirs):
    assert ours.keys() == theirs.keys()
    for name, parts in theirs.items():
        assert len(ours[name]) == len(parts), name
        for (my_head, mine), (head, other) in zip(ours[name], parts, strict=True):
            assert my_head == head, name
            assert mine.keys() == other.keys(), name
            assert [
                channel for channel in other if not np.array_equal(mine[channel], other[channel], equal_nan=True)
            ] == [], name


def by_blender(scene, frame):
    """What `blender -b -f` calls."""
    first, last = scene.frame_start, scene.frame_end
    scene.frame_start = scene.frame_end = frame
    bpy.ops.render.render(animation=True, scene=scene.name)
    scene.frame_start, scene.frame_end = first, last


def both(scene, tmp_path, **more):
    """The pictures of frames 2 and 3 by Blender, and by a job that culls; and the job's report."""
    pattern, found = scene.render.filepath, []
    for name in ("theirs", "ours"):
        folder = tmp_path / name
        scene.render.filepath = str(folder / pattern)
        for node in [n for tree in bpy.data.node_groups for n in tree.nodes if n.type == "OUTPUT_FILE"]:
            node.directory = str(folder / "nodes")
        if name == "theirs":
            for frame in (2, 3):
                scene.frame_set(frame)
                by_blender(scene, frame)
        else:
            before = [values(scene), values(scene.render), values(scene.cycles), values(scene.render.image_settings)]
            report = Report("", "", "", "distance", "cycles", 0, 0)
            job = Job(tmp_path / "report", (2, 3), FAR, engine_of(scene), as_scene=True, **more)
            run(job, report)
            after = [values(scene), values(scene.render), values(scene.cycles), values(scene.render.image_settings)]
            assert {k: v for k, v in after[0].items() if not k.startswith("frame_")} == {
                k: v for k, v in before[0].items() if not k.startswith("frame_")
            }
            assert after[1:] == before[1:]
            assert (scene.frame_start, scene.frame_end) == (1, 250)
        found.append(images(folder))
    return *found, report, job


@pytest.fixture
def asking(boxes):
    """A scene that asks for all there is: passes in multilayer OpenEXR, two layers, a region, a compositor with a file
    of its own, a pattern, metadata."""
    render = boxes.render
    render.filepath = "shot_###_x"
    render.image_settings.media_type, render.image_settings.file_format = "MULTI_LAYER_IMAGE", "OPEN_EXR_MULTILAYER"
    render.image_settings.color_depth, render.image_settings.exr_codec = "16", "PIZ"
    render.use_border, render.use_crop_to_border = True, False
    render.border_min_x, render.border_max_x, render.border_min_y, render.border_max_y = 0.25, 0.75, 0.0, 1.0
    second = boxes.view_layers.new("second")
    boxes.view_layers[0].use_pass_normal = second.use_pass_z = second.use_pass_diffuse_color = True
    boxes.cycles.seed, boxes.cycles.use_animated_seed, boxes.cycles.samples = 7, True, 2
    render.use_stamp_note, render.stamp_note_text = True, "a note"
    tree = boxes.compositing_node_group = bpy.data.node_groups.new("compositor", "CompositorNodeTree")
    tree.interface.new_socket("Image", in_out="OUTPUT", socket_type="NodeSocketColor")
    layers, output, file = (
        tree.nodes.new(n) for n in ("CompositorNodeRLayers", "NodeGroupOutput", "CompositorNodeOutputFile")
    )
    file.file_output_items.new("RGBA", "graded")
    for socket in (output.inputs[0], file.inputs[0]):
        tree.links.new(layers.outputs["Image"], socket)
    return boxes


@pytest.mark.parametrize("bake", ["frame", SHOT])
def test_all_that_a_scene_asks_for(asking, tmp_path, bake):
    theirs, ours, report, job = both(asking, tmp_path, bake=bake)
    assert len(theirs) == 4
    assert {"shot_002_x.exr", "shot_003_x.exr"} < theirs.keys()
    channels = [name for _, planes in theirs["shot_002_x.exr"] for name in planes]
    assert any("Normal" in name for name in channels) and any(name.startswith("second.") for name in channels)
    assert_same(ours, theirs)
    assert min(frame["culled"] for frame in report.frames) >= 4
    assert REGION in report.warnings
    assert job.is_finished(2)
    assert not [line for line in report.approximated if line.startswith(("output", "render region", "view layers"))]
    assert not list((tmp_path / "report").glob("frame_*"))


def test_a_plain_scene_by_eevee(boxes, tmp_path):
    """16-bit PNG without an alpha, half the size, four digits and an ending of Blender's own."""
    boxes.render.engine, boxes.render.filepath, boxes.render.resolution_percentage = "BLENDER_EEVEE", "e", 50
    boxes.eevee.taa_render_samples = 1
    boxes.render.image_settings.color_mode, boxes.render.image_settings.color_depth = "RGB", "16"
    theirs, ours, report, _ = both(boxes, tmp_path)
    assert list(theirs) == ["e0002.png", "e0003.png"]
    assert_same(ours, theirs)
    assert report.frames[0]["first_sample_s"] is None or report.frames[0]["first_sample_s"] > 0


def test_views_are_all_rendered_and_nothing_is_culled(boxes, tmp_path):
    boxes.render.use_multiview, boxes.render.filepath, boxes.cycles.samples = True, "v", 1
    theirs, ours, report, _ = both(boxes, tmp_path)
    assert list(theirs) == ["v0002_L.png", "v0002_R.png", "v0003_L.png", "v0003_R.png"]
    assert_same(ours, theirs)
    assert report.warnings == [STEREO]
    assert report.frames[0]["active"] == report.frames[0]["instances"]
    assert [path.name for path in files_of(boxes, 2)] == ["v0002_L.png", "v0002_R.png"]


def test_what_cannot_be_rendered_so_is_refused(boxes):
    boxes.render.engine = "BLENDER_WORKBENCH"
    with pytest.raises(
        InputError, match=r"^--as-scene: scene 'Scene' is rendered by BLENDER_WORKBENCH, which culling does not reach"
    ):
        engine_of(boxes)
    boxes.render.engine = "CYCLES"
    boxes.render.image_settings.media_type, boxes.render.image_settings.file_format = "VIDEO", "FFMPEG"
    with pytest.raises(InputError, match=r"^--as-scene: scene 'Scene' is rendered to a film"):
        engine_of(boxes)


def test_a_frame_before_0_is_refused(boxes):
    """Blender's range of frames begins at 0: it would render that, and overwrite its file."""
    with pytest.raises(InputError, match=r"^--as-scene: frame -3 is before 0"):
        render_as_scene("cycles", -3)


def test_by_the_command(asking, tmp_path, capfd):
    """Relative to the file; an engine, or a device for EEVEE, is refused in one line."""
    asking.render.filepath = "//pictures/p_##"
    asking.compositing_node_group = None
    path = tmp_path / "file.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    out = tmp_path / "out"
    capfd.readouterr()
    assert (
        main(
            [
                "render", str(path), "-o", str(out), "--as-scene", "--cull", "distance", "--distance", "19.5",
                "--frames", "4", "--quiet"
            ]
        )
        == 0
    )
    assert [str(p.relative_to(tmp_path)) for p in (tmp_path / "pictures").iterdir()] == ["pictures/p_04.exr"]
    assert (out / "report.json").exists() and not list(out.glob("frame*"))
    capfd.readouterr()
    assert main(["render", str(path), "-o", str(out), "--as-scene", "--engine", "cycles", "--quiet"]) == 2
    assert "leave --engine out" in capfd.readouterr().err
    bpy.context.scene.render.engine = "BLENDER_EEVEE"
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    capfd.readouterr()
    assert main(["render", str(path), "-o", str(Path(tmp_path) / "b"), "--as-scene", "--device", "cpu", "--quiet"]) == 2
    assert "--device chooses where Cycles renders; EEVEE" in capfd.readouterr().err
