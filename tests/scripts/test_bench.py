"""The benchmark measures what it says: both loops trace the same rays to the same hits, the peers render the same
picture, the table reads the figures."""

from __future__ import annotations

import ctypes
from pathlib import Path

import numpy as np
import pytest

from lipac.core.accel.blas import BlasCache
from lipac.core.accel.embree import lib
from lipac.core.accel.tlas import Tlas
from lipac.core.scene.bounds import world_bounds
from lipac.core.scene.mesh import Mesh
from lipac.core.scene.model import RAY_TYPES, Instances
from lipac.scripts import bench
from lipac.scripts.studies import bench_tracing, compare


def _tetrahedra(count: int) -> tuple[Tlas, Instances]:
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32)
    mesh = Mesh(corners, np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.uint32))
    transform = np.tile(np.eye(3, 4, dtype=np.float32), (count, 1, 1))
    transform[:, :, 3] = np.random.default_rng(1).uniform(-5, 5, (count, 3))
    index = np.zeros(count, np.int32)
    bounds = world_bounds(transform, np.array([[[0, 0, 0], [1, 1, 1]]], np.float32), index)
    instances = Instances(transform, index, index, np.full(count, 31, np.uint8), bounds)
    blas = BlasCache([mesh])
    blas.need(index)
    return Tlas(instances, blas, np.ones(count, bool)), instances


def test_bare_loop_and_feedback_loop_meet_the_same(tmp_path: Path) -> None:
    library = bench_tracing._compiled(tmp_path)
    if library is None:
        pytest.skip("no C compiler")
    tlas, instances = _tetrahedra(200)
    rng = np.random.default_rng(2)
    rays = np.concatenate([rng.uniform(-5, 5, (3_000, 3)), rng.normal(size=(3_000, 3))], 1).astype(np.float32)
    bare = library.bare_loop(
        ctypes.cast(lib.rtcIntersect1, ctypes.c_void_p), int(tlas.handle), rays.ctypes.data, len(rays), 3
    )
    hits = np.zeros((len(instances), RAY_TYPES), np.int64)
    counters = np.zeros((0, RAY_TYPES), np.int64)
    bench_tracing._feedback_loop(
        tlas.handle, tlas.ids, tlas.first, np.uint64(0), counters, 0, rays, 0, len(rays), hits, 0
    )
    assert 0 < bare < len(rays)
    assert hits.sum() == bare


def test_interleaved_jobs_take_turns_and_give_medians() -> None:
    order: list[str] = []
    seconds = {"a": iter([5.0, 1.0, 2.0]), "b": iter([1.0, 1.0, 9.0])}

    def job(name: str) -> float:
        order.append(name)
        return next(seconds[name])

    assert bench_tracing.interleaved({"a": lambda: job("a"), "b": lambda: job("b")}, 3) == {"a": 2.0, "b": 1.0}
    assert order == ["a", "b"] * 3


def test_report_says_machine_command_peers_and_ratios() -> None:
    error = {"flip": 0.002, "relmse": 0.001, "rmse": 0.0, "rmse_p99": 0.0}
    run = {"work_s": 30.0, "process_s": 40.0, "peak_bytes": 2e9}
    results = {
        "rays": {
            "machine": "M",
            "cases": [{"case": "all active", "rays": "camera", "ours": 9e6, "bare": 1e7, "ratio": 0.9}],
        },
        "extraction": {"machine": "M", "seconds": {"pull": 0.05, "ours": 0.1, "read": 6.0, "touch": 3.0}},
        "city": {
            "machine": "M",
            "command": "lipac render X",
            "full": run,
            "culled": {"work_s": 5.0, "process_s": 8.0, "peak_bytes": 5e8},
            "error": {"culled": error, "other-seed": {name: 10 * value for name, value in error.items()}},
        },
    }
    lines = bench.report(results).splitlines()
    assert "`lipac bench`: M." in lines

    def ratio(*words: str) -> str:
        return next(line.split("|")[5].strip() for line in lines if all(word in line for word in words))

    assert ratio("rays with feedback", "bare Embree loop") == "0.9"
    assert ratio("1M instances pulled", "read into arrays") == "120"
    assert ratio("as a core scene", "read into arrays") == "60"
    assert ratio("open file to picture") == "6"
    assert ratio("peak memory") == "0.25"
    assert ratio("error (flip)") == "0.1"
    assert any("lipac render X" in line for line in lines)


def test_a_missing_compiler_is_said(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setattr(bench_tracing.shutil, "which", lambda name: None)
    result = bench_tracing.rays(tmp_path)
    assert "compiler" in result["skipped"]
    assert "compiler" in bench.report({"rays": result | {"machine": "M"}})


def test_a_run_does_not_inherit_the_peak_memory_of_the_one_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The report of a command goes on with what its folder has; a measurement begins anew."""
    report = tmp_path / compare.CULLED / "report.json"
    report.parent.mkdir()
    report.write_text('{"totals": {"peak_bytes": 9e9}}')

    def command(*_: object) -> float:
        assert not report.exists()
        report.write_text('{"totals": {"peak_bytes": 1}}')
        return 2.0

    monkeypatch.setattr(compare, "lipac", command)
    assert compare.render(tmp_path / "scene.blend", tmp_path, compare.CULLED, ()) == {
        "totals": {"peak_bytes": 1},
        "process_s": 2.0,
    }


@pytest.mark.parametrize(
    ("target", "measured", "shown"),
    [
        (">= 5", 5.0, ">= 5"),
        (">= 5", 3.41, ">= 5, **missed**"),
        ("<= 40 s", 23.9, "<= 40 s"),
        ("<= 0.4", 0.5, "<= 0.4, **missed**"),
        ("", 1.0, ""),
    ],
)
def test_missed_targets_are_marked(target: str, measured: float, shown: str) -> None:
    assert bench.marked(target, measured) == shown
