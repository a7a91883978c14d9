"""From how many instances on a single frame on a processor is worth its analysis: a table of docs/benchmarks.md.

`python -m lipac.scripts.studies.break_even -o docs`. The demo city in several sizes, rendered by Cycles on the CPU in
full and culled, each as a whole command in a process of its own, in turns. Of several runs the quickest counts, for
what else runs on a machine only ever makes one slower. Beside the seconds stand those of all processors together, which
depend less on that.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import sys
import textwrap
from collections.abc import Sequence
from pathlib import Path

from ...core.files.figures import size
from . import compare
from .compare import CULLED, FULL, cores, markdown
from .machine import stamp

SIZES = (20_000, 50_000, 100_000, 200_000, 300_000)
SAMPLES = (4, 64)
PICTURE = "320x180"
_PART = re.compile(r"(<!-- break-even -->\n).*?(<!-- end -->)", re.DOTALL)
Figures = dict[str, float]


def main(argv: Sequence[str] | None = None) -> int:
    """Measure what is not measured yet, replace the table in the page, print it; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--output", type=Path, default=Path("docs"), metavar="DIR", help="with benchmarks.md")
    parser.add_argument("--work", type=Path, default=Path("out/break-even"), metavar="DIR", help="scenes and renders")
    parser.add_argument("--sizes", type=int, nargs="*", default=SIZES)
    parser.add_argument("--samples", type=int, nargs="*", default=SAMPLES)
    parser.add_argument("--repeats", type=int, default=3)
    args = parser.parse_args(argv)
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else 0.0
    found = {
        (count, samples): measured(args.work, count, samples, args.repeats)
        for count in args.sizes
        for samples in args.samples
    }
    said = stamp("python -m lipac.scripts.studies.break_even -o docs")
    busy = f" Load when it began: {load:.1f} on {cores()} cores." if load else ""
    table = markdown(rows_of(found))
    text = f"{table}\n\n{textwrap.fill(f'{said} The quickest of {args.repeats} runs.{busy}', 120)}"
    page = args.output / "benchmarks.md"
    page.write_text(_PART.sub(lambda part: f"{part[1]}{text}\n{part[2]}", page.read_text()))
    print(text)
    return 0


def measured(work: Path, instances: int, samples: int, repeats: int) -> dict[str, Figures]:
    """Of the ways FULL and CULLED the least seconds of the command, those of all processors, and bytes at the peak;
    those of an earlier run where they are there."""
    place = work / f"{instances}-{samples}"
    kept = place / "measured.json"
    if kept.exists():
        known: dict[str, Figures] = json.loads(kept.read_text())
        return known
    scene = work / f"city-{instances}.blend"
    if not scene.exists():
        compare.lipac("demo", "mirror-city", "-o", scene, "--instances", str(instances), "--quiet")
    options = ("--resolution", PICTURE, "--samples", str(samples), "--device", "cpu", "--quiet")
    runs: dict[str, list[Figures]] = {FULL: [], CULLED: []}
    for _ in range(repeats):
        for way, several in runs.items():
            before = processor_seconds()
            report = compare.render(scene, place, way, options)
            seconds = {"command": report["process_s"], "processor": processor_seconds() - before}
            active = report["frames"][0]["active"]
            several.append({**seconds, "bytes": report["totals"]["peak_bytes"], "active": active})
    least = {way: {name: min(run[name] for run in several) for name in several[0]} for way, several in runs.items()}
    kept.write_text(json.dumps(least, indent=1) + "\n")
    return least


def processor_seconds() -> float:
    """Of all processes that were started from here and have ended."""
    times = os.times()
    return times.children_user + times.children_system


def rows_of(found: dict[tuple[int, int], dict[str, Figures]]) -> list[tuple[str, ...]]:
    """The table, its head first."""
    head = (
        "instances",
        "samples",
        "everything",
        "culled, analysis included",
        "ratio",
        "processor seconds",
        "ratio of these",
        "peak memory",
        "stay",
    )
    rows: list[tuple[str, ...]] = [head]
    for (count, samples), ways in found.items():
        full, culled = ways[FULL], ways[CULLED]
        rows.append(
            (
                f"{count:,}",
                f"{samples}",
                f"{full['command']:.1f} s",
                f"{culled['command']:.1f} s",
                _ratio(full["command"] / culled["command"]),
                f"{full['processor']:.1f}, {culled['processor']:.1f}",
                _ratio(full["processor"] / culled["processor"]),
                f"{size(int(full['bytes']))}, {size(int(culled['bytes']))}",
                f"{culled['active']:,.0f}",
            )
        )
    return rows


def _ratio(ratio: float) -> str:
    return f"{ratio:.2f}" + ("" if ratio > 1 else ": **costs more**")


if __name__ == "__main__":
    sys.exit(main())
