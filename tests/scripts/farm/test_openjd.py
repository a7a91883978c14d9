"""The job template: as the specification's own command reads it, and run by it."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from lipac.lipac_addon.farm.layout import FarmShot, read_json
from lipac.scripts.lipac import main

from .conftest import FARM
from .same import assert_same_shot

OPENJD = [sys.executable, "-m", "openjd"]
STEPS = {
    "analyze": [],
    "unite": ["analyze"],
    "judge": ["unite"],
    "render": ["unite"],
    "verify": ["judge", "render"],
    "certify": ["verify"],
}


def openjd(*arguments: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run([*OPENJD, *map(str, arguments)], capture_output=True, text=True, timeout=300, check=False)


@pytest.fixture(scope="module")
def job(flythrough: Path, tmp_path_factory: pytest.TempPathFactory) -> FarmShot:
    """Written, one frame measured."""
    folder = tmp_path_factory.mktemp("openjd")
    assert main(["farm", str(flythrough), "-o", str(folder), *FARM]) == 0
    return FarmShot.load(folder)


def test_the_template_is_valid_and_says_what_is_needed(job: FarmShot) -> None:
    path = job.folder / "template.json"
    done = openjd("check", path)
    assert done.returncode == 0, done.stdout + done.stderr
    template, measured = json.loads(path.read_text()), json.loads((job.folder / "measured.json").read_text())
    assert {s["name"]: [d["dependsOn"] for d in s.get("dependencies", [])] for s in template["steps"]} == STEPS
    asked = {
        s["name"]: s["hostRequirements"]["amounts"][0]["min"] * 2**20
        for s in template["steps"]
        if "hostRequirements" in s
    }
    assert asked["analyze"] == pytest.approx(1.5 * measured["analysis"]["peak_bytes"], abs=2**20)
    assert asked["render"] == pytest.approx(1.5 * measured["full"]["peak_bytes"], abs=2**20)
    assert asked["verify"] == max(asked["analyze"], asked["render"])
    for step in template["steps"]:
        run = step["script"]["actions"]["onRun"]
        assert run["timeout"] >= 3600
        assert run["cancelation"]["mode"] == "NOTIFY_THEN_TERMINATE"
    assert str(job.folder) not in path.read_text(), "paths of this machine belong into parameters"


def test_chunks(job: FarmShot) -> None:
    """As the command counts them: three and two frames."""
    done = openjd(
        "summary", job.folder / "template.json", "-p", f"file://{job.folder / 'parameters.json'}", "--output", "json"
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert {s["name"]: s["total_tasks"] for s in json.loads(done.stdout)["steps"]}.items() >= {
        "unite": 1,
        "verify": 2,
        "certify": 1,
    }.items()


def descendants(pid: int) -> list[int]:
    """Processes that a process has started, and that these have."""
    tables = (Path(f"/proc/{pid}/task").glob("*/children")) if Path(f"/proc/{pid}").exists() else ()
    children = [int(child) for table in tables for child in table.read_text().split()]
    return [one for child in children for one in (child, *descendants(child))]


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="needs /proc")
def test_killed_in_the_middle_and_run_again(job: FarmShot, one_process: FarmShot) -> None:
    """All its processes are killed when some pictures are there, and a half-written file is left behind: then the rest
    is done, to the same pictures."""
    run = [
        *OPENJD,
        "run",
        str(job.folder / "template.json"),
        "-p",
        f"file://{job.folder / 'parameters.json'}",
        "--step",
        "certify",
        "--run-dependencies",
    ]
    process = subprocess.Popen(run, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    limit = time.monotonic() + 200
    while not job.picture(2).exists() and process.poll() is None and time.monotonic() < limit:
        time.sleep(0.01)
    for pid in (process.pid, *descendants(process.pid)):
        os.kill(pid, signal.SIGKILL)
    process.wait()
    assert job.picture(2).exists()
    assert not job.picture(5).exists()
    before = {path: path.stat().st_mtime_ns for path in (job.analysis(1), job.culled, job.picture(1), job.picture(2))}
    (job.folder / "pictures" / ".frame_0005.0123456789abcdef.part.png").write_bytes(b"half a picture")
    done = subprocess.run(run, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert {path: path.stat().st_mtime_ns for path in before} == before
    assert_same_shot(job, one_process)
    certificate = read_json(job.folder / "certificate.json")
    assert certificate is not None
    assert [frame["frame"] for frame in certificate["frames"]] == list(range(1, 6))
    assert (certificate["verified"], certificate["broken"]) == (2, 0)
