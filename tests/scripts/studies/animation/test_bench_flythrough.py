"""The figures of animated scenes: what appears and when it is there, changes of states, and the page that tells
them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lipac.scripts.studies.animation import report as animation_report
from lipac.scripts.studies.animation.bench_flythrough import (
    AFTER,
    BEFORE,
    Appearance,
    appearances,
    latencies,
    state_changes,
)

F = BEFORE + 12


def test_what_appears_is_new_and_stays() -> None:
    """Rows: there from the first frame on; new; new, but gone at once; new, but seen by few before; back after a short
    while."""
    met = np.zeros((F, 5), np.int64)
    met[:, 0] = 9
    met[BEFORE + 2 :, 1] = 9
    met[BEFORE + 2, 2] = 9
    met[BEFORE + 1, 3], met[BEFORE + 2 :, 3] = 1, 9
    met[:, 4], met[BEFORE : BEFORE + 3, 4] = 9, 0
    assert appearances(met, 5) == [Appearance(BEFORE + 2, 1)]
    met[BEFORE + 2 + AFTER - 1, 1] = 0  # once not, and still there
    assert appearances(met, 5) == [Appearance(BEFORE + 2, 1)]


def test_latency_is_counted_from_the_appearance() -> None:
    """At once, after two frames, never, and active before."""
    states = np.zeros((8, 4), bool)
    states[3:, 0] = states[5:, 1] = states[2:, 3] = True
    found = [Appearance(3, k) for k in range(4)]
    assert latencies(found, states) == {"before": 1, "frames": [1, 0, 1], "never": 1}
    assert latencies([], states) == {"before": 0, "frames": [], "never": 0}


def test_changes_of_states() -> None:
    """One of two instances that are ever active goes on, off soon after, and on again much later; the other is on from
    the start."""
    states = np.zeros((41, 3), bool)
    states[:, 0] = True
    states[5:8, 1] = states[30:, 1] = True
    found = state_changes(states)
    assert found == {
        "changes": pytest.approx(100 * 3 / (2 * 40)),
        "undone": pytest.approx(100 * 1 / (2 * 40)),
        "ever": 2,
    }
    assert state_changes(np.zeros((3, 2), bool))["changes"] == 0


def crowd() -> dict[str, Any]:
    def frame(number: int) -> dict[str, Any]:
        whole = {"active": 210, "hitboxes": 0, "blas_bytes": 1000, "blas_held_bytes": 1000, "blas_s": 0.5}
        return {
            "frame": number,
            "instances": 210,
            "whole": whole,
            "culled": {**whole, "active": 30, "blas_bytes": 80, "blas_held_bytes": 130, "blas_s": 0.05},
        }

    error = {"frame": 4, "mean": 0.003, "mean_ci": 0.0004, "worst": 0.03, "worst_ci": 0.01, "seed": 0.01}
    return {
        "machine": "M",
        "size": [4, 4],
        "figures": 200,
        "triangles": 40_000,
        "samples": 64,
        "frames": [frame(k) for k in range(1, 8)],
        "errors": [error],
    }


def growth() -> dict[str, Any]:
    def city(count: int, seconds: float) -> dict[str, Any]:
        culled = {
            "build_s": 0.1,
            "trace_s": seconds,
            "feedback_s": 0.1,
            "active": 100,
            "hitboxes": 900,
            "iterations": 1,
        }
        culled["advance_s"] = seconds
        frame = {"frame": 1, "read_s": 0.0, "culled": culled, "whole": {**culled, "build_s": count * 1e-6}}
        return {
            "instances": count,
            "cold": {"asked": 150, "met": 120, "active": 100, "rounds": 5, "meshes": 3},
            "frames": [frame] * 6,
        }

    return {"machine": "M", "size": [4, 4], "cities": [city(10_000, 1.0), city(1_000_000, 1.5)]}


def test_the_page_reads_the_figures(tmp_path: Path) -> None:
    table = animation_report.write(
        tmp_path, {"crowd": crowd(), "growth": growth(), "character": {"skipped": "not here", "machine": "M"}}
    )

    def measured(*words: str) -> str:
        return next(line.split("|")[2].strip() for line in table.splitlines() if all(word in line for word in words))

    assert measured("200 figures of 200 triangles", "bytes held") == "0.130"
    assert measured("milliseconds") == "0.100"
    assert measured("error") == "0.3 % ± 0.04 %"
    assert measured("settled frame", "10,000 to 1,000,000") == "1.50 times"
    assert measured("without tracing") == "1.00 times"
    assert measured("cold start") == "1.50"
    assert measured("entries of the TLAS") == "0.1 %"
    page = (tmp_path / "animation.md").read_text()
    assert table in page
    assert "Crowd of a supplied" not in page
    for name in ("crowd-blas.png", "growth.png"):
        assert f"(animation/{name})" in page
        assert (tmp_path / "animation" / name).stat().st_size > 1000
