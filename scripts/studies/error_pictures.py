"""The picture and the table of docs/error.md: what the measure does not see.

`python -m lipac.scripts.studies.error_pictures -o docs`. Two scenes, each rendered by Cycles in full and culled.
"""

from __future__ import annotations

import argparse
import re
import sys
import tempfile
import textwrap
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ...core.error_budget.budget import Budget
from ...core.evaluation.judge import picture_change

SIZE, SAMPLES = (1280, 720), 32
SHOWN = (320, 180)  # pixels of a part that is shown
BUDGET = Budget(0.01, 0.05)
_PART = re.compile(r"(<!-- failures -->\n).*?(<!-- end -->)", re.DOTALL)


def main(argv: Sequence[str] | None = None) -> int:
    """Render, write the picture and the table; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--output", type=Path, default=Path("docs"))
    args = parser.parse_args(argv)
    import bpy

    from .machine import stamp

    rows, strips = [], []
    for scene in SCENES:
        bpy.ops.wm.read_factory_settings(use_empty=True)
        budget = scene()
        frame, full, culled = _both(budget)
        rows.append(_row(scene, budget, frame, full, culled))
        strips.append((scene, full, culled))
    head = (
        "case",
        "allowed: mean, worst tile",
        "instances kept",
        "certified",
        "change, by Cycles",
        "largest change of a pixel",
    )
    table = [head, ("---",) * len(head), *rows]
    said = stamp("python -m lipac.scripts.studies.error_pictures -o docs")
    said += f" Cycles on the CPU, {SAMPLES} samples per pixel."
    text = "\n".join("| " + " | ".join(row) + " |" for row in table) + "\n\n" + textwrap.fill(said, 120)
    page = args.output / "error.md"
    page.write_text(_PART.sub(lambda part: f"{part[1]}{text}\n{part[2]}", page.read_text()))
    _draw(strips, args.output / "pictures" / "failures.png")
    return 0


def _stage() -> None:
    """An empty scene in even light, seen from above through an orthographic camera 16 m wide."""
    import bpy

    from ...lipac_addon.demo import builders

    scene = bpy.context.scene
    scene.render.engine, scene.cycles.samples, scene.cycles.use_denoising = "CYCLES", SAMPLES, False
    scene.render.resolution_x, scene.render.resolution_y = SIZE
    camera = bpy.data.cameras.new("camera")
    camera.type, camera.ortho_scale = "ORTHO", 16.0
    scene.camera = bpy.data.objects.new("camera", camera)
    scene.camera.location = (0, 0, 10)
    scene.collection.objects.link(scene.camera)
    scene.world = bpy.data.worlds.new("world")
    scene.world.node_tree.nodes["Background"].inputs["Color"].default_value = (1, 1, 1, 1)
    _put(_square("ground", 40.0, builders.material("ground", (0.5, 0.5, 0.5), 1.0)), (0, 0, 0))


def _square(name: str, side: float, material: Any) -> Any:
    import bpy

    mesh = bpy.data.meshes.new(name)
    half = side / 2
    mesh.from_pydata([(-half, -half, 0), (half, -half, 0), (half, half, 0), (-half, half, 0)], [], [(0, 1, 2, 3)])
    mesh.materials.append(material)
    return mesh


def _put(mesh: Any, place: tuple[float, float, float]) -> None:
    import bpy

    ob = bpy.data.objects.new(mesh.name, mesh)
    ob.location = place
    bpy.context.scene.collection.objects.link(ob)


def small_things() -> Budget:
    """dark dots, 9 pixels wide, a few to a tile"""
    from ...lipac_addon.demo import builders

    _stage()
    dot = _square("dot", 9 / SIZE[0] * 16, builders.material("dark", (0.01, 0.01, 0.01), 1.0))
    for x, y in np.random.default_rng(0).uniform((-7.5, -4), (7.5, 4), (180, 2)).tolist():
        _put(dot, (x, y, 0.01))
    return BUDGET


def fine_pattern() -> Budget:
    """a weave of light and dark squares, 2 pixels wide, on a ground of their mean"""
    from ...lipac_addon.demo import builders

    _stage()
    side = 2 / SIZE[0] * 16
    meshes = [_square(f"{v}", side, builders.material(f"grey {v}", (v, v, v), 1.0)) for v in (0.1, 0.9)]
    for i in range(-24, 24):
        for j in range(-24, 24):
            _put(meshes[(i + j) % 2], ((i + 0.5) * side, (j + 0.5) * side, 0.01))
    return BUDGET


SCENES: tuple[Callable[[], Budget], ...] = (small_things, fine_pattern)


def _both(budget: Budget) -> tuple[dict[str, Any], Any, Any]:
    """The report's frame, and the pictures of the open scene, full and culled, (H, W, 3) linear."""
    import bpy

    from ... import CullOptions, render
    from ...lipac_addon.pictures import read_picture

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.blend"
        bpy.ops.wm.save_as_mainfile(filepath=str(path))
        render(path, Path(folder) / "full", options=CullOptions(policy="none"))
        report = render(path, Path(folder) / "culled", budget)
        full, culled = (read_picture(Path(folder) / name / "frame_0001.exr")[..., :3] for name in ("full", "culled"))
    return report.frames[0], full, culled


def _row(scene: Callable[[], Budget], budget: Budget, frame: dict[str, Any], full: Any, culled: Any) -> tuple[str, ...]:
    most = np.abs(culled - full).mean(axis=2).max() / full.mean()
    allowed, certified = (budget.mean, budget.worst), (frame["certified_mean"], frame["certified_worst"])
    shown = [", ".join(f"{100 * x:.2g} %" for x in pair) for pair in (allowed, certified, picture_change(full, culled))]
    kept = f"{frame['active']:,} of {frame['instances']:,}"
    return str(scene.__doc__), shown[0], kept, shown[1], shown[2], f"{most:.2g} of the mean"


def _draw(strips: Sequence[tuple[Callable[[], Budget], Any, Any]], path: Path) -> None:
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(len(strips), 3, figsize=(12, 2.4 * len(strips)), layout="constrained")
    for (scene, full, culled), row in zip(strips, axes, strict=True):
        x, y = (full.shape[1] - SHOWN[0]) // 2, (full.shape[0] - SHOWN[1]) // 2
        parts = [picture[y : y + SHOWN[1], x : x + SHOWN[0]] for picture in (full, culled, np.abs(culled - full))]
        for axis, part, title in zip(row, parts, ("everything", "culled", "difference"), strict=True):
            axis.imshow(np.clip(part, 0, 1) ** (1 / 2.2), origin="lower", interpolation="nearest", aspect="equal")
            axis.set_xticks([])
            axis.set_yticks([])
            axis.set_title(f"{scene.__name__.replace('_', ' ')}: {title}", fontsize=9)
    figure.savefig(path, dpi=100)


if __name__ == "__main__":
    sys.exit(main())
