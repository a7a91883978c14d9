"""Renders by Blender's engines leave the scene as it was, and by the path tracer."""

import bpy
import numpy as np
import pytest

from lipac.core.errors import InputError
from lipac.lipac_addon.batch.engines.blender import render_blender
from lipac.lipac_addon.batch.engines.path import render_path
from lipac.lipac_addon.batch.engines.wishes import left_out
from lipac.lipac_addon.extract import extract_frame
from lipac.lipac_addon.pictures import read_picture

pytestmark = pytest.mark.slow


def values(thing):
    return {
        p.identifier: str(getattr(thing, p.identifier))
        for p in thing.bl_rna.properties
        if p.type not in ("POINTER", "COLLECTION")
    }


def test_cycles(boxes, tmp_path):
    boxes.render.engine = "BLENDER_EEVEE"
    boxes.render.use_border = True
    before = [values(boxes.render), values(boxes.cycles), values(boxes.render.image_settings)]
    said = []
    first = render_blender(
        "cycles", tmp_path / "a", samples=3, seed=5, threads=1, progress=lambda f, w: said.append((f, w))
    )
    render_blender("cycles", tmp_path / "b", samples=3, seed=5, threads=2)
    render_blender("cycles", tmp_path / "c", samples=3, seed=6)
    assert [values(boxes.render), values(boxes.cycles), values(boxes.render.image_settings)] == before
    assert first.seconds > (first.first_sample_s or 0.0) > 0
    assert said[-1] == (1.0, "sample 3 of 3")
    a, b, c = (read_picture(tmp_path / f"{n}.exr") for n in "abc")
    assert a.shape[:2] == (36, 64)
    assert (a == b).all()
    assert (a != c).any()


def test_file_outputs_write_nothing(boxes, tmp_path):
    tree = boxes.compositing_node_group = bpy.data.node_groups.new("compositor", "CompositorNodeTree")
    tree.interface.new_socket("Image", in_out="OUTPUT", socket_type="NodeSocketColor")
    layers, output, file = (
        tree.nodes.new(n) for n in ("CompositorNodeRLayers", "NodeGroupOutput", "CompositorNodeOutputFile")
    )
    file.directory = str(tmp_path / "theirs")
    file.file_output_items.new("RGBA", "Image")
    for socket in (output.inputs[0], file.inputs[0]):
        tree.links.new(layers.outputs["Image"], socket)
    render_blender("cycles", tmp_path / "a", samples=1)
    assert not (tmp_path / "theirs").exists()
    assert not file.mute
    bpy.ops.render.render()
    assert (tmp_path / "theirs").exists()  # Blender alone would have written


def test_scenes_in_the_compositor_stay_at_their_frames(boxes, tmp_path):
    """A render moves them to its own."""
    tree = boxes.compositing_node_group = bpy.data.node_groups.new("compositor", "CompositorNodeTree")
    tree.interface.new_socket("Image", in_out="OUTPUT", socket_type="NodeSocketColor")
    layers, output = tree.nodes.new("CompositorNodeRLayers"), tree.nodes.new("NodeGroupOutput")
    layers.scene = other = bpy.data.scenes.new("second")
    tree.links.new(layers.outputs["Image"], output.inputs[0])
    other.camera, other.render.engine, other.cycles.samples = boxes.camera, "CYCLES", 1
    boxes.frame_set(12, subframe=0.5)
    other.frame_current, other.frame_subframe = 3, 0.25
    render_blender("cycles", tmp_path / "a", samples=1)
    assert (other.frame_current, other.frame_subframe) == (3, 0.25)
    bpy.ops.render.render()
    assert other.frame_current == 12  # Blender alone


def test_parts_of_a_film(boxes, tmp_path):
    """Blender refuses to render a film of less than 16 pixels, and a verification renders parts."""
    settings = boxes.render.image_settings
    settings.media_type, settings.file_format = "VIDEO", "FFMPEG"
    render_blender("cycles", tmp_path / "a", samples=1, border=(0.0, 0.0, 0.25, 1 / 3))
    assert read_picture(tmp_path / "a.exr").shape[:2] == (12, 16)
    assert (settings.media_type, settings.file_format) == ("VIDEO", "FFMPEG")


def test_no_view_layer_is_unusable_input(boxes, tmp_path):
    """Blender renders nothing then, without an error."""
    boxes.view_layers[0].use = False
    with pytest.raises(InputError, match="no view layer is used for rendering"):
        render_blender("cycles", tmp_path / "a", samples=1)


def test_eevee(boxes, tmp_path):
    boxes.render.resolution_percentage = 50
    render_blender("eevee", tmp_path / "a", samples=1)
    picture = read_picture(tmp_path / "a.exr")
    assert picture.shape[:2] == (18, 32)
    assert np.isfinite(picture).all()
    assert picture[..., :3].max() > 0.05
    assert boxes.render.engine == "CYCLES"


def test_path(boxes, tmp_path):
    """The linear mean of the path tracer's picture is that of Cycles, to the noise: 3 standard errors of the difference
    of 8 independent pairs."""
    scene = extract_frame(boxes).scene
    everything = np.ones(len(scene.instances), bool)
    differences = []
    for seed in range(8):
        render_path(scene, everything, tmp_path / "p", samples=8, seed=seed)
        render_blender("cycles", tmp_path / "c", samples=8, seed=seed)
        differences.append(
            read_picture(tmp_path / "p.exr")[..., :3].mean() - read_picture(tmp_path / "c.exr")[..., :3].mean()
        )
    error = np.std(differences, ddof=1) / np.sqrt(len(differences))
    assert abs(np.mean(differences)) < 3 * error + 1e-6


def test_no_camera(boxes, tmp_path):
    boxes.camera = None
    with pytest.raises(InputError, match="cycles cannot render the scene"):
        render_blender("cycles", tmp_path / "a", samples=1)


def test_left_out(boxes):
    """What a scene asks of its renders and an engine does not do is named; what it does not ask is not."""
    assert [line.partition(":")[0] for line in left_out(boxes, "eevee")] == ["EEVEE's sun"]
    for sun in [ob for ob in boxes.objects if ob.type == "LIGHT"]:
        sun.data.type = "POINT"
    assert [left_out(boxes, engine) for engine in ("", "cycles", "eevee", "hybrid", "path")] == [[]] * 5
    boxes.render.use_border = boxes.render.use_motion_blur = True
    boxes.view_layers.new("second")
    boxes.compositing_node_group = bpy.data.node_groups.new("grade", "CompositorNodeTree")
    named = {
        engine: [line.partition(":")[0] for line in left_out(boxes, engine)]
        for engine in ("", "cycles", "hybrid", "path")
    }
    ours = ["render region", "view layers", "motion blur", "compositing"]
    assert named == {"": [], "cycles": ["render region"], "hybrid": ours, "path": ours}


def test_output_that_is_left_out_is_said(boxes):
    """In one line, which names the way to have it; with that, nothing is left out. What a scene does not ask for, or
    has muted, is not named."""
    tree = boxes.compositing_node_group = bpy.data.node_groups.new("compositor", "CompositorNodeTree")
    files = [tree.nodes.new("CompositorNodeOutputFile") for _ in range(3)]
    files[0].mute = True
    boxes.render.image_settings.media_type, boxes.render.image_settings.file_format = (
        "MULTI_LAYER_IMAGE",
        "OPEN_EXR_MULTILAYER",
    )
    boxes.render.use_stamp = True
    said = (
        "output: pictures are .exr and .png; left out: passes in multilayer OpenEXR, 2 File Output nodes of the "
        "compositor, text burnt into the picture"
    )
    assert left_out(boxes, "cycles") == [said + "; --as-scene writes all of it"]
    assert left_out(boxes, "path")[0] == said
    assert left_out(boxes, "cycles", as_scene=True) == left_out(boxes, "") == []
    boxes.render.use_compositing = boxes.render.use_stamp = False
    boxes.render.image_settings.media_type, boxes.render.image_settings.file_format = "VIDEO", "FFMPEG"
    assert left_out(boxes, "eevee")[0] == "output: pictures are .exr and .png; left out: the film"
