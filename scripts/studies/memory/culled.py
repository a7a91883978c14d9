"""What Cycles' own memory is in full and culled, by Cycles' count, with the change of the picture that is certified and
that which is measured in all parts of it.

    python -m lipac.scripts.studies.memory.culled -o DIR [--device cuda]

DIR/culled.json keeps what is measured, so that a call that is stopped is followed by another that goes on.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from ....core.files.atomic import replacing
from ..compare import markdown
from ..machine import stamp
from ..supplied import SUPPLIED
from .within import Row, mb, scene_file

FILES = ("candela_city", "indoor", "kitchen", "rooms1024")
SCENES = ("terrain", "mirror-city", *FILES)
OPTIONS = ("--resolution", "640x360", "--samples", "16", "--quiet")
HOW = {"full": ("--cull", "none"), "culled": ("--cull", "light-paths", "--verify", "12")}
COLUMNS = ("Cycles, full", "culled", "of full", "stays", "certified", "measured", "of that sure")


def main(argv: Sequence[str] | None = None) -> int:
    """Measure what is not there yet, and print the table; returns the exit status."""
    from ....core.files.report import output_folder
    from ...command.options import Parser

    parser = Parser(prog="python -m lipac.scripts.studies.memory.culled", description="Cycles' memory, culled.")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DIR")
    parser.add_argument("--scenes", type=lambda text: text.split(","), default=SCENES, metavar="NAME,...")
    parser.add_argument("--device", default="cpu", metavar="NAME", help="of `lipac render`; a folder is of one device")
    args = parser.parse_args(argv)
    folder = output_folder(args.output)
    file = folder / "culled.json"
    data: dict[str, dict[str, Row]] = json.loads(file.read_text()) if file.exists() else {}
    for name in args.scenes:
        scene = SUPPLIED / f"{name}.blend" if name in FILES else scene_file(folder, name)
        if scene is None or not scene.exists():
            print(f"{name} is not here: left out", file=sys.stderr)
            continue
        for kind in HOW:
            row = data.setdefault(name, {})
            if kind not in row:
                print(f"rendering {name}, {kind}", file=sys.stderr, flush=True)
                row[kind] = rendered(scene, folder / f"{name}-{kind}", kind, args.device)
                with replacing(file) as part:
                    part.write_text(json.dumps(data, indent=1) + "\n")
    print(stamp("python -m lipac.scripts.studies.memory.culled"), table(data), sep="\n\n")
    return 0


def rendered(scene: Path, folder: Path, kind: str, device: str) -> Row:
    """What the report says of a render in a process of its own."""
    command = [
        sys.executable,
        "-m",
        "lipac.scripts.lipac",
        "render",
        str(scene),
        "-o",
        str(folder),
        *HOW[kind],
        *OPTIONS,
        "--device",
        device,
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(done.stderr)
    frame: Row = json.loads((folder / "report.json").read_text())["frames"][0]
    return frame


def table(data: dict[str, dict[str, Row]]) -> str:
    """Of scenes that were rendered both ways."""
    rows: list[tuple[str, ...]] = [("scene", *COLUMNS)]
    for name, of in data.items():
        if len(of) < len(HOW):
            continue
        full, culled = of["full"], of["culled"]
        stays = f"{culled['active']:,} of {culled['instances']:,}"
        if culled.get("parts"):
            stays += f"; {culled['parts_active']:,} of {culled['parts']:,} parts"
        bytes_of = full["device_bytes"], culled["device_bytes"]
        changes = (
            f"{100 * culled[f'{kind}_mean']:.2f}, {100 * culled[f'{kind}_worst']:.1f} %"
            for kind in ("certified", "verified", "verified_least")
        )
        rows.append(
            (name, *(f"{mb(b)} MB" for b in bytes_of), f"{100 * bytes_of[1] / bytes_of[0]:.0f} %", stays, *changes)
        )
    return markdown(rows)


if __name__ == "__main__":
    sys.exit(main())
