"""Warm up the JIT-compiled kernels: load them ahead in a thread, and report the progress of compiling them the first
time."""

from __future__ import annotations

import math
import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from numba import int64, uint64
from numba.core import event

from .jit.kernel_cache import kept
from .progress import Progress, clock, silent
from .threads import processors

KERNELS = 120  # kept when the path tracing kernel, which unites most of them, is all that is left to compile, about
LAST = 0.15  # of the whole time, for that one
MOST = 0.99  # the share that is told until it is done: then it takes longer than expected, and nobody knows how long


_waiting: list[threading.Timer] = []  # to load kernels


def load_ahead(after: float = 0.0) -> None:
    """Load the engine and its kernels in a thread of their own, where they were compiled before and more than one
    thread may run: whoever needs them finds them there, or waits for the rest.

    Worth while before work that leaves Python alone, such as Blender opening a file. It does nothing that would not be
    done later. after: seconds in which `not_needed` may still say that nobody will need them.
    """
    not_needed()
    if processors() == 1 or not _compiled():
        return

    def try_to_load() -> None:
        with suppress(Exception):  # whoever needs it meets the error, and can tell the user
            load()

    timer = threading.Timer(after, try_to_load)
    timer.name = "kernels"
    _waiting.append(timer)
    timer.start()


def load() -> None:
    """Load the engine and nearly all of its kernels, or compile them."""
    from .culling import shot as frames  # noqa: F401
    from .tracing.tile_kernel import trace_tiles

    trace_tiles.compile((int64[:, ::1], int64[::1], uint64[::1]))


def _compiled() -> bool:
    """Whether the kernels of tracing are kept on disk: that of paths, which unites most of them, comes last."""
    folder = os.environ.get("NUMBA_CACHE_DIR")  # by kernel_cache
    return bool(folder) and any(Path(folder or "").glob("*/tile_kernel.trace_tiles-*.nbi"))


def not_needed() -> None:
    """Do not load ahead what has not begun to be loaded."""
    while _waiting:
        _waiting.pop().cancel()


class _Compiling(event.Listener):
    """Forwards a progress; while kernels are compiled it tells that instead."""

    def __init__(self, progress: Progress) -> None:
        self._progress, self._lock = progress, threading.Lock()
        self._depth = self._done = 0
        self._first: float | None = None  # when compiling began
        self._begun = 0.0  # what share was there before
        self._united: float | None = None  # seconds until the last one began

    def __call__(self, fraction: float, what: str) -> None:
        with self._lock:  # kernels are compiled on whichever thread calls them first
            if self._depth:
                fraction, what = math.nan, self.text()
            self._progress(fraction, what)

    def text(self) -> str:
        """How far compiling is, and the time left."""
        if self._first is None:
            self._first, self._begun = time.monotonic(), self._share(0.0)
        spent = time.monotonic() - self._first
        share = self._share(spent)
        done = share - self._begun
        left = f", about {clock(spent * (1 - share) / done)} left" if done > 0.1 and share < MOST else ""
        return f"compiling kernels, the first time only: {share:.0%}{left}"

    def _share(self, spent: float) -> float:
        """What share of the work is done after so many seconds. Of what is kept on disk: another process may compile,
        too (`core.tracing.second_process`)."""
        done = max(self._done, kept())
        if done < KERNELS:
            return (1 - LAST) * done / KERNELS
        self._united = self._united or max(spent, 1e-3)
        return min((1 - LAST) * spent / self._united, MOST)

    def on_start(self, event: event.Event) -> None:
        """One more is being compiled, perhaps for the sake of one that is."""
        self._depth += 1
        self(math.nan, "")

    def on_end(self, event: event.Event) -> None:
        """One is compiled."""
        self._done += 1
        self._depth -= 1


def waiting(progress: Progress, what: str) -> Callable[[], None]:
    """What tells a progress, whenever it is called, that one waits for what another process does; that it compiles
    kernels, as long as it has to."""
    compiling, cold = _Compiling(silent), not _compiled()

    def tell() -> None:
        nonlocal cold
        cold = cold and not _compiled()
        progress(math.nan if cold else 0.0, compiling.text() if cold else what)

    return tell


@contextmanager
def telling(progress: Progress) -> Iterator[Progress]:
    """A progress that forwards to the one given, and says so while kernels are being compiled."""
    compiling = _Compiling(progress)
    event.register("numba:compile", compiling)
    try:
        yield compiling
    finally:
        event.unregister("numba:compile", compiling)
