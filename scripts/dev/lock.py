"""The versions that `make` installs, read from requirements-test.txt."""

from __future__ import annotations

import re
from pathlib import Path

from packaging.markers import Marker

LOCK = Path(__file__).resolve().parents[2] / "requirements-test.txt"
PIN = re.compile(r"^([\w.-]+)==(\S+)(?: ; (.+?))? \\$", re.MULTILINE)


def pins(environment: dict[str, str] | None = None) -> dict[str, str]:
    """Version by package name (normalized as in PEP 503) that the lock pins.

    environment: markers (PEP 508) that differ from those of the Python that runs, e.g. {"python_full_version":
    "3.11.0", "sys_platform": "win32"}.
    """
    found = PIN.findall(LOCK.read_text())
    return {
        name: version
        for name, version, marker in found
        if not marker or Marker(marker).evaluate(dict(environment or {}))
    }
