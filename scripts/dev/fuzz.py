"""`python -m lipac.scripts.dev.fuzz`: random scenes by seed, and what failed, into a JSON file. From a checkout, for
developers.

Of kind "render", files with what people's files have in them are rendered; of kind "faults", work ends at a random
moment: both by child processes, which may crash and hang; a page, FILE.md, is written as well.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import textwrap
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ..command.children import Child, serve
from ..studies.machine import made_by

EVERY = 50  # scenes from one writing of the record to the next
COMMAND = (sys.executable, "-m", "lipac.scripts.dev.fuzz", "child")  # of a child process
LIMIT = 300.0  # seconds for a scene of a child process
RENEWED = 25  # scenes after which a process is replaced by a new one


def main(argv: Sequence[str]) -> int:
    """Write the record; exit status 1 where a scene failed."""
    parser = argparse.ArgumentParser(
        prog="fuzz", description="Check random scenes by seed; the record keeps the seeds that failed."
    )
    kinds = (
        "scenes of arrays, scenes built in Blender, damaged files, files of many features through lipac render, "
        "work that ends at a random moment"
    )
    parser.add_argument("kind", choices=("core", "blender", "files", "render", "faults"), help=kinds)
    parser.add_argument("--scenes", type=int, default=1000, metavar="N")
    parser.add_argument("--first", type=int, default=0, metavar="SEED")
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="FILE", help="record, continued where it exists"
    )
    parser.add_argument(
        "--again",
        action="store_true",
        help="kinds render, faults: repeat what of the record did not hold, and keep what it was before",
    )
    args = parser.parse_args(argv)
    record: dict[str, Any] = {"kind": args.kind, "first": args.first, "done": 0, "failed": []}
    if args.output.exists():
        record |= json.loads(args.output.read_text())
    with checking(args.kind) as check:
        if args.again:
            repeat(record, check)
        for seed in range(record["first"] + record["done"], record["first"] + args.scenes):
            try:
                found = check(seed)
                if found is not None:
                    record.setdefault("scenes", []).append(found)
                if found is not None and "failed" in found:
                    record["failed"].append(
                        {"seed": seed, "error": found["failed"], "features": found.get("features", [])}
                    )
                    print(record["failed"][-1], file=sys.stderr, flush=True)
            except Exception as error:
                where = traceback.extract_tb(error.__traceback__)[-1].name
                record["failed"].append({"seed": seed, "error": f"{type(error).__name__}: {error}", "where": where})
                print(record["failed"][-1], file=sys.stderr, flush=True)
            record["done"] += 1
            if record["done"] % EVERY == 0:
                write(args.output, record)
    write(args.output, record)
    print(f"{record['done']:,} scenes, {len(record['failed'])} failed", file=sys.stderr)
    return 1 if record["failed"] else 0


def repeat(record: dict[str, Any], check: Callable[[int], dict[str, Any] | None]) -> None:
    """Check the scenes of a record again that did not hold."""
    for k, scene in enumerate(record["scenes"]):
        if "failed" in scene or scene["verdict"] != "held":
            record["scenes"][k] = {**(check(scene["seed"]) or {}), "before": scene.get("before", _outcome(scene))}
    again = [scene for scene in record["scenes"] if "failed" in scene]
    record["failed"] = [
        {"seed": scene["seed"], "error": scene["failed"], "features": scene["features"]} for scene in again
    ]


def _outcome(scene: dict[str, Any]) -> str:
    """In a line, what a scene came to that did not hold."""
    if "failed" in scene:
        return str(scene["failed"])
    return _told(scene) if scene["verdict"] == "told" else str(scene["said"][0])


def write(path: Path, record: dict[str, Any]) -> None:
    """Write a record, and the page of one that has scenes."""
    path.write_text(json.dumps(record, indent=None if "scenes" in record else 1, default=float) + "\n")
    if "scenes" in record:
        path.with_suffix(".md").write_text(f"{page(record)}\n{textwrap.fill(f'Measured by {made_by()}.', 120)}\n")


@contextmanager
def checking(kind: str) -> Iterator[Callable[[int], dict[str, Any] | None]]:
    """The check of one seed; of kinds "render" and "faults", its record."""
    from ...tests.hard.choices import Seeded

    if kind == "core":
        from ...tests.hard import fuzz_core

        yield lambda seed: fuzz_core.check(fuzz_core.random_scene(Seeded(seed)), seed)
    elif kind == "blender":
        from ...tests.hard import fuzz_blender

        yield lambda seed: fuzz_blender.check(Seeded(seed), seed)
    elif kind == "files":
        from ...tests.hard import fuzz_files

        yield lambda seed: fuzz_files.check(Seeded(seed))
    else:
        with in_children(kind) as check:
            yield check


@contextmanager
def in_children(kind: str, crops: int = 12, every: int = 1) -> Iterator[Callable[[int], dict[str, Any]]]:
    """What does a seed, in a process that is replaced when it ended, and now and then. Options as of `in_child`."""
    from ...tests.hard.fuzz_render import drawn

    child: Child | None = None

    def check(seed: int) -> dict[str, Any]:
        nonlocal child
        if child is None or not child.alive or child.done >= RENEWED:
            if child is not None:
                child.end()
            try:
                child = Child(COMMAND, {"kind": kind, "crops": crops, "every": every}, 1, LIMIT)
            except RuntimeError as error:
                raise SystemExit(f"fuzz: {error}") from error
        return {"features": drawn(seed) if kind == "render" else [], **child.do(seed)}

    try:
        yield check
    finally:
        if child is not None:
            child.end()


def in_child(kind: str, crops: int, every: int) -> None:
    """What a child process does. Of kind "render": every so many seeds it renders, verified in so many crops; the
    others it analyses alone."""

    def prepare() -> Callable[[int], dict[str, Any]]:
        from ...core.jit import kernel_cache

        kernel_cache.use()
        if kind == "faults":
            from ...tests.hard import fuzz_faults

            return fuzz_faults.run
        from ...tests.hard import fuzz_render

        return lambda seed: fuzz_render.run(seed, verify=0 if seed % every else crops)

    serve(prepare)


def page(record: dict[str, Any]) -> str:
    """Markdown of a record of kinds "render" and "faults": what came of them, by what is in them; all that is not as it
    should be; what was told."""
    scenes = record["scenes"]
    verdicts = ("held", "told", "refused", "failed")
    lines = [
        f"Seeds {record['first']:,} to {record['first'] + record['done'] - 1:,}, {seconds(scenes):.1f} s each "
        "(median).",
        "",
    ]
    lines += ["| what | runs | " + " | ".join(verdicts) + " |", "|---|" + (1 + len(verdicts)) * "---:|"]
    for name in ("all", *sorted({name for scene in scenes for name in scene["features"]})):
        having = [scene for scene in scenes if name == "all" or name in scene["features"]]
        counted = Counter("failed" if "failed" in scene else scene["verdict"] for scene in having)
        lines.append(
            f"| {name.replace('_', ' ')} | {len(having)} | "
            + " | ".join(str(counted[verdict]) for verdict in verdicts)
            + " |"
        )
    for title, chosen in (
        ("Failed", [(s, _outcome(s)) for s in scenes if "failed" in s]),
        ("Refused", [(s, _outcome(s)) for s in scenes if "failed" not in s and s["verdict"] == "refused"]),
        (
            "Told: the budget is broken, and the status says so",
            [(s, _outcome(s)) for s in scenes if "failed" not in s and s["verdict"] == "told"],
        ),
        (
            "Repeated, after what was found was mended; before it was",
            [(s, s["before"]) for s in scenes if "before" in s],
        ),
    ):
        if chosen:
            lines += ["", f"{title}:", "", *(f"- {s['seed']} ({', '.join(s['features'])}): {why}" for s, why in chosen)]
    return "\n".join(lines) + "\n"


def _told(scene: dict[str, Any]) -> str:
    """By how much, and what was said to be approximated."""
    approximated = [line.removeprefix("approximated: ") for line in scene["said"] if line.startswith("approximated: ")]
    return f"{100 * scene['mean']:.2g} / {100 * scene['worst']:.2g} %; " + (
        "; ".join(approximated) or "nothing approximated"
    )


def seconds(scenes: Sequence[dict[str, Any]]) -> float:
    """Seconds of a scene."""
    return statistics.median(scene.get("seconds", LIMIT) for scene in scenes)


if __name__ == "__main__":
    if sys.argv[1:2] == ["child"]:
        in_child(**json.loads(sys.argv[2]))
    else:
        sys.exit(main(sys.argv[1:]))
