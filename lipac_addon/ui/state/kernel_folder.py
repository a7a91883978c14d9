"""The engine's compiled kernels on disk: how many, how large, removed. Loads nothing of the engine but where it keeps
them, and that when asked."""

from __future__ import annotations

import os
import shutil
from contextlib import suppress
from pathlib import Path


def count() -> int:
    """How many kernels of this version have been compiled and kept. Asked for again and again: it looks at one folder,
    not at those of other versions."""
    folder = os.environ.get("NUMBA_CACHE_DIR")  # which the engine set
    return sum(1 for _ in Path(folder).glob("*/*.nbi")) if folder else 0


def size() -> int:
    """Bytes of the compiled kernels of all versions."""
    found = 0
    for path in (path for folder in _folders() for path in folder.rglob("*")):
        with suppress(OSError):  # another Blender puts it in place just now
            if path.is_file():
                found += path.stat().st_size
    return found


def clear() -> int:
    """Remove the compiled kernels of all versions; returns the bytes that were freed."""
    freed = size()
    for folder in _folders():
        shutil.rmtree(folder, ignore_errors=True)
    return freed


def _folders() -> list[Path]:
    from ....core.jit.kernel_cache import own_folders, user_cache

    return own_folders(user_cache())
