"""Images of more pixels than an analysis looks at, judged by Cycles.

`python -m lipac.scripts.studies.pictures.fine_images -o DIR`.

An analysis reduces images to 1,024 pixels a side (`core/scene/images.py`). Each scene here depends on detail that is
lost by that: light of single pixels of a map of emission, things seen through holes of single pixels, and a mirror
whose bumps are of single pixels, so that it reflects more than a smooth one would. Each is rendered with all twelve
parts of the picture verified, by images of several sizes.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..compare import markdown
from ..machine import stamp

SIZES = (1024, 4096, 8192)
OPTIONS = ("--resolution", "320x180", "--samples", "128", "--verify", "12", "--quiet")
THINGS = 600


def main(argv: Sequence[str] | None = None) -> int:
    """Build, render, verify; write DIR/fine_images.md and print it; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DIR")
    parser.add_argument("--sizes", type=int, nargs="*", default=SIZES, help="pixels of a side")
    parser.add_argument("--scenes", nargs="*", choices=[*SCENES], default=[*SCENES])
    args = parser.parse_args(argv)
    rows: list[tuple[str, ...]] = [("scene", "image", "stay", "certified", "by Cycles", "surely", "status")]
    for name in args.scenes:
        for side in args.sizes:
            folder = args.output / f"{name}-{side}"
            folder.mkdir(parents=True, exist_ok=True)
            built(name, side, folder)
            status = _rendered(folder)
            frame = json.loads((folder / "report.json").read_text())["frames"][0]
            rows.append((name, f"{side:,} x {side:,}", *row_of(frame), f"{status}"))
    text = f"{stamp('python -m lipac.scripts.studies.pictures.fine_images')}\n\n{markdown(rows)}\n"
    (args.output / "fine_images.md").write_text(text)
    print(text)
    return 0


def _rendered(folder: Path) -> int:
    """The status of `lipac render`: 0, or 3 where the budget is broken."""
    import subprocess

    command = [sys.executable, "-m", "lipac.scripts.lipac", "render", str(folder / "scene.blend"), "-o", str(folder)]
    done = subprocess.run([*command, *OPTIONS], stdout=subprocess.DEVNULL, check=False)
    if done.returncode not in (0, 3):
        raise SystemExit(f"{folder}: status {done.returncode}")
    return done.returncode


def row_of(frame: dict[str, Any]) -> tuple[str, ...]:
    """What stays, and the change: certified, verified, and what of that is no noise."""
    pairs = [
        tuple(frame[f"{kind}_{of}"] for of in ("mean", "worst")) for kind in ("certified", "verified", "verified_least")
    ]
    return (
        f"{frame['active']:,} of {frame['instances']:,}",
        *(f"{100 * mean:.2g} %, {100 * worst:.2g} %" for mean, worst in pairs),
    )


def built(name: str, side: int, folder: Path) -> None:
    """The file of a scene whose image has so many pixels a side: scene.blend, and the image beside it."""
    import bpy

    from ....lipac_addon.console import muted

    with muted():
        bpy.ops.wm.read_factory_settings(use_empty=True)
        SCENES[name](side, folder)
        bpy.ops.wm.save_as_mainfile(filepath=str(folder / "scene.blend"))


def _image(values: NDArray[np.uint8], folder: Path, is_data: bool) -> Any:
    """An image of the file's folder with these values, (H, W) grey or (H, W, 3)."""
    import bpy
    from PIL import Image

    Image.fromarray(values).save(folder / "detail.png", compress_level=1)
    image = bpy.data.images.load(str(folder / "detail.png"))
    image.colorspace_settings.name = "Non-Color" if is_data else "sRGB"
    return image


def _stage(eye: tuple[float, float, float], lens: float) -> None:
    """A camera at eye that looks along y, and a dark sky."""
    import bpy

    scene = bpy.context.scene
    scene.render.engine, scene.cycles.use_denoising, scene.cycles.use_adaptive_sampling = "CYCLES", False, False
    camera = bpy.data.cameras.new("camera")
    camera.lens = lens
    scene.camera = bpy.data.objects.new("camera", camera)
    scene.camera.location, scene.camera.rotation_euler = eye, (np.pi / 2, 0, 0)
    scene.collection.objects.link(scene.camera)
    scene.world = bpy.data.worlds.new("world")
    scene.world.node_tree.nodes["Background"].inputs["Color"].default_value = (0.02, 0.02, 0.02, 1)


def _wall(y: float, half: float, material: Any) -> None:
    """A square that faces the camera, with UVs from corner to corner."""
    import bpy

    mesh = bpy.data.meshes.new(material.name)
    mesh.from_pydata([(-half, y, -half), (half, y, -half), (half, y, half), (-half, y, half)], [], [(0, 1, 2, 3)])
    layer = mesh.uv_layers.new(name="UVMap")
    layer.data.foreach_set("uv", [0, 0, 1, 0, 1, 1, 0, 1])
    mesh.materials.append(material)
    bpy.context.scene.collection.objects.link(bpy.data.objects.new(material.name, mesh))


def _material(name: str, image: Any) -> tuple[Any, Any, Any]:
    """A material: it, its principled node, and the colour that its image gives."""
    import bpy

    material = bpy.data.materials.new(name)
    nodes = material.node_tree.nodes
    texture = nodes.new("ShaderNodeTexImage")
    texture.image = image
    return material, nodes["Principled BSDF"], texture.outputs["Color"]


def _things(places: NDArray[np.float64], radius: float, glow: float) -> None:
    """A small ball at each of (N, 3) places, in a few colours."""
    import bpy

    from ....lipac_addon.demo import builders

    meshes = []
    for k, color in enumerate(((0.9, 0.2, 0.1), (0.1, 0.8, 0.2), (0.2, 0.3, 0.9), (0.8, 0.8, 0.8))):
        bpy.ops.mesh.primitive_ico_sphere_add(radius=radius, subdivisions=2)
        ball = bpy.context.object
        material = builders.material(f"ball {k}", color, 0.6)
        if glow:
            shader = material.node_tree.nodes["Principled BSDF"].inputs
            shader["Emission Color"].default_value, shader["Emission Strength"].default_value = (*color, 1), glow
        ball.data.materials.append(material)
        meshes.append(ball.data)
        bpy.data.objects.remove(ball)
    for k, place in enumerate(places.tolist()):
        ob = bpy.data.objects.new(f"ball {k}", meshes[k % len(meshes)])
        ob.location = place
        bpy.context.scene.collection.objects.link(ob)


def _scattered(low: tuple[float, float, float], high: tuple[float, float, float]) -> NDArray[np.float64]:
    return np.random.default_rng(1).uniform(low, high, (THINGS, 3))


def emission(side: int, folder: Path) -> None:
    """A screen of which one pixel of 256 glows lights balls before a wall: half of them the camera sees."""
    values = np.zeros((side, side), np.uint8)
    values[8::16, 8::16] = 255
    material, shader, color = _material("screen", _image(values, folder, is_data=False))
    material.node_tree.links.new(color, shader.inputs["Emission Color"])
    shader.inputs["Emission Strength"].default_value = 400.0
    shader.inputs["Base Color"].default_value = (0, 0, 0, 1)
    _stage((0, -9, 0), 35)
    _wall(6.0, 5.0, material)
    _things(_scattered((-9, -2, -4), (9, 5.5, 4)), 0.25, 0.0)


def alpha(side: int, folder: Path) -> None:
    """A curtain with a hole of a pixel in each 4 x 4 of them; glowing balls behind it, and at its sides."""
    values = np.full((side, side), 255, np.uint8)
    values[1::4, 1::4] = 0
    material, shader, color = _material("curtain", _image(values, folder, is_data=True))
    material.node_tree.links.new(color, shader.inputs["Alpha"])
    _stage((0, -9, 0), 35)
    _wall(0.0, 5.0, material)
    _things(_scattered((-9, 1, -4), (9, 8, 4)), 0.3, 6.0)


def bump(side: int, folder: Path) -> None:
    """A mirror whose bumps have the size of a pixel: it reflects glowing balls all around, a smooth one but those
    straight ahead."""
    values = np.random.default_rng(0).integers(0, 256, (side, side)).astype(np.uint8)
    node = _mirror(_image(values, folder, is_data=True), "ShaderNodeBump", "Height")
    node.inputs["Distance"].default_value = 0.6 * 10.0 / side  # slopes of the same size, whatever that of a pixel


def _mirror(image: Any, kind: str, socket: str) -> Any:
    """A wall that reflects, whose normals a node of a kind makes of an image, and glowing balls behind the camera;
    returns the node."""
    material, shader, color = _material("mirror", image)
    links, node = material.node_tree.links, material.node_tree.nodes.new(kind)
    links.new(color, node.inputs[socket])
    links.new(node.outputs["Normal"], shader.inputs["Normal"])
    shader.inputs["Metallic"].default_value, shader.inputs["Roughness"].default_value = 1.0, 0.02
    shader.inputs["Base Color"].default_value = (0.9, 0.9, 0.9, 1)
    _stage((0, -4, 0), 50)
    _wall(0.0, 5.0, material)
    _things(_scattered((-20, -30, -20), (20, -6, 20)), 0.5, 4.0)
    return node


def normal(side: int, folder: Path) -> None:
    """The same mirror by a map of normals, each of which leans by half a radian at most."""
    lean = np.random.default_rng(0).uniform(-0.35, 0.35, (side, side, 2)).astype(np.float32)
    values = np.concatenate([lean, np.sqrt(1 - (lean**2).sum(axis=2, keepdims=True))], axis=2)
    image = _image(np.round(127.5 * (values + 1)).astype(np.uint8), folder, is_data=True)
    _mirror(image, "ShaderNodeNormalMap", "Color")


SCENES: dict[str, Callable[[int, Path], None]] = {"emission": emission, "alpha": alpha, "bump": bump, "normal": normal}


if __name__ == "__main__":
    sys.exit(main())
