"""`lipac bench -o DIR`: the project's speed as ratios to peers, all measured in one run on one machine."""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..core.errors import InputError
from ..core.files.report import SECONDS
from ..lipac_addon.batch.engines.choices import CPU, GPU_KINDS
from .studies import compare
from .studies.compare import CULLED, FULL, OTHER_SEED, markdown
from .studies.machine import made_by

PEERS = ("rays", "feedback", "paths", "extraction", "city", "compiling")
FLYTHROUGH = ("flythrough", "shot")
ANIMATION = ("crowd", "character", *FLYTHROUGH, "growth", "rest", "memory", "pictures")
PARTS = (*PEERS, *ANIMATION)
GPU = "gpu"
KINDS = (CPU, *GPU_KINDS)
CITY = 1_000_000
CITY_OPTIONS = ("--resolution", "320x180", "--samples", "4")


def main(argv: Sequence[str]) -> int:
    """Run what is not measured yet, write benchmarks.json, benchmarks.md and animation.md, print them; returns the exit
    status."""
    from ..core.files.report import output_folder
    from .command.options import Parser

    parser = Parser(
        prog="lipac bench",
        description="Measure against peers, and animated scenes; parts already measured in DIR are kept. Rows of peers "
        "that are not here (Mitsuba, a C compiler) are left out.",
    )
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DIR")
    what = (
        "measure only this part, again; may be repeated. animation: what is not measured yet of animated scenes, "
        "instead of peers; gpu: on graphics cards"
    )
    parser.add_argument("--only", choices=(*PARTS, "animation", GPU), action="append", help=what)
    parser.add_argument(
        "--repeats", type=int, default=3, help="runs of each command of the part 'city' (default: %(default)s)"
    )
    parser.add_argument(
        "--run",
        choices=PARTS,
        help="measure one part in this process and write DIR/PART.json (what the parts' processes are called with)",
    )
    _add_gpu_options(parser)
    args = parser.parse_args(argv)
    folder = output_folder(args.output)
    if GPU in (args.only or []):
        if len(args.only) > 1:
            raise InputError("--only gpu measures nothing else: give it alone")
        return _gpu(folder, args)
    if args.run:
        result = measure(args.run, folder, args.repeats)
        (folder / f"{args.run}.json").write_text(json.dumps(result | {"machine": made_by()}, indent=1) + "\n")
        return 0
    only = args.only or []
    group = ANIMATION if "animation" in only else () if only else PEERS
    again = [name for name in only if name != "animation"]
    for name in again + [part for part in group if not (folder / f"{part}.json").exists()]:
        print(f"measuring {name}", file=sys.stderr, flush=True)
        command = [
            sys.executable,
            "-m",
            "lipac.scripts.lipac",
            "bench",
            "-o",
            str(folder),
            "--run",
            name,
            "--repeats",
            str(args.repeats),
        ]
        if subprocess.run(command, stdout=sys.stderr, check=False).returncode:
            print(f"lipac bench: part '{name}' failed and is left out", file=sys.stderr)
    results = {
        name: json.loads((folder / f"{name}.json").read_text()) for name in PARTS if (folder / f"{name}.json").exists()
    }
    peers = {name: results[name] for name in PEERS if name in results}
    if peers:
        text = report(peers)
        (folder / "benchmarks.json").write_text(json.dumps(peers, indent=1) + "\n")
        (folder / "benchmarks.md").write_text(text)
        print(text)
    animated = {name: results[name] for name in ANIMATION if name in results}
    if animated:
        from .studies.animation.report import write

        print(write(folder, animated))
    return 0


def _add_gpu_options(parser: argparse.ArgumentParser) -> None:
    from .command.arguments import resolution
    from .studies.bench_gpu import DEVICES, SCENES, WAYS, Plan

    plan, gpu = Plan(), parser.add_argument_group("--only gpu")

    def some(text: str) -> list[str]:
        return text.split(",")

    known = ",".join(f"{name}:{count}" for name, count in SCENES.items())
    gpu.add_argument(
        "--scenes",
        type=some,
        default=[*SCENES],
        metavar="NAME[:N],...",
        help=f"with so many instances (default: {known})",
    )
    gpu.add_argument(
        "--devices",
        type=some,
        default=[*DEVICES],
        metavar="NAME,...",
        help=f"as of lipac render --device, or eevee (default: {','.join(DEVICES)})",
    )
    gpu.add_argument("--samples", type=some, default=["32", "128"], metavar="N,...", help="per pixel (default: 32,128)")
    gpu.add_argument("--ways", type=some, default=[*WAYS], metavar="NAME,...", help=f"default: {','.join(WAYS)}")
    gpu.add_argument("--size", type=resolution, default=plan.size, metavar="WxH", help="default: 1920x1080")
    gpu.add_argument(
        "--limit", type=float, default=plan.limit, metavar="S", help="seconds of one measurement (default: %(default)g)"
    )
    gpu.add_argument(
        "--within",
        type=float,
        default=plan.within,
        metavar="S",
        help="seconds of the whole call; another goes on (default: %(default)g)",
    )
    gpu.add_argument("--again", action="store_true", help="measure what was measured before, too")


def _gpu(folder: Path, args: argparse.Namespace) -> int:
    """Measure on graphics cards. Raises InputError for names that do not exist."""
    from .studies.bench_gpu import DEVICES, SCENES, WAYS, Plan, run

    named = [scene.partition(":") for scene in args.scenes]
    counts = [count or str(SCENES.get(name, 0)) for name, _, count in named]
    places = {
        "--scenes": ([name for name, *_ in named], [*SCENES]),
        "--devices": (args.devices, [*dict.fromkeys([*DEVICES, *KINDS])]),
        "--ways": (args.ways, [*WAYS]),
    }
    for option, (given, known) in places.items():
        if wrong := [name for name in given if name not in known]:
            raise InputError(f"{option}: no '{wrong[0]}'; choose from {', '.join(known)}")
    if wrong := [number for number in [*counts, *args.samples] if not number.isdecimal() or not int(number)]:
        raise InputError(f"'{wrong[0]}' is no number of instances or samples")
    scenes = {name: int(count) for (name, *_), count in zip(named, counts, strict=True)}
    plan = Plan(
        scenes,
        tuple(args.devices),
        tuple(map(int, args.samples)),
        tuple(args.ways),
        args.size,
        args.limit,
        args.within,
        args.again,
    )
    print(run(folder, plan))
    return 0


def measure(name: str, folder: Path, repeats: int) -> dict[str, Any]:
    """The figures of one part."""
    if name == "extraction":
        return extraction()
    if name == "city":
        return city(folder, repeats)
    from .studies import bench_paths, bench_tracing
    from .studies.animation import bench_animation, bench_flythrough

    module = (
        bench_flythrough
        if name in FLYTHROUGH
        else bench_animation
        if name in ANIMATION
        else bench_paths
        if name == "paths"
        else bench_tracing
    )
    part: dict[str, Any] = getattr(module, name)(folder)
    return part


def extraction() -> dict[str, Any]:
    """Seconds to pull a million geometry-nodes instances out of Blender (transforms, references and what they refer
    to), to make a whole core scene of them (composed transforms, bounds, flags, keys), and to go through
    `object_instances`: touching each instance's matrix and object, and reading what tells instances apart into
    arrays."""
    import bpy
    import numpy as np

    from ..lipac_addon.demo import build
    from ..lipac_addon.extract import extract
    from ..lipac_addon.extract.graph import GraphReader
    from .studies.bench_tracing import interleaved

    build("mirror-city", CITY)
    graph = bpy.context.evaluated_depsgraph_get()
    count = len(extract(graph).scene.instances)

    def ours() -> float:
        start = time.perf_counter()
        extract(graph)
        return time.perf_counter() - start

    def pull() -> float:
        start = time.perf_counter()
        GraphReader().read(graph, False)
        return time.perf_counter() - start

    def touch() -> float:
        start = time.perf_counter()
        for instance in graph.object_instances:
            instance.matrix_world, instance.object  # noqa: B018
        return time.perf_counter() - start

    def read() -> float:
        start = time.perf_counter()
        n = len(graph.object_instances)
        matrices, ids, names = np.empty((n, 4, 4)), np.empty((n, 8), np.int32), []
        for k, instance in enumerate(graph.object_instances):
            matrices[k], ids[k] = instance.matrix_world, instance.persistent_id
            names.append(instance.object.name)
        return time.perf_counter() - start

    return {"instances": count, "seconds": interleaved({"pull": pull, "ours": ours, "touch": touch, "read": read}, 3)}


def city(folder: Path, repeats: int) -> dict[str, Any]:
    """mirror-city with a million instances: full and culled Cycles renders as whole commands, their peak memory, and
    the error."""
    scene = folder / "city.blend"
    compare.lipac("demo", "mirror-city", "-o", scene, "--instances", str(CITY))
    runs: dict[str, list[dict[str, Any]]] = {FULL: [], CULLED: []}
    compare.render(scene, folder, CULLED, CITY_OPTIONS)  # kernels compiled, file in the system's cache
    for _ in range(repeats):
        for name, done in runs.items():
            done.append(compare.render(scene, folder, name, CITY_OPTIONS))
    compare.render(scene, folder, OTHER_SEED, CITY_OPTIONS)

    def median(name: str, value: Any) -> float:
        return statistics.median(value(run) for run in runs[name])

    out: dict[str, Any] = {
        "command": " ".join(("lipac render city.blend --engine cycles", *CITY_OPTIONS)),
        "error": compare.errors(folder),
    }
    for name, done in runs.items():
        frames = [run["frames"][0] for run in done]
        seconds = {key: statistics.median(f[key] for f in frames) for key in frames[0] if key.endswith("_s")}
        counts = {key: frames[-1][key] for key in ("instances", "active", "hitboxes", "blas_bytes", "tlas_bytes")}
        # From the open file to the picture: the interpreter's start and the reading of the file are the same for both.
        out[name] = (
            seconds
            | counts
            | {"work_s": median(name, lambda r: sum(v for k, v in r["frames"][0].items() if k in SECONDS))}
        )
        out[name] |= {
            "process_s": median(name, lambda r: r["process_s"]),
            "peak_bytes": median(name, lambda r: r["totals"]["peak_bytes"]),
        }
    return out


def marked(target: str, measured: float) -> str:
    """A target such as ">= 5", and that it is missed where it is."""
    if not target:
        return ""
    bound = float(target.split()[1])
    return target if (measured >= bound if target.startswith(">=") else measured <= bound) else f"{target}, **missed**"


def report(results: dict[str, Any]) -> str:
    """benchmarks.md."""
    rows: list[tuple[str, ...]] = [("what", "peer", "ours", "peer's", "ratio", "target")]

    def row(what: str, peer: str, ours: str, theirs: str, ratio: float, target: str) -> None:
        rows.append((what, peer, ours, theirs, f"{ratio:.3g}", marked(target, ratio)))

    if "rays" in results:
        if "skipped" in results["rays"]:
            rows.append(("rays with feedback", "bare Embree loop in C", "", "", results["rays"]["skipped"], ">= 0.85"))
        for case in results["rays"].get("cases", ()):
            what = f"rays with feedback: {case['rays']}, {case['case']}"
            row(
                what,
                "bare Embree loop in C",
                f"{case['ours'] / 1e6:.2f} M/s",
                f"{case['bare'] / 1e6:.2f} M/s",
                case["ratio"],
                ">= 0.85",
            )
    if "feedback" in results:
        took = results["feedback"]["seconds"]
        more = took["measured"] + took["deciding"] - took["bare"]
        what = "feedback, weights, path logs and states of a measurement"
        row(what, "tracing the same paths", f"{more:.3f} s", f"{took['bare']:.3f} s", more / took["bare"], "<= 0.15")
    if "paths" in results:
        speeds = results["paths"]["paths_per_s"]
        for peer in (p for p in speeds if p != "ours"):
            target = ">= 1" if peer.startswith("Mitsuba") else ""
            ours, theirs = speeds["ours"], speeds[peer]
            row(
                "path tracing, 10,000 spheres",
                peer,
                f"{ours / 1e6:.2f} M paths/s",
                f"{theirs / 1e6:.2f} M paths/s",
                ours / theirs,
                target,
            )
    if "extraction" in results:
        took = results["extraction"]["seconds"]
        for own, what, target in (
            ("pull", "1M instances pulled out of Blender", ">= 50"),
            ("ours", "the same as a core scene", ""),
        ):
            for key, label in (("read", "read into arrays"), ("touch", "matrix and object touched")):
                row(
                    what,
                    f"object_instances, {label}",
                    f"{took[own]:.3f} s",
                    f"{took[key]:.2f} s",
                    took[key] / took[own],
                    target,
                )
    if "city" in results:
        full, culled, error = (results["city"][name] for name in (FULL, CULLED, "error"))
        for key, label in (
            ("work_s", "1M instances: open file to picture"),
            ("process_s", "1M instances: whole command"),
        ):
            row(label, "--cull none", f"{culled[key]:.1f} s", f"{full[key]:.1f} s", full[key] / culled[key], ">= 5")
        ours, theirs = culled["peak_bytes"], full["peak_bytes"]
        row(
            "1M instances: peak memory",
            "--cull none",
            compare.size(ours),
            compare.size(theirs),
            ours / theirs,
            "<= 0.4",
        )
        for metric in ("flip", "relmse"):
            a, b = error[CULLED][metric], error[OTHER_SEED][metric]
            row(f"1M instances: error ({metric})", "another seed", f"{a:.4f}", f"{b:.4f}", a / b, "<= 1")
    if "compiling" in results:
        took = results["compiling"]
        for what, key, target in (
            ("compiling all kernels, once", "compile_s", "<= 40 s"),
            ("file open to a few pixels analysed, cached", "warm_s", "<= 3 s"),
        ):
            rows.append((what, "", f"{took[key]:.1f} s", "", "", marked(target, took[key])))
    machines = sorted({result["machine"] for result in results.values()})
    notes = [
        "Ratios are ours to the peer's: speeds as they are, seconds inverted (the peer's over ours), memory, error "
        "and what feedback adds as they are."
    ]
    if "paths" in results:
        means = ", ".join(f"{name} {value:.4f}" for name, value in results["paths"]["mean_radiance"].items())
        notes.append(f"Mean radiance of the spheres: {means}. Cycles' speed is that of its sampling alone.")
    if "city" in results:
        notes.append(f"The city: `{results['city']['command']}`, with and without `--cull none`.")
    return "\n\n".join(["# Benchmarks", f"`lipac bench`: {'; '.join(machines)}.", markdown(rows), *notes]) + "\n"


if __name__ == "__main__":
    import runpy

    sys.exit(runpy.run_path(str(Path(__file__).with_name("by_path.py")))["run"]("bench"))
