"""The path tracer's pictures are Cycles' pictures, within the noise of both.

Each renders several seeds; every coarse tile of their means is compared by Welch's t-test, at a significance of 1 % for
the whole picture (Sidak's correction over tiles and channels). Eight means of few samples are not normal, and there are
dozens of pictures on several Blenders, each with random numbers of its own: so what differs there is rendered once more
with other seeds and four times the samples, and fails if it differs again. A right renderer fails about one scene in
ten thousand, a wrong one both times. Clamping and Filter Glossy are off: they depend on how a renderer samples, not on
what it computes.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import bpy
import numpy as np
import pytest
from mathutils import Vector
from scipy import stats

import lipac
from lipac.core.accel.blas import BlasCache
from lipac.core.accel.tlas import Tlas
from lipac.core.tracing.tracer import prepare, trace
from lipac.lipac_addon.batch.engines.blender import render_blender
from lipac.lipac_addon.extract import extract_frame
from lipac.lipac_addon.pictures import read_picture
from lipac.tests.stats import level

SHARED = Path(lipac.__file__).parent.parent / "shared" / "scenes"
SEEDS = 8
COLUMNS, ROWS = 8, 5


def tiles(picture):
    """(ROWS, COLUMNS, 4) means of coarse tiles."""
    rows = np.array_split(picture.astype(np.float64), ROWS, axis=0)
    return np.array([[tile.mean((0, 1)) for tile in np.array_split(row, COLUMNS, axis=1)] for row in rows])


def check(folder: Any, samples: int = 8, size: tuple[int, int] = (80, 45)) -> Any:
    """Render the open scene both ways, and compare; twice where it differs."""
    scene = bpy.context.scene
    render, cycles = scene.render, scene.cycles
    render.resolution_x, render.resolution_y, render.resolution_percentage = *size, 100
    cycles.use_adaptive_sampling = cycles.use_denoising = False
    cycles.sample_clamp_direct = cycles.sample_clamp_indirect = cycles.blur_glossy = 0.0
    core = extract_frame(scene).scene
    blas = BlasCache(core.meshes)
    prepared = prepare(core, blas)
    blas.need(core.instances.mesh)
    tlas = Tlas(core.instances, blas, np.ones(len(core.instances), bool))

    def both(seeds, samples):
        theirs = []
        for seed in seeds:
            render_blender("cycles", folder / f"{seed}", samples=samples, seed=seed + 1)
            theirs.append(tiles(read_picture(folder / f"{seed}.exr")))
        return np.array(theirs), np.array([tiles(trace(prepared, tlas, samples, seed=seed).mean) for seed in seeds])

    if difference(*both(range(SEEDS), samples)):
        again = difference(*both(range(SEEDS, 2 * SEEDS), 4 * samples))
        assert not again, again


def difference(theirs, ours):
    """What Welch's t-test per tile and channel finds, (SEEDS, ROWS, COLUMNS, 4) each: empty where nothing."""
    variance = theirs.var(0, ddof=1), ours.var(0, ddof=1)
    # A tile without noise still has rounding: float32 sums.
    error2 = (variance[0] + variance[1]) / SEEDS + (2e-6 * (1 + theirs.mean(0))) ** 2
    freedom = (SEEDS - 1) * (variance[0] + variance[1]) ** 2 / (variance[0] ** 2 + variance[1] ** 2 + 1e-300)
    t = (ours.mean(0) - theirs.mean(0)) / np.sqrt(error2)
    p = 2 * stats.t.sf(np.abs(t), np.maximum(freedom, SEEDS - 1))
    limit = level(p.size, 0.01)
    worst = np.unravel_index(p.argmin(), p.shape)
    if p.min() <= limit:
        return (
            f"tile {worst}: {ours.mean(0)[worst]:.5f} instead of {theirs.mean(0)[worst]:.5f}; {(p < limit).sum()} of "
            f"{p.size} differ"
        )
    # Tiles err to either side: their mean does not drift.
    drift = abs(t[error2 > 1e-10].mean())
    return f"the tiles' mean is {drift:.2f} standard errors off" if drift >= 1.5 else ""


def shader(kind, **inputs):
    """A material of one shader node."""
    material = bpy.data.materials.new(kind)
    tree = material.node_tree
    tree.nodes.clear()
    output, node = tree.nodes.new("ShaderNodeOutputMaterial"), tree.nodes.new(kind)
    for name, value in inputs.items():
        node.inputs[name.replace("_", " ")].default_value = value
    tree.links.new(node.outputs[0], output.inputs[0])
    return material


def lamp(kind, location, energy, **fields):
    """A lamp that shines at the middle of the scene."""
    light = bpy.data.lights.new(kind, kind)
    light.energy = energy
    for name, value in fields.items():
        setattr(light, name, value)
    item = bpy.data.objects.new(kind, light)
    bpy.context.scene.collection.objects.link(item)
    item.location = location
    item.rotation_euler = (Vector((0, 0, 0.3)) - item.location).to_track_quat("-Z", "Y").to_euler()
    return item


def world(color):
    background = bpy.context.scene.world.node_tree.nodes["Background"]
    background.inputs[0].default_value = (*color, 1)
    return background


@pytest.fixture
def stage():
    """A plane, a cube and a coarse sphere, diffuse; a dark world; bpy.types.Scene."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.world = bpy.data.worlds.new("World")
    world((0, 0, 0))
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    scene.collection.objects.link(camera)
    scene.camera = camera
    camera.location = (5, -6, 4)
    camera.rotation_euler = (Vector((0, 0, 0.6)) - camera.location).to_track_quat("-Z", "Y").to_euler()
    camera.data.lens = 40
    bpy.ops.mesh.primitive_plane_add(size=12)
    bpy.context.object.data.materials.append(shader("ShaderNodeBsdfDiffuse", Color=(0.7, 0.6, 0.5, 1)))
    bpy.ops.mesh.primitive_cube_add(size=1.2, location=(0.8, 0.3, 0.65))
    bpy.context.object.data.materials.append(shader("ShaderNodeBsdfDiffuse", Color=(0.3, 0.6, 0.8, 1)))
    bpy.ops.mesh.primitive_uv_sphere_add(radius=0.7, location=(-0.9, -0.4, 0.7), segments=12, ring_count=8)
    bpy.context.object.data.materials.append(shader("ShaderNodeBsdfDiffuse", Color=(0.8, 0.3, 0.3, 1)))
    c = scene.cycles
    c.max_bounces = c.diffuse_bounces = c.glossy_bounces = c.transmission_bounces = 3
    yield scene
    bpy.ops.wm.read_factory_settings(use_empty=True)


def paint(name, material):
    bpy.data.objects[name].data.materials[0] = material


LAMPS = {
    "point": ("POINT", {"shadow_soft_size": 0.3}),
    "sphere": ("POINT", {"shadow_soft_size": 0.5, "use_soft_falloff": False}),
    "spot": ("SPOT", {"shadow_soft_size": 0.2, "spot_size": 0.9, "spot_blend": 0.4}),
    "sun": ("SUN", {"angle": 0.2}),
    "square": ("AREA", {"size": 2.0}),
    "ellipse": ("AREA", {"shape": "ELLIPSE", "size": 2.0, "size_y": 0.7, "spread": 1.2}),
}


@pytest.mark.parametrize("name", LAMPS)
def test_lamps(stage, tmp_path, name):
    kind, fields = LAMPS[name]
    lamp(kind, (1, -2, 3), 3 if kind == "SUN" else 300, **fields)
    check(tmp_path, samples=4)


def test_a_spot_of_uneven_scale(stage, tmp_path):
    """Its cone is an ellipse, and wider than long."""
    lamp("SPOT", (1, -2, 3), 300, shadow_soft_size=0.2, spot_size=0.5, spot_blend=0.4).scale = (3, 0.5, 1.5)
    check(tmp_path, samples=4)


def test_lamps_that_are_seen(stage, tmp_path):
    """By the camera and in a mirror; one of them only by the mirror."""
    paint("Sphere", shader("ShaderNodeBsdfPrincipled", Metallic=1.0, Roughness=0.05))
    for k, visible in enumerate((True, False)):
        item = lamp("AREA", (-1.5 + 2 * k, 2, 1.5), 60, size=1.0)
        item.rotation_euler = (math.pi / 2 + 0.3, 0, math.pi)
        item.visible_camera = visible
    check(tmp_path)


def test_many_lamps_and_emissive_meshes(stage, tmp_path):
    rng = np.random.default_rng(1)
    for k in range(24):
        lamp(("POINT", "SPOT", "AREA")[k % 3], rng.uniform((-4, -4, 0.8), (4, 4, 3)), 25)
    bpy.ops.mesh.primitive_uv_sphere_add(radius=0.5, location=(1, -2, 3))
    bpy.context.object.scale = (1, 0.4, 0.7)
    bpy.context.object.data.materials.append(shader("ShaderNodeEmission", Strength=8.0))
    lamp("SUN", (1, -2, 3), 1, angle=0.1)
    check(tmp_path, samples=16)


def test_sky_image(stage, tmp_path):
    image = bpy.data.images.new("sky", 1024, 512, float_buffer=True)
    pixels = np.ones((512, 1024, 4), np.float32)
    pixels[..., :3] = np.random.default_rng(0).random((512, 1024, 3)) * 0.3
    pixels[380:390, 320:335] = (200, 180, 150, 1)
    image.pixels.foreach_set(pixels.ravel())
    image.update()
    tree = stage.world.node_tree
    node = tree.nodes.new("ShaderNodeTexEnvironment")
    node.image = image
    tree.links.new(node.outputs[0], tree.nodes["Background"].inputs[0])
    # Cycles takes seconds for more
    stage.world.cycles.sampling_method, stage.world.cycles.sample_map_resolution = "MANUAL", 256
    check(tmp_path)


def test_metal_plastic_glass(stage, tmp_path):
    world((0.3, 0.3, 0.4))
    lamp("AREA", (1, -2, 3), 200, size=1.5)
    paint("Sphere", shader("ShaderNodeBsdfGlass", Roughness=0.2))
    for polygon in bpy.data.objects["Sphere"].data.polygons:
        polygon.use_smooth = True
    paint("Cube", shader("ShaderNodeBsdfPrincipled", Metallic=1.0, Roughness=0.3, Base_Color=(0.8, 0.6, 0.4, 1)))
    paint("Plane", shader("ShaderNodeBsdfPrincipled", Roughness=0.2, Base_Color=(0.5, 0.5, 0.2, 1)))
    check(tmp_path)


def test_rough_diffuse_and_coat(stage, tmp_path):
    """What Cycles changed between versions, in direct light: nearly no noise hides a model of another version."""
    paint("Plane", shader("ShaderNodeBsdfDiffuse", Color=(0.8, 0.5, 0.2, 1), Roughness=1.0))
    paint("Cube", shader("ShaderNodeBsdfPrincipled", Coat_Weight=1.0, Coat_Roughness=0.4, Coat_Tint=(0.9, 0.5, 0.4, 1)))
    lamp("POINT", (1, -2, 3), 300, shadow_soft_size=0.05)
    stage.cycles.max_bounces = 0
    check(tmp_path, samples=4)


@pytest.mark.parametrize("limit", [8, 3, 1])
def test_transparency(stage, tmp_path, limit):
    """Up to a limit: what is met behind so many transparent surfaces shows its emission alone."""
    stage.cycles.transparent_max_bounces = limit
    world((0.3, 0.3, 0.4))
    lamp("SUN", (1, -2, 3), 3, angle=0.1)
    paint("Cube", shader("ShaderNodeBsdfPrincipled", Alpha=0.4, Base_Color=(0.8, 0.2, 0.2, 1)))
    paint("Sphere", shader("ShaderNodeBsdfTransparent", Color=(0.9, 0.5, 0.2, 1)))
    check(tmp_path)


def test_depth_of_field(stage, tmp_path):
    world((0.5, 0.5, 0.5))
    lamp("SUN", (1, -2, 3), 3, angle=0.1)
    dof = stage.camera.data.dof
    dof.use_dof, dof.focus_distance, dof.aperture_fstop = True, 6, 0.15
    dof.aperture_blades, dof.aperture_ratio, dof.aperture_rotation = 5, 1.5, 0.3
    check(tmp_path)


def test_smooth_and_mirrored_meshes(stage, tmp_path):
    world((0.4, 0.4, 0.4))
    lamp("POINT", (1, -2, 3), 300, shadow_soft_size=0.1)
    bpy.data.objects["Sphere"].scale, bpy.data.objects["Cube"].scale = (-1, 1.4, 0.6), (1, -1, 1)
    for polygon in bpy.data.objects["Sphere"].data.polygons:
        polygon.use_smooth = True
    check(tmp_path)


def test_orthographic_transparent_film(stage, tmp_path):
    world((0.4, 0.4, 0.4))
    stage.render.film_transparent, stage.cycles.film_exposure, stage.cycles.pixel_filter_type = True, 1.7, "GAUSSIAN"
    camera = stage.camera.data
    camera.type, camera.ortho_scale, camera.shift_x = "ORTHO", 5, 0.1
    bpy.data.objects["Plane"].scale = (0.2, 0.2, 1)
    check(tmp_path)


def test_transparent_film_through_glass(stage, tmp_path):
    """Up to a roughness, what refracts shows the film's transparency, not the world."""
    world((0.4, 0.4, 0.4))
    lamp("POINT", (1, -2, 3), 300, shadow_soft_size=0.1)
    stage.render.film_transparent = stage.cycles.film_transparent_glass = True
    stage.cycles.film_transparent_roughness = 0.3
    paint("Sphere", shader("ShaderNodeBsdfGlass", Roughness=0.25))
    paint("Cube", shader("ShaderNodeBsdfGlass", Roughness=0.35))
    bpy.data.objects["Plane"].scale = (0.2, 0.2, 1)
    check(tmp_path)


@pytest.mark.parametrize("bounces", [0, 1])
def test_a_world_of_few_bounces(stage, tmp_path, bounces):
    world((0.5, 0.5, 0.6))
    stage.world.cycles.max_bounces = bounces
    check(tmp_path)


def test_who_sees_what(stage, tmp_path):
    """Ray visibility of objects and of the world."""
    world((0.5, 0.5, 0.6))
    lamp("SUN", (1, -2, 3), 3, angle=0.1)
    stage.world.cycles_visibility.diffuse = False
    bpy.data.objects["Cube"].visible_camera = False
    bpy.data.objects["Sphere"].visible_shadow = False
    bpy.data.objects["Sphere"].visible_diffuse = False
    paint("Plane", shader("ShaderNodeBsdfPrincipled", Metallic=1.0, Roughness=0.1))
    check(tmp_path)


@pytest.mark.parametrize("hidden", ["visible_diffuse", "visible_glossy", "visible_transmission"])
def test_lamps_that_some_lobes_do_not_see(stage, tmp_path, hidden):
    world((0.1, 0.1, 0.1))
    setattr(lamp("AREA", (1, -2, 3), 200, size=1.5), hidden, False)
    paint("Plane", shader("ShaderNodeBsdfPrincipled", Roughness=0.3, Base_Color=(0.5, 0.5, 0.2, 1)))
    refraction = shader("ShaderNodeBsdfRefraction", Roughness=0.4)
    next(n for n in refraction.node_tree.nodes if n.type == "BSDF_REFRACTION").distribution = "GGX"
    paint("Cube", refraction)
    paint("Sphere", shader("ShaderNodeBsdfPrincipled", Metallic=1.0, Roughness=0.3))
    check(tmp_path)


def picture_node(tree: Any, pixels: Any, colorspace: str) -> Any:
    """An image texture node of (H, W, 4) pixels."""
    image = bpy.data.images.new("pixels", pixels.shape[1], pixels.shape[0])
    image.colorspace_settings.name = colorspace
    image.pixels.foreach_set(pixels.astype(np.float32).ravel())
    image.update()
    node = tree.nodes.new("ShaderNodeTexImage")
    node.image = image
    return node


def test_textures_and_normal_maps(stage: Any, tmp_path: Path) -> None:
    world((0.3, 0.3, 0.3))
    lamp("SUN", (1, -2, 3), 3, angle=0.1)
    color = np.ones((32, 32, 4))
    color[..., :3] = np.random.default_rng(0).random((32, 32, 3))
    y, x = np.mgrid[:64, :64] / 64 * 2 * np.pi
    normal = np.stack([0.5 * np.sin(2 * x), 0.5 * np.cos(3 * y), np.ones((64, 64))], -1)
    bumps = np.ones((64, 64, 4))
    bumps[..., :3] = normal / np.linalg.norm(normal, axis=-1, keepdims=True) * 0.5 + 0.5
    for name in ("Plane", "Cube", "Sphere"):
        material = shader("ShaderNodeBsdfPrincipled", Roughness=0.5)
        tree = material.node_tree
        surface = next(n for n in tree.nodes if n.type == "BSDF_PRINCIPLED")
        bend = tree.nodes.new("ShaderNodeNormalMap")
        tree.links.new(picture_node(tree, color, "sRGB").outputs[0], surface.inputs["Base Color"])
        tree.links.new(picture_node(tree, bumps, "Non-Color").outputs[0], bend.inputs["Color"])
        tree.links.new(bend.outputs[0], surface.inputs["Normal"])
        paint(name, material)
    for polygon in bpy.data.objects["Sphere"].data.polygons:
        polygon.use_smooth = True
    check(tmp_path, samples=16)


def blend(node: str, factor: Any, first: Any, second: Any) -> Any:
    """A material of a Mix or Add Shader of two shader nodes, given as (type, inputs). factor: None, a number, (type of
    a node, output), or pixels."""
    material = bpy.data.materials.new("blend")
    tree = material.node_tree
    tree.nodes.clear()
    output, mix = tree.nodes.new("ShaderNodeOutputMaterial"), tree.nodes.new(node)
    for (kind, inputs), socket in zip((first, second), list(mix.inputs)[-2:], strict=True):
        part = tree.nodes.new(kind)
        if hasattr(part, "distribution"):
            part.distribution = "GGX"
        for name, value in inputs.items():
            part.inputs[name].default_value = value
        tree.links.new(part.outputs[0], socket)
    if isinstance(factor, tuple):
        tree.links.new(tree.nodes.new(factor[0]).outputs[factor[1]], mix.inputs[0])
    elif isinstance(factor, np.ndarray):
        tree.links.new(picture_node(tree, factor, "Non-Color").outputs[0], mix.inputs[0])
    elif factor is not None:
        mix.inputs[0].default_value = factor
    tree.links.new(mix.outputs[0], output.inputs[0])
    return material


Part = tuple[str, dict[str, Any]]
RED, GREEN = (
    ("ShaderNodeBsdfDiffuse", {"Color": (0.8, 0.2, 0.1, 1)}),
    ("ShaderNodeBsdfDiffuse", {"Color": (0.1, 0.7, 0.2, 1)}),
)
CLEAR: Part = ("ShaderNodeBsdfTransparent", {})
TINTED: Part = ("ShaderNodeBsdfTransparent", {"Color": (0.3, 0.9, 0.6, 1)})
MIRROR, GLASS = ("ShaderNodeBsdfAnisotropic", {"Roughness": 0.1}), ("ShaderNodeBsdfGlass", {"Roughness": 0.1})


def test_mixes_of_unlike_shaders(stage: Any, tmp_path: Path) -> None:
    world((0.3, 0.3, 0.4))
    lamp("SUN", (1, -2, 3), 3, angle=0.1)
    pattern = np.ones((4, 4, 4))
    pattern[..., :3] = np.random.default_rng(0).random((4, 4, 1)).round(1)
    paint("Plane", blend("ShaderNodeMixShader", pattern, RED, MIRROR))
    paint("Cube", blend("ShaderNodeMixShader", 0.4, GLASS, TINTED))
    paint("Sphere", blend("ShaderNodeAddShader", None, GREEN, TINTED))
    check(tmp_path, samples=32)


def test_mixes_by_rays_and_sides(stage: Any, tmp_path: Path) -> None:
    """What is clear to the camera alone, what is cut away, what shines otherwise than it looks, what blocks no
    light."""
    world((0.2, 0.2, 0.3))
    lamp("AREA", (2, -2, 3), 150, size=1.5)
    paint("Cube", blend("ShaderNodeMixShader", ("ShaderNodeNewGeometry", "Backfacing"), CLEAR, RED))
    paint("Sphere", blend("ShaderNodeMixShader", ("ShaderNodeLightPath", "Is Camera Ray"), GREEN, CLEAR))
    bright, dim = (("ShaderNodeEmission", {"Strength": strength}) for strength in (6.0, 0.5))
    bpy.ops.mesh.primitive_plane_add(size=1.0, location=(-0.5, 2.5, 1.0), rotation=(1.3, 0, 0))
    bpy.context.object.data.materials.append(
        blend("ShaderNodeMixShader", ("ShaderNodeLightPath", "Is Camera Ray"), bright, dim)
    )
    bpy.ops.mesh.primitive_plane_add(size=1.5, location=(1.6, -1.6, 1.2))
    bpy.context.object.data.materials.append(
        blend("ShaderNodeMixShader", ("ShaderNodeLightPath", "Is Shadow Ray"), RED, CLEAR)
    )
    check(tmp_path, samples=16)


@pytest.mark.parametrize(("kind", "output"), [("Fresnel", 0), ("LayerWeight", "Fresnel"), ("LayerWeight", "Facing")])
def test_mixes_by_the_angle(kind: str, output: str | int, stage: Any, tmp_path: Path) -> None:
    """Panes that are clear but for what they reflect, glow at grazing angles, paint under a coat."""
    world((0.2, 0.2, 0.3))
    lamp("AREA", (2, -2, 3), 150, size=1.5)
    share = f"ShaderNode{kind}", output
    paint("Cube", blend("ShaderNodeMixShader", share, CLEAR, MIRROR))
    paint("Sphere", blend("ShaderNodeMixShader", share, RED, ("ShaderNodeEmission", {"Strength": 3.0})))
    paint("Plane", blend("ShaderNodeMixShader", share, GREEN, MIRROR))
    check(tmp_path, samples=16)


def test_a_backdrop_for_the_camera_alone(stage: Any, tmp_path: Path) -> None:
    """A sky that lights but is not seen, and another that is seen but lights nothing."""
    tree = stage.world.node_tree
    mix, path = tree.nodes.new("ShaderNodeMix"), tree.nodes.new("ShaderNodeLightPath")
    mix.data_type = "RGBA"
    tree.links.new(path.outputs["Is Camera Ray"], mix.inputs[0])
    mix.inputs[6].default_value, mix.inputs[7].default_value = (1, 0.8, 0.6, 1), (0, 0.1, 0.3, 1)
    tree.links.new(mix.outputs[2], tree.nodes["Background"].inputs["Color"])
    check(tmp_path)


@pytest.mark.parametrize(("name", "samples"), [("kitchen", 16), ("indoor", 4), ("rooms1024", 8), ("candela_city", 4)])
def test_supplied_scenes(tmp_path, name, samples):
    path = SHARED / f"{name}.blend"
    if not path.exists():
        pytest.skip(f"no {path}")
    bpy.ops.wm.open_mainfile(filepath=str(path), load_ui=False)
    check(tmp_path, samples, (64, 36))
    bpy.ops.wm.read_factory_settings(use_empty=True)
