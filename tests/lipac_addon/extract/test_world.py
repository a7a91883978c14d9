"""Worlds: constant ones as they are, any other as Cycles bakes it."""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np
import pytest

from lipac.core.scene.model import RayType
from lipac.lipac_addon.extract import extract_frame, extract_world
from lipac.lipac_addon.extract import world as module
from lipac.lipac_addon.extract.materials.reader import WORTHLESS

from .conftest import add, cube


def new_world() -> tuple[Any, Any, Any]:
    """A world of the scene, its tree and its Background node."""
    world = bpy.context.scene.world = bpy.data.worlds.new("World")
    tree = world.node_tree
    return world, tree, next(n for n in tree.nodes if n.type == "BACKGROUND")


def directions(height: int) -> np.ndarray:
    """(height, 2 height, 3): what `World.image` documents for its pixel centres."""
    v, u = np.meshgrid((np.arange(height) + 0.5) / height, (np.arange(2 * height) + 0.5) / (2 * height), indexing="ij")
    angle, z = (u - 0.5) * 2 * np.pi, np.sin((v - 0.5) * np.pi)
    r = np.sqrt(1 - z * z)
    return np.stack((-r * np.cos(angle), r * np.sin(angle), z), axis=2)


def test_constant_worlds() -> None:
    """None is black; Background is colour times strength; ray visibility becomes bits."""
    assert not extract_world(bpy.context.scene).world.color.any()
    world, _, background = new_world()
    background.inputs["Color"].default_value, background.inputs["Strength"].default_value = (0.2, 0.4, 0.8, 1), 2.5
    world.cycles_visibility.glossy = False
    extracted = extract_world(bpy.context.scene).world
    np.testing.assert_allclose(extracted.color, [0.5, 1.0, 2.0], rtol=1e-6)
    assert extracted.image is None
    assert extracted.visibility == 0b11111 & ~(1 << RayType.GLOSSY)


def test_baked_world_shows_directions(monkeypatch: pytest.MonkeyPatch) -> None:
    """A world that emits its own direction, moved to be positive: every pixel looks where the core says it does.
    Nothing stays behind in the file."""
    monkeypatch.setattr(module, "BAKE_HEIGHT", 32)
    monkeypatch.setattr(module, "SUPERSAMPLES", 1)  # at the centres of pixels
    world, tree, background = new_world()
    world.cycles_visibility.camera = False
    coordinates, shift = tree.nodes.new("ShaderNodeTexCoord"), tree.nodes.new("ShaderNodeVectorMath")
    shift.inputs[1].default_value = (2, 2, 2)
    tree.links.new(coordinates.outputs["Generated"], shift.inputs[0])
    tree.links.new(shift.outputs[0], background.inputs["Color"])
    scene = bpy.context.scene

    def contents() -> dict[str, list[str]]:
        return {
            name: [item.name_full for item in getattr(bpy.data, name)]
            for name in ("scenes", "objects", "cameras", "worlds", "images", "collections")
        }

    before, engine, path = contents(), scene.render.engine, scene.render.filepath
    image = extract_world(scene).world.image
    assert contents() == before
    assert (scene.render.engine, scene.render.filepath, bpy.context.scene) == (engine, path, scene)
    assert image is not None
    # A filter of 0.01 pixels around the centre, pixels of pi / 32
    np.testing.assert_allclose(image - 2, directions(32), atol=0.01 * np.pi / 32 + 1e-5)


def test_environment_image(monkeypatch: pytest.MonkeyPatch) -> None:
    """An Environment Texture keeps its pixels: here at the image's own size."""
    monkeypatch.setattr(module, "BAKE_HEIGHT", 8)
    _, tree, background = new_world()
    pixels = np.random.default_rng(0).random((8, 16, 4)).astype(np.float32)
    pixels[..., 3] = 1
    image = bpy.data.images.new("env", 16, 8, float_buffer=True)
    image.pixels.foreach_set(pixels.ravel())
    image.pack()
    node = tree.nodes.new("ShaderNodeTexEnvironment")
    node.image = image
    tree.links.new(node.outputs[0], background.inputs["Color"])
    baked = extract_world(bpy.context.scene).world.image
    assert baked is not None
    # bilinear between pixels: 0.005 pixels off the centre mix in half a percent per axis at most; half floats of a
    # packed image
    np.testing.assert_allclose(np.roll(baked, 8, axis=1), pixels[..., :3], atol=0.011)


def test_camera_and_other_rays_see_their_own_sky() -> None:
    """A world by Is Camera Ray: a backdrop for the camera, another light for all else; both whole, and nothing of the
    bake is left."""
    _, tree, background = new_world()
    mix = tree.nodes.new("ShaderNodeMix")
    mix.data_type = "RGBA"
    tree.links.new(tree.nodes.new("ShaderNodeLightPath").outputs["Is Camera Ray"], mix.inputs[0])
    mix.inputs[6].default_value, mix.inputs[7].default_value = (4, 2, 1, 1), (0, 0.5, 0, 1)
    tree.links.new(mix.outputs[2], background.inputs["Color"])
    blocks = [
        len(getattr(bpy.data, name)) for name in ("objects", "meshes", "materials", "worlds", "cameras", "scenes")
    ]
    extracted = extract_world(bpy.context.scene)
    assert extracted.world.image is not None
    assert extracted.world.seen is not None
    for picture, color in ((extracted.world.image, (4, 2, 1)), (extracted.world.seen, (0, 0.5, 0))):
        np.testing.assert_allclose(
            picture, np.broadcast_to(np.array(color, np.float32), picture.shape), rtol=1e-4, atol=1e-4
        )
    assert len(extracted.approximated) == 1
    assert blocks == [
        len(getattr(bpy.data, name)) for name in ("objects", "meshes", "materials", "worlds", "cameras", "scenes")
    ]


@pytest.mark.parametrize(("ray", "worthless"), [("Is Camera Ray", False), ("Is Diffuse Ray", True)])
def test_what_only_other_rays_see_of_a_world_is_said_to_be_worth_nothing(ray: str, worthless: bool) -> None:
    """Which makes the line a warning. Rays through glass, and light sampling, see no diffuse rays' sky."""
    _, tree, background = new_world()
    tree.links.new(tree.nodes.new("ShaderNodeLightPath").outputs[ray], background.inputs["Strength"])
    (line,) = extract_world(bpy.context.scene).approximated
    assert line.endswith(WORTHLESS) == worthless


def test_a_world_in_fog_is_baked_without_it() -> None:
    """And said, of a constant sky too."""
    _, tree, background = new_world()
    scatter = tree.nodes.new("ShaderNodeVolumeScatter")
    tree.links.new(scatter.outputs[0], next(n for n in tree.nodes if n.type == "OUTPUT_WORLD").inputs["Volume"])
    background.inputs["Color"].default_value = (1, 1, 1, 1)
    extracted = extract_world(bpy.context.scene)
    assert extracted.world.color.tolist() == [1, 1, 1]
    assert len(extracted.approximated) == 1
    tree.links.new(tree.nodes.new("ShaderNodeTexGradient").outputs[0], background.inputs["Color"])
    extracted = extract_world(bpy.context.scene)
    assert extracted.world.image is not None
    assert extracted.world.image.max() > 0.5
    assert "volume not rendered" in extracted.approximated[0]


def test_sky_with_a_sun_keeps_its_power() -> None:
    """The sun disc, a pixel or two wide, brings the light that it brings at twice the resolution; and is reported."""
    world, tree, background = new_world()
    sky = tree.nodes.new("ShaderNodeTexSky")
    sky.sky_type, sky.sun_disc, sky.sun_elevation = "SINGLE_SCATTERING", True, 0.9
    tree.links.new(sky.outputs[0], background.inputs["Color"])
    lines = extract_world(bpy.context.scene).approximated
    assert len(lines) == 1
    assert "sun disc" in lines[0]

    def sun(height: int) -> float:
        image = module.bake(world, height, module.SUPERSAMPLES)
        weight = np.cos((np.arange(height) + 0.5) / height * np.pi - np.pi / 2)[:, None] * (np.pi / height) ** 2
        bright = image[..., 1] > 100 * np.median(image[..., 1])
        return float((image[..., 1] * weight)[bright].sum())

    # Coverage of some 8 pixels on the disc's edge by 16 stratified samples each: under 10 % of their share, which is
    # most of the disc
    assert sun(256) == pytest.approx(sun(512), rel=0.2)


@pytest.mark.parametrize("grouped", [False, True])
def test_a_sun_of_less_than_a_pixel_keeps_its_power(grouped: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """A disc so small that no sample meets it, for crisp shadows; the file's own stays as small."""
    monkeypatch.setattr(module, "BAKE_HEIGHT", 128)
    _, tree, background = new_world()
    inner = bpy.data.node_groups.new("sky", "ShaderNodeTree") if grouped else tree
    sky = inner.nodes.new("ShaderNodeTexSky")
    sky.sun_disc, sky.sun_elevation, sky.sun_size = True, 0.6, np.radians(6)
    socket = sky.outputs[0]
    if grouped:
        inner.interface.new_socket("Color", in_out="OUTPUT", socket_type="NodeSocketColor")
        inner.links.new(socket, inner.nodes.new("NodeGroupOutput").inputs[0])
        group = tree.nodes.new("ShaderNodeGroup")
        group.node_tree = inner
        socket = group.outputs[0]
    tree.links.new(socket, background.inputs["Color"])

    def power() -> np.ndarray:
        image = extract_world(bpy.context.scene).world.image
        assert image is not None
        return (image * np.sin((np.arange(128) + 0.5) / 128 * np.pi)[:, None, None]).sum(axis=(0, 1))

    wide, sky.sun_size = power(), np.radians(0.05)
    size = sky.sun_size
    np.testing.assert_allclose(power(), wide, rtol=0.05)
    assert sky.sun_size == size


def test_an_image_that_is_reduced_keeps_its_light(monkeypatch: pytest.MonkeyPatch) -> None:
    """A lamp of one pixel, which samples at the centres of larger ones miss."""
    monkeypatch.setattr(module, "BAKE_HEIGHT", 8)
    monkeypatch.setattr(module, "MAX_HEIGHT", 16)
    _, tree, background = new_world()
    pixels = np.zeros((64, 128, 4), np.float32)
    pixels[..., 3] = 1
    pixels[40, 77, :3] = 1000
    image = bpy.data.images.new("env", 128, 64, float_buffer=True)
    image.pixels.foreach_set(pixels.ravel())
    image.pack()
    node = tree.nodes.new("ShaderNodeTexEnvironment")
    node.image = image
    tree.links.new(node.outputs[0], background.inputs["Color"])
    baked = extract_world(bpy.context.scene).world.image
    assert baked is not None
    assert baked.shape == (16, 32, 3)
    assert baked[..., 0].sum() == pytest.approx(1000 / 16, rel=0.5)  # bilinear, by 16 samples a pixel


@pytest.mark.parametrize(("output", "known"), [("Window", False), ("Camera", False), ("Generated", True)])
def test_nothing_goes_before_a_world_that_is_seen_by_the_view(
    output: str, known: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A backdrop by coordinates of the picture, or of the camera: it is baked by another one."""
    monkeypatch.setattr(module, "BAKE_HEIGHT", 32)
    _, tree, background = new_world()
    tree.links.new(tree.nodes.new("ShaderNodeTexCoord").outputs[output], background.inputs["Color"])
    add("cube", cube())
    scene = extract_frame(bpy.context.scene).scene
    assert (scene.whole == "") == known
    assert any(line.endswith(module.VIEW) for line in scene.approximated) != known


def test_a_layer_without_environment_is_black() -> None:
    """Its light is none that changes could be relative to, whether it is constant or not; another layer has it."""
    _, tree, background = new_world()
    background.inputs["Color"].default_value = (1, 1, 1, 1)
    scene = bpy.context.scene
    add("cube", cube())
    lit, dark = scene.view_layers[0], scene.view_layers.new("dark")
    dark.use_sky = False
    for layer, light in ((lit, 1.0), (dark, 0.0)):
        world = extract_frame(scene, view_layer=layer.name).scene.world
        assert (world.image, world.color.tolist()) == (None, [light] * 3)
    tree.links.new(tree.nodes.new("ShaderNodeTexCoord").outputs["Generated"], background.inputs["Color"])
    world = extract_frame(scene, view_layer="dark").scene.world
    assert (world.image, world.color.tolist()) == (None, [0.0] * 3)


def test_suns_of_worlds_that_tell_rays_apart_are_not_clamped(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is not for the camera is baked through a pane, which makes it indirect light."""
    monkeypatch.setattr(module, "BAKE_HEIGHT", 32)
    _, tree, background = new_world()
    path, mix = tree.nodes.new("ShaderNodeLightPath"), tree.nodes.new("ShaderNodeMixShader")
    bright, out = tree.nodes.new("ShaderNodeBackground"), next(n for n in tree.nodes if n.type == "OUTPUT_WORLD")
    bright.inputs["Strength"].default_value = 500.0
    tree.links.new(path.outputs["Is Camera Ray"], mix.inputs[0])
    tree.links.new(bright.outputs[0], mix.inputs[1])
    tree.links.new(background.outputs[0], mix.inputs[2])
    tree.links.new(mix.outputs[0], out.inputs[0])
    world = extract_world(bpy.context.scene).world
    assert world.image is not None
    np.testing.assert_allclose(np.median(world.image), 400.0, rtol=1e-3)  # the colour is 0.8
