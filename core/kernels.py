"""Kernels are compiled the first time that they are called, and this is said."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

from numba.core import event

from .progress import Progress

KERNELS = 170  # compilations until every kernel is there, about: for the time left


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
