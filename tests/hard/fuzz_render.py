"""Random .blend files with what people's files have in them, rendered by the command and judged: no crash, nothing
changed, within the budget or told."""

from __future__ import annotations

import hashlib
import io
import json
import tempfile
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import replace
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from lipac.core.arrays import F32
from lipac.core.culling.options import DEFAULT_BUDGET
from lipac.lipac_addon.batch.verify import GRID, Verified, change
from lipac.lipac_addon.console import muted
from lipac.lipac_addon.demo import family
from lipac.lipac_addon.open import leave_modes
from lipac.lipac_addon.pictures import read_picture
from lipac.scripts.lipac import main

from .choices import Seeded
from .features import FEATURES
from .fuzz_blender import snapshot
from .later_features import LATER, OPTIONS, features

MODES = ("edit_mode", "painted", "posed")  # come last: only what is in Object Mode can be added to
MOST = 4  # features of a scene
SIZE, SAMPLES = {"render": "64x36", "analyze": "32x18"}, "8"


def drawn(seed: int) -> list[str]:
    """Names of the features of a seed; at most one of modes, which is the last."""
    choose = Seeded(seed)
    names = sorted(features(seed))
    taken = dict.fromkeys(choose.one(names) for _ in range(choose.integer(1, MOST)))
    modes = [name for name in taken if name in MODES][:1]
    return [name for name in taken if name not in MODES] + modes


def build(seed: int, path: Path, names: list[str] | None = None) -> list[str]:
    """Save the file of a seed, in a folder of its own: a scatter of the family, and features, by default those that it
    draws. Returns their names."""
    choose, names, known = Seeded(seed + 2**32), names or drawn(seed), FEATURES | LATER
    with muted():
        family.build_drawn(replace(family.draw(seed), count=choose.integer(50, 400)))
        scene = bpy.context.scene
        for name in names:
            known[name](choose, scene, path.parent)
        bpy.ops.wm.save_as_mainfile(filepath=str(path), compress=choose.rarely())
    return names


def run(seed: int, names: list[str] | None = None, verify: int = 12) -> dict[str, Any]:
    """Build, render, judge. The record: features; status of the command; what it said; change of the picture, by a
    render of all; verdict.

    That is "held" (status 0, no change that is surely above the budget), "told" (status 3), "refused" (status 2), or in
    "failed" is what is wrong. names: of the features, in place of those that the seed draws; verify 0: analysed only.
    """
    with tempfile.TemporaryDirectory(prefix="lipac") as temporary:
        folder = Path(temporary)
        path = folder / "scene.blend"
        record: dict[str, Any] = {"seed": seed, "features": build(seed, path, names)}
        before = files(folder)
        options = [text for name in record["features"] for text in OPTIONS.get(name, ())]
        options += ["--verify", str(verify)] if verify else []
        status, lines = command("render" if verify else "analyze", path, folder / "culled", *options)
        record |= {"status": status, "said": lines}
        if bpy.data.filepath and Path(bpy.data.filepath) == path:
            used = snapshot()
            with muted():
                bpy.ops.wm.open_mainfile(filepath=str(path), load_ui=False, use_scripts=False)
                leave_modes()
            record |= _changed(used, snapshot())
        if files(folder) | before != before | files(folder):
            record["failed"] = "files beside the scene changed"
        if status not in (0, 2, 3) or (status == 2 and len(lines) != 1):
            record["failed"] = f"status {status}: {lines[-1:]}"
        record["verdict"] = {0: "held", 2: "refused", 3: "told"}.get(status, "failed")
        if status in (0, 3):
            record |= {
                name: json.loads((folder / "culled" / "report.json").read_text())["frames"][0][name]
                for name in ("instances", "active")
            }
        if verify and status in (0, 3):
            record |= _judged(path, folder, record)
        with muted():
            bpy.ops.wm.read_factory_settings(use_empty=True)
        return record


def command(name: str, path: Path, folder: Path, *options: str) -> tuple[int, list[str]]:
    """Run a command on a file: its status, and what it says on stderr."""
    said, samples = io.StringIO(), ["--engine", "cycles", "--samples", SAMPLES] if name == "render" else []
    with redirect_stderr(said), redirect_stdout(io.StringIO()):
        status = main([name, str(path), "-o", str(folder), "--resolution", SIZE[name], "--quiet", *samples, *options])
    return status, said.getvalue().strip().splitlines()


def files(folder: Path) -> dict[str, str]:
    """What files of the user's there are, by their contents."""
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in folder.glob("*.blend")}


def _changed(used: dict[str, Any], fresh: dict[str, Any]) -> dict[str, str]:
    """What of the open file is not put back."""
    changed = [name for name in used.keys() | fresh.keys() if used.get(name) != fresh.get(name)]
    return (
        {
            "failed": (
                "not as in the file: "
                f"{[(name, *_differing(used.get(name), fresh.get(name))) for name in sorted(changed)[:3]]}"
            )
        }
        if changed
        else {}
    )


def _differing(a: Any, b: Any) -> list[str]:
    """Names of properties that differ, where it is that."""
    return (
        [key for key in a.keys() | b.keys() if a.get(key) != b.get(key)]
        if isinstance(a, dict) and isinstance(b, dict)
        else []
    )


def _judged(path: Path, folder: Path, record: dict[str, Any]) -> dict[str, Any]:
    """The picture beside one of everything, of the same samples, by another run of the command."""
    status, lines = command("render", path, folder / "full", "--cull", "none")
    if status:
        return {"failed": f"--cull none: status {status}: {lines[-1:]}"}
    culled, full = (read_picture(next((folder / name).glob("frame_*.exr"))) for name in ("culled", "full"))
    found = judge(full, culled)
    broken = found.breaks(DEFAULT_BUDGET)
    out: dict[str, Any] = {"mean": found.mean, "worst": found.worst, "finite": bool(np.isfinite(culled).all())}
    if broken and record["status"] == 0:
        shares = [f"{100 * share:.2g}" for share in (found.mean, found.worst, found.least_mean, found.least_worst)]
        out["failed"] = f"in silence: {shares[0]} / {shares[1]} %, surely {shares[2]} / {shares[3]} %"
    return out


def judge(full: F32, culled: F32) -> Verified:
    """The change of a whole picture, with its noise, as of all crops of a verification."""
    height, width = full.shape[:2]
    crops = tuple((x, y) for y in range(GRID[1]) for x in range(GRID[0]))

    def cut(picture: F32) -> list[F32]:
        y, x = (np.arange(n + 1) * size // n for n, size in ((GRID[1], height), (GRID[0], width)))
        return [picture[y[j] : y[j + 1], x[i] : x[i + 1]] for i, j in crops]

    return change(cut(full), cut(culled), crops)
