"""Kernels over parts of a range: all of it once, also where the system gives no threads, and on no more than may be."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from lipac.core import threads
from lipac.core.accel import embree
from lipac.core.culling.analysis import analyze
from lipac.core.culling.options import CullOptions

from .culling.test_loop import stage


@pytest.fixture(autouse=True)
def no_limit() -> Iterator[None]:
    yield
    threads.limit(0)


@pytest.mark.parametrize("refused", [False, True])
def test_each_item_is_done_once(refused: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(threads, "_pools", {})
    monkeypatch.setattr(threads, "processors", lambda: 4)
    if refused:

        def start(_thread: threading.Thread) -> None:
            raise RuntimeError("can't start new thread")

        monkeypatch.setattr(threading.Thread, "start", start)
    done = np.zeros(1001, np.int64)

    def kernel(first: int, stop: int) -> None:
        done[first:stop] += 1

    threads.over_parts(kernel, len(done), worth_while=10)
    assert (done == 1).all()


@pytest.mark.parametrize(("asked", "may"), [(0, 4), (3, 3), (1, 1)])
def test_no_kernel_takes_more_threads_than_were_asked_for(
    asked: int, may: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of traces, path logs and all other parts of an analysis, and of Embree's builds."""
    if not hasattr(os, "sched_getaffinity"):
        pytest.skip("the system does not say which processors a process may use")
    monkeypatch.setattr(os, "sched_getaffinity", lambda _pid: set(range(4)))
    monkeypatch.setattr(threads, "_WORTH_WHILE", 64)
    monkeypatch.setattr(threads.over_parts, "__defaults__", (64,))
    monkeypatch.setattr(embree, "_shared", {})
    seen: list[int] = []
    start = threads.start

    def counted(work: Any, calls: int, of: int = 0) -> Any:
        seen.append(calls)
        assert (of or threads.processors()) <= may
        return start(work, calls, of)

    built: list[int] = []
    device = embree.Device

    def made(count: int = 0) -> Any:
        built.append(count)
        return device(count)

    monkeypatch.setattr(threads, "start", counted)
    monkeypatch.setattr("lipac.core.tracing.tracer.start", counted)
    monkeypatch.setattr(embree, "Device", made)
    analyze(stage(), CullOptions(width=96, paths=4, threads=asked))
    assert threads.processors() == may
    assert max(seen, default=1) == may
    assert built == [may]
