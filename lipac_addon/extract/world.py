"""World shader -> constant radiance, or a picture of all directions that Cycles bakes.

Any node world is rendered by Cycles itself into an equirectangular picture, from a scene that holds nothing else.
Blender cannot start a render inside a render, so this is done before `with_render_depsgraph`, and once for all frames
unless the world is animated.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from ...core.arrays import F32
from ...core.errors import InputError
from ...core.scene.model import ALL_RAYS, RayType, World
from ..depsgraph import changed, no_new_images, own_slot, render_result, with_render_depsgraph
from .materials.reader import WORTHLESS

BAKE_HEIGHT = 512  # of worlds without an image
MAX_HEIGHT = 2048
VIEW = "coordinates of the view: what it shows is not known; nothing is culled"
_FILMS = {"SEQUENCE", "MOVIE"}
_NO_LOOKS = {
    "rna_type", "inputs", "outputs", "internal_links", "parent", "location", "location_absolute", "width", "height",
    "dimensions", "select"
}
_DEPTH = 4  # of structs within a node: curves hold curves hold points
SUPERSAMPLES = 16  # Cycles samples a pixel where edges (a sun's, or of what nodes make) are to be averaged
SUN = 2.0  # pixels that a sun disc is wide at least: of a smaller one samples may meet nothing, or too much


@dataclass(frozen=True)
class ExtractedWorld:
    """world, and one line per thing that differs from Blender."""

    world: World
    approximated: tuple[str, ...] = ()

    @staticmethod
    def black() -> ExtractedWorld:
        """No light at all."""
        return ExtractedWorld(World(np.zeros(3, np.float32)))


def _visibility(world: Any) -> int:
    v = world.cycles_visibility
    on = {
        RayType.CAMERA: v.camera,
        RayType.DIFFUSE: v.diffuse,
        RayType.GLOSSY: v.glossy,
        RayType.TRANSMISSION: v.transmission,
    }
    return ALL_RAYS & ~sum(1 << kind for kind, seen in on.items() if not seen)


def constant_color(world: Any) -> F32 | None:
    """(3,) radiance where the world is the same in all directions, else None. world: bpy.types.World or None
    (black)."""
    if world is None:
        return np.zeros(3, np.float32)
    if world.node_tree is None:
        return np.array(world.color[:3], np.float32)
    tree = world.inline_shader_nodes()  # keeps the tree alive
    output = tree.node_tree.get_output_node("CYCLES")
    if output is None or not output.inputs["Surface"].is_linked:
        return np.zeros(3, np.float32)
    node = output.inputs["Surface"].links[0].from_node
    if node.type not in {"BACKGROUND", "EMISSION"}:
        return None
    color, strength = node.inputs["Color"], node.inputs["Strength"]
    if strength.is_linked or (color.is_linked and strength.default_value != 0.0):
        return None
    return np.array(color.default_value[:3], np.float32) * np.float32(strength.default_value)


def constant_world(world: Any) -> ExtractedWorld | None:
    """A bpy.types.World that is the same in all directions (None: black); None where it is not."""
    color = constant_color(world)
    return (
        None
        if color is None
        else ExtractedWorld(World(color, None, ALL_RAYS if world is None else _visibility(world)), _volume(world))
    )


def _volume(world: Any) -> tuple[str, ...]:
    """A line where the world is filled with a volume."""
    if world is None or world.node_tree is None:
        return ()
    tree = world.inline_shader_nodes()  # keeps the tree alive
    output = tree.node_tree.get_output_node("CYCLES")
    filled = output is not None and output.inputs["Volume"].is_linked
    return (
        (
            f"world {world.name}: volume not rendered: what only lights it or throws shadows into it {WORTHLESS}",
        )
        if filled
        else ()
    )


def fingerprint(world: Any, frame: int) -> str:
    """A text that differs where the world may look different: all numbers of its nodes, what they refer to, and the
    frame where a film is shown."""
    tree = world.inline_shader_nodes()
    lines = [world.name_full, str(_visibility(world))]
    for node in tree.node_tree.nodes:
        lines.append(node.bl_idname)
        _describe(node, lines, 0)
        for socket in node.inputs:
            lines += [
                _value(getattr(socket, "default_value", None)),
                *(f"{link.from_node.name}.{link.from_socket.identifier}" for link in socket.links),
            ]
    if any(
        node.type in {"TEX_ENVIRONMENT", "TEX_IMAGE"} and node.image is not None and node.image.source in _FILMS
        for node in tree.node_tree.nodes
    ):
        lines.append(str(frame))
    return "\n".join(lines)


def _describe(item: Any, lines: list[str], depth: int) -> None:
    """All values of a struct of Blender's, and of those in it."""
    for prop in item.bl_rna.properties:
        if prop.identifier in _NO_LOOKS:
            continue
        value = getattr(item, prop.identifier)
        if prop.type not in {"POINTER", "COLLECTION"}:
            lines.append(_value(value))
        elif isinstance(value, bpy.types.ID):
            lines.append(value.name_full + (_value(value.matrix_world) if isinstance(value, bpy.types.Object) else ""))
        elif value is not None and depth < _DEPTH:
            for part in value if prop.type == "COLLECTION" else [value]:
                _describe(part, lines, depth + 1)


def _value(value: Any) -> str:
    return (
        repr([_value(part) for part in value])
        if hasattr(value, "__iter__") and not isinstance(value, str)
        else repr(value)
    )


def world_of(scene: Any, view_layer: Any) -> Any | None:
    """The bpy.types.World that a view layer renders: its override, else that of the scene; None (black) where its
    Environment is off. view_layer: None counts as one with no settings of its own."""
    if not getattr(view_layer, "use_sky", True):
        return None
    return getattr(view_layer, "world_override", None) or scene.world


def extract_world(scene: Any, view_layer: Any = None) -> ExtractedWorld:
    """World of a scene at its current frame, as Cycles shows it to camera rays. Renders where it is not constant: not
    to be called inside a render.

    scene: bpy.types.Scene; view_layer: bpy.types.ViewLayer, as of `world_of`. Everything made for the bake is removed
    again.
    """
    world = world_of(scene, view_layer)
    constant = constant_world(world)
    if constant is not None:
        return constant
    if render_result() is not None:
        with_render_depsgraph(scene, None, lambda _: None)  # so that the bake is the second render in our slot
    return baked_world(world)


def baked_world(world: Any) -> ExtractedWorld:
    """`extract_world` of a bpy.types.World that is not constant, right after a `RenderGraph` was evaluated."""
    tree = world.inline_shader_nodes()
    nodes = list(tree.node_tree.nodes)
    lines = [*_volume(world)]
    told = {out.name for n in nodes if n.type == "LIGHT_PATH" for out in n.outputs if out.is_linked}
    split = bool(told)
    if told == {"Is Camera Ray"}:
        lines.append(f"world {world.name}: Light Path node, all rays but the camera's see what rays through glass see")
    elif told:
        lines.append(f"world {world.name}: Light Path node: what only rays of other kinds see of it {WORTHLESS}")
    if any(_by_view(node) for node in nodes):
        lines.append(f"world {world.name}: {VIEW}")
    sizes = [n.image.size[1] for n in nodes if n.type in {"TEX_ENVIRONMENT", "TEX_IMAGE"} and n.image is not None]
    height = int(np.clip(max([BAKE_HEIGHT, *sizes]), 1, MAX_HEIGHT))
    sun = any(_has_sun(node) for node in nodes)
    if sun:
        lines.append(f"world {world.name}: the sun disc of the sky is sampled at {180 / height:.2f} degrees a pixel")
    if max(sizes, default=0) > MAX_HEIGHT:
        lines.append(f"world {world.name}: image reduced to {2 * MAX_HEIGHT}x{MAX_HEIGHT}")
    reduced = -(-max([*sizes, 1]) // MAX_HEIGHT)  # each pixel of an image counts
    samples = max(SUPERSAMPLES if sun or not sizes else 1, reduced**2)
    image, visible, black = bake(world, height, samples), _visibility(world), np.zeros(3, np.float32)
    if not split:
        return ExtractedWorld(World(black, image, visible), tuple(lines))
    light = bake(world, height, samples, through=True)
    if not light.any():
        return ExtractedWorld(World(black, image, visible & 1 << RayType.CAMERA), tuple(lines))
    return ExtractedWorld(World(black, light, visible, image), tuple(lines))


def _by_view(node: Any) -> bool:
    """Whether a node goes by where the camera looks, for which the bake has another camera."""
    if node.type == "TEX_COORD":
        return any(out.is_linked and out.name in {"Camera", "Window"} for out in node.outputs)
    return node.type == "CAMERA" or (
        node.type == "VECT_TRANSFORM" and "CAMERA" in {node.convert_from, node.convert_to}
    )


def _has_sun(node: Any) -> bool:
    return node.type == "TEX_SKY" and node.sun_disc and node.sky_type not in {"PREETHAM", "HOSEK_WILKIE"}


def _suns(tree: Any) -> Iterator[Any]:
    """Sky nodes with a sun disc of a world's tree, and of the groups in it."""
    for node in tree.nodes:
        if node.type == "GROUP" and node.node_tree is not None:
            yield from _suns(node.node_tree)
        elif _has_sun(node):
            yield node


@contextmanager
def _wide_suns(world: Any, least: float) -> Iterator[None]:
    """Sun discs of at least this angle, which bring the same light."""
    with ExitStack() as stack:
        for node in _suns(world.node_tree):
            if node.sun_size < least:
                stack.enter_context(changed(node, sun_size=least))
        yield


@contextmanager
def _bake_scene(world: Any, through: bool) -> Iterator[Any]:
    """A scene with nothing but a copy of the world, and a camera that sees all directions. through: glass that bends no
    ray is around the camera, so that what meets the world are no camera rays."""
    copy = world.copy()
    copy.cycles_visibility.camera = copy.cycles_visibility.transmission = True
    for link in [
        link for link in copy.node_tree.links if link.to_node.type == "OUTPUT_WORLD" and link.to_socket.name == "Volume"
    ]:
        copy.node_tree.links.remove(link)  # which would hide the sky
    scene = bpy.data.scenes.new(".lipac world bake")
    camera = bpy.data.cameras.new(".lipac world bake")
    item = bpy.data.objects.new(".lipac world bake", camera)
    made: list[Any] = []
    try:
        scene.world, scene.camera = copy, item
        scene.collection.objects.link(item)
        camera.type, camera.panorama_type = "PANO", "EQUIRECTANGULAR"
        item.rotation_euler = (np.pi / 2, 0.0, -np.pi / 2)
        if through:
            scene.collection.objects.link(_pane(made))
        yield scene
    finally:
        bpy.data.scenes.remove(scene)
        for block in (item, camera, copy, *made):
            bpy.data.batch_remove([block])


def _pane(made: list[Any]) -> Any:
    """A cube around the origin that refracts by an index of 1; what is made for it goes into made."""
    mesh, material = bpy.data.meshes.new(".lipac world bake"), bpy.data.materials.new(".lipac world bake")
    item = bpy.data.objects.new(".lipac world bake", mesh)
    made += [item, mesh, material]
    item.rotation_euler = (0.1, 0.2, 0.3)  # no edge lies along a row of pixels
    corners = [(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
    mesh.from_pydata(corners, [], [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)])
    mesh.materials.append(material)
    tree = material.node_tree
    tree.nodes.clear()
    output, node = tree.nodes.new("ShaderNodeOutputMaterial"), tree.nodes.new("ShaderNodeBsdfRefraction")
    node.inputs["Color"].default_value, node.inputs["Roughness"].default_value, node.inputs["IOR"].default_value = (
        (1, 1, 1, 1),
        0.0,
        1.0,
    )
    tree.links.new(node.outputs[0], output.inputs[0])
    return item


def bake(world: Any, height: int, samples: int, through: bool = False) -> F32:
    """(height, 2 height, 3) float32 equirectangular radiance of a bpy.types.World, oriented as `World.image`; through:
    as others than camera rays see it. Raises InputError if Cycles fails."""
    from ..pictures import read_picture

    with (
        no_new_images(),
        own_slot(),
        _bake_scene(world, through) as scene,
        tempfile.TemporaryDirectory(prefix="lipac") as folder,
    ):
        scene.render.engine = "CYCLES"
        scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = (
            2 * height, height, 100
        )
        scene.render.use_compositing = scene.render.use_sequencer = False
        scene.render.film_transparent = False
        c = scene.cycles
        c.device, c.samples, c.use_adaptive_sampling, c.use_denoising, c.max_bounces, c.film_exposure = (
            "CPU", samples, False, False, 4 * through, 1.0
        )
        c.transmission_bounces = 4 * through  # an edge may be met twice
        c.pixel_filter_type, c.filter_width, c.seed = "BOX", 1.0 if samples > 1 else 0.01, 0
        c.sample_clamp_direct = c.sample_clamp_indirect = 0.0
        settings = scene.render.image_settings
        settings.file_format, settings.color_depth, settings.color_mode = "OPEN_EXR", "32", "RGB"
        scene.render.use_file_extension = True
        path = Path(folder) / "world.exr"
        with changed(scene.render, filepath=str(path)), _wide_suns(scene.world, SUN * np.pi / height):
            bpy.ops.render.render(scene=scene.name, write_still=True)
        if not path.exists():
            raise InputError(f"world {world.name!r} could not be baked: Cycles rendered nothing")
        pixels = read_picture(path)[:, :, :3]
    # Cycles' picture has +X in its middle column, the core's has -X there
    return np.ascontiguousarray(np.roll(pixels, height, axis=1))
