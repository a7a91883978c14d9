"""What figures were measured on, for the heads of pages: asked of what runs, not of what should be installed."""

from __future__ import annotations

import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from .compare import cores


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
