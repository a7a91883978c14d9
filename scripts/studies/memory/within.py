"""What renders take, predicted and measured, and whether `--memory` keeps to what it is told.

Each render is a process of its own, of which the peak memory is measured: the scene with nothing culled, then within
targets between the least that it can take and that. What is measured is kept in DIR/memory.json, so that a call that is
stopped is followed by another that goes on; DIR/memory.md has the tables.

    python -m lipac.scripts.studies.memory.within -o DIR
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ....core.files.atomic import replacing
from ..compare import markdown
from ..machine import stamp
from ..supplied import SUPPLIED

OPTIONS = ("--resolution", "320x180", "--samples", "4", "--device", "cpu", "--quiet")
# what changes the picture goes for want of memory alone, and few paths say how much that is
EXACT = ("--max-error", "0.0005", "--paths", "8")
DEMOS = {"mirror-city": 300_000, "textures": 16}
TERRAIN = 1_200  # vertices along a side
FILES = ("candela_city", "rooms1024")
SCENES = ("terrain", *DEMOS, *FILES)
SHARES = (0.1, 0.3, 0.55, 0.8)  # of the way from the least that a scene can take to all of it
USED = 0.7  # of a target, where more of it would have helped
Row = dict[str, Any]


def main(argv: Sequence[str] | None = None) -> int:
    """Measure what is not there yet, and write the page; returns the exit status."""
    from ....core.files.report import output_folder
    from ...command.options import Parser

    parser = Parser(prog="python -m lipac.scripts.studies.memory.within", description="Renders within --memory.")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DIR")
    parser.add_argument("--scenes", type=lambda text: text.split(","), default=SCENES, metavar="NAME,...")
    args = parser.parse_args(argv)
    folder = output_folder(args.output)
    file = folder / "memory.json"
    data: dict[str, Row] = json.loads(file.read_text()) if file.exists() else {}
    for name in args.scenes:
        scene = scene_file(folder, name)
        if scene is None:
            print(f"{name} is not here: left out", file=sys.stderr)
            continue
        for target in ("full", "least", *map(str, SHARES)):
            row = data.setdefault(name, {})
            if target not in row:
                print(f"measuring {name}, {target}", file=sys.stderr, flush=True)
                row[target] = measured(scene, folder / f"{name}-{target}", target, row)
                with replacing(file) as part:
                    part.write_text(json.dumps(data, indent=1) + "\n")
    text = page(data)
    with replacing(folder / "memory.md") as part:
        part.write_text(text)
    print(text)
    return 0


def scene_file(folder: Path, name: str) -> Path | None:
    """The file of a scene, made where it is not there; None for a supplied one that is missing."""
    if name in FILES:
        found = SUPPLIED / f"{name}.blend"
        return found if found.exists() else None
    path = folder / f"{name}.blend"
    if not path.exists():
        module = [sys.executable, "-m"]
        count = ["--instances", str(DEMOS.get(name, 0))]
        demo = [*module, "lipac.scripts.lipac", "demo", name, "-o", str(path), *count]
        made = [*module, "lipac.scripts.studies.memory.terrain", str(path), str(TERRAIN)]
        subprocess.run(demo if name in DEMOS else made, check=True, stdout=subprocess.DEVNULL)
    return path


def measured(scene: Path, folder: Path, target: str, known: dict[str, Row]) -> Row:
    """A render in a process of its own: "full", with nothing culled; "least", the bytes without which it is refused; or
    within a share of the way between these, which are known."""
    (folder / "report.json").unlink(missing_ok=True)
    limit = 1
    if target == "full":
        how = ["--cull", "none"]
    else:
        if target != "least":
            least, full = known["least"]["needed"], known["full"]["peak"]
            limit = round(least + float(target) * max(full - least, 0))
        how = [*EXACT, "--memory", str(limit)]
    command = [sys.executable, "-m", "lipac.scripts.lipac", "render", str(scene), "-o", str(folder), *how, *OPTIONS]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode == 2:
        found = re.search(r"takes at least ([\d,]+) MB", done.stderr)
        return {"limit": limit, "refused": True, "needed": int(found[1].replace(",", "")) * 1_000_000 if found else 0}
    if done.returncode:
        raise SystemExit(done.stderr)
    report = json.loads((folder / "report.json").read_text())
    frame, peak = report["frames"][0], report["totals"]["peak_bytes"]
    row = {"limit": limit, "peak": peak, "predicted": frame["memory_bytes"], "error": frame["memory_error_bytes"]}
    for name in ("instances", "active", "parts", "parts_active", "certified_mean", "certified_worst"):
        row[name] = frame.get(name)
    return row


def page(data: dict[str, Row]) -> str:
    """memory.md."""
    full = [("scene, nothing culled", "predicted", "and at most", "measured", "measured / predicted")]
    rows = [("scene", "`--memory`", "predicted", "measured peak", "of the target", "stays", "certified change")]
    kept, used, targets = 0, 0, 0
    for name, of in data.items():
        one = of.get("full")
        if one:
            most = one["predicted"] + one["error"]
            figures = f"{mb(one['predicted'])} MB", f"{mb(most)} MB", f"{mb(one['peak'])} MB"
            full.append((name, *figures, f"{one['peak'] / one['predicted']:.3f}"))
        for share in map(str, SHARES):
            row = of.get(share)
            if row is None:
                continue
            if row.get("refused"):
                rows.append((name, f"{mb(row['limit'])} MB", "refused", f"needs {mb(row['needed'])} MB", "", "", ""))
                continue
            targets += 1
            kept += row["peak"] <= row["limit"]
            used += row["peak"] >= USED * row["limit"]
            stays = f"{row['active']:,} of {row['instances']:,}"
            if row.get("parts"):
                stays += f"; {row['parts_active']:,} of {row['parts']:,} parts"
            change = f"{100 * row['certified_mean']:.2g} %, worst {100 * row['certified_worst']:.2g} %"
            peak = f"{mb(row['peak'])} MB"
            rows.append(
                (
                    name,
                    f"{mb(row['limit'])} MB",
                    f"{mb(row['predicted'])} MB",
                    peak,
                    f"{100 * row['peak'] / row['limit']:.0f} %",
                    stays,
                    change,
                )
            )
    text = (
        f"{kept} of {targets} renders within their target; {used} of them take at least {100 * USED:.0f} % of it.\n"
        f"Targets: {', '.join(f'{100 * s:.0f} %' for s in SHARES)} of the way from the least that a scene can take to\n"
        f"all of it, with `{' '.join(EXACT)}`."
    )
    head = textwrap.fill(stamp("python -m lipac.scripts.studies.memory.within"), 120)
    return "\n\n".join([head, markdown(full), markdown(rows), text]) + "\n"


def mb(count: int) -> str:
    """Megabytes."""
    return f"{count / 1e6:,.0f}"


if __name__ == "__main__":
    sys.exit(main())
