"""`python -m lipac.scripts.studies.farm.page [--measure SCENE --frames A-B]`: measures a shot's tasks on this machine,
and plans with them: docs/farm.md."""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
import tempfile
import textwrap
import time
from collections.abc import Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

from ....core.files.atomic import replacing
from ....core.files.figures import size
from ....core.progress import clock
from ....lipac_addon.farm.analyse import note_of
from ....lipac_addon.farm.layout import FarmShot, read_json, write_json
from ..machine import made_by, measured_by
from .makespan import STEPS, Farm, Measured, in_full, simulate

ROOT = Path(__file__).resolve().parents[3]
PAGE, FOLDER = ROOT / "docs" / "farm.md", ROOT / "docs" / "farm"
WORKERS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)
SHOTS = ((250, 10), (10_000, 400))  # frames, and how many are verified


def main(argv: Sequence[str] | None = None) -> int:
    """Measure where asked to, draw, and write the page's tables; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--measure", type=Path, metavar="SCENE.blend")
    parser.add_argument("--frames", default="1-12")
    parser.add_argument("--resolution", default="640x360")
    parser.add_argument("--samples", default="16")
    args = parser.parse_args(argv)
    if args.measure:
        FOLDER.mkdir(exist_ok=True)
        with tempfile.TemporaryDirectory(prefix="lipac") as place:
            asked = ["--frames", args.frames, "--resolution", args.resolution, "--samples", args.samples]
            found = measure(args.measure, Path(place), asked)
            write_json(FOLDER / "measured.json", {"made_by": made_by(), **found})
    found = json.loads((FOLDER / "measured.json").read_text())
    measured = Measured(**{name: found[name] for name in Measured.__dataclass_fields__})
    plot(measured, FOLDER / "makespan.svg")
    parts = {"measured": measured_table(found), "simulated": simulated_table(measured)}
    text = re.sub(
        r"(<!-- (measured|simulated) -->\n).*?(<!-- end -->)",
        lambda m: f"{m[1]}{parts[m[2]]}\n{m[3]}",
        PAGE.read_text(),
        flags=re.DOTALL,
    )
    PAGE.write_text(text)
    return 0


def measure(scene: Path, folder: Path, asked: Sequence[str]) -> dict[str, Any]:
    """Do a shot step by step, each in a process of its own, and note what it took beside its frames."""
    walls: dict[str, float] = {}
    lipac = [sys.executable, "-m", "lipac.scripts.lipac"]
    _seconds([*lipac, "farm", str(scene), "-o", str(folder), "--no-measure", "--verify", "2", "--quiet", *asked])
    for step in STEPS:
        walls[step] = _seconds([*lipac, "shot", step, str(folder), "--quiet"])
    shot = FarmShot.load(folder)
    certificate, united = (read_json(path) or {} for path in (folder / "certificate.json", shot.united))
    frames = certificate["frames"]
    notes = {"analyze": "analysis", "judge": "judgement", "render": "render"}
    own = {step: [f[note]["seconds"] for f in frames] for step, note in notes.items()}
    own["verify"] = [f["verified"]["seconds"] for f in frames if f["verified"]]
    begin = time.perf_counter()
    for frame in shot.frames:
        note_of(shot.analysis(frame))
        read_json(shot.rendered(frame))
    certify = (time.perf_counter() - begin) / len(frames)
    per_frame = {"unite": _union_seconds(shot), "look": _look_seconds(shot), "certify": certify}
    beside = {name: max(walls[name] - sum(own[name]), 0.0) for name in notes}
    beside["verify"] = max(walls["verify"] - sum(own["verify"]), 0.0)
    beside |= {name: max(walls[name] - per_frame[name] * len(frames), 0.0) for name in ("unite", "certify")}
    files = {
        "scene": shot.scene,
        "culled": shot.culled,
        "analysis": shot.analysis(shot.first),
        "picture": shot.picture(shot.first),
    }
    return {
        **own,
        "start": beside,
        "per_frame": per_frame,
        "bytes": {name: path.stat().st_size for name, path in files.items()},
        "ratio": certificate["seconds"]["ratio"],
        "shot": {
            "frames": [shot.first, shot.last],
            "resolution": shot.resolution,
            "samples": shot.samples,
            "instances": united["instances"],
        },
        "kept": {"active": united["active"], "needed": fmean(f["analysis"]["active"] for f in frames)},
        "peak_bytes": certificate["peak_bytes"],
        "error": [found["attempts"][-1]["verified_mean"] for f in frames if (found := f["verified"])],
    }


def _seconds(command: Sequence[str]) -> float:
    begin = time.perf_counter()
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return time.perf_counter() - begin


def _union_seconds(shot: FarmShot) -> float:
    """Of a frame: its states read and added."""
    from ....lipac_addon.farm.unite import united

    begin = time.perf_counter()
    united(shot, [shot.analysis(frame) for frame in shot.frames])
    return (time.perf_counter() - begin) / len(shot.frames)


def _look_seconds(shot: FarmShot) -> float:
    """Of a frame: its file held against that of a chunk."""
    from ....lipac_addon.farm.unite import contents

    begin = time.perf_counter()
    for frame in shot.frames:
        contents(shot.analysis(frame))
    return (time.perf_counter() - begin) / len(shot.frames)


def plot(measured: Measured, path: Path) -> None:
    """Makespan over machines for both shots, culled and in full; and the share of each step for the long one."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context({"svg.hashsalt": "lipac", "svg.fonttype": "none"}):
        figure = Figure(figsize=(11, 4.2), layout="constrained")
        left, right = figure.subplots(1, 2)
        for (frames, checks), colour in zip(SHOTS, ("tab:blue", "tab:orange"), strict=True):
            runs = [simulate(measured, frames, n, checks).total for n in WORKERS]
            left.loglog(WORKERS, runs, "o-", color=colour, label=f"{frames:,} frames: all steps")
            left.loglog(
                WORKERS,
                [in_full(measured, frames, n) for n in WORKERS],
                "--",
                color=colour,
                label=f"{frames:,} frames: in full, without certificate",
            )
        left.set(xlabel="machines", ylabel="seconds")
        left.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2, fontsize=8)
        left.grid(alpha=0.3)
        frames, checks = SHOTS[-1]
        stacked = [simulate(measured, frames, n, checks) for n in WORKERS]
        bottom = [0.0] * len(WORKERS)
        for step in STEPS:
            share = [run.steps[step] / run.total for run in stacked]
            right.bar([str(n) for n in WORKERS], share, bottom=bottom, label=step)
            bottom = [b + s for b, s in zip(bottom, share, strict=True)]
        right.set(xlabel="machines", ylabel=f"share of the time of {frames:,} frames")
        right.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=len(STEPS), fontsize=8)
        with replacing(path) as part:
            figure.savefig(part, metadata={"Date": None})


def measured_table(found: dict[str, Any]) -> str:
    """What was measured."""
    shot, kept, peak = found["shot"], found["kept"], found["peak_bytes"]
    first, last = shot["frames"]
    frames = last - first + 1
    rows = [
        ("analyze", "a frame", fmean(found["analyze"]), found["start"]["analyze"], peak["analysis"]),
        ("unite", "a file of states", found["per_frame"]["unite"], found["start"]["unite"], peak["unite"]),
        ("", "a frame that a chunk holds", found["per_frame"]["look"], 0.0, 0),
        ("judge", "a frame", fmean(found["judge"]), found["start"]["judge"], peak["judgement"]),
        ("render", "a frame, culled", fmean(found["render"]), found["start"]["render"], peak["render"]),
        (
            "render",
            "a frame in full, estimated",
            fmean(found["render"]) * found["ratio"],
            found["start"]["render"],
            peak["crops_full"],
        ),
        ("verify", "a frame of the sample", fmean(found["verify"]), found["start"]["verify"], peak["crops_full"]),
        ("certify", "a frame's notes", found["per_frame"]["certify"], found["start"]["certify"], 0),
    ]
    lines = [
        f"| {step} | {what} | {_short(own)} | {f'{start:.1f} s' if start else ''} | {size(memory) if memory else ''} |"
        for step, what, own, start, memory in rows
    ]
    head = ["| step | of | seconds | and once a task | peak memory |", "|---|---|---:|---:|---:|"]
    total = sum(sum(found[name]) for name in ("analyze", "judge", "render", "verify")) + sum(found["start"].values())
    size_of = {name: size(count) for name, count in found["bytes"].items()}
    return "\n".join(
        [
            textwrap.fill(
                f"Frames {first}-{last} of `flythrough` with {shot['instances']:,} instances, "
                f"{'x'.join(map(str, shot['resolution']))}, {shot['samples']} samples: "
                f"a frame proposes {kept['needed']:,.0f} of them on average, the shot {kept['active']:,}. "
                "Two verified frames change by "
                f"{' and '.join(f'{100 * error:.2g} %' for error in found['error'])}. All {frames} frames took "
                f"{clock(total)}. Files: the scene "
                f"{size_of['scene']}, shot.blend {size_of['culled']}, a frame's analysis {size_of['analysis']}, its "
                f"picture {size_of['picture']}.",
                120,
                break_long_words=False,
                break_on_hyphens=False,
            ),
            "",
            *head,
            *lines,
            "",
            textwrap.fill(measured_by(found), 120),
        ]
    )


def _short(seconds: float) -> str:
    return f"{1000 * seconds:.1f} ms" if seconds < 0.1 else f"{seconds:.1f} s"


def simulated_table(measured: Measured) -> str:
    """The plan, and what the shared folder's share of it is."""
    lines = [
        "| frames | machines | analyze | unite | judge | render | verify | certify | in all | in full, uncertified |",
        "|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|",
    ]
    for frames, checks in SHOTS:
        for workers in (1, 10, 100, 1000):
            run = simulate(measured, frames, workers, checks)
            cells = [clock(run.steps[step]) for step in STEPS]
            lines.append(
                f"| {frames:,} | {workers:,} | {' | '.join(cells)} | {clock(run.total)} | "
                f"{clock(in_full(measured, frames, workers))} |"
            )
    frames, checks = SHOTS[-1]
    usual, slow = (
        simulate(measured, frames, WORKERS[-1], checks, farm).total
        for farm in (Farm(), Farm(folder=Farm().folder / 10))
    )
    more = (
        f"With a shared folder a tenth as fast, {frames:,} frames on {WORKERS[-1]:,} machines take {clock(slow)} "
        f"in place of {clock(usual)}."
    )
    return "\n".join([*lines, "", more])


if __name__ == "__main__":
    sys.exit(main())
