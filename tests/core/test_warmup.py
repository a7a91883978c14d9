"""Kernels are loaded ahead only where they are compiled, and compiling is said."""

from __future__ import annotations

import math
import re
import subprocess
import sys
from pathlib import Path

import numba
import pytest
from numba.core.event import Event, EventStatus

from lipac.core import warmup
from lipac.core.culling.analysis import analyze
from lipac.core.culling.options import CullOptions
from lipac.core.scene import model as s
from lipac.core.tracing.tile_kernel import trace_tiles
from lipac.core.warmup import KERNELS, LAST, telling

from . import scenes

LOAD = """
import threading
from lipac.core.warmup import load_ahead
load_ahead()
for thread in threading.enumerate():
    if thread.name == "kernels":
        thread.join()
import sys
kernels = sys.modules.get("lipac.core.tracing.tile_kernel")
print("LOADED", 0 if kernels is None else sum(kernels.trace_tiles.stats.cache_hits.values()))
"""
UNLOADED = LOAD.replace("load_ahead()\n", "load_ahead(30.0)\nfrom lipac.core.warmup import not_needed\nnot_needed()\n")
TYPES = (numba.int64[:, ::1], numba.int64[::1], numba.uint64[::1])


@pytest.mark.parametrize("cold", [False, True])
def test_kernels_are_loaded_ahead_where_they_are_compiled(cold, tmp_path, monkeypatch):
    if cold:
        monkeypatch.setenv("LIPAC_CACHE_DIR", str(tmp_path))
    else:
        trace_tiles.compile(TYPES)
    done = subprocess.run([sys.executable, "-c", LOAD], stdout=subprocess.PIPE, text=True, check=True)
    assert done.stdout.split() == ["LOADED", "0" if cold else "1"]


def test_nothing_is_loaded_that_is_not_needed_after_all() -> None:
    trace_tiles.compile(TYPES)
    done = subprocess.run([sys.executable, "-c", UNLOADED], stdout=subprocess.PIPE, text=True, check=True)
    assert done.stdout.split() == ["LOADED", "0"]


def test_the_loaded_kernel_is_the_one_that_tracing_calls():
    scene = scenes.build([scenes.cube()], [(0, scenes.placed((0, 3, 0)), 0)], [s.default_material()])
    assert analyze(scene, CullOptions(width=16, paths=1)).stats["rays"] > 0
    assert trace_tiles.signatures == [TYPES]


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


def test_what_another_process_compiles_is_said_until_it_is_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    said: list[str] = []
    tell = warmup.waiting(lambda fraction, what: said.append(what), "waiting")
    (tmp_path / "core_1").mkdir()
    tell()
    for k in range(KERNELS // 2):
        (tmp_path / "core_1" / f"{k}.nbi").touch()
    tell()
    (tmp_path / "core_1" / "tile_kernel.trace_tiles-1.nbi").touch()
    tell()
    assert said[0].startswith("compiling kernels, the first time only: 0%")
    assert said[1].startswith(f"compiling kernels, the first time only: {round(50 * (1 - LAST))}%, about")
    assert said[2] == "waiting"


def test_what_takes_longer_than_expected_is_not_about_to_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No time is told where the share is the most that is told."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    now, said = [0.0], []
    monkeypatch.setattr(warmup.time, "monotonic", lambda: now[0])
    compiling = warmup._Compiling(lambda fraction, what: said.append(what))
    (tmp_path / "core_1").mkdir()
    for seconds, kept in ((0.0, 0), (10.0, KERNELS), (11.0, KERNELS), (1000.0, KERNELS)):
        now[0] = seconds
        for k in range(kept):
            (tmp_path / "core_1" / f"{k}.nbi").touch()
        compiling.on_start(Event("numba:compile", EventStatus.START))
    assert ["left" in text for text in said] == [False, True, True, False]
    assert "99%" in said[-1]
