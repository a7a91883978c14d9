"""Where compiled kernels are kept: in a folder of the user's, one for every state of the engine's sources.

numba looks at the file of a cached function, not at the files of the functions it calls: after an upgrade a kernel would go on with the old inner functions.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import sys
import time
from pathlib import Path

_KEEP_SECONDS = 14 * 24 * 3600  # caches of other versions, since they were last used


def user_cache() -> Path:
    """The user's folder for what programs can make again; LIPAC_CACHE_DIR overrides it."""
    given = os.environ.get("LIPAC_CACHE_DIR")
    if given:
        return Path(given)
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", Path.home() / "AppData" / "Local")) / "lipac"
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches" / "lipac"
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "lipac"


def kernel_sources(core: Path) -> list[Path]:
    """Modules of the folder core that compile kernels, and all that these import from it: their constants become part of the kernels. Sorted."""
    text = {path.stem: path.read_text() for path in core.glob("*.py")}
    found: set[str] = set()
    pending = [name for name, source in text.items() if re.search(r"^\s*@(njit|cfunc|intrinsic)\b", source, re.MULTILINE)]
    while pending:
        name = pending.pop()
        if name in text and name not in found:
            found.add(name)
            for several, one in re.findall(r"^from \.(?: import (.+)|(\w+) import)", text[name], re.MULTILINE):
                pending += [one] if one else [part.split()[0] for part in several.split(",")]
    return [core / f"{name}.py" for name in sorted(found)]


def kept() -> int:
    """How many compiled kernels the folder in use has."""
    folder = os.environ.get("NUMBA_CACHE_DIR")
    return sum(1 for _ in Path(folder).glob("*/*.nbi")) if folder else 0


def use(folder: Path | None = None) -> Path | None:
    """Have numba keep compiled kernels under folder (default `user_cache()`), in a subfolder for these sources. Returns it, None where it cannot be written.

    Must run before kernels are defined. Without a folder to write to, numba falls back to its own choice.
    """
    sources = hashlib.sha256()
    for path in kernel_sources(Path(__file__).parent):
        sources.update(path.read_bytes())
    parent = folder or user_cache()
    cache = parent / f"kernels-{sys.version_info[0]}.{sys.version_info[1]}-{sources.hexdigest()[:12]}"
    try:
        cache.mkdir(parents=True, exist_ok=True)
        os.utime(cache)
        for other in parent.glob("kernels-*"):
            if time.time() - other.stat().st_mtime > _KEEP_SECONDS:
                shutil.rmtree(other, ignore_errors=True)
    except OSError:
        return None
    os.environ["NUMBA_CACHE_DIR"] = str(cache)
    if "numba" in sys.modules:  # it read its settings when it was imported
        sys.modules["numba"].config.CACHE_DIR = str(cache)
    return cache
