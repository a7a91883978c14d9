"""Where compiled kernels are kept: in a folder of the user's, one for every state of the engine's sources.

numba looks at the file of a cached function, not at the files of the functions it calls: after an upgrade a kernel would go on with the old inner functions.
"""

from __future__ import annotations

import atexit
import hashlib
import os
import re
import shutil
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path

_KEEP_SECONDS = 14 * 24 * 3600  # caches of other versions, since they were last used
_NAME = re.compile(r"kernels-\d+\.\d+-[0-9a-f]{12}")
_MARK = ".lipac-kernels"  # a file in every folder that is ours to remove


def user_cache() -> Path:
    """The user's folder for what programs can make again; LIPAC_CACHE_DIR overrides it. Raises RuntimeError where the user has no home."""
    given = os.environ.get("LIPAC_CACHE_DIR")
    if given:
        return Path(given)
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local") / "lipac"
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches" / "lipac"
    folder = os.environ.get("XDG_CACHE_HOME", "")
    return (Path(folder) if os.path.isabs(folder) else Path.home() / ".cache") / "lipac"


def own_folders(parent: Path) -> list[Path]:
    """Folders of compiled kernels that this program made in parent: no link, with our mark inside."""
    with suppress(OSError):
        return [path for path in parent.iterdir() if _NAME.fullmatch(path.name) and not path.is_symlink() and (path / _MARK).is_file()]
    return []


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
    """Have numba keep compiled kernels under folder (default `user_cache()`), in a subfolder for these sources. Returns it.

    Must run before kernels are defined. Where it cannot be written they are kept in a temporary folder until the process ends; None where not even there.
    """
    sources = hashlib.sha256()
    for path in kernel_sources(Path(__file__).parent):
        sources.update(path.read_bytes())
    name = f"kernels-{sys.version_info[0]}.{sys.version_info[1]}-{sources.hexdigest()[:12]}"
    cache = _kept_in(folder, name) or _temporary(name)
    if cache is None:
        return None
    os.environ["NUMBA_CACHE_DIR"] = str(cache)
    if "numba" in sys.modules:  # it read its settings when it was imported
        sys.modules["numba"].config.CACHE_DIR = str(cache)
    return cache


def _kept_in(folder: Path | None, name: str) -> Path | None:
    """The cache of that name in a folder, those of other versions that nobody used for long removed; None where it cannot be written."""
    try:
        parent = folder or user_cache()
        cache = parent / name
        cache.mkdir(parents=True, exist_ok=True)
        (cache / _MARK).touch()
        os.utime(cache)
        with tempfile.TemporaryFile(dir=cache):  # what is another user's, or on a full disk
            pass
    except (OSError, RuntimeError):
        return None
    for other in own_folders(parent):
        with suppress(OSError):
            if time.time() - other.stat().st_mtime > _KEEP_SECONDS:
                shutil.rmtree(other, ignore_errors=True)
    return cache


def _temporary(name: str) -> Path | None:
    try:
        parent = Path(tempfile.mkdtemp(prefix="lipac-"))
    except OSError:
        return None
    atexit.register(_remove, parent)
    os.environ["LIPAC_CACHE_DIR"] = str(parent)  # for processes that this one starts
    return _kept_in(parent, name)


def _remove(folder: Path) -> None:
    """Remove a temporary folder. What a process wrote to it while it was being ended may come in between."""
    for _ in range(10):
        shutil.rmtree(folder, ignore_errors=True)
        if not folder.exists():
            return
        time.sleep(0.05)
