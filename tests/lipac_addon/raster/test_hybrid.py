"""The hybrid renderer by its command: against Cycles, against EEVEE alone, and what it leaves behind."""

import json
import os
import subprocess
import sys
import tracemalloc

import bpy
import numpy as np
import pytest

from lipac.core.culling.loop import Loop
from lipac.core.culling.options import CullOptions
from lipac.core.errors import InputError
from lipac.core.evaluation.metrics import relative_mse
from lipac.lipac_addon.batch.engines import hybrid_frame
from lipac.lipac_addon.batch.engines.blender import render_blender
from lipac.lipac_addon.batch.engines.hybrid_frame import HybridOptions, render_hybrid
from lipac.lipac_addon.extract import extract_frame
from lipac.lipac_addon.pictures import read_picture
from lipac.lipac_addon.raster import opengl
from lipac.lipac_addon.raster.denoise import _library, denoise
from lipac.lipac_addon.raster.layers import read_layers
from lipac.lipac_addon.raster.passes import Passes, render_passes
from lipac.scripts.lipac import main
from lipac.scripts.studies.hybrid import pop

from ..conftest import draw_quickly

SMALL = ["--resolution", "64x36", "--quiet"]
FAST = [*SMALL, "--engine", "hybrid", "--raster-samples", "2"]
needs_opengl = pytest.mark.skipif(not opengl.has_opengl(), reason=opengl.NO_OPENGL)


@pytest.fixture(scope="module")
def scene_file(tmp_path_factory):
    """A ground, a slab that keeps the sun off a part of it, a red wall that lends it its colour, all plain; its
    path."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    bpy.ops.mesh.primitive_plane_add(size=14)
    bpy.ops.mesh.primitive_cube_add(size=1, location=(0, 0, 2.5))
    bpy.context.object.name, bpy.context.object.scale = "slab", (3, 3, 0.2)
    bpy.ops.mesh.primitive_cube_add(size=1, location=(3.2, 0, 1.2))
    bpy.context.object.scale = (0.2, 6, 2.4)
    material = bpy.data.materials.new("red")
    material.use_nodes = True
    material.node_tree.nodes["Principled BSDF"].inputs["Base Color"].default_value = (0.8, 0.1, 0.1, 1)
    bpy.context.object.data.materials.append(material)
    bpy.ops.object.light_add(type="SUN", rotation=(0.1, -0.2, 0))
    bpy.context.object.data.energy = 3
    bpy.ops.object.camera_add(location=(0, -9, 4), rotation=(1.2, 0, 0))
    scene.camera = bpy.context.object
    scene.world = bpy.data.worlds.new("World")
    scene.world.use_nodes = True
    scene.world.node_tree.nodes["Background"].inputs["Color"].default_value = (0.3, 0.3, 0.3, 1)
    draw_quickly(scene)
    scene.render.engine, scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = (
        "CYCLES", 64, 36, 100
    )
    scene.cycles.use_denoising, scene.cycles.use_adaptive_sampling = False, False
    path = tmp_path_factory.mktemp("scene") / "slab.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    return path


@pytest.fixture(scope="module")
def pictures(scene_file, tmp_path_factory):
    """Of that scene: Cycles (converged), EEVEE, and hybrid with nothing, something and everything culled; and the
    folder."""
    folder = tmp_path_factory.mktemp("pictures")
    bpy.ops.wm.open_mainfile(filepath=str(scene_file))
    render_blender("cycles", folder / "cycles", samples=256)
    render_blender("eevee", folder / "eevee", samples=2)
    out = {name: read_picture(folder / f"{name}.exr")[..., :3] for name in ("cycles", "eevee")}
    ways = {
        "full": ["--cull", "none"],
        "some": ["--max-error", "0.4"],
        "few": ["--cull", "distance", "--distance", "7.2"],
        "none": ["--min-share", "1e9"],
    }
    for name, options in ways.items():
        assert main(["render", str(scene_file), "-o", str(folder / name), *FAST, "--samples", "32", *options]) == 0
        out[name] = read_picture(folder / name / "frame_0001.exr")[..., :3]
    return out, folder


@needs_opengl
def test_as_cycles_where_nothing_is_culled(pictures):
    """The mean is Cycles' own, to what 32 paths per pixel of 2304 pixels leave of noise: less than 0.2 % of it, taken
    as five times that. Denoised pixels may be off by more, at edges above all; relMSE is that of a good picture."""
    out, _ = pictures
    assert abs(out["full"].mean() / out["cycles"].mean() - 1) < 0.01
    assert relative_mse(out["cycles"], out["full"]) < 0.25 * relative_mse(out["cycles"], out["eevee"])


@needs_opengl
def test_never_below_the_raster(pictures):
    """Hybrid is no further from the truth than EEVEE, whatever is culled: where it might be, what is shown is the
    mixture of both that is nearest."""
    out, folder = pictures
    base = relative_mse(out["cycles"], out["eevee"])
    for name in ("full", "some", "few", "none"):
        assert relative_mse(out["cycles"], out[name]) <= base * (1 + 1e-6)
    frames = {
        name: json.loads((folder / name / "report.json").read_text())["frames"][0]
        for name in ("full", "some", "few", "none")
    }
    assert frames["full"]["path_share"] == 1 and "comparison" not in {
        stage["stage"] for stage in frames["full"]["timeline"]
    }
    assert 0 < frames["few"]["active"] < frames["few"]["instances"]
    assert frames["none"]["active"] == frames["none"]["blas_bytes"] == 0
    assert frames["some"]["active"] < frames["some"]["instances"]


@pytest.fixture(scope="module")
def ride_file(scene_file, tmp_path_factory):
    """The scene, from which the camera draws back over two frames; its path."""
    bpy.ops.wm.open_mainfile(filepath=str(scene_file))
    for frame in (1, 2):
        bpy.context.scene.camera.location.y = -8.75 - 0.25 * frame
        bpy.context.scene.camera.keyframe_insert("location", frame=frame)
    path = tmp_path_factory.mktemp("ride") / "ride.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    return path


@needs_opengl
def test_sequence(ride_file, tmp_path):
    """Frames that are mixed with the raster are the same whichever process renders them, and after whichever others: at
    the end of a range, or alone, and by --resume into a folder that has the next one. Their layers have the same
    names."""
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    command = [
        "render", str(ride_file), *FAST, "--raster-samples", "1", "--samples", "8", "--cull", "distance", "--distance",
        "7.2"
    ]
    assert main([*command, "-o", str(whole), "--frames", "1-2"]) == 0
    assert main([*command, "-o", str(parts), "--frames", "2"]) == 0
    assert main([*command, "-o", str(parts), "--frames", "1-2", "--resume"]) == 0
    shares, again = (
        [f["path_share"] for f in json.loads((folder / "report.json").read_text())["frames"]]
        for folder in (whole, parts)
    )
    assert min(shares) < 1 and shares[0] != shares[1] and again == shares
    names = read_layers(whole / "frame_0001_layers.exr").keys()
    for frame in ("frame_0001", "frame_0002"):
        for ending in (".exr", ".png"):
            np.testing.assert_array_equal(*(read_picture(folder / f"{frame}{ending}") for folder in (whole, parts)))
        first, second = (read_layers(folder / f"{frame}_layers.exr") for folder in (whole, parts))
        assert first.keys() == second.keys() == names
        for name in names:
            np.testing.assert_array_equal(first[name], second[name])


@needs_opengl
def test_raster_alone_is_eevee(scene_file, tmp_path, monkeypatch):
    """Where paths have no share, what is shown is EEVEE's picture bit for bit as EEVEE shows it."""
    monkeypatch.setattr("lipac.core.hybrid.composition.share_of_paths", lambda *_: 0.0)
    bpy.ops.wm.open_mainfile(filepath=str(scene_file))
    scene, cull = extract_frame(bpy.context.scene).scene, CullOptions(policy="distance", setting=0.0)
    _, figures = render_hybrid(scene, HybridOptions(raster_samples=1), cull, tmp_path / "hybrid", 1)
    assert figures["path_share"] == 0
    render_blender("eevee", tmp_path / "eevee", samples=1)
    for ending in (".exr", ".png"):
        np.testing.assert_array_equal(
            *(read_picture(tmp_path / f"{name}{ending}")[..., :3] for name in ("hybrid", "eevee"))
        )


@needs_opengl
def test_failure_ends_the_work(scene_file, tmp_path):
    """What cannot be denoised is said before anything is decided; what fails in the decision is what is raised, and
    nothing is traced or left after it."""
    bpy.ops.wm.open_mainfile(filepath=str(scene_file))
    scene = extract_frame(bpy.context.scene).scene

    def fails(scene):
        raise MemoryError("no room")

    with pytest.raises(MemoryError, match="no room"):
        render_hybrid(scene, HybridOptions(raster_samples=1), CullOptions(), tmp_path / "a", 64, decide=fails)
    assert not list(tmp_path.iterdir())


def test_no_denoiser(boxes, tmp_path, monkeypatch):
    """Where Blender brings no library to denoise with, that is said before any work."""
    monkeypatch.setattr(
        "lipac.lipac_addon.raster.denoise._NAMES", {sys.platform: "libNowhere.so", "linux": "libNowhere.so"}
    )
    _library.cache_clear()

    def never(scene):
        raise AssertionError("decided before it was known whether the picture can be denoised")

    with pytest.raises(InputError, match="use --denoise off"):
        render_hybrid(
            extract_frame(boxes).scene, HybridOptions(primary="traced"), CullOptions(), tmp_path / "a", 1, decide=never
        )
    _library.cache_clear()


def test_memory_does_not_grow_with_passes(scene_file, tmp_path, monkeypatch):
    """Sixteen passes hold no more pictures than four: each is added to the sums. One has 16 floats per pixel. None is
    drawn ahead of the decision here, for how many wait then depends on who is faster."""
    monkeypatch.setattr(hybrid_frame, "AHEAD_BYTES", 0)
    bpy.ops.wm.open_mainfile(filepath=str(scene_file))
    bpy.context.scene.render.resolution_x, bpy.context.scene.render.resolution_y = 256, 144
    scene = extract_frame(bpy.context.scene).scene
    peaks = []
    for samples in (16, 4, 16):  # the first one loads what stays
        tracemalloc.start()
        options = HybridOptions(primary="traced", denoise=False)
        render_hybrid(scene, options, CullOptions(policy="none"), tmp_path / "a", samples)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[2] - peaks[1] < 256 * 144 * 16 * 4


@needs_opengl
@pytest.mark.parametrize("primary", ["raster", "traced"])
def test_culled_blocker(scene_file, tmp_path, primary):
    """A slab that is culled by hand is still seen, and keeps its shadow by the raster's shadow maps; where there is no
    raster, the light comes through."""
    bpy.ops.wm.open_mainfile(filepath=str(scene_file))
    extraction = extract_frame(bpy.context.scene)
    slab = extraction.keys.names.index("slab")
    kept = extraction.keys.records["object"] != slab
    assert (~kept).sum() == 1
    bpy.context.scene.render.resolution_x, bpy.context.scene.render.resolution_y = 64, 36

    def decide(scene):
        return Loop(scene, CullOptions()).result(
            kept, np.zeros(len(kept), np.float32), np.zeros((len(kept), 5), np.int64)
        )

    options = HybridOptions(primary=primary, raster_samples=2)
    render_hybrid(extraction.scene, options, CullOptions(), tmp_path / "a", 16, decide=decide)
    layers = read_layers(tmp_path / "a_layers.exr")
    lamps, doubt = layers["Traced Lamps"].sum(axis=2), layers["Shadow Doubt"]
    ground = (layers["Normal"][..., 2] > 0.999) & (layers["Culling State"] == 1)
    lit = np.median(lamps[ground])
    shadow = (ground & (layers["Shadow"] < 0.01)) if primary == "raster" else ground
    if primary == "raster":
        assert shadow.sum() > 50
        assert lamps[shadow].max() < 0.02 * lit
    else:
        assert lamps[ground].min() > 0.2 * lit and doubt.min() == 1
    assert (layers["Culling State"] == 0).sum() > 50  # the slab, and the sky


@needs_opengl
def test_report_has_a_timeline(pictures):
    _, folder = pictures
    frame = json.loads((folder / "some" / "report.json").read_text())["frames"][0]
    by_stage = {stage["stage"]: stage for stage in frame["timeline"]}
    assert {"first hits", "EEVEE", "analysis", "building", "tracing", "combine", "saving"} == set(by_stage) - {
        "comparison"
    }
    assert by_stage["analysis"]["start_s"] < by_stage["EEVEE"]["end_s"]  # beside each other
    assert 0 < frame["overlap_s"] <= by_stage["EEVEE"]["end_s"]
    assert frame["raster_s"] > 0


@needs_opengl
def test_layers_open_in_blender(pictures):
    """Blender sees a multilayer picture with the passes by name, and its compositor gets their pixels."""
    out, folder = pictures
    image = bpy.data.images.load(str(folder / "some" / "frame_0001_layers.exr"))
    tuple(image.size)  # reading it loads the file
    assert image.type == "MULTILAYER"
    tree = bpy.data.node_groups.new("compositor", "CompositorNodeTree")
    node = tree.nodes.new("CompositorNodeImage")
    node.image = image
    names = {o.name for o in node.outputs}
    wanted = {
        "Combined",
        "Raster Direct",
        "Traced Indirect",
        "Traced Lamps",
        "Shadow",
        "Hit Feedback",
        "Culling State",
        "Denoised",
    }
    assert wanted <= names
    layers = read_layers(folder / "some" / "frame_0001_layers.exr")
    np.testing.assert_allclose(layers["Combined"][..., :3], out["some"], atol=1e-3)
    assert (layers["Traced Indirect"] >= 0).all() and layers["Traced Indirect"].mean() > 0


@needs_opengl
@pytest.mark.smoke  # on every Blender, whose settings for this differ
def test_passes_hold_lamps_alone(boxes):
    """What EEVEE calls direct is the sun's light: gone without the sun, though the sky shines. Settings are as
    before."""
    before = [(k, str(getattr(boxes.eevee, k))) for k in ("taa_render_samples", "use_raytracing", "light_threshold")]
    lit = render_passes(boxes, 1, unshadowed=True)
    sun = next(o for o in boxes.objects if o.type == "LIGHT")
    sun.hide_render = True
    dark = render_passes(boxes, 1)
    assert lit.direct.mean() > 0.05
    assert dark.direct.max() < 1e-3
    assert lit.visible.min() < 0.1 and lit.visible.max() == 1
    assert lit.diffuse_color.max() == pytest.approx(0.8, abs=0.05)  # the diffuse lobe alone
    assert [(k, str(getattr(boxes.eevee, k))) for k, _ in before] == before
    assert not boxes.view_layers[0].use_pass_shadow


def settings(scene):
    """All plain values that passes might change."""
    things = [scene.render, scene.render.image_settings, scene.eevee, scene.world, *scene.view_layers]
    return [
        {
            p.identifier: str(getattr(t, p.identifier))
            for p in t.bl_rna.properties
            if p.type not in ("POINTER", "COLLECTION")
        }
        for t in things
    ]


@needs_opengl
def test_passes_of_any_scene(boxes):
    """Layers may have dots in their names, and there may be several; passes are of the whole picture at one moment.
    Everything is as before, also after an error."""
    (
        boxes.render.image_settings.file_format,
        boxes.render.image_settings.color_mode,
        boxes.render.image_settings.color_depth,
    ) = "PNG", "BW", "16"
    plain = render_passes(boxes, 4)
    boxes.view_layers[0].name = "fg.v2"
    boxes.view_layers.new("second")
    boxes.render.use_border, boxes.render.border_max_x = True, 0.5
    boxes.render.use_motion_blur, boxes.eevee.motion_blur_steps = True, 4
    box = bpy.data.objects["box0"]
    for frame, x in ((0, -3.0), (1, box.location.x), (2, 3.0)):
        box.location.x = x
        box.keyframe_insert("location", frame=frame)
    boxes.frame_set(1)
    before = settings(boxes)
    passes = render_passes(boxes, 4)
    assert settings(boxes) == before
    np.testing.assert_allclose(passes.diffuse_color, plain.diffuse_color, atol=1e-3)
    boxes.camera = None
    with pytest.raises(InputError, match="eevee cannot render the scene"):
        render_passes(boxes, 1)
    assert settings(boxes) == before


def test_visible_is_a_share_of_light():
    """A pixel that faces the sun by half and is in no shadow is wholly visible; in half shadow, by half; where no light
    is, nothing is kept away."""
    one = np.ones((1, 3, 3), np.float32)
    light = np.array([0.5, 0.25, 0.0], np.float32)[None, :, None] * one
    rest = {
        "combined": np.ones((1, 3, 4), np.float32),
        "glossy": 0 * one,
        "glossy_color": one,
        "emission": 0 * one,
        "environment": 0 * one,
    }
    passes = Passes(
        diffuse=light, diffuse_color=one, unshadowed=np.array([0.5, 0.5, 0.0], np.float32)[None, :, None] * one, **rest
    )
    np.testing.assert_allclose(passes.visible, [[1.0, 0.5, 1.0]])


@needs_opengl
def test_nothing_traced(boxes_file, tmp_path):
    """EEVEE's own picture, with all culled."""
    assert main(["render", str(boxes_file), "-o", str(tmp_path), *FAST, "--samples", "4", "--gi", "none"]) == 0
    frame = json.loads((tmp_path / "report.json").read_text())["frames"][0]
    assert frame["render_rays"] == frame["active"] == 0
    assert read_picture(tmp_path / "frame_0001.exr")[..., :3].mean() > 0.01


@pytest.mark.parametrize("mode", ["diffuse-1", "reflections"])
def test_modes_cull(scene_file, tmp_path, mode):
    """Each mode culls by the paths that it traces: without diffuse bounces this scene of plain surfaces needs what
    casts shadows alone, and fewer rays."""
    frames = {}
    for gi in ("path", mode):
        command = [
            "render", str(scene_file), "-o", str(tmp_path / gi), *FAST, "--samples", "4", "--primary", "traced",
            "--max-error", "0.05", "--gi", gi
        ]
        assert main(command) == 0
        frames[gi] = json.loads((tmp_path / gi / "report.json").read_text())["frames"][0]
    assert frames[mode]["rays"] < frames["path"]["rays"]
    assert frames[mode]["active"] <= frames["path"]["active"] <= frames[mode]["instances"]
    assert frames[mode]["certified_mean"] <= 0.05


def test_frames_follow_each_other(scene_file, tmp_path):
    """With --warm the second frame begins with what the first one needed: one round, nothing built."""
    command = [
        "render", str(scene_file), "-o", str(tmp_path), *FAST, "--samples", "2", "--primary", "traced", "--frames",
        "1-2", "--warm"
    ]
    assert main(command) == 0
    first, second = json.loads((tmp_path / "report.json").read_text())["frames"]
    assert first["blas_built"] > 0 and first["iterations"] > 1
    assert second["blas_built"] == 0 and second["iterations"] == 1
    assert second["active"] == first["active"]
    assert (tmp_path / "frame_0002_layers.exr").exists()


@needs_opengl
def test_pop(monkeypatch):
    """A slab that distance culls in the middle one of three frames takes its shadow along, unless the raster keeps it:
    then what is left of the pop is the light that the slab bounced, less than a quarter of it here."""
    build = pop.build

    def quick(size):
        scene, camera = build(size)
        draw_quickly(scene)
        return scene, camera

    monkeypatch.setattr(pop, "build", quick)
    monkeypatch.setattr(pop, "RASTER_SAMPLES", 1)
    result = pop.measure(3, (64, 36), 8)
    assert result.kept == [True, False, True]
    assert result.largest("none") > 0.5  # of the lit floor's brightness
    assert result.largest("raster shadow maps") < 0.25 * result.largest("none")


def test_no_opengl(boxes_file, tmp_path):
    """One line says what to install, and what works without."""
    blind = {**os.environ, "__EGL_VENDOR_LIBRARY_DIRS": str(tmp_path)}
    base = [
        sys.executable, "-m", "lipac.scripts.lipac", "render", str(boxes_file), *SMALL, "--engine", "hybrid",
        "--samples", "2", "--cull", "none"
    ]
    if sys.platform != "linux":
        pytest.skip("OpenGL is always there")
    failed = subprocess.run([*base, "-o", str(tmp_path / "a")], capture_output=True, text=True, check=False, env=blind)
    assert failed.returncode == 2
    assert len(failed.stderr.strip().splitlines()) == 1
    assert "apt install libegl1" in failed.stderr and "--primary traced" in failed.stderr
    traced = subprocess.run(
        [*base, "-o", str(tmp_path / "b"), "--primary", "traced"],
        capture_output=True,
        text=True,
        check=False,
        env=blind,
    )
    assert traced.returncode == 0, traced.stderr
    assert read_picture(tmp_path / "b" / "frame_0001.exr")[..., :3].mean() > 0.05


def test_denoise():
    """Noise of known size on a ramp with an edge: what is left is a small part of it, the mean stays, and the edge that
    a guide shows stays sharp."""
    rng = np.random.default_rng(1)
    clean = np.repeat(np.linspace(0.5, 1.0, 64, dtype=np.float32)[None, :, None], 64, axis=0).repeat(3, axis=2)
    clean[:, 32:] *= 4
    noisy = (clean * rng.exponential(1.0, clean.shape[:2])[..., None]).astype(np.float32)
    albedo = (
        np.where(np.arange(64)[None, :, None] < 32, np.float32(0.2), np.float32(0.8))
        .repeat(64, axis=0)
        .repeat(3, axis=2)
    )
    smooth = denoise(noisy, albedo, np.zeros_like(albedo))
    assert np.abs(smooth - clean).mean() < 0.2 * np.abs(noisy - clean).mean()
    assert smooth.mean() == pytest.approx(clean.mean(), rel=0.05)  # 3 standard errors of the noise's mean: 3 / 64
    assert smooth[:, 33].mean() > 2.5 * smooth[:, 30].mean()
