"""Compiling is said, and nothing else meanwhile."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numba
import pytest

from lipac.core.kernels import KERNELS, LAST, telling


def test_compiling_is_said_and_nothing_else_meanwhile():
    said = []

    @numba.njit
    def inner(x):
        return x + 1

    @numba.njit
    def outer(x):
        return inner(x) * 2

    with telling(lambda fraction, what: said.append((fraction, what))) as progress:
        progress(0.5, "tracing")
        assert outer(3) == 8
        progress(0.6, "building")
    outer(3.0)  # outside: not told
    assert said[0] == (0.5, "tracing")
    assert said[-1] == (0.6, "building")
    assert len(said) == 4
    assert all(math.isnan(fraction) and what.startswith("compiling kernels") for fraction, what in said[1:-1])


def test_the_share_counts_what_other_processes_compiled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "core_1"
    folder.mkdir()
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    said: list[str] = []

    @numba.njit
    def kernel(x):
        return x + 1

    with telling(lambda fraction, what: said.append(what)):
        kernel(3)
        for k in range(KERNELS // 2):
            (folder / f"{k}.nbi").write_bytes(b"")
        kernel(3.0)
    shares = [int(share) for text in said for share in re.findall(r"(\d+)%", text)]
    assert shares == [0, round(50 * (1 - LAST))]
    assert "left" in said[1]
