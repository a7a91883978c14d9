"""Blenders of their own, that need not have the add-on: what render nodes run."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import bpy

from ...core.errors import InputError
from ..batch.job import Cancel, check, never
from ..batch.verify import Crop
from ..pictures import read_picture
from .layout import SCRIPT, FarmShot, read_json

STEP = Path(__file__).parents[2] / "scripts" / "farm" / "step.py"
_NO_WINDOW = getattr(subprocess, "CREATE_NO_WINDOW", 0)  # Windows would open one
_PYTHON = re.compile(r"python[\d.]*(\.exe)?$", re.IGNORECASE)
_LAST = 2000  # characters of a child's output that are shown


def program(blender: str = "") -> list[str]:
    """Begin of a command line that runs a script in a Blender. blender: its path, or that of a Python with the module
    bpy; "": the one that this is."""
    path = blender or (sys.executable if bpy.app.module else bpy.app.binary_path)
    return [path] if _PYTHON.search(Path(path).name) else [path, "-b", "--python-exit-code", "1", "-P"]


def render(
    shot: FarmShot,
    frames: tuple[int, ...],
    blender: str = "",
    file: Path | None = None,
    mended: str = "",
    cancelled: Cancel = never,
) -> None:
    """Render frames to their pictures. file: from this one instead of shot.blend, which is what `mended` says. Raises
    InputError, Cancelled."""
    other = ["--file", str(file), "--mended", mended] if file else []
    run(
        [
            *program(blender),
            str(shot.folder / SCRIPT),
            "--",
            str(shot.folder),
            "--frames",
            f"{frames[0]}-{frames[-1]}",
            *other,
        ],
        cancelled,
    )


def crops_of(
    shot: FarmShot,
    frame: int,
    file: Path,
    crops: Iterable[Crop],
    into: Path,
    blender: str = "",
    cancelled: Cancel = never,
) -> tuple[list[Any], dict[str, Any]]:
    """Parts of a frame of a file, (h, w, 4) float32 each; and the seconds and the memory of the process that rendered
    them. Raises InputError, Cancelled."""
    into.mkdir(parents=True, exist_ok=True)
    named = [f"{x},{y}" for x, y in crops]
    arguments = [str(shot.folder), "--frames", str(frame), "--file", str(file), "--into", str(into), "--crops", *named]
    run([*program(blender), str(shot.folder / SCRIPT), "--", *arguments], cancelled)
    return [read_picture(into / f"frame_{frame:04}_{name}.exr") for name in named], read_json(
        into / f"frame_{frame:04}.json"
    ) or {}


def lipac_program(lipac: str = "") -> list[str]:
    """Begin of a command line that does a step of a shot. lipac: the path of the lipac command; "": of what runs
    now."""
    found = lipac or (shutil.which("lipac", path=str(Path(sys.executable).parent)) if bpy.app.module else None)
    return [found, "shot"] if found else [*program(), str(STEP), "--"]


def run(command: list[str], cancelled: Cancel = never, allowed: tuple[int, ...] = (0,)) -> tuple[int, str]:
    """Run a program to its end, which is ended with this one; its exit status and what it said.

    Raises InputError with the last that it said where its status is not allowed; Cancelled.
    """
    if shutil.which(command[0]) is None:
        raise InputError(f"no such program: {command[0]}; name one by --blender or --lipac")
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, errors="replace", creationflags=_NO_WINDOW
    )
    try:
        while True:
            try:
                said, _ = process.communicate(timeout=0.2)
                break
            except subprocess.TimeoutExpired:
                check(cancelled)
    finally:
        process.kill()
        process.wait()
    if process.returncode not in allowed:
        print(said[-_LAST:], file=sys.stderr)
        last = next((line for line in reversed(said.splitlines()) if line.strip()), f"status {process.returncode}")
        raise InputError(f"{Path(command[0]).name} failed: {last.strip()[:300]}")
    return process.returncode, said
