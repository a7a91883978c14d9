"""Processor seconds behind the rates in seconds of `core.scene.render_costs`: what Cycles takes for one thing more of a
kind until it samples, what of a sample culling saves, and what an analysis of next to nothing takes.
`python -m lipac.scripts.studies.memory.seconds` prints the tables."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from ....core.scene.render_costs import (
    ANALYSED,
    ANALYSED_BYTES,
    CHEAPER,
    IMAGE_BYTE_S,
    LOADED,
    LOADING_S,
    OBJECT_S,
    PATH_S,
    PLACED_S,
    TRIANGLE_S,
)
from .. import compare
from ..break_even import processor_seconds
from ..compare import markdown
from ..machine import stamp
from ..supplied import SUPPLIED

# Scene, how many things more it has than the first, and what each is taken to need at most
CASES: dict[str, tuple[dict[str, Any], int, float]] = {
    "nothing": ({}, 1, 0.0),
    "a triangle: a mesh of 2 million": ({"triangles": 2_000_000}, 2_000_000, TRIANGLE_S),
    "40 meshes of 100,000": ({"triangles": 100_000, "meshes": 40}, 4_000_000, TRIANGLE_S),
    "subdivided: 10 x 4,000 x 64": ({"triangles": 4_000, "meshes": 10, "subdivided": 3}, 2_560_000, TRIANGLE_S),
    "what is placed: 100,000 by geometry nodes": ({"scattered": 100_000}, 100_000, PLACED_S),
    "300,000": ({"scattered": 300_000}, 300_000, PLACED_S),
    "an object: 5,000 of one mesh": ({"objects": 5_000}, 5_000, OBJECT_S),
    "300 of a mesh each": ({"meshes": 300}, 300, OBJECT_S),
    "a byte of an image: a PNG of 4,096 x 4,096": ({"image": 4096}, 4 * 4096**2, IMAGE_BYTE_S),
}
SCENES = ("indoor", "kitchen", "candela_city", "rooms1024")
SAMPLES = (2, 18)
TURNS = 3


def main() -> int:
    """Measure each case in a process of its own, and print the tables; returns the exit status."""
    load, base = os.getloadavg()[0], 0.0
    rows: list[tuple[str, ...]] = [("one more of what Cycles reads", "processor seconds", "taken to be at most")]
    for name, (case, count, rate) in CASES.items():
        found = _measured("case", json.dumps(case))[0]
        if not case:
            base = found
            continue
        rows.append((name, f"{(found - base) / count:.1e}", f"{rate:.0e}"))
    print(markdown(rows), flush=True)
    rows = [("processor seconds of a path", "Cycles, full", "culled", "saved", "analysis", "of Cycles' in full")]
    for name in SCENES:
        full, culled, own = _measured("scene", name)
        shares = f"{1 - culled / full:.0%}", f"{own:.1e}", f"{own / full:.2f}"
        rows.append((name, f"{full:.1e}", f"{culled:.1e}", *shares))
    low, high = PATH_S
    rows.append(("taken to be", f"{low:.0e} to {high:.0e}", "", f"{CHEAPER:.0%} at most", "", f"{ANALYSED:g} at least"))
    print(f"\n{markdown(rows)}", flush=True)
    first, path, size, each = _measured("analysis", "")
    rows = [
        ("what an analysis of next to nothing takes", "measured", "taken to be at least"),
        ("processor seconds, once", f"{first:.2f}", f"{LOADING_S:g}"),
        ("memory, once", f"{size / 1e6:.0f} MB", f"{LOADED / 1e6:.0f} MB"),
        ("memory of a path", f"{each:.0f} bytes", f"{ANALYSED_BYTES} bytes"),
        ("processor seconds of a path", f"{path:.1e}", f"{PATH_S[0]:.0e}"),
    ]
    said = stamp("python -m lipac.scripts.studies.memory.seconds")
    print(f"\n{markdown(rows)}\n\n{said} Load when it began: {load:.1f}.")
    return 0


def _measured(kind: str, what: str) -> list[float]:
    """What a process of its own finds."""
    command = [sys.executable, "-m", "lipac.scripts.studies.memory.seconds", kind, what]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    print(what, done.stdout.splitlines()[-1], file=sys.stderr, flush=True)
    found: list[float] = json.loads(done.stdout.splitlines()[-1])
    return found


def _clock() -> float:
    """Of all processors, that this process has taken so far."""
    return sum(os.times()[:2])


def measure_case(case: dict[str, Any]) -> list[float]:
    """Of a render of a few pixels, the least of TURNS."""
    import bpy

    from .sweep import build

    build()
    bpy.ops.render.render()  # what is loaded once
    build(width=32, **case)
    with tempfile.TemporaryDirectory() as folder:
        if case.get("image"):
            _to_file(bpy.data.images[0], Path(folder) / "image.png")
        bpy.context.scene.cycles.samples = 1
        return [min(_rendered() for _ in range(TURNS))]


def _to_file(image: Any, path: Path) -> None:
    """Have a generated image come from a file, of noise, which does not compress."""
    import numpy as np

    image.pixels.foreach_set(np.random.default_rng(0).random(len(image.pixels), np.float32))
    image.filepath_raw, image.file_format = str(path), "PNG"
    image.save()
    image.source = "FILE"
    image.reload()


def _rendered() -> float:
    import bpy

    start = _clock()
    bpy.ops.render.render()
    return _clock() - start


def measure_scene(name: str) -> list[float]:
    """Of each further path of a pixel, in full and culled by the default budget, 320 x 180; and of each of an analysis,
    with all that it does."""
    import bpy

    from .... import analyze, apply, restore
    from ....lipac_addon.console import muted
    from ....lipac_addon.open import open_scene

    with muted():
        open_scene(SUPPLIED / f"{name}.blend")
        scene = bpy.context.scene
        render, cycles = scene.render, scene.cycles
        render.engine, render.resolution_x, render.resolution_y, render.resolution_percentage = "CYCLES", 320, 180, 100
        cycles.device, cycles.use_denoising, cycles.use_adaptive_sampling = "CPU", False, False
        analyze(scene)  # what is loaded once
        start = _clock()
        found = analyze(scene)
        own = (_clock() - start) / found.entry["paths"]
        least = {(way, samples): float("inf") for way in ("full", "culled") for samples in SAMPLES}
        for _ in range(TURNS):
            for (way, samples), before in least.items():
                if way == "culled":
                    apply(found)
                cycles.samples = samples
                least[way, samples] = min(before, _rendered())
                restore()
    few, many = SAMPLES
    return [(least[way, many] - least[way, few]) / (320 * 180 * (many - few)) for way in ("full", "culled")] + [own]


def measure_analysis() -> list[float]:
    """By which `lipac render` of next to nothing takes more with an analysis than without: seconds of a processor at no
    path at all, of each path, and bytes at the peak likewise. Of each way the least of TURNS."""
    import bpy

    from .sweep import build

    ways = {"none": ("--cull", "none"), "few": ("--paths", "2"), "many": ("--paths", "34")}
    found: dict[str, list[tuple[float, int, int]]] = {way: [] for way in ways}
    with tempfile.TemporaryDirectory() as folder:
        scene, out = Path(folder) / "scene.blend", Path(folder) / "out"
        build()
        bpy.ops.wm.save_as_mainfile(filepath=str(scene))
        for way, options in list(ways.items()) * TURNS:
            before = processor_seconds()
            compare.lipac("render", scene, "-o", out / way, "--samples", "1", "--device", "cpu", "--quiet", *options)
            report = json.loads((out / way / "report.json").read_text())
            taken = processor_seconds() - before, report["frames"][0]["paths"], report["totals"]["peak_bytes"]
            found[way].append(taken)
            (out / way / "report.json").unlink()
    none, few, many = (min(turns) for turns in found.values())
    path = (many[0] - few[0]) / (many[1] - few[1])
    nothing, less, more = (min(peak for _, _, peak in turns) for turns in found.values())
    each = (more - less) / (many[1] - few[1])
    return [few[0] - none[0] - path * few[1], path, less - nothing - each * few[1], each]


if __name__ == "__main__":
    if len(sys.argv) == 1:
        sys.exit(main())
    KINDS = {"case": lambda: measure_case(json.loads(sys.argv[2])), "scene": lambda: measure_scene(sys.argv[2])}
    print(json.dumps(KINDS.get(sys.argv[1], measure_analysis)()))
