"""Paths in command lines that are printed for users to run."""

from __future__ import annotations

import os
import shlex
import subprocess
from pathlib import Path


def quoted(path: str | Path) -> str:
    """A path as a word that the system's shell reads as one, whatever is in it."""
    return subprocess.list2cmdline([str(path)]) if os.name == "nt" else shlex.quote(str(path))
