"""Culls a scene by light paths and renders it twice, whole and culled: `python examples/cull_and_render.py SCENE.blend
OUT`.

Shows the steps one by one. In one call: `lipac.render("SCENE.blend", "OUT", max_error=0.01)`.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import bpy

import lipac


def rendered(path: Path) -> float:
    """Render the open scene to a file; the seconds that took."""
    bpy.context.scene.render.filepath = str(path)
    start = time.perf_counter()
    bpy.ops.render.render(write_still=True)
    return time.perf_counter() - start


def main(scene: str, folder: Path) -> None:
    """Cull, render, and put everything back."""
    analysis = lipac.analyze(scene, max_error=0.01, options=lipac.CullOptions(seed=1))
    print(f"{int((analysis.state == 2).sum())} of {len(analysis.state)} instances stay")
    print(
        f"the picture changes by no more than {analysis.entry['certified_mean']:.2%} in the mean, with a confidence of "
        f"{analysis.entry['confidence']:.0%}"
    )
    whole = rendered(folder / "whole.png")
    applied = lipac.apply(analysis)
    print(
        f"{int(applied.removed.sum())} instances are taken out of renders; kept although culled: "
        f"{applied.kept or 'none'}"
    )
    culled = rendered(folder / "culled.png")
    lipac.restore()
    print(f"{whole:.1f} s whole, {culled:.1f} s culled")


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]))
