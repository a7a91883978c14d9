"""The benchmark on graphics cards: what is kept from call to call, what is said of what was not run, the tables."""

import json
import sys

import pytest

from lipac.scripts.lipac import main
from lipac.scripts.studies import bench_gpu
from lipac.scripts.studies.bench_gpu import OUT_OF_TIME, Plan, page, run

ROW = {
    "wall_s": 2.0,
    "render_s": 1.0,
    "first_sample_s": None,
    "device": "CUDA: a card",
    "device_bytes": None,
    "card_bytes": 5 << 30,
    "host_bytes": 1 << 30,
}


@pytest.fixture
def measured(monkeypatch):
    """Measurements are made up; which ones were asked for."""
    asked = []

    def measure(_folder, _plan, case, _prepared, limit):
        assert 0 < limit <= 300
        asked.append(case)
        return ROW | {"instances": None, "active": None}

    monkeypatch.setattr(bench_gpu, "_measure", measure)
    return asked


def test_a_call_goes_on_where_the_one_before_stopped(tmp_path, measured):
    plan = {"scenes": {"crowd": 5}, "devices": ("cuda",), "samples": (32,)}
    text = run(tmp_path, Plan(**plan, within=0.0))
    assert measured == []
    assert text.count(OUT_OF_TIME) == 3
    assert text == (tmp_path / "gpu.md").read_text()
    text = run(tmp_path, Plan(**plan))
    assert measured == [("crowd", "cuda", 32, way) for way in ("full", "culled", "baked")]
    assert OUT_OF_TIME not in text
    run(tmp_path, Plan(**plan))
    assert len(measured) == 3
    run(tmp_path, Plan(**plan, again=True))
    assert len(measured) == 6


def test_the_tables_tell_what_is_not_known(tmp_path):
    name = "crowd-5 64x36 cuda 32"
    rows = {
        f"{name} full": ROW | {"instances": None, "active": None},
        f"{name} culled": ROW | {"wall_s": 0.5, "instances": 10, "active": 4},
    }
    text = page(
        {
            "machine": "a machine",
            "prepared": {"culled crowd-5 64x36": 3.0},
            "measured": rows | {f"{name} baked": {"not_run": "no card"}},
        }
    )
    full, culled = (next(line for line in text.splitlines() if f"samples, {way}" in line) for way in ("full", "culled"))
    assert full.count("unknown") == 2
    assert "5.37 GB" in full
    assert "0.50 (4 times)" in culled
    assert "4 of 10" in culled
    assert f"- {name} baked: no card" in text
    assert "crowd-5 64x36: 3.0 s" in text


def test_children_that_fail_or_take_too_long_are_not_run():
    assert bench_gpu._child(["-c", "import sys; print('a', 'line', file=sys.stderr); sys.exit(2)"], 60) == {
        "not_run": "a line"
    }
    assert bench_gpu._child(["-c", "import time; time.sleep(60)"], 1.0) == {"not_run": "ended after 1 s"}
    assert bench_gpu._child(["-c", "pass"], 60)["wall_s"] > 0


BAD = [
    (["--devices", "gpu"], "--devices: no 'gpu'"),
    (["--scenes", "city"], "--scenes: no 'city'"),
    (["--scenes", "crowd:x"], "'x' is no number"),
    (["--samples", "0"], "'0' is no number"),
    (["--only", "rays"], "give it alone"),
]


@pytest.mark.parametrize(("arguments", "says"), BAD)
def test_bad_options(tmp_path, capfd, arguments, says):
    assert main(["bench", "-o", str(tmp_path), "--only", "gpu", *arguments]) == 2
    err = capfd.readouterr().err
    assert says in err
    assert err.count("\n") == 1


@pytest.mark.slow
def test_a_file_is_rendered_as_it_is(tmp_path):
    """By a child of the benchmark, with what a baked copy has culled."""
    scene = tmp_path / "crowd.blend"
    assert main(["demo", "crowd", "-o", str(scene), "--instances", "2", "--quiet"]) == 0
    done = bench_gpu._child(
        ["-m", "lipac.scripts.studies.bench_gpu", str(scene), "cpu", "1", "16", "9", str(tmp_path)], 120
    )
    assert "not_run" not in done, done
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["frames"][0]["device"].startswith("CPU: ")
    assert report["totals"]["peak_bytes"] > 0 or sys.platform not in ("linux", "darwin", "win32")
    assert bench_gpu._child(
        ["-m", "lipac.scripts.studies.bench_gpu", str(scene), "hip", "1", "16", "9", str(tmp_path)], 120
    )["not_run"].startswith("--device hip")
