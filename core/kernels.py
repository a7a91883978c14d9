"""Kernels are compiled the first time that they are called, and this is said."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

from numba.core import event

from .progress import Progress, clock

KERNELS = 185  # compilations until every kernel is there, about: for the time left


class _Compiling(event.Listener):
    """Forwards a progress; while kernels are compiled it tells that instead."""

    def __init__(self, progress: Progress) -> None:
        self._progress, self._lock = progress, threading.Lock()
        self._depth = self._done = 0
        self._first: float | None = None  # when compiling began

    def __call__(self, fraction: float, what: str) -> None:
        with self._lock:  # kernels are compiled on whichever thread calls them first
            if self._depth:
                fraction, what = math.nan, self._text()
            self._progress(fraction, what)

    def _text(self) -> str:
        self._first = self._first or time.monotonic()
        share, spent = min(self._done / KERNELS, 0.99), time.monotonic() - self._first
        left = f", about {clock(spent * (1 - share) / share)} left" if share > 0.1 else ""
        return f"compiling kernels, the first time only: {share:.0%}{left}"

    def on_start(self, event: event.Event) -> None:
        """One more is being compiled, perhaps for the sake of one that is."""
        self._depth += 1
        self(math.nan, "")

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
