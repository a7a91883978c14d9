"""`make accuracy`: run every hard case of tests/hard and write docs/accuracy.md. From a checkout, for developers."""

from __future__ import annotations

import argparse
import importlib
import sys
import textwrap
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from ..studies.machine import stamp

if TYPE_CHECKING:
    from ...tests.hard.case import Case, Figure

MODULES = ("places", "transforms", "meshes", "rays", "light", "counters", "cameras", "inside_blender", "field")


def main(argv: Sequence[str]) -> int:
    """Write the table; exit status 1 where a case does not hold."""
    parser = argparse.ArgumentParser(
        prog="accuracy", description="Run every hard case and write the table of docs/accuracy.md."
    )
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        default=Path("docs/accuracy.md"),
        metavar="FILE",
        help="page whose part after the mark is replaced",
    )
    parser.add_argument("--only", metavar="GROUP", help="print the rows of one group and write nothing")
    args = parser.parse_args(argv)
    for name in MODULES:
        importlib.import_module(f"...tests.hard.{name}", __package__)
    from ...tests.hard.case import CASES

    results: list[tuple[Case, list[Figure]]] = []
    for case in CASES:
        if args.only in (None, case.group):
            print(f"{case.group}: {case.name}", file=sys.stderr, flush=True)
            results.append((case, case.figures()))
    text = "\n".join(table(results))
    broken = [f.stressed for _, figures in results for f in figures if not f.holds]
    if args.only:
        print(text)
    else:
        head = args.output.read_text().split(MARK)[0] if args.output.exists() else ""
        args.output.write_text(f"{head}{MARK}\n\n{textwrap.fill(stamp('make accuracy'), 120)}\n\n{text}\n")
    print(
        "\n".join(f"does not hold: {line}" for line in broken) or f"all {sum(len(f) for _, f in results)} hold",
        file=sys.stderr,
    )
    return 1 if broken else 0


MARK = "<!-- below: written by scripts/dev/accuracy.py -->"


def table(results: Iterable[tuple[Case, list[Figure]]]) -> list[str]:
    """Markdown, a table per group."""
    lines: list[str] = []
    group = None
    for case, figures in results:
        if case.group != group:
            group = case.group
            lines += [
                "",
                f"## {group}",
                "",
                "| what is stressed | measure | figure | without the remedy | holds up to | |",
                "|---|---|---:|---:|---:|---|",
            ]
        for f in figures:
            before = "" if f.before is None else number(f.before)
            why = f.why if f.holds else f"**does not hold** {f.why}"
            lines.append(f"| {f.stressed} | {f.measure} | {number(f.figure)} | {before} | {number(f.limit)} | {why} |")
    return lines[1:]


def number(x: float) -> str:
    """Three digits, whole numbers whole."""
    return f"{x:,.0f}" if x == round(x) and abs(x) < 1e9 else f"{x:.2g}"


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
