"""What figures were measured by and on, for the heads of pages: asked of what runs, not of what should be installed."""

from __future__ import annotations

import platform
import subprocess
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from ...version import __version__
from .compare import cores

ROOT = Path(__file__).parents[2]
CODE = ("*.py", "*.c", "*.toml", "requirements*.txt")  # what figures depend on


def stamp(command: str) -> str:
    """The sentence by which a page says what its figures come from: the command, the code, the machine."""
    return f"`{command}`: {made_by()}."


def made_by() -> str:
    """The code and the machine."""
    return f"{code()}, on {machine()}"


def measured_by(found: Mapping[str, Any]) -> str:
    """The sentence by which figures that were kept in a file say that of themselves: found is what the file has."""
    return f"Measured by {found.get('made_by', 'code that did not note its version')}."


def code() -> str:
    """Version and commit of the code that runs; whether it was changed since that; that no commit is known."""
    commit = _git("rev-parse", "--short=7", "HEAD")
    if not commit or Path(_git("rev-parse", "--show-toplevel")) != ROOT.resolve():
        return f"LiPaC {__version__}, of no checkout"
    changed = " and changes to it" if _git("status", "--porcelain", "--untracked-files=no", "--", *CODE) else ""
    return f"LiPaC {__version__}, commit {commit}{changed}"


def _git(*arguments: str) -> str:
    """What git says of the folder of the code; "" where there is none, or no git."""
    try:
        done = subprocess.run(["git", "-C", str(ROOT), *arguments], capture_output=True, text=True, check=False)
    except OSError:
        return ""
    return "" if done.returncode else done.stdout.strip()


def machine() -> str:
    """Processor, cores, system, and the versions of Python, Blender and the packages that figures depend on."""
    import bpy

    model = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        model = next(
            (line.split(":")[1].strip() for line in info.read_text().splitlines() if line.startswith("model name")),
            model,
        )
    packages = [f"Blender {bpy.app.version_string}"]
    for name in ("numba", "embreex", "mitsuba"):
        try:
            packages.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            continue
    return f"{model}, {cores()} cores, {platform.system()}, Python {platform.python_version()}, {', '.join(packages)}"
