"""docs/pictures/plan.png: the mirror city from above, and what of it is kept by the camera's view and by light paths.

`python -m lipac.scripts.dev.plan_picture`.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes

POLICIES = {"frustum": "by the camera's view", "light-paths": "by light paths, 1 % error"}
SHOWN = ((-260.0, 260.0), (-190.0, 190.0))  # metres of x and y
KEPT, CULLED = "#e69f00", "#c9d3dc"


def main(argv: Sequence[str] | None = None) -> int:
    """Analyse by both policies and draw; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--output", type=Path, default=Path("docs/pictures/plan.png"))
    parser.add_argument("--instances", type=int, default=20_000)
    args = parser.parse_args(argv)
    import bpy
    from matplotlib.figure import Figure

    from ...core.culling.analysis import analyze
    from ...core.culling.options import CullOptions, State
    from ...lipac_addon.demo import mirror_city
    from ...lipac_addon.extract import extract_frame

    mirror_city.build(args.instances, 0)
    scene = extract_frame(bpy.context.scene).scene
    low, high = np.moveaxis(scene.instances.bounds.astype(np.float64) + scene.origin, 1, 0)
    middle, small = (low + high)[:, :2] / 2, (high - low)[:, :2].max(axis=1) < 200  # not the ground
    figure = Figure(figsize=(12, 5), layout="constrained")
    for axes, (policy, label) in zip(figure.subplots(1, 2), POLICIES.items(), strict=True):
        keep = analyze(scene, CullOptions(policy=policy)).state == State.ACTIVE
        for chosen, color, size in ((~keep, CULLED, 1.5), (keep, KEPT, 7)):
            x, y = middle[chosen & small].T
            axes.scatter(x, y, size, color=color, linewidths=0)
        _camera_and_mirror(axes, mirror_city)
        axes.set_title(f"kept {label}: {int(keep.sum()):,} of {len(keep):,} instances", fontsize=11)
        axes.set(xlim=SHOWN[0], ylim=SHOWN[1], aspect="equal", xlabel="metres")
    figure.savefig(args.output, dpi=100)
    return 0


def _camera_and_mirror(axes: Axes, city: Any) -> None:
    """The camera with the edges of its view, and the mirror."""
    import bpy

    camera = bpy.context.scene.camera
    frame = [camera.matrix_world @ corner for corner in camera.data.view_frame(scene=bpy.context.scene)]
    place = np.array(camera.matrix_world.translation)[:2]
    for corner in (frame[0], frame[3]):
        side = np.array(corner)[:2] - place
        end = place + 600 * side / np.linalg.norm(side)
        axes.plot(*np.stack([place, end]).T, color="black", linewidth=0.8, linestyle="--")
    half = city.MIRROR_SIZE[0] / 2 * np.array([np.cos(city.MIRROR_TURN), np.sin(city.MIRROR_TURN)])
    axes.plot(*np.stack([city.MIRROR - half, city.MIRROR + half]).T, color="#0072b2", linewidth=3)
    axes.plot(*place, "o", color="black", markersize=4)
    for text, (x, y), to in (("camera", place, (-120, -30)), ("mirror", city.MIRROR, (70, 50))):
        axes.annotate(text, (float(x), float(y)), to, arrowprops={"arrowstyle": "-", "linewidth": 0.7}, fontsize=10,
                      bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.5})  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())
