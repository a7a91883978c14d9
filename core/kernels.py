"""Compiled kernels: loaded ahead while something else goes on, and, the first time, compiled, which is said."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from numba import int64, uint64
from numba.core import event

from .progress import Progress

KERNELS = 170  # compilations until every kernel is there, about: for the time left


def load_ahead() -> None:
    """Load the engine and its kernels in a thread of their own, where they were compiled before: whoever needs them finds them there, or waits for the rest.

    Worth while before work that leaves Python alone, such as Blender opening a file. It does nothing that would not be done later.
    """
    folder = os.environ.get("NUMBA_CACHE_DIR")  # by kernel_cache
    if not folder or not any(Path(folder).rglob("path_kernel.trace_tile-*.nbi")):
        return

    def load() -> None:
        with suppress(Exception):  # whoever needs it meets the error, and can tell the user
            from . import frames  # noqa: F401
            from .path_kernel import trace_tile

            trace_tile.compile((int64, int64, int64, int64, uint64[::1]))

    threading.Thread(target=load, name="kernels").start()


class _Compiling(event.Listener):
    """Forwards a progress; while kernels are compiled it tells that instead."""

    def __init__(self, progress: Progress) -> None:
        self._progress, self._lock = progress, threading.Lock()
        self._depth = self._done = 0
        self._fraction = 0.0

    def __call__(self, fraction: float, what: str) -> None:
        with self._lock:  # kernels are compiled on whichever thread calls them first
            self._fraction = fraction
            if self._depth:
                what = f"compiling kernels, the first time only: {min(self._done / KERNELS, 0.99):.0%}"
            self._progress(fraction, what)

    def on_start(self, event: event.Event) -> None:
        """One more is being compiled, perhaps for the sake of one that is."""
        self._depth += 1
        self(self._fraction, "")

    def on_end(self, event: event.Event) -> None:
        """One is compiled."""
        self._done += 1
        self._depth -= 1


@contextmanager
def telling(progress: Progress) -> Iterator[Progress]:
    """A progress that forwards to the one given, and says so while kernels are being compiled."""
    compiling = _Compiling(progress)
    event.register("numba:compile", compiling)
    try:
        yield compiling
    finally:
        event.unregister("numba:compile", compiling)
