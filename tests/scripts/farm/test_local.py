"""The graph on this machine, by several processes."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

import pytest

from lipac.lipac_addon.farm.layout import FarmShot, read_json
from lipac.scripts.lipac import main

from ...processes import INTERRUPTIBLE
from .conftest import FARM
from .same import assert_same_shot


def command(scene: Path, folder: Path) -> list[str]:
    fewer = ["--verify", "1"]  # processes than on a farm
    return ["farm", str(scene), "-o", str(folder), "--for", "local", "--workers", "2", *FARM, *fewer]


def test_stopped_and_gone_on_with(flythrough: Path, one_process: FarmShot, tmp_path: Path) -> None:
    """Ctrl-C in the midst of the analysis ends the processes that it has started; the same command then does the rest:
    the pictures of one process."""
    arguments = [sys.executable, "-m", "lipac.scripts.lipac", *command(flythrough, tmp_path)]
    process = subprocess.Popen(arguments, stderr=subprocess.PIPE, text=True, **INTERRUPTIBLE)
    limit = time.monotonic() + 200
    while not list(tmp_path.glob("analysis/*.npz")) and process.poll() is None and time.monotonic() < limit:
        time.sleep(0.01)
    process.send_signal(2)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130, err
    there = set(tmp_path.glob("analysis/*.npz"))
    time.sleep(1.0)
    assert set(tmp_path.glob("analysis/*.npz")) == there, "something goes on"
    assert main(command(flythrough, tmp_path)) == 0
    assert_same_shot(FarmShot.load(tmp_path), one_process)
    certificate = read_json(tmp_path / "certificate.json")
    assert certificate is not None
    assert certificate["verified"] == 1


def test_a_task_that_fails_is_told_in_a_line(
    flythrough: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert main([*command(flythrough, tmp_path), "--frames", "1-2", "--lipac", str(tmp_path / "nothing")]) == 2
    err = capfd.readouterr().err
    assert err == f"lipac farm: no such program: {tmp_path / 'nothing'}; name one by --blender or --lipac\n"
