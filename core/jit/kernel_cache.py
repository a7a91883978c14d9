"""Where compiled kernels are kept: in a folder of the user's, one for every state of the engine's sources.

numba looks at the file of a cached function, not at the files of the functions it calls: after an upgrade a kernel
would go on with the old inner functions.
"""

from __future__ import annotations

import ast
import atexit
import hashlib
import os
import re
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

_KEEP_SECONDS = 14 * 24 * 3600  # caches of other versions, since they were last used
_NAME = re.compile(r"kernels-\d+\.\d+-[0-9a-f]{12}")
_MARK = ".lipac-kernels"  # a file in every folder that is ours to remove


def user_cache() -> Path:
    """The user's folder for what programs can make again; LIPAC_CACHE_DIR overrides it. Raises RuntimeError where the
    user has no home."""
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
        return [
            path
            for path in parent.iterdir()
            if _NAME.fullmatch(path.name) and not path.is_symlink() and (path / _MARK).is_file()
        ]
    return []


def kernel_sources(core: Path) -> list[Path]:
    """Modules below the folder core that compile kernels, and all that these import from it: their constants become
    part of the kernels. Sorted."""
    text = {path: path.read_text(encoding="utf-8") for path in core.rglob("*.py")}
    found: set[Path] = set()
    pending = [
        path for path, source in text.items() if re.search(r"^\s*@(njit|cfunc|intrinsic)\b", source, re.MULTILINE)
    ]
    while pending:
        path = pending.pop()
        if path in text and path not in found:
            found.add(path)
            pending += _imported(path, ast.parse(text[path]))
    return sorted(found)


def _imported(path: Path, tree: ast.Module) -> Iterator[Path]:
    """Files that the module of a path may import by relative imports, wherever these stand; some of them may not
    exist."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.level:
            folder = path.parents[node.level - 1].joinpath(*(node.module or "").split("."))
            yield folder.with_suffix(".py")
            yield folder / "__init__.py"
            yield from (folder / f"{alias.name}.py" for alias in node.names)


def kept() -> int:
    """How many compiled kernels the folder in use has."""
    folder = os.environ.get("NUMBA_CACHE_DIR")
    return sum(1 for _ in Path(folder).glob("*/*.nbi")) if folder else 0


def use(folder: Path | None = None) -> Path | None:
    """Have numba keep compiled kernels under folder (default `user_cache()`), in a subfolder for these sources. Returns
    it.

    Must run before kernels are defined. Where it cannot be written they are kept in a temporary folder until the
    process ends; None where not even there.
    """
    core = Path(__file__).parents[1]
    sources = hashlib.sha256()
    for path in kernel_sources(core):
        content = path.read_bytes()  # where a module is counts, too: what is cached holds for a module's name
        sources.update(f"{path.relative_to(core).as_posix()} {len(content)} ".encode() + content)
    name = f"kernels-{sys.version_info[0]}.{sys.version_info[1]}-{sources.hexdigest()[:12]}"
    cache = _kept_in(folder, name) or _temporary(name)
    if cache is None:
        return None
    os.environ["NUMBA_CACHE_DIR"] = str(cache)
    if "numba" in sys.modules:  # it read its settings when it was imported
        sys.modules["numba"].config.CACHE_DIR = str(cache)
    return cache


def _kept_in(folder: Path | None, name: str) -> Path | None:
    """The cache of that name in a folder, those of other versions that nobody used for long removed; None where it
    cannot be written."""
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
