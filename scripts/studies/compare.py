"""What culling saves and what it costs: full and culled Cycles renders of a scene, each in a process of its own, and
the pictures that show the difference."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ...core.errors import InputError
from ...core.files.figures import size
from ...core.threads import processors

FULL, OTHER_SEED, CULLED = "full", "other-seed", "culled"


def lipac(*arguments: str | Path) -> float:
    """Run `lipac ARGUMENTS` in a process of its own, its progress on our stderr; returns its seconds. Ends the program
    with its status if it fails."""
    start = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-m", "lipac.scripts.lipac", *map(str, arguments)], stdout=subprocess.DEVNULL, check=False
    )
    if done.returncode:
        sys.exit(done.returncode)
    return time.perf_counter() - start


def render(scene: Path, folder: Path, name: str, options: Sequence[str]) -> dict[str, Any]:
    """One of the renders FULL, OTHER_SEED and CULLED of a scene by Cycles into folder/name; its report, and the seconds
    of the whole command as `process_s`."""
    policy = "light-paths" if name == CULLED else "none"
    seed = "1" if name == OTHER_SEED else "0"
    (folder / name / "report.json").unlink(missing_ok=True)  # which would go on with the peak memory of the run before
    seconds = lipac(
        "render", scene, "-o", folder / name, "--engine", "cycles", "--cull", policy, "--seed", seed, *options
    )
    report: dict[str, Any] = json.loads((folder / name / "report.json").read_text())
    return report | {"process_s": seconds}


def pictures(folder: Path, name: str) -> tuple[Any, Any]:
    """A render's picture: linear and as displayed, (H, W, 4) float32 each, rows from the top."""
    from ...lipac_addon.pictures import read_picture

    stem = sorted((folder / name).glob("frame_*.exr"))[0]
    return read_picture(stem)[::-1], read_picture(stem.with_suffix(".png"))[::-1]


def errors(folder: Path) -> dict[str, dict[str, float]]:
    """Errors against the full render: of the culled one with the same random numbers, and, as a yardstick, of the full
    one with other random numbers."""
    from ...core.evaluation.metrics import error

    linear, shown = pictures(folder, FULL)
    out = {}
    for name in (CULLED, OTHER_SEED):
        other, other_shown = pictures(folder, name)
        out[name] = error(linear, other, shown, other_shown)
    return out


def flip_picture(folder: Path) -> Any:
    """The FLIP map between full and culled picture in the Magma colours that FLIP is published with: (H, W, 3)
    uint8."""
    from matplotlib import colormaps

    from ...core.evaluation.metrics import flip

    difference, _ = flip(pictures(folder, FULL)[1], pictures(folder, CULLED)[1])
    return colormaps["magma"](difference, bytes=True)[..., :3]


def tlas_of(scene: Path, states: Path, frame: int, size: tuple[int, int] = (960, 540)) -> Any:
    """The picture of the TLAS for the states that a command saved: (H, W, 3) uint8; size: W and H. Raises InputError
    where these are of another scene."""
    import bpy
    import numpy as np

    from ...core.culling.options import State
    from ...core.evaluation.tlas_picture import tlas_picture
    from ...lipac_addon.extract import extract_frame
    from ...lipac_addon.open import open_scene

    open_scene(scene)
    frozen = extract_frame(bpy.context.scene, frame).scene
    with np.load(states) as data:
        active, boxes = data["state"] == State.ACTIVE, (data["boxes"] - frozen.origin).astype(np.float32)
    if len(active) != len(frozen.instances):
        raise InputError(f"{scene} has {len(frozen.instances):,} instances, and {states} is of {len(active):,}")
    return tlas_picture(frozen, active, boxes, size)


def table(full: dict[str, Any], culled: dict[str, Any], error: dict[str, dict[str, float]]) -> str:
    """Full against culled as a Markdown table."""
    a, b = full["frames"][0], culled["frames"][0]
    peak_a, peak_b = full["totals"]["peak_bytes"], culled["totals"]["peak_bytes"]

    def row(name: str, x: str, y: str, times: str = "") -> tuple[str, ...]:
        return name, x, y, times

    def ratio(x: float, y: float) -> str:
        return f"{x / y:.3g} times" if y > 0 else ""

    phases = {
        "sync_s": "read the scene",
        "build_s": "build",
        "trace_s": "trace",
        "feedback_s": "feedback",
        "writeback_s": "write back",
        "render_s": "Cycles",
    }
    rows = [
        row("", "full", "culled", "full / culled"),
        row("instances", f"{a['instances']:,}", f"{b['instances']:,}"),
        row("active", f"{a['active']:,}", f"{b['active']:,}", ratio(a["active"], b["active"])),
        row("hitboxes", "", f"{b['hitboxes']:,}"),
        row("BLAS", "", size(b["blas_bytes"])),
        row("TLAS", "", size(b["tlas_bytes"])),
        *(
            row(label, f"{a[key]:.2f} s", f"{b[key]:.2f} s", ratio(a[key], b[key]) if key == "render_s" else "")
            for key, label in phases.items()
        ),
        row(
            "whole command",
            f"{full['process_s']:.2f} s",
            f"{culled['process_s']:.2f} s",
            ratio(full["process_s"], culled["process_s"]),
        ),
        row("peak memory", size(peak_a), size(peak_b), ratio(peak_a, peak_b)),
    ]
    head = ("error against full", "another seed", "culled", "seed / culled")
    measures = {
        "flip": "mean FLIP",
        "relmse": "relMSE",
        "rmse": "RMSE, mean of tiles",
        "rmse_p99": "RMSE, 99 % of tiles",
    }
    seeds, cost = error[OTHER_SEED], error[CULLED]
    marks = [
        row(label, f"{seeds[key]:.4f}", f"{cost[key]:.4f}", ratio(seeds[key], cost[key]))
        for key, label in measures.items()
    ]
    return markdown(rows) + "\n\n" + markdown([head, *marks])


def markdown(rows: Sequence[Sequence[str]]) -> str:
    """Rows, the first being the head, as an aligned Markdown table."""
    widths = [max(len(row[c]) for row in rows) for c in range(len(rows[0]))]

    def line(cells: Sequence[str]) -> str:
        first, *rest = cells
        return (
            "| "
            + " | ".join([first.ljust(widths[0]), *(cell.rjust(w) for cell, w in zip(rest, widths[1:], strict=True))])
            + " |"
        )

    rule = "|" + "|".join("-" * (widths[0] + 2) if c == 0 else "-" * (w + 1) + ":" for c, w in enumerate(widths)) + "|"
    return "\n".join([line(rows[0]), rule, *map(line, rows[1:])])


def cores() -> int:
    """Processor cores that this process may use."""
    return processors()
