"""The table and pictures of docs/hybrid.md: `python -m lipac.scripts.hybrid_pictures SCENE... -o out/hybrid`.

Each scene is rendered by Cycles (the truth), by EEVEE alone, and by the hybrid renderer with nothing culled, within a budget of 1 %, and with everything
culled, each by the `lipac render` command in a process of its own. What is there already is not rendered again.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..core.metrics import flip, relative_mse

RUNS = {
    "Cycles": ["--engine", "cycles", "--cull", "none"],
    "EEVEE": ["--engine", "eevee", "--cull", "none"],
    "raw": ["--engine", "hybrid", "--cull", "none", "--denoise", "off"],
    "hybrid": ["--engine", "hybrid", "--cull", "none"],
    "culled": ["--engine", "hybrid", "--max-error", "0.01"],
    "nothing": ["--engine", "hybrid", "--min-share", "1e9"],
}
SHOWN = ("Cycles", "EEVEE", "hybrid", "culled")
HEAD = (
    "| scene | EEVEE | hybrid, not denoised | hybrid | hybrid, 1 % | hybrid, all culled | instances kept at 1 % | BLAS bytes kept at 1 % | overlap |\n"
    "|---|---:|---:|---:|---:|---:|---:|---:|---:|"
)


def main(argv: Sequence[str] | None = None) -> int:
    """Render, compare, and write table.md, table.json and a row of pictures per scene; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", nargs="+", type=Path, metavar="SCENE")
    parser.add_argument("-o", "--output", type=Path, default=Path("out/hybrid"))
    parser.add_argument("--resolution", default="240x135")
    parser.add_argument("--truth", type=int, default=1024, help="paths per pixel of Cycles")
    parser.add_argument("--samples", type=int, default=32, help="of the hybrid renderer")
    parser.add_argument("--raster-samples", type=int, default=8, help="of EEVEE, alone and in the hybrid renderer")
    args = parser.parse_args(argv)
    rows = [compare(scene, args) for scene in args.scenes]
    (args.output / "table.json").write_text(json.dumps(rows, indent=1) + "\n")
    table = "\n".join([HEAD, *map(line, rows)]) + "\n"
    (args.output / "table.md").write_text(table)
    print(table)
    return 0


def compare(scene: Path, args: argparse.Namespace) -> dict[str, Any]:
    """Render a scene all ways; its errors by way, FLIP of what is displayed and relMSE of what is linear, and figures of the culled run."""
    from matplotlib.image import imsave

    folder = args.output / scene.stem
    samples = {"Cycles": args.truth, "EEVEE": args.raster_samples}
    for name, options in RUNS.items():
        if (folder / name / "frame_0001.png").exists() or any((folder / name).glob("frame_*.png")):
            continue
        raster = ["--raster-samples", str(args.raster_samples)] if "hybrid" in options else []
        command = [sys.executable, "-m", f"{__package__}.lipac", "render", str(scene), "-o", str(folder / name), *options, *raster]
        subprocess.run([*command, "--resolution", args.resolution, "--samples", str(samples.get(name, args.samples))], check=True)
    from ..lipac_addon.pictures import read_picture

    shown = {name: read_picture(next((folder / name).glob("frame_*.png")))[..., :3] for name in RUNS}
    linear = {name: read_picture(next(p for p in (folder / name).glob("frame_*.exr") if "layers" not in p.name))[..., :3] for name in RUNS}
    imsave(args.output / f"{scene.stem}.png", np.concatenate([np.clip(shown[name], 0, 1) for name in SHOWN], axis=1)[::-1])
    frames = {name: json.loads((folder / name / "report.json").read_text())["frames"][0] for name in RUNS}
    whole, part = frames["hybrid"], frames["culled"]
    return {
        "scene": scene.stem,
        "flip": {name: flip(shown["Cycles"], shown[name])[1] for name in RUNS},
        "relmse": {name: relative_mse(linear["Cycles"], linear[name]) for name in RUNS},
        "kept": [part["active"], part["instances"]],
        "blas_share": part["blas_bytes"] / max(whole["blas_bytes"], 1),
        "overlap": part["overlap_s"] / max(part["timeline"][-1]["end_s"], 1e-9),
    }


def line(row: dict[str, Any]) -> str:
    """A line of the table."""
    errors = " | ".join(f"{row['flip'][name]:.4f}" for name in ("EEVEE", "raw", "hybrid", "culled", "nothing"))
    kept, of = row["kept"]
    return f"| {row['scene']} | {errors} | {kept:,} of {of:,} | {row['blas_share']:.0%} | {row['overlap']:.0%} |"


if __name__ == "__main__":
    sys.exit(main())
