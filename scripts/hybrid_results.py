"""What the hybrid renderer shows and costs, measured: `python -m lipac.scripts.hybrid_results -o docs/results`.

Each scene is rendered by Cycles (the truth), by EEVEE alone, and by the hybrid renderer with nothing culled, within budgets, and with everything culled;
some also with 1 to 8 paths per pixel, next to Cycles in equal time. Every render is one `lipac render` in a process of its own, into the folder --work; what
is there of the same scene file, and where it is ours of the same code, is not rendered again.

Writes DIR/hybrid.json after each scene, pictures into DIR/../pictures, and the tables into DIR/../results.md where that is there. Scenes that are not named
keep their rows, so a list of scenes can be measured in several goes; their settings must be the same.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from ..core.errors import InputError
from ..core.metrics import flip, relative_mse
from ..core.report import replacing
from .compare import lipac, markdown, pictures
from .evaluate import SUPPLIED

TRUTH, RASTER, WHOLE, CULLED, ROUGH, NOTHING, RAW = "Cycles", "EEVEE", "hybrid", "hybrid, 1 %", "hybrid, 30 %", "hybrid, all culled", "hybrid, not denoised"
WAYS = {
    TRUTH: ("--engine", "cycles", "--cull", "none"),
    RASTER: ("--engine", "eevee", "--cull", "none"),
    WHOLE: ("--engine", "hybrid", "--cull", "none"),
    CULLED: ("--engine", "hybrid", "--max-error", "0.01"),
    ROUGH: ("--engine", "hybrid", "--max-error", "0.3"),
    NOTHING: ("--engine", "hybrid", "--min-share", "1e9"),
}
SHOWN = (TRUTH, RASTER, WHOLE, CULLED)
SUPPLIED_SCENES = ("indoor", "kitchen", "candela_city", "rooms1024")
DEMOS = {"mirror-city": 20_000, "crowd": 1_000}
SCENES = (*SUPPLIED_SCENES, *DEMOS)
SETTINGS = ("resolution", "truth", "samples", "raster_samples")
TITLE = "## The hybrid renderer"
COSTED = ("indoor", "candela_city", "mirror-city")
PATHS = (1, 2, 4, 8)
CYCLES_PATHS = (1, 2, 4, 8, 16, 32, 64)
STAGES = ("first hits", "EEVEE", "analysis", "building", "tracing", "combine")
Row = dict[str, Any]


def main(argv: Sequence[str] | None = None) -> int:
    """Render, compare, write; returns the exit status."""
    parser = argparse.ArgumentParser(prog="hybrid_results", description=__doc__)
    parser.add_argument("scenes", nargs="*", metavar="NAME", default=[*SCENES], help=f"default: all, {', '.join(SCENES)}")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help="folder for hybrid.json")
    parser.add_argument("--work", type=Path, default=Path("out/hybrid"), metavar="DIR", help="folder for renders (default: %(default)s)")
    parser.add_argument("--supplied", type=Path, default=SUPPLIED, metavar="DIR", help="where the supplied scenes are")
    parser.add_argument("--resolution", default="320x180")
    parser.add_argument("--truth", type=int, default=512, help="paths per pixel of the truth")
    parser.add_argument("--samples", type=int, default=32, help="paths per pixel of the hybrid renderer")
    parser.add_argument("--raster-samples", type=int, default=8, help="of EEVEE, alone and in the hybrid renderer")
    parser.add_argument("--no-cost", action="store_true", help="errors alone; what the file says of seconds stays, for another machine's would not compare")
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
        plot(results["cost"], pictures_folder(args.output) / "hybrid-cost.png")
    print(section(results))
    return 0


def begun(args: argparse.Namespace) -> dict[str, Any]:
    """What DIR/hybrid.json has, or the beginning of it. Raises InputError for unknown scenes, and where rows that stay were measured by other settings."""
    if unknown := [name for name in args.scenes if name not in SCENES]:
        raise InputError(f"no such scene: {', '.join(unknown)}; choose of {', '.join(SCENES)}")
    args.output.mkdir(parents=True, exist_ok=True)
    target, settings = args.output / "hybrid.json", {name: getattr(args, name) for name in SETTINGS}
    results: dict[str, Any] = json.loads(target.read_text()) if target.exists() else {"scenes": {}, "cost": {}, "settings": settings}
    stay = results["scenes"].keys() - set(args.scenes)
    if results["settings"] != settings and stay:
        old = ", ".join(f"--{name.replace('_', '-')} {value}" for name, value in results["settings"].items())
        raise InputError(f"{target} has {', '.join(sorted(stay))} by {old}: give the same settings, or name these scenes, too")
    return results | {"settings": settings}


def write(results: dict[str, Any], output: Path) -> None:
    """DIR/hybrid.json, scenes in the order of SCENES; and its tables in DIR/../results.md."""
    for part_of in ("scenes", "cost"):
        results[part_of] = {name: results[part_of][name] for name in SCENES if name in results[part_of]}
    with replacing(output / "hybrid.json") as part:
        part.write_text(json.dumps(results, indent=1) + "\n")
    write_page(output)


def write_page(output: Path) -> None:
    """Put the sections about the hybrid renderer, as the files in a folder say, at the end of the page beside it, where there is one."""
    from .evaluate_report import hybrid

    page = output.parent / "results.md"
    if page.exists():
        head = page.read_text().partition(f"\n{TITLE}\n")[0]
        with replacing(page) as part:
            part.write_text(head + hybrid(output))


def pictures_folder(output: Path) -> Path:
    """Where pictures of results in a folder go."""
    folder = output.parent / "pictures"
    folder.mkdir(parents=True, exist_ok=True)
    return folder


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
    folder: Path = args.work / name / f"{args.resolution}-{samples}-{way.replace(', ', '-').replace(' %', '').replace(' ', '-')}-{made}"
    if (folder / "report.json").exists() and json.loads((folder / "report.json").read_text())["frames"]:
        return folder
    print(f"{name}: {way}, {samples} samples", file=sys.stderr, flush=True)
    lipac("render", scene, "-o", folder, *WAYS[way], *more, "--resolution", args.resolution, "--samples", str(samples))
    return folder


@cache
def digest(*paths: Path) -> str:
    """Of the contents of files."""
    return hashlib.sha256(b"".join(hashlib.sha256(path.read_bytes()).digest() for path in paths)).hexdigest()


def sources() -> list[Path]:
    """What a render of ours depends on."""
    root = Path(__file__).parents[1]
    return sorted(path for folder in ("core", "lipac_addon") for path in (root / folder).rglob("*.py") if "ui" not in path.parts)


def frame_of(folder: Path) -> Row:
    """The frame of a report."""
    frame: Row = json.loads((folder / "report.json").read_text())["frames"][0]
    return frame


def compare(name: str, scene: Path, args: argparse.Namespace) -> Row:
    """A scene in all ways: error of each against the truth, FLIP of what is displayed and relMSE of what is linear, and what the culled one keeps."""
    from matplotlib.image import imsave

    samples = {TRUTH: args.truth, RASTER: args.raster_samples}
    folders = {way: render(name, scene, way, samples.get(way, args.samples), args) for way in WAYS}
    seen = {way: pictures(folder.parent, folder.name) for way, folder in folders.items()}
    row = np.concatenate([np.clip(seen[way][1][..., :3], 0, 1) for way in SHOWN], axis=1)
    imsave(pictures_folder(args.output) / f"hybrid-{name}.png", row)
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
        "path_share": {way: share for way, folder in folders.items() if (share := frame_of(folder).get("path_share", 1)) < 1},
    }


def not_denoised(folder: Path) -> Any:
    """The picture of a folder without its denoising, from its layers: (H, W, 3) float32, rows from the top."""
    from ..lipac_addon.raster.layers import read_layers

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
            stages = {stage: sum(s["end_s"] - s["start_s"] for s in frame.get("timeline", ()) if s["stage"] == stage) for stage in STAGES}
            error = flip(truth, pictures(folder.parent, folder.name)[1])[1]
            out.append({"way": way, "paths": paths, "seconds": seconds(frame), "stages": stages if "timeline" in frame else {}, "flip": error})
    return out


def plot(costs: dict[str, list[Row]], path: Path) -> None:
    """Error against time."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5.5 * len(costs), 4), layout="constrained")
    for axes, (name, rows) in zip(np.atleast_1d(figure.subplots(1, len(costs))), costs.items(), strict=True):
        for way, style in ((TRUTH, "k.-"), (WHOLE, "s-"), (CULLED, "o-")):
            own = [r for r in rows if r["way"] == way]
            axes.plot([r["seconds"] for r in own], [r["flip"] for r in own], style, label=way, markersize=5)
            if way != TRUTH:
                hidden = [r["seconds"] - r["stages"]["EEVEE"] for r in own]
                axes.plot(hidden, [r["flip"] for r in own], style.replace("-", ":"), color=axes.lines[-1].get_color(), label=f"{way}, less EEVEE", markersize=3)
        axes.set(xlabel="seconds of a frame", ylabel="mean FLIP against converged Cycles", xscale="log", yscale="log", title=name)
        axes.grid(alpha=0.3, which="both")
    figure.axes[0].legend(fontsize=7)
    with replacing(path) as part:
        figure.savefig(part, dpi=80)


def section(results: dict[str, Any]) -> str:
    """A section of docs/results.md."""
    settings = results["settings"]
    ways = (RASTER, WHOLE, CULLED, ROUGH, NOTHING)
    head = ("scene", *ways[:3], "worse by", *ways[3:])
    body, linear = [], []
    for name, row in results["scenes"].items():
        errors, worse = ({m: row[m] for m in ("flip", "relmse")}, {m: row[m][CULLED] / row[m][WHOLE] - 1 for m in ("flip", "relmse")})
        blas, tlas = row["blas_bytes"], row["tlas_bytes"]
        share = (blas[0] + tlas[0]) / max(blas[1] + tlas[1], 1)
        cells = [[f"{errors[m][way]:.4f}" if way in errors[m] else "" for way in (*ways, RAW)] for m in errors]
        kept = (f"{row['active']:,} of {row['instances']:,}", f"{blas[0] / max(blas[1], 1):.0%}", f"{share:.0%}", f"{row['overlap']:.0%}")
        body.append((name, *cells[0][:3], f"{worse['flip']:+.1%}", *cells[0][3:5], *kept))
        linear.append((name, *cells[1][:3], f"{worse['relmse']:+.1%}", *cells[1][3:]))
    lines = [TITLE, ""]
    size, truth, samples, raster = (settings[name] for name in SETTINGS)
    lines += [f"`python -m lipac.scripts.hybrid_results -o docs/results`, at {size}: {truth} paths per pixel of Cycles are the truth, {samples} those of the"]
    lines += [f"hybrid renderer, {raster} the samples of EEVEE. Mean FLIP of what is displayed. Bytes of the culled picture over those of the unculled one,"]
    lines += ["hitboxes included. Overlap: share of the frame in which both threads worked."]
    lines += ["", markdown([(*head, "kept", "BLAS", "BLAS and TLAS", "overlap"), *body]), ""]
    lines += ["relMSE of the linear pictures:", "", markdown([(*head, RAW), *linear]), ""]
    lines += mixtures(results["scenes"])
    lines += [f"From left to right {', '.join(SHOWN)}:", ""]
    lines += [f"![{name}](pictures/hybrid-{name}.png)" for name in results["scenes"]]
    if results["cost"]:
        lines += ["", "### Cost", "", "Seconds of a frame by stage (they overlap, on two threads), and error:", ""]
        for name, rows in results["cost"].items():
            lines += [cost_table(name, rows), ""]
        lines += ["![Error against time, next to Cycles](pictures/hybrid-cost.png)"]
    return "\n".join(lines) + "\n"


def mixtures(scenes: dict[str, Row]) -> list[str]:
    """What is said of pictures that are EEVEE's in part or as a whole."""
    lines = []
    shares = {name: ", ".join(f"{way}: {share:.0%}" for way, share in row.get("path_share", {}).items()) for name, row in scenes.items()}
    mixed = [f"{name} ({of})" for name, of in shares.items() if of]
    if mixed:
        lines += [f"Mixed with EEVEE's picture, and by which share made by paths: {'; '.join(mixed)}.", ""]
    alone = [f"{name} ({', '.join(row['raster_only'])})" for name, row in scenes.items() if row.get("raster_only")]
    if alone:
        lines += ["Measured when one of the two pictures was chosen, before they were mixed (an error that is EEVEE's can have become smaller since), and"]
        lines += [f"shown by EEVEE alone: {'; '.join(alone)}.", ""]
    return lines


def cost_table(name: str, rows: list[Row]) -> str:
    """Stages of the hybrid renderer as shares of its frame, its error, and that of Cycles in the time of the frame, and in the time of it without EEVEE."""
    cycles = sorted((r["seconds"], r["flip"]) for r in rows if r["way"] == TRUTH)
    known = np.log([c[0] for c in cycles]), np.log([c[1] for c in cycles])

    def in_time(limit: float) -> str:
        """Error of Cycles after so many seconds, between measured ones on a line of their logarithms; beyond them the nearest."""
        return f"{np.exp(np.interp(np.log(max(limit, 1e-9)), *known)):.4f}"

    head = (name, "paths per pixel", *STAGES, "FLIP", "Cycles in equal time", "in that less EEVEE")
    body = []
    for r in rows:
        if r["way"] != TRUTH:
            stages = [f"{r['stages'][stage] / r['seconds']:.0%}" for stage in STAGES]
            body.append((r["way"], str(r["paths"]), *stages, f"{r['flip']:.4f}", in_time(r["seconds"]), in_time(r["seconds"] - r["stages"]["EEVEE"])))
    return markdown([head, *body])


if __name__ == "__main__":
    sys.exit(main())
