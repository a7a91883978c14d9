"""Error of a picture over the time that it took, in full and culled: docs/pictures/error-time.png.

`python -m lipac.scripts.studies.pictures.error_over_time`. The demo city by Cycles on the CPU with more and more
samples, each a whole command with its analysis, against a picture of everything with many more. Time is of all
processors together, which depends less on what else a machine does than that on the wall.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from .. import compare
from ..break_even import processor_seconds
from ..compare import CULLED, FULL
from ..machine import code

SAMPLES, TRUTH = (2, 8, 32, 128), 512
NAMES = {FULL: "everything", CULLED: "culled within 1 %, analysis included"}
Points = dict[str, list[tuple[float, float]]]


def main(argv: Sequence[str] | None = None) -> int:
    """Render what is not rendered yet, measure, draw; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--output", type=Path, default=Path("docs/pictures/error-time.png"))
    parser.add_argument("--work", type=Path, default=Path("out/error-over-time"), metavar="DIR")
    parser.add_argument("--instances", type=int, default=300_000)
    args = parser.parse_args(argv)
    scene = args.work / f"city-{args.instances}.blend"
    if not scene.exists():
        compare.lipac("demo", "mirror-city", "-o", scene, "--instances", str(args.instances), "--quiet")
    rendered(scene, args.work / f"{TRUTH}", FULL, TRUTH, "1")
    truth = compare.pictures(args.work / f"{TRUTH}", FULL)
    points: Points = {
        way: [measured(scene, args.work / f"{samples}", way, samples, truth) for samples in SAMPLES] for way in NAMES
    }
    draw(points, args.instances, args.output)
    print(json.dumps(points))
    return 0


def rendered(scene: Path, folder: Path, way: str, samples: int, seed: str) -> float:
    """Render a scene one way, unless that is done; returns the seconds of all processors."""
    kept = folder / f"{way}.json"
    if not kept.exists():
        before = processor_seconds()
        options = ["--resolution", "320x180", "--samples", f"{samples}", "--device", "cpu", "--quiet"]
        policy = "light-paths" if way == CULLED else "none"
        compare.lipac("render", scene, "-o", folder / way, "--cull", policy, "--seed", seed, *options)
        kept.write_text(json.dumps(processor_seconds() - before) + "\n")
    return float(json.loads(kept.read_text()))


def measured(scene: Path, folder: Path, way: str, samples: int, truth: tuple[Any, Any]) -> tuple[float, float]:
    """Seconds of all processors, and relMSE of the linear picture against the truth."""
    from ....core.evaluation.metrics import relative_mse

    seconds = rendered(scene, folder, way, samples, "0")
    return seconds, relative_mse(truth[0], compare.pictures(folder, way)[0])


def draw(points: Points, instances: int, path: Path) -> None:
    """The plot."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    figure = Figure(figsize=(7.5, 4.6), layout="constrained")
    axes = figure.subplots()
    for (way, name), style in zip(NAMES.items(), (".-", "o-"), strict=True):
        x, y = zip(*points[way], strict=True)
        axes.plot(x, y, style, label=name, color="black" if way == FULL else "#e69f00")
        for samples, at in zip(SAMPLES, points[way], strict=True):
            place = (4, 5) if way == FULL else (-12, -11)
            axes.annotate(f"{samples}", at, place, textcoords="offset points", fontsize=8)
    axes.set(xscale="log", yscale="log", xlabel="seconds of all processors, whole command")
    axes.set_ylabel(f"relMSE against {TRUTH} samples of everything")
    title = f"Demo city of {instances:,} instances, 320x180; numbers are samples per pixel"
    axes.set_title(f"{title}\n{code()}", fontsize=10)
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.grid(alpha=0.3, which="both")
    axes.legend(fontsize=9)
    figure.savefig(path, dpi=100)


if __name__ == "__main__":
    sys.exit(main())
