"""`lipac evaluate --family`: scenes in child processes that may crash and hang, resumed where it was stopped, and the
table."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from lipac.scripts import lipac
from lipac.scripts.studies import family

# Does as a child process does, for scenes that nobody renders: 2 crashes, 3 hangs, 4 says something odd first, 5
# raises; the others are done.
FAKE = """
import json, os, sys, time
say = lambda what: print("lipac-child " + json.dumps(what), flush=True)
say({"ready": True})
change = {"mean": {"low": 0.0, "value": 0.01, "high": 0.02}, "worst": {"low": 0.0, "value": 0.1, "high": 0.2}}
for line in sys.stdin:
    seed = int(line)
    if seed == 2:
        print("out of memory", file=sys.stderr, flush=True)
        os._exit(9)
    if seed == 3:
        time.sleep(1000)
    if seed == 4:
        print("Blender says", flush=True)
    if seed == 5:
        say({"seed": seed, "failed": "ValueError: no"})
        continue
    twice = seed == 6
    say({
        "seed": seed, "draw": {"kind": "lawn", "mean": 0.01, "worst": 0.05, "pixels": 1.0}, "instances": 100,
        "active": 10, "analysis_s": 1.0, "cycles_64_s": 2.0, "verdict": "twice" if twice else "held",
        "verdict_mean": "held", "verdict_worst": "twice" if twice else "held",
        "verdict_detail": "open",
        "times": 2.5 if twice else 0.0, "changes": {"luminance": change, "colour": change}, "process": os.getpid(),
    })
"""


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(family, "COMMAND", (sys.executable, "-c", FAKE))


def records(folder: Path) -> dict[int, dict]:
    return {record["seed"]: record for record in json.loads((folder / "family.json").read_text())}


def test_crashes_and_hangs_are_recorded_and_the_others_done(
    tmp_path: Path, fake: None, capfd: pytest.CaptureFixture[str]
) -> None:
    command = ["evaluate", "--family", "7", "--first", "1", "-o", str(tmp_path), "--jobs", "2", "--time-limit", "2"]
    assert lipac.main(command) == 0
    shown = capfd.readouterr()
    done = records(tmp_path)
    assert sorted(done) == [1, 2, 3, 4, 5, 6, 7]
    assert done[2]["failed"] == "crashed with status 9: out of memory"
    assert done[3]["failed"] == "over 2 s"
    assert done[5]["failed"] == "ValueError: no"
    assert [done[k]["verdict"] for k in (1, 4, 6, 7)] == ["held", "held", "twice", "held"]
    text = (tmp_path / "family.md").read_text()
    assert text in shown.out
    assert "7 of 7" in shown.err
    assert "| all | 4 | 75.0 % | 75.0 % | 100.0 % | 75.0 % | 1 | 100.0 % | 10 % | 0.50 |" in text
    assert "| 6 | lawn | 100 | 1 | 1, 5 % | 1 % / 1 % | 10 % / 10 % | 2.50 |" in text
    assert "- 3: over 2 s" in text


def test_what_is_done_is_not_done_again(tmp_path: Path, fake: None, monkeypatch: pytest.MonkeyPatch) -> None:
    command = ["evaluate", "--family", "2", "--first", "7", "-o", str(tmp_path), "--jobs", "1", "--quiet"]
    assert lipac.main(command) == 0
    first = records(tmp_path)
    command[2] = "3"
    assert lipac.main(command) == 0
    second = records(tmp_path)
    assert {k: r["process"] == first[k]["process"] for k, r in second.items() if k in first} == {7: True, 8: True}
    assert sorted(second) == [7, 8, 9]
    assert lipac.main([*command, "--samples", "8"]) == 0  # by other options, all of them
    assert all(r["options"]["samples"] == 8 for r in records(tmp_path).values())
    monkeypatch.setattr(family, "COMMAND", (sys.executable, "-c", "raise SystemExit(3)"))
    assert lipac.main(command) == 1  # no process starts, and something is to do
    assert lipac.main([*command, "--samples", "8"]) == 0


def test_time_is_kept(tmp_path: Path, fake: None, monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter(range(0, 1000, 10))
    monkeypatch.setattr(family.time, "monotonic", lambda: next(clock))
    assert (
        lipac.main(
            [
                "evaluate", "--family", "90", "--first", "10", "-o", str(tmp_path), "--jobs", "1", "--stop-after", "45",
                "--quiet"
            ]
        )
        == 0
    )
    assert 1 <= len(records(tmp_path)) <= 5


def test_bad_input_is_one_line(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    for more in (["scene.blend"], ["--first", "-1"], ["--device", "abacus"]):
        assert lipac.main(["evaluate", "--family", "2", "-o", str(tmp_path), *more]) == 2
        assert capfd.readouterr().err.count("\n") == 1


def test_a_real_scene_is_judged(tmp_path: Path) -> None:
    """Seed 103 is confetti of half a pixel: built, analysed, culled and rendered in a child process."""
    options = ["--resolution", "64x36", "--samples", "8", "--instances", "200", "--jobs", "1", "--quiet"]
    assert lipac.main(["evaluate", "--family", "1", "--first", "103", "-o", str(tmp_path), *options]) == 0
    record = records(tmp_path)[103]
    assert "failed" not in record, record
    assert record["options"]["device"] == "cpu"
    assert record["draw"]["kind"] == "confetti"
    assert 200 <= record["instances"] <= 212
    assert 0 < record["active"] < record["instances"]
    assert record["verdict"] in ("held", "open")
    assert record["judge_samples"] in (16, 48, 112)
    assert set(record["changes"]) == {"luminance", "colour", "detail"}
    assert record["changes"]["detail"]["worst"]["value"] > 0  # something was culled that is seen
    assert record["analysis_s"] > record["sync_s"] > 0 < record["cycles_64_s"]
