"""The engine's compiled kernels on disk: how many, how large, removed. Loads nothing of the engine but where it keeps them, and that when asked."""

from __future__ import annotations

import os
import shutil
import sys
from pathlib import Path


def count() -> int:
    """How many kernels of this version have been compiled and kept. Asked for again and again: it looks at one folder, not at those of other versions."""
    folder = _in_use()
    return sum(path.suffix == ".nbi" for part in _parts(folder) for path in part.iterdir()) if folder is not None else 0


def size() -> int:
    """Bytes of the compiled kernels of all versions."""
    return sum(path.stat().st_size for folder in _folders() for path in folder.rglob("*") if path.is_file())


def clear() -> int:
    """Remove the compiled kernels of all versions; returns the bytes that were freed. A loaded engine can go on to keep what it compiles."""
    freed, used = size(), _in_use()
    parts = _parts(used) if used is not None and "numba" in sys.modules else []
    for folder in _folders():
        shutil.rmtree(folder, ignore_errors=True)
    for part in parts:  # numba makes its folders when a kernel is defined, and writes into them when it is compiled
        part.mkdir(parents=True, exist_ok=True)
    return freed


def _folders() -> list[Path]:
    from ...core.kernel_cache import user_cache

    return list(user_cache().glob("kernels-*"))


def _in_use() -> Path | None:
    """The folder of this version, which the engine told numba; None before."""
    name = os.environ.get("NUMBA_CACHE_DIR")
    return Path(name) if name else None


def _parts(folder: Path) -> list[Path]:
    """Its folders, one for each of the engine's own."""
    return [part for part in folder.iterdir() if part.is_dir()] if folder.is_dir() else []
