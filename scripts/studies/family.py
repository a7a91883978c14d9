"""`lipac evaluate --family N -o DIR`: does the budget hold on random scatters (`lipac_addon/demo/family.py`)? Each
judged by Cycles.

Scenes are worked off by child processes, which may crash or hang: that is what the record then says. Each scene has a
file in DIR/seeds; what is there already, by the same code and options, is not done again. DIR/family.json has all of
them, DIR/family.md the table.
"""

from __future__ import annotations

import json
import os
import queue
import sys
import textwrap
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from ..command import children
from ..command.children import Child
from .machine import made_by

ROOT = Path(__file__).resolve().parents[2]
COMMAND = (sys.executable, "-m", "lipac.scripts.studies.family")  # of a child process
DEVICE = "cpu"
RENEWED = 25  # scenes after which a process is replaced by a new one: what leaks does so no further
BUDGETS = (0.003, 0.006, 0.012, 0.025, 0.06)  # of the mean: bins of the table
PIXELS = (0.1, 0.5, 2.0, 10.0, 100.0)
COLUMNS = (
    "scenes",
    "runs",
    "held",
    "surely held",
    "mean held",
    "worst tile held",
    "beyond twice",
    "detail held",
    "kept, median",
    "analysis to Cycles, median",
)
BROKEN = (
    "seed",
    "kind",
    "instances",
    "pixels",
    "budget",
    "luminance, colour: mean",
    "worst tile",
    "times the budget, surely",
)
NOTE = """
Held: not surely broken by luminance or colour, noise taken off (3 standard errors); surely held: the upper end is
within the budget too. Detail: beside it.
Analysis: reading Blender's scene included, over the time that Cycles takes for 64 samples of the same
picture with as many threads, where it renders on the CPU.
"""


@dataclass(frozen=True)
class Plan:
    """What to do with each seed.

    size: of pictures; samples: of Cycles' first pairs; threads: of each job; limit: seconds for a scene; instances:
    rows of each scatter, None as drawn; device: of Cycles, as of `lipac render --device`.
    """

    size: tuple[int, int]
    samples: int
    threads: int
    limit: float
    instances: int | None = None
    device: str = DEVICE

    def options(self) -> dict[str, Any]:
        """All that a record depends on, but for its seed."""
        from ...core.files.digest import digest

        sources = sorted([*(ROOT / "core").rglob("*.py"), *(ROOT / "lipac_addon").rglob("*.py")])
        return {
            "size": list(self.size),
            "samples": self.samples,
            "threads": self.threads,
            "instances": self.instances,
            "device": self.device,
            "code": digest(*sources)[:12],
        }

    def child(self, number: int) -> Child:
        """A new process for scenes. Raises RuntimeError where it does not start."""
        given = {
            "size": self.size,
            "samples": self.samples,
            "threads": self.threads,
            "instances": self.instances,
            "device": self.device,
            "number": number,
        }
        return Child(COMMAND, given, self.threads, self.limit)


def serve(given: dict[str, Any]) -> None:
    """What a child process does. Its job number picks the processors that are its own."""
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
    own = cores[given["number"] * given["threads"] :][: given["threads"]]
    if len(own) == given["threads"]:
        os.sched_setaffinity(0, own)

    def prepare() -> Callable[[int], dict[str, Any]]:
        from ...core.jit import kernel_cache
        from ...lipac_addon.console import muted

        kernel_cache.use()
        with muted():
            import bpy  # noqa: F401
        from ...lipac_addon import family_trial

        family_trial.warm(given["threads"])
        return lambda seed: family_trial.run(
            seed, tuple(given["size"]), given["samples"], given["threads"], given["instances"], given["device"]
        )

    children.serve(prepare)


def main(seeds: range, folder: Path, plan: Plan, jobs: int, stop_after: float, tell: Callable[[str], None]) -> int:
    """Do what is missing of some seeds, so many at a time, and write the tables; exit status. stop_after: seconds after
    which no scene is begun.

    Raises KeyboardInterrupt after all processes have ended; what is done is kept.
    """
    options, begun = plan.options(), time.monotonic()
    place = folder / "seeds"
    place.mkdir(parents=True, exist_ok=True)
    waiting: queue.SimpleQueue[int] = queue.SimpleQueue()
    missing = [seed for seed in seeds if not _done(place, seed, options)]
    for seed in missing:
        waiting.put(seed)
    workers: dict[int, Child] = {}
    problems: list[str] = []
    stopped, count = threading.Event(), 0
    counting = threading.Lock()

    def work(number: int) -> None:
        nonlocal count
        try:
            while not stopped.is_set() and time.monotonic() - begun < stop_after and not waiting.empty():
                child = workers.get(number)
                if child is None or not child.alive or child.done >= RENEWED:
                    if child is not None:
                        child.end()
                    child = workers[number] = plan.child(number)
                try:
                    seed = waiting.get_nowait()
                except queue.Empty:
                    break
                record = child.do(seed)
                if stopped.is_set():
                    break
                _write(place / f"{seed:06}.json", json.dumps(record | {"options": options}, default=float))
                with counting:
                    count += 1
                    tell(
                        f"{count} of {len(missing)}: {seed} {record.get('draw', {}).get('kind', '')} "
                        f"{record.get('failed') or record['verdict']}"
                    )
        except RuntimeError as error:
            problems.append(str(error))

    if missing:
        workers[0] = plan.child(0)  # compiles the kernels, for all
    threads = [threading.Thread(target=work, args=(number,), daemon=True) for number in range(min(jobs, len(missing)))]
    try:
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    finally:
        stopped.set()
        for child in workers.values():
            child.end()
    records = read(folder)
    _write(folder / "family.json", json.dumps(records, default=float))
    text = table(records) + "\n" + textwrap.fill(f"Measured by {made_by()}.", 120) + "\n"
    _write(folder / "family.md", text)
    print(text)
    for line in sorted(set(problems)):
        print(f"warning: {line}", file=sys.stderr)
    return 1 if problems else 0


def _done(place: Path, seed: int, options: dict[str, Any]) -> bool:
    path = place / f"{seed:06}.json"
    return path.exists() and json.loads(path.read_text())["options"] == options


def _write(path: Path, text: str) -> None:
    from ...core.files.report import replacing

    with replacing(path) as part:
        part.write_text(text)


def read(folder: Path) -> list[dict[str, Any]]:
    """All records of a folder, by seed."""
    return [json.loads(path.read_text()) for path in sorted((folder / "seeds").glob("*.json"))]


def table(records: Sequence[dict[str, Any]]) -> str:
    """Markdown: by kind, by budget, by size; then every scene whose budget was broken, or that failed."""
    judged = [r for r in records if "failed" not in r]
    failed = [r for r in records if "failed" in r]
    groups: list[tuple[str, list[dict[str, Any]]]] = [("all", judged)]
    groups += [
        (kind, [r for r in judged if r["draw"]["kind"] == kind]) for kind in sorted({r["draw"]["kind"] for r in judged})
    ]
    groups += [
        (f"budget {100 * a:g} to {100 * b:g} %", [r for r in judged if a <= r["draw"]["mean"] < b])
        for a, b in pairwise(BUDGETS)
    ]
    groups += [
        (f"{a:g} to {b:g} pixels", [r for r in judged if a <= r["draw"]["pixels"] < b]) for a, b in pairwise(PIXELS)
    ]
    lines = _head(COLUMNS, 1)
    lines += [_row(name, group) for name, group in groups if group]
    lines += NOTE.rstrip().splitlines()
    broken = sorted((r for r in judged if r["verdict"] in ("broken", "twice")), key=lambda r: -r["times"])
    if broken:
        lines += ["", "Broken:", "", *_head(BROKEN, 2), *map(_broken, broken)]
    if failed:
        lines += ["", "Failed:", "", *(f"- {r['seed']}: {r['failed']}" for r in failed)]
    return "\n".join(lines) + "\n"


def _head(columns: Sequence[str], left: int) -> list[str]:
    return ["| " + " | ".join(columns) + " |", "|" + left * "---|" + (len(columns) - left) * "---:|"]


def _row(name: str, records: Sequence[dict[str, Any]]) -> str:
    def held(key: str) -> str:
        return _percent(r[key] not in ("broken", "twice") for r in records)

    surely = _percent(r["verdict"] == "held" for r in records)
    twice = sum(r["verdict"] == "twice" for r in records)
    kept = float(np.median([r["active"] / max(r["instances"], 1) for r in records]))
    on_cpu = [r["analysis_s"] / r["cycles_64_s"] for r in records if r["options"].get("device", DEVICE) == DEVICE]
    ratio = f"{np.median(on_cpu):.2f}" if on_cpu else ""
    cells = (
        held("verdict"),
        surely,
        held("verdict_mean"),
        held("verdict_worst"),
        twice,
        held("verdict_detail"),
        f"{100 * kept:.3g} %",
        ratio,
    )
    return f"| {name} | {len(records)} | " + " | ".join(map(str, cells)) + " |"


def _broken(record: dict[str, Any]) -> str:
    draw, changes = record["draw"], record["changes"]
    by = [
        " / ".join(f"{100 * changes[m][bound]['value']:.3g} %" for m in ("luminance", "colour"))
        for bound in ("mean", "worst")
    ]
    budget = f"{100 * draw['mean']:.2g}, {100 * draw['worst']:.2g} %"
    return (
        f"| {record['seed']} | {draw['kind']} | {record['instances']:,} | {draw['pixels']:.2g} | {budget} | "
        f"{by[0]} | {by[1]} | {record['times']:.2f} |"
    )


def _percent(flags: Iterable[bool]) -> str:
    every = list(flags)
    return f"{100 * sum(every) / len(every):.1f} %"


if __name__ == "__main__":
    serve(json.loads(sys.argv[1]))
