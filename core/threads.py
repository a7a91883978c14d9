"""Threads for kernels that run without Python's lock: how many there may be, how many are worth while, and those that
wait for work."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor

_pools: dict[int, ThreadPoolExecutor] = {}  # by number of threads: starting some takes as long as a small trace
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pools.clear)  # whose threads are the parent's
_WORTH_WHILE = 1 << 15  # items of a cheap kernel under which one thread is as fast
_most = 0  # threads at a time that were asked for, 0: no limit


def limit(threads: int) -> None:
    """From now on no kernel of this process takes more than so many threads at a time; 0: as many as there are
    processors."""
    global _most  # noqa: PLW0603 - a process has one such number, as it has one set of processors
    _most = threads


def processors() -> int:
    """Processors that this process may use: of a machine whose others are another's, those alone; within `limit`."""
    there = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(_most or there, there)


def start(work: Callable[[], None], calls: int, threads: int = 0) -> set[Future[None]]:
    """Call work so many times at once, on so many threads (0: all processors), in which it must not call this itself.
    Raises RuntimeError where the system has none to give; no call is left then."""
    threads = threads or processors()
    if threads not in _pools:
        _pools[threads] = ThreadPoolExecutor(threads, "lipac")
    pool = _pools[threads]
    try:
        return {pool.submit(work) for _ in range(calls)}
    except RuntimeError:
        _pools.pop(threads, None)
        pool.shutdown(cancel_futures=True)
        raise


def over_parts(kernel: Callable[[int, int], None], count: int, worth_while: int = _WORTH_WHILE) -> None:
    """Call kernel(start, stop) for parts of range(count), together all of it, on several threads. worth_while: items
    under which one thread is as fast."""
    parts = min(processors(), count // worth_while)
    if parts <= 1:
        kernel(0, count)
        return
    left = iter([(count * k // parts, count * (k + 1) // parts) for k in range(parts)])

    def take() -> None:
        for first, stop in left:  # list iterators hand out each item once, whoever asks
            kernel(first, stop)

    try:
        running = start(take, parts)
    except RuntimeError:  # no threads to be had: what is left is done on this one
        running = set()
        take()
    for future in running:
        future.result()
