"""Kernels over parts of a range: all of it once, also where the system gives no threads."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from lipac.core import threads


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
