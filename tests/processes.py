"""Processes that tests start, and files for them."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import bpy


def _interruptible() -> None:
    signal.signal(signal.SIGINT, signal.default_int_handler)


# For subprocess: Ctrl-C reaches the process, also where whoever started the tests had them ignore it
INTERRUPTIBLE: dict[str, Any] = {} if os.name == "nt" else {"preexec_fn": _interruptible}


def saved(build: Callable[[], object], path: Path) -> Path:
    """A .blend of what a function makes of the open file, at path; an empty file is open then."""
    build()
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    bpy.ops.wm.read_factory_settings(use_empty=True)
    return path
