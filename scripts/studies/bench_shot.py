"""What a shot takes, by each way to cull it, side by side: nothing culled, one set for the shot, each frame by itself,
and Cycles' own Simplify as users set it.

Each way is a command of its own; they take turns. Times are the medians of the turns, as a clock tells them and of all
processors: on a machine that has other work to do the latter say more. Where the seconds go is what the command's
report says, the rest is starting, opening the file and writing pictures. The error is that of the pictures themselves,
against those of the full scene with the same random numbers, noise included: the mean of all tiles and frames, and the
worst tile.

    python -m lipac.scripts.studies.bench_shot SCENE.blend --frames 60-67
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from ...core.files.figures import size
from ..command.arguments import frame_range, resolution
from .machine import made_by

FULL = "nothing culled"
STEPS = {"analysis": ("sync_s", "build_s", "trace_s", "feedback_s"), "write-back": ("writeback_s",)}


@dataclass
class Way:
    """How a shot is rendered: name, options of `lipac render`, and what is set in the file before. Times of each turn;
    report: of the last."""

    name: str
    options: tuple[str, ...] = ("--cull", "none")
    camera: bool = False
    distance: float = 0.0
    walls: list[float] = field(default_factory=list)
    processors: list[float] = field(default_factory=list)
    report: dict[str, Any] = field(default_factory=dict)
    folder: Path = Path()


def ways(distance: float) -> list[Way]:
    """Those that are compared. distance: metres, of Simplify's."""
    return [
        Way(FULL),
        Way("`--bake shot`", ("--bake", "shot")),
        Way("`--bake shot --ahead`", ("--bake", "shot", "--ahead")),
        Way("`--bake frame`", ("--cull", "light-paths")),
        Way("Simplify: camera", camera=True),
        Way(f"Simplify: camera, distance {distance:g} m", camera=True, distance=distance),
    ]


def simplified(scene: Path, way: Way, place: Path) -> Path:
    """The scene as a way sets it: Simplify is on, and each object has its ticks."""
    if not way.camera:
        return scene
    import bpy

    from ...lipac_addon.console import muted

    with muted():
        bpy.ops.wm.open_mainfile(filepath=str(scene))
    for one in bpy.data.scenes:
        one.render.use_simplify = True
        one.cycles.use_camera_cull, one.cycles.use_distance_cull = way.camera, way.distance > 0
        one.cycles.distance_cull_margin = way.distance
    for ob in bpy.data.objects:
        ob.cycles.use_camera_cull, ob.cycles.use_distance_cull = way.camera, way.distance > 0
    path = place / f"{way.distance:g}.blend"
    with muted():
        bpy.ops.wm.save_as_mainfile(filepath=str(path), copy=True)
    return path


def turn(scene: Path, way: Way, folder: Path, common: Sequence[str]) -> None:
    """Render the shot once by a way."""
    import resource

    way.folder = folder
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    command = [sys.executable, "-m", "lipac.scripts.lipac", "render", str(scene), "-o", str(folder)]
    done = subprocess.run([*command, *common, *way.options, "--quiet"], stdout=subprocess.DEVNULL, check=False)
    if done.returncode:
        sys.exit(done.returncode)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    way.walls.append(time.perf_counter() - start)
    way.processors.append(after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime)
    way.report = json.loads((folder / "report.json").read_text())


def change(full: Path, other: Path) -> tuple[float, float]:
    """Of the pictures in a folder against those of the full scene: the mean, and the worst tile of all."""
    from ...core.evaluation.judge import picture_change
    from ...lipac_addon.pictures import read_picture

    found = [
        picture_change(read_picture(path), read_picture(other / path.name)) for path in sorted(full.glob("frame_*.exr"))
    ]
    return float(np.mean([mean for mean, _ in found])), max(worst for _, worst in found)


def table(done: Sequence[Way]) -> list[str]:
    """Markdown."""
    full = done[0]
    lines = [
        "| | stays | seconds | of processors | analysis | write-back | render | rest | memory | change, worst tile |",
        "|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|",
    ]
    for way in done:
        frames = way.report["frames"]
        wall, used = median(way.walls), median(way.processors)
        ratios = [
            f" ({of / own:.2f} times)" if way is not full else ""
            for of, own in ((median(full.walls), wall), (median(full.processors), used))
        ]
        spent = {name: sum(frame.get(step, 0.0) for frame in frames for step in steps) for name, steps in STEPS.items()}
        spent["render"] = sum(frame["render_s"] for frame in frames)
        cells = [f"{value:.1f}" for value in (*spent.values(), way.walls[-1] - sum(spent.values()))]
        mean, worst = (0.0, 0.0) if way is full else change(full.folder, way.folder)
        kept = "" if way.camera else f"{max(frame['active'] for frame in frames):,}"
        error = "" if way is full else f"{100 * mean:.2g} %, {100 * worst:.2g} %"
        row = (
            way.name,
            kept,
            f"{wall:.1f}{ratios[0]}",
            f"{used:.1f}{ratios[1]}",
            *cells,
            size(way.report["totals"]["peak_bytes"]),
            error,
        )
        lines.append(f"| {' | '.join(row)} |")
    return lines


def main(argv: Sequence[str] | None = None) -> int:
    """Measure, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("--frames", type=frame_range, required=True, metavar="A-B")
    parser.add_argument("--resolution", type=resolution, default=(320, 180), metavar="WxH")
    parser.add_argument("--samples", type=int, default=8)
    parser.add_argument("--turns", type=int, default=1)
    parser.add_argument("--distance", type=float, default=150.0, help="metres, of Simplify's distance culling")
    parser.add_argument("--only", type=int, nargs="*", help="ways, by number from 0")
    args = parser.parse_args(argv)
    frames = f"{args.frames[0]}-{args.frames[-1]}"
    common = ("--frames", frames, "--resolution", "{}x{}".format(*args.resolution), "--samples", str(args.samples))
    done = [way for k, way in enumerate(ways(args.distance)) if args.only is None or k in (0, *args.only)]
    with tempfile.TemporaryDirectory(prefix="lipac") as temporary:
        place = Path(temporary)
        scenes = [simplified(args.scene.resolve(), way, place) for way in done]
        for _ in range(args.turns):
            for k, (way, scene) in enumerate(zip(done, scenes, strict=True)):
                turn(scene, way, place / str(k), common)
        turns = "one turn" if args.turns == 1 else f"{args.turns} turns"
        print(f"Frames {frames} of {args.scene.name}, `{' '.join(common[2:])}`, {turns}: {made_by()}.\n")
        print("\n".join(table(done)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
