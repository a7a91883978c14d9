"""What the hybrid renderer shows and costs, measured: `python -m lipac.scripts.studies.hybrid.results -o docs/results`.

Each scene is rendered by Cycles (the truth), by EEVEE alone, and by the hybrid renderer with nothing culled, within
budgets, and with everything culled; some also with 1 to 8 paths per pixel, next to Cycles in equal time. Every render
is one `lipac render` in a process of its own, into the folder --work; what is there of the same scene file, and where
it is ours of the same code, is not rendered again.

Writes DIR/hybrid.json after each scene, pictures into DIR/../pictures, and the tables into DIR/../results.md where that
is there. Scenes that are not named keep their rows, so a list of scenes can be measured in several goes; their settings
must be the same.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ....core.errors import InputError
from ....core.evaluation.metrics import flip, relative_mse
from ....core.files.atomic import replacing
from ....core.files.digest import digest
from ..compare import lipac, pictures
from ..machine import made_by
from ..pictures.strips import save, strip
from ..supplied import SUPPLIED
from . import report
from .report import (
    CULLED,
    NOTHING,
    RASTER,
    RAW,
    ROUGH,
    SETTINGS,
    SHOWN,
    STAGES,
    TRUTH,
    WHOLE,
    Row,
    pictures_folder,
    write_page,
)

WAYS = {
    TRUTH: ("--engine", "cycles", "--cull", "none"),
    RASTER: ("--engine", "eevee", "--cull", "none"),
    WHOLE: ("--engine", "hybrid", "--cull", "none"),
    CULLED: ("--engine", "hybrid", "--max-error", "0.01"),
    ROUGH: ("--engine", "hybrid", "--max-error", "0.3"),
    NOTHING: ("--engine", "hybrid", "--min-share", "1e9"),
}
SUPPLIED_SCENES = ("indoor", "kitchen", "candela_city", "rooms1024")
DEMOS = {"mirror-city": 20_000, "crowd": 1_000}
SCENES = (*SUPPLIED_SCENES, *DEMOS)
PATHS = (1, 2, 4, 8)
COSTED = ("indoor", "candela_city", "mirror-city")
CYCLES_PATHS = (1, 2, 4, 8, 16, 32, 64)


def main(argv: Sequence[str] | None = None) -> int:
    """Render, compare, write; returns the exit status."""
    parser = argparse.ArgumentParser(prog="hybrid_results", description=__doc__)
    parser.add_argument(
        "scenes", nargs="*", metavar="NAME", default=[*SCENES], help=f"default: all, {', '.join(SCENES)}"
    )
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help="folder for hybrid.json")
    parser.add_argument(
        "--work", type=Path, default=Path("out/hybrid"), metavar="DIR", help="folder for renders (default: %(default)s)"
    )
    parser.add_argument("--supplied", type=Path, default=SUPPLIED, metavar="DIR", help="where the supplied scenes are")
    parser.add_argument("--resolution", default="320x180")
    parser.add_argument("--truth", type=int, default=512, help="paths per pixel of the truth")
    parser.add_argument("--samples", type=int, default=32, help="paths per pixel of the hybrid renderer")
    parser.add_argument("--raster-samples", type=int, default=8, help="of EEVEE, alone and in the hybrid renderer")
    parser.add_argument(
        "--no-cost",
        action="store_true",
        help="errors alone; what the file says of seconds stays, for another machine's would not compare",
    )
    args = parser.parse_args(argv)
    try:
        results = begun(args)
    except InputError as error:
        print(f"hybrid_results: {error}", file=sys.stderr)
        return 2
    for name in args.scenes:
        scene = scene_file(name, args)
        if scene is None:
            print(f"{name} is not in {args.supplied} and is left out; --supplied says where it is", file=sys.stderr)
            continue
        row, before = compare(name, scene, args), results["scenes"].get(name, {})
        results["scenes"][name] = row | ({"overlap": before["overlap"]} if args.no_cost and before else {})
        if name in COSTED and not args.no_cost:
            results["cost"][name] = cost(name, scene, args)
        write(results, args.output)
    if results["cost"]:
        report.plot(results["cost"], pictures_folder(args.output) / "hybrid-cost.png")
    print(report.results(results))
    return 0


def begun(args: argparse.Namespace) -> dict[str, Any]:
    """What DIR/hybrid.json has, or the beginning of it. Raises InputError for unknown scenes, and where rows that stay
    were measured by other settings."""
    if unknown := [name for name in args.scenes if name not in SCENES]:
        raise InputError(f"no such scene: {', '.join(unknown)}; choose of {', '.join(SCENES)}")
    args.output.mkdir(parents=True, exist_ok=True)
    target, settings = args.output / "hybrid.json", {name: getattr(args, name) for name in SETTINGS}
    results: dict[str, Any] = (
        json.loads(target.read_text()) if target.exists() else {"scenes": {}, "cost": {}, "settings": settings}
    )
    stay = results["scenes"].keys() - set(args.scenes)
    if results["settings"] != settings and stay:
        old = ", ".join(f"--{name.replace('_', '-')} {value}" for name, value in results["settings"].items())
        raise InputError(
            f"{target} has {', '.join(sorted(stay))} by {old}: give the same settings, or name these scenes, too"
        )
    return results | {"settings": settings}


def write(results: dict[str, Any], output: Path) -> None:
    """DIR/hybrid.json, scenes in the order of SCENES; and its tables in DIR/../results.md."""
    for part_of in ("scenes", "cost"):
        results[part_of] = {name: results[part_of][name] for name in SCENES if name in results[part_of]}
    results["made_by"] = made_by()
    with replacing(output / "hybrid.json") as part:
        part.write_text(json.dumps(results, indent=1) + "\n")
    write_page(output)


def scene_file(name: str, args: argparse.Namespace) -> Path | None:
    """The file of a scene by name, None where it is missing; demos are built."""
    if name not in DEMOS:
        path: Path = args.supplied / f"{name}.blend"
        return path if path.exists() else None
    path = args.work / f"{name}-{DEMOS[name]}.blend"
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        lipac("demo", name, "-o", path, "--instances", str(DEMOS[name]), "--quiet")
    return path


def render(name: str, scene: Path, way: str, samples: int, args: argparse.Namespace) -> Path:
    """Render a scene one way, unless that is done; returns its folder."""
    ours = "hybrid" in WAYS[way]
    more = ["--raster-samples", str(args.raster_samples)] if ours else []
    made = hashlib.sha256(f"{digest(scene)} {digest(*sources()) if ours else ''} {more}".encode()).hexdigest()[:10]
    folder: Path = (
        args.work
        / name
        / f"{args.resolution}-{samples}-{way.replace(', ', '-').replace(' %', '').replace(' ', '-')}-{made}"
    )
    if (folder / "report.json").exists() and json.loads((folder / "report.json").read_text())["frames"]:
        return folder
    print(f"{name}: {way}, {samples} samples", file=sys.stderr, flush=True)
    lipac("render", scene, "-o", folder, *WAYS[way], *more, "--resolution", args.resolution, "--samples", str(samples))
    return folder


def sources() -> list[Path]:
    """What a render of ours depends on."""
    root = Path(__file__).parents[3]
    return sorted(
        path for folder in ("core", "lipac_addon") for path in (root / folder).rglob("*.py") if "ui" not in path.parts
    )


def frame_of(folder: Path) -> Row:
    """The frame of a report."""
    frame: Row = json.loads((folder / "report.json").read_text())["frames"][0]
    return frame


def compare(name: str, scene: Path, args: argparse.Namespace) -> Row:
    """A scene in all ways: error of each against the truth, FLIP of what is displayed and relMSE of what is linear, and
    what the culled one keeps."""
    samples = {TRUTH: args.truth, RASTER: args.raster_samples}
    folders = {way: render(name, scene, way, samples.get(way, args.samples), args) for way in WAYS}
    seen = {way: pictures(folder.parent, folder.name) for way, folder in folders.items()}
    shown = [np.rint(255 * np.clip(seen[way][1][..., :3], 0, 1)).astype(np.uint8) for way in SHOWN]
    save(strip(shown, SHOWN), pictures_folder(args.output) / f"hybrid-{name}.jpg")
    whole, culled = frame_of(folders[WHOLE]), frame_of(folders[CULLED])
    linear = {way: seen[way][0] for way in folders} | {RAW: not_denoised(folders[WHOLE])}
    return {
        "flip": {way: flip(seen[TRUTH][1], seen[way][1])[1] for way in folders if way != TRUTH},
        "relmse": {way: relative_mse(linear[TRUTH], picture) for way, picture in linear.items() if way != TRUTH},
        "active": culled["active"],
        "instances": culled["instances"],
        "blas_bytes": [culled["blas_bytes"], whole["blas_bytes"]],
        "tlas_bytes": [culled["tlas_bytes"], whole["tlas_bytes"]],
        "overlap": culled["overlap_s"] / max(seconds(culled), 1e-9),
        "path_share": {
            way: share for way, folder in folders.items() if (share := frame_of(folder).get("path_share", 1)) < 1
        },
    }


def not_denoised(folder: Path) -> Any:
    """The picture of a folder without its denoising, from its layers: (H, W, 3) float32, rows from the top."""
    from ....lipac_addon.raster.layers import read_layers

    layer = read_layers(next(folder.glob("frame_*_layers.exr")))
    return (layer["Combined"][..., :3] - layer["Denoised"] + layer["Traced Lamps"] + layer["Traced Indirect"])[::-1]


def seconds(frame: Row) -> float:
    """Of a frame from its first stage to its last, for the hybrid renderer; else of the render."""
    return float(max(stage["end_s"] for stage in frame["timeline"]) if "timeline" in frame else frame["render_s"])


def cost(name: str, scene: Path, args: argparse.Namespace) -> list[Row]:
    """Seconds by stage and error of the hybrid renderer at few paths per pixel, and of Cycles."""
    truth = pictures((args.work / name), render(name, scene, TRUTH, args.truth, args).name)[1]
    out = []
    for way, all_paths in ((WHOLE, PATHS), (CULLED, PATHS), (TRUTH, CYCLES_PATHS)):
        for paths in all_paths:
            folder = render(name, scene, way, paths, args)
            frame = frame_of(folder)
            stages = {
                stage: sum(s["end_s"] - s["start_s"] for s in frame.get("timeline", ()) if s["stage"] == stage)
                for stage in STAGES
            }
            error = flip(truth, pictures(folder.parent, folder.name)[1])[1]
            out.append(
                {
                    "way": way,
                    "paths": paths,
                    "seconds": seconds(frame),
                    "stages": stages if "timeline" in frame else {},
                    "flip": error,
                }
            )
    return out


if __name__ == "__main__":
    sys.exit(main())
