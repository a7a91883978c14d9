"""numba's cache on disk, made safe against damage: a kernel whose file is not as it was written is compiled again; one
that cannot be written is not kept.

numba trusts its files: one that was cut off or changed breaks every later process, or is run as it is. Files in our own
cache folder begin with a check sum. Other caches of the process are numba's own affair. Imported for its effect, before
kernels are loaded.
"""

from __future__ import annotations

import hashlib
import os
import pickle
from contextlib import suppress
from pathlib import Path
from typing import Any

from numba.core.caching import Cache, IndexDataCacheFile

_SUM = hashlib.sha256().digest_size
_load_overload, _save_overload = Cache.load_overload, Cache.save_overload
_load_data, _save_data = IndexDataCacheFile._load_data, IndexDataCacheFile._save_data


def _is_ours(folder: str) -> bool:
    own = os.environ.get("NUMBA_CACHE_DIR")  # by kernel_cache
    return bool(own) and Path(folder).is_relative_to(own or "")


def load_overload(self: Cache, sig: Any, target_context: Any) -> Any:
    """The kernel of a signature; None, and its files forgotten, where they are damaged."""
    if not _is_ours(self.cache_path):
        return _load_overload(self, sig, target_context)
    try:
        return _load_overload(self, sig, target_context)
    except Exception:  # whatever comes of unpickling, or of giving LLVM, what is anything
        with suppress(OSError):
            self.flush()
        return None


def save_overload(self: Cache, sig: Any, data: Any) -> None:
    """Keep a kernel; where the disk is full, or the folder gone, it is there for this process."""
    try:
        _save_overload(self, sig, data)
    except OSError:
        if not _is_ours(self.cache_path):
            raise


def load_data(self: IndexDataCacheFile, name: str) -> Any:
    """What `save_data` wrote. Raises ValueError where it is not that."""
    if not _is_ours(self._cache_path):
        return _load_data(self, name)
    data = Path(self._data_path(name)).read_bytes()
    if hashlib.sha256(data[_SUM:]).digest() != data[:_SUM]:
        raise ValueError("damaged")
    return pickle.loads(data[_SUM:])


def save_data(self: IndexDataCacheFile, name: str, data: Any) -> None:
    """Write a kernel with its check sum before it."""
    if not _is_ours(self._cache_path):
        _save_data(self, name, data)
        return
    content = self._dump(data)
    with self._open_for_write(self._data_path(name)) as file:
        file.write(hashlib.sha256(content).digest() + content)


Cache.load_overload, Cache.save_overload = load_overload, save_overload  # type: ignore[method-assign]
IndexDataCacheFile._load_data, IndexDataCacheFile._save_data = load_data, save_data  # type: ignore[method-assign]
