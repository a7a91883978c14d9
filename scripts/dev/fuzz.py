"""`python -m lipac.scripts.dev.fuzz`: random scenes by seed, and what failed, into a JSON file. From a checkout, for developers."""

from __future__ import annotations

import argparse
import json
import sys
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

EVERY = 50  # scenes from one writing of the record to the next


def main(argv: Sequence[str]) -> int:
    """Write the record; exit status 1 where a scene failed."""
    parser = argparse.ArgumentParser(prog="fuzz", description="Check random scenes by seed; the record keeps the seeds that failed.")
    parser.add_argument("kind", choices=("core", "blender", "files"), help="scenes of arrays, scenes built in Blender, damaged files")
    parser.add_argument("--scenes", type=int, default=1000, metavar="N")
    parser.add_argument("--first", type=int, default=0, metavar="SEED")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help="record, continued where it exists")
    args = parser.parse_args(argv)
    record: dict[str, Any] = {"kind": args.kind, "first": args.first, "done": 0, "failed": []}
    if args.output.exists():
        record |= json.loads(args.output.read_text())
    check = checker(args.kind)
    for seed in range(record["first"] + record["done"], record["first"] + args.scenes):
        try:
            check(seed)
        except Exception as error:
            record["failed"].append({"seed": seed, "error": f"{type(error).__name__}: {error}", "where": traceback.extract_tb(error.__traceback__)[-1].name})
            print(record["failed"][-1], file=sys.stderr, flush=True)
        record["done"] += 1
        if record["done"] % EVERY == 0:
            args.output.write_text(json.dumps(record, indent=1) + "\n")
    args.output.write_text(json.dumps(record, indent=1) + "\n")
    print(f"{record['done']:,} scenes, {len(record['failed'])} failed", file=sys.stderr)
    return 1 if record["failed"] else 0


def checker(kind: str) -> Callable[[int], None]:
    """The check of one seed."""
    from ...tests.hard.choices import Seeded

    if kind == "core":
        from ...tests.hard import fuzz_core

        return lambda seed: fuzz_core.check(fuzz_core.random_scene(Seeded(seed)), seed)
    if kind == "blender":
        from ...tests.hard import fuzz_blender

        return lambda seed: fuzz_blender.check(Seeded(seed), seed)
    from ...tests.hard.fuzz_files import check

    return lambda seed: check(Seeded(seed))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
