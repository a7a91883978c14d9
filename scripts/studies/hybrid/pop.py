"""The pop of a shadow whose caster is culled and comes back: `python -m lipac.scripts.studies.hybrid.pop -o
docs/results`.

A camera draws back from a slab over a floor, and returns; `--cull distance` culls the slab on the way and keeps it
again. Each frame is rendered with nothing culled, with the slab's shadow from the raster where it is culled (the hybrid
renderer), and without (`--primary traced`). The pop of a frame is how much its shadow, less that of the unculled frame,
differs from the frame before, over the brightness of the lit floor. Writes DIR/hybrid_pop.json, a picture into
DIR/../pictures, and the tables into DIR/../results.md where that is there.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ....core.arrays import F32
from ....core.culling.options import CullOptions
from ....core.files.atomic import replacing
from ....core.scene.film import LUMINANCE
from ..evaluate_report import shown
from ..machine import made_by
from ..pictures.strips import strip
from .report import pictures_folder, pop, write_page

FRAMES = 9
RASTER_SAMPLES = 4
NEAR, FAR = 9.0, 11.0  # metres from the camera to the slab's middle, along the floor
KEPT = 8.6  # distance of the slab's box up to which it is kept
FALLBACKS = {"raster shadow maps": "raster", "none": "traced"}


@dataclass(frozen=True)
class Pop:
    """Of F frames. kept: whether the slab was. shadow: brightness of its shadow over that of the lit floor, by fallback
    and "unculled".
    pop: of each frame, by fallback, 0 in the first. pictures: of each frame, unculled and by fallback side by side."""

    kept: list[bool]
    shadow: dict[str, list[float]]
    pop: dict[str, list[float]]
    pictures: list[F32]

    def largest(self, fallback: str) -> float:
        """Of all frames."""
        return max(self.pop[fallback])


def main(argv: Sequence[str] | None = None) -> int:
    """Render the sequence, measure, write; returns the exit status."""
    from matplotlib.image import imsave

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DIR")
    parser.add_argument("--samples", type=int, default=32)
    args = parser.parse_args(argv)
    result = measure(FRAMES, (160, 90), args.samples)
    args.output.mkdir(parents=True, exist_ok=True)
    figures = {
        "made_by": made_by(),
        "kept": result.kept,
        "shadow": result.shadow,
        "pop": result.pop,
        "largest": {name: result.largest(name) for name in FALLBACKS},
    }
    with replacing(args.output / "hybrid_pop.json") as part:
        part.write_text(json.dumps(figures, indent=1) + "\n")
    changes = [k for k in range(1, FRAMES) if result.kept[k] != result.kept[k - 1]]
    rows = [k for change in changes[:1] for k in (change - 1, change)]
    labels = "everything", *(f"shadow of what is culled: {name}" for name in FALLBACKS)
    large = [np.repeat(np.repeat(shown(result.pictures[k]), 2, 0), 2, 1) for k in rows]
    seen = np.concatenate([strip(np.split(row, len(labels), axis=1), labels) for row in large])
    imsave(pictures_folder(args.output) / "hybrid-pop.png", seen)
    write_page(args.output)
    print(pop(figures))
    return 0


def measure(frames: int, size: tuple[int, int], samples: int) -> Pop:
    """The sequence in so many frames, of a picture of size, with so many paths per pixel."""
    import bpy

    scene, camera = build(size)
    kept: list[bool] = []
    shadow: dict[str, list[float]] = {name: [] for name in ("unculled", *FALLBACKS)}
    pop: dict[str, list[float]] = {name: [] for name in FALLBACKS}
    before: dict[str, NDArray[Any]] = {}
    pictures = []
    for k in range(frames):
        camera.location.y = -(NEAR + (FAR - NEAR) * np.sin(np.pi * k / (frames - 1)))
        bpy.context.view_layer.update()
        whole, layers, _ = frame(scene, CullOptions(policy="none"), "raster", samples)
        floor = layers["Normal"][..., 2] > 0.999
        dark, lit = floor & (layers["Shadow"] < 0.5), floor & (layers["Shadow"] > 0.5)
        bright = float(np.median(whole[lit] @ LUMINANCE))
        shadow["unculled"].append(float((whole[dark] @ LUMINANCE).mean()) / bright)
        row, cull = [whole], CullOptions(policy="distance", setting=KEPT)
        without, _, active = frame(scene, cull, FALLBACKS["none"], samples)
        kept.append(bool(active.all()))
        raster = whole if kept[-1] else frame(scene, cull, FALLBACKS["raster shadow maps"], samples)[0]
        for name, picture in zip(FALLBACKS, (raster, without), strict=True):
            shadow[name].append(float((picture[dark] @ LUMINANCE).mean()) / bright)
            difference = (picture - whole) @ LUMINANCE / bright
            pop[name].append(float(np.abs(difference - before[name])[dark].mean()) if k else 0.0)
            before[name] = difference
            row.append(picture)
        pictures.append(np.concatenate(row, axis=1))
    return Pop(kept, shadow, pop, pictures)


def build(size: tuple[int, int]) -> tuple[Any, Any]:
    """Replace the open file by the floor, the slab over it, a sun and a camera; the scene and the camera."""
    import bpy

    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    bpy.ops.mesh.primitive_plane_add(size=16)
    bpy.ops.mesh.primitive_cube_add(size=1, location=(0, 0, 2.5))
    bpy.context.object.scale = (3, 3, 0.2)
    bpy.ops.object.light_add(type="SUN", rotation=(0.3, -0.3, 0))
    bpy.context.object.data.energy, bpy.context.object.data.angle = 3, 0.02
    bpy.ops.object.camera_add(location=(0, -NEAR, 4), rotation=(1.2, 0, 0))
    scene.camera = bpy.context.object
    scene.world = bpy.data.worlds.new("World")
    scene.world.color = (0.1, 0.1, 0.1)
    scene.render.resolution_x, scene.render.resolution_y = size
    scene.render.resolution_percentage = 100
    return scene, scene.camera


def frame(scene: Any, cull: CullOptions, primary: str, samples: int) -> tuple[F32, dict[str, F32], NDArray[np.bool_]]:
    """The hybrid renderer's picture, (H, W, 3) linear, rows bottom up, its layers, and which instances it kept."""
    from ....lipac_addon.batch.engines.hybrid_frame import HybridOptions, render_hybrid
    from ....lipac_addon.extract import extract_frame
    from ....lipac_addon.raster.layers import read_layers

    with tempfile.TemporaryDirectory(prefix="lipac-") as folder:
        stem = Path(folder) / "frame"
        result, _ = render_hybrid(
            extract_frame(scene, scene.frame_current).scene,
            HybridOptions(primary=primary, raster_samples=RASTER_SAMPLES),
            cull,
            stem,
            samples,
        )
        layers = read_layers(stem.with_name("frame_layers.exr"))
    return layers["Combined"][..., :3], layers, result.active


if __name__ == "__main__":
    sys.exit(main())
