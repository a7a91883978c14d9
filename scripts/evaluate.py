"""`lipac evaluate SCENE -o DIR`: speed against error for every culling policy. Also `--all`: every scene, as
docs/results.md has them; and `--family N`: do budgets hold on random scatters.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from ..core.errors import InputError
from ..core.progress import Progress, part
from ..core.threads import processors
from .studies.machine import made_by
from .studies.supplied import SUPPLIED

SIZE = (320, 180)
SAMPLES, FAMILY_SAMPLES, FAMILY_THREADS = 16, 64, 2
SCENES = ("rooms1024.blend", "candela_city.blend", "kitchen.blend", "indoor.blend")
DEMOS = {"mirror-city": 20_000, "crowd": 500}
PIECES = "build"  # folder of finished pieces, which need not be kept


def main(argv: Sequence[str]) -> int:
    """Evaluate what the command line says; returns the exit status."""
    from ..core.files.report import output_folder
    from .command.arguments import count, device, path_count, resolution, seed_number, thread_count
    from .command.options import Parser

    parser = Parser(
        prog="lipac evaluate",
        description="Measure cost and error of every culling policy. What is already measured in DIR is kept.",
    )
    parser.add_argument("scene", nargs="?", type=Path, metavar="SCENE", help="a scene file, as for lipac render")
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        required=True,
        metavar="DIR",
        help="folder for tables, plots, pictures, report.md and report.html",
    )
    parser.add_argument(
        "--all",
        action="store_true",
        help="all supplied scenes and demos, each in a folder of DIR, and DIR/../results.md",
    )
    parser.add_argument(
        "--scenes", type=Path, default=SUPPLIED, metavar="DIR", help="with --all: where the supplied scenes are"
    )
    parser.add_argument("--camera", metavar="NAME", help="camera to use (default: the scene's)")
    parser.add_argument(
        "--resolution", type=resolution, default=SIZE, metavar="WxH", help="size of the pictures (default: 320x180)"
    )
    parser.add_argument(
        "--samples",
        type=path_count,
        metavar="N",
        help=f"paths per pixel of the judge (default: {SAMPLES}; with --family: {FAMILY_SAMPLES})",
    )
    parser.add_argument(
        "--cycles", action="store_true", help="also render full and culled by Cycles: seconds and peak memory"
    )
    parser.add_argument(
        "--budget-check",
        type=count,
        metavar="SEEDS",
        help="also: does the error stay in the budget, over so many seeds",
    )
    parser.add_argument("--ray-budget", action="store_true", help="also: how many paths the states need")
    family = parser.add_argument_group(
        "--family: does the budget hold, on random scatters, each with a budget of its own, judged by Cycles"
    )
    family.add_argument(
        "--family",
        type=count,
        metavar="N",
        help="so many scenes, in place of SCENE; lipac demo family --seed K writes one of them",
    )
    family.add_argument(
        "--first", type=seed_number, default=0, metavar="SEED", help="seed of the first scene (default: %(default)s)"
    )
    family.add_argument(
        "--jobs", type=count, metavar="N", help="scenes at a time (default: as many as there are cores for)"
    )
    family.add_argument(
        "--instances", type=count, metavar="N", help="rows of each scatter (default: as its seed draws)"
    )
    family.add_argument(
        "--time-limit", type=count, default=300, metavar="S", help="seconds for one scene (default: %(default)s)"
    )
    family.add_argument(
        "--device",
        type=device,
        metavar="KIND",
        help="where Cycles renders what is judged, as for lipac render (default: cpu)",
    )
    family.add_argument(
        "--stop-after",
        type=count,
        metavar="S",
        help="seconds after which no scene is begun; the same command goes on from there",
    )
    parser.add_argument(
        "--threads",
        type=thread_count,
        default=0,
        metavar="N",
        help="0: all cores (default); with --family: of each job (default: 2)",
    )
    parser.add_argument("--quiet", action="store_true", help="no progress")
    args = parser.parse_args(argv)
    folder = output_folder(args.output)
    if args.all and (args.scene is not None or args.family):
        raise InputError("--all evaluates all scenes that there are: name no SCENE, and leave --family out")
    if args.all:
        return everything(args, folder)
    if args.family:
        return random_scenes(args, folder)
    if args.scene is None:
        raise InputError("SCENE is missing: name a scene file, or use --all or --family")
    if not args.scene.exists():
        raise InputError(f"no such file: {args.scene}")
    from .command.interrupt import ctrl_c
    from .command.streams import progress_of

    with progress_of(args.quiet) as progress, ctrl_c() as cancelled:
        evaluate(args, folder, progress, cancelled)
    print((folder / "report.md").read_text())
    return 0


def random_scenes(args: argparse.Namespace, folder: Path) -> int:
    """The scenes of `--family`; returns the exit status."""
    from .studies import family

    if args.scene is not None:
        raise InputError("--family makes its own scenes: name no SCENE")
    threads = args.threads or FAMILY_THREADS
    cores = processors()
    samples, device = args.samples or FAMILY_SAMPLES, str(args.device or family.DEVICE)
    plan = family.Plan(args.resolution, samples, threads, args.time_limit, args.instances, device)

    def tell(line: str) -> None:
        if not args.quiet:
            print(line, file=sys.stderr, flush=True)

    seeds = range(args.first, args.first + args.family)
    return family.main(
        seeds, folder, plan, args.jobs or max(cores // threads, 1), args.stop_after or float("inf"), tell
    )


def extracted(args: argparse.Namespace) -> Any:
    """The core scene of the file, at the size of the evaluation."""
    from ..lipac_addon.console import muted

    with muted():
        import bpy

        from ..lipac_addon.extract import extract_frame
        from ..lipac_addon.open import open_scene, use_camera

        open_scene(args.scene)
        scene = bpy.context.scene
        scene.render.resolution_x, scene.render.resolution_y = args.resolution
        scene.render.resolution_percentage = 100
        if args.camera:
            use_camera(scene, args.camera)
        return extract_frame(scene, scene.frame_current).scene


def evaluate(
    args: argparse.Namespace, folder: Path, progress: Progress, cancelled: Callable[[], bool]
) -> dict[str, Any]:
    """Everything for one scene; returns what evaluation.json holds."""
    from ..core.evaluation import evaluate as core
    from .studies import evaluate_report as report

    progress(0.0, "opening the scene")
    scene = extracted(args)
    settings = core.Settings(samples=args.samples or SAMPLES, threads=args.threads)
    evaluation = core.Evaluation(scene, settings, folder / PIECES, part(progress, 0.0, 0.05), cancelled)
    evaluation.run(part(progress, 0.05, 0.9))
    summary: dict[str, Any] = {
        "made_by": made_by(),
        "scene": args.scene.name,
        "size": list(args.resolution),
        "samples": evaluation.judge.samples,
        "instances": len(scene.instances),
        "noise_floor": evaluation.judge.noise_floor(),
        "equal_error": core.at_equal_error(evaluation.rows),
        "rows": evaluation.rows,
    }
    if args.budget_check:
        summary["budget_check"] = core.budget_check(
            evaluation, args.budget_check, part(progress, 0.9, 0.97, "budget check, ")
        )
    if args.ray_budget:
        summary["ray_budget"] = core.ray_budget(evaluation, part(progress, 0.97, 0.99, "ray budget, "))
    if args.cycles:
        summary["cycles"] = cycles(args, folder)
    report.write(folder, summary, evaluation)
    return summary


def cycles(args: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """Seconds and peak memory of Cycles, full and culled, each in a process of its own."""
    from .studies import compare

    options = ("--resolution", f"{args.resolution[0]}x{args.resolution[1]}", "--samples", "16")
    out = {}
    for name in (compare.FULL, compare.CULLED):
        result = compare.render(args.scene, folder / PIECES / "cycles", name, options)
        frame = result["frames"][0]
        out[name] = {
            "render_s": frame["render_s"],
            "process_s": result["process_s"],
            "peak_bytes": result["totals"]["peak_bytes"],
            "active": frame["active"],
        }
    return out


def everything(args: argparse.Namespace, folder: Path) -> int:
    """Each scene in a process of its own, then the table over all; returns the worst exit status."""
    import subprocess

    from .studies import evaluate_report as report

    worst = 0
    own = [a for a in ("--cycles", "--ray-budget", "--quiet") if getattr(args, a[2:].replace("-", "_"))]
    own += [
        "--resolution",
        f"{args.resolution[0]}x{args.resolution[1]}",
        "--samples",
        str(args.samples or SAMPLES),
        "--threads",
        str(args.threads),
    ]
    own += ["--budget-check", str(args.budget_check)] if args.budget_check else []
    for name, scene in scenes(args.scenes, folder):
        print(f"{name}", file=sys.stderr, flush=True)
        command = [sys.executable, "-m", "lipac.scripts.lipac", "evaluate", str(scene), "-o", str(folder / name), *own]
        status = subprocess.run(command, stdout=subprocess.DEVNULL, check=False).returncode
        if status == 130:
            return status
        worst = max(worst, status)
    print(report.write_results(folder))
    return worst


def scenes(supplied: Path, folder: Path) -> list[tuple[str, Path]]:
    """Names and files of the supplied scenes that are there, and of the demos, which are built where they are
    missing."""
    from .studies import compare

    out = [(Path(name).stem, supplied / name) for name in SCENES if (supplied / name).exists()]
    if len(out) < len(SCENES):
        print(
            f"some of {', '.join(SCENES)} are not in {supplied} and are left out; --scenes says where they are",
            file=sys.stderr,
        )
    for name, instances in DEMOS.items():
        path = folder / name / PIECES / f"{name}.blend"
        if not path.exists():
            os.makedirs(path.parent, exist_ok=True)
            compare.lipac("demo", name, "-o", path, "--instances", str(instances), "--quiet")
        out.append((name, path))
    return out


if __name__ == "__main__":
    import runpy

    sys.exit(runpy.run_path(str(Path(__file__).with_name("by_path.py")))["run"]("evaluate"))
