"""Standard streams without a reader, full or closed, a home that cannot be written, a locale without UTF-8, and Ctrl-C
that is to be ignored: the work is done all the same."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from ...lipac_addon.conftest import ground_and_boxes
from ...processes import INTERRUPTIBLE, saved

pytestmark = pytest.mark.skipif(os.name == "nt", reason="POSIX streams and signals")
FRUSTUM = ["--cull", "frustum", "--resolution", "32x18", "--samples", "1"]


@pytest.fixture(scope="module")
def blend(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The boxes as a .blend."""
    return saved(ground_and_boxes, tmp_path_factory.mktemp("scene") / "boxes.blend")


def start(arguments: list[Any], **options: Any) -> subprocess.Popen[str]:
    return subprocess.Popen([sys.executable, "-m", "lipac.scripts.lipac", *map(str, arguments)], text=True, **options)


@pytest.mark.parametrize("how", ["closed", "no reader", "full"])
def test_lost_streams_end_no_job(blend: Path, tmp_path: Path, how: str) -> None:
    options: dict[str, Any] = {}
    if how == "closed":
        options["preexec_fn"] = lambda: os.closerange(0, 3)
    elif how == "full":
        options["stdout"] = options["stderr"] = open("/dev/full", "w")  # noqa: SIM115
    else:
        for name in ("stdout", "stderr"):
            read, options[name] = os.pipe()
            os.close(read)
    process = start(["render", blend, "-o", tmp_path, *FRUSTUM], **options)
    assert process.wait(timeout=120) == 0
    assert (tmp_path / "frame_0001.png").exists()
    assert (tmp_path / "report.json").exists()


def test_a_machine_without_a_writable_home(blend: Path, tmp_path: Path) -> None:
    """Kernels of the analysis are compiled for the one process: here none is needed but those of the extraction."""
    (tmp_path / "file").write_text("")
    environment = {
        name: value
        for name, value in os.environ.items()
        if name not in ("LIPAC_CACHE_DIR", "XDG_CACHE_HOME", "HOME", "NUMBA_CACHE_DIR")
    }
    environment |= {"TMPDIR": str(tmp_path), "HOME": str(tmp_path / "file")}
    process = start(
        ["render", blend, "-o", tmp_path / "out", *FRUSTUM, "--quiet"],
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
    )
    _, err = process.communicate(timeout=300)
    assert (process.returncode, err) == (0, "")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["file", "out"]  # the temporary folder is gone


def test_names_of_files_in_a_locale_without_utf_8(blend: Path, tmp_path: Path) -> None:
    scene = tmp_path / "Bäume ☃.blend"
    scene.write_bytes(blend.read_bytes())
    process = start(
        ["render", scene, "-o", tmp_path / "Ördner", *FRUSTUM, "--quiet"],
        env=os.environ | {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        encoding="utf-8",
    )
    _, err = process.communicate(timeout=300)
    assert (process.returncode, err) == (0, "")
    assert "Bäume ☃.blend" in (tmp_path / "Ördner" / "report.html").read_text(encoding="utf-8")


def test_ctrl_c_that_is_ignored_stays_ignored(blend: Path, tmp_path: Path) -> None:
    """As a shell starts what runs in the background."""
    arguments = ["render", blend, "-o", tmp_path, "--frames", "1-3", *FRUSTUM, "--quiet"]
    process = start(
        arguments,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_IGN),
    )
    end = time.monotonic() + 120
    while process.poll() is None and time.monotonic() < end:
        process.send_signal(signal.SIGINT)
        time.sleep(0.1)
    assert process.returncode == 0
    assert len(list(tmp_path.glob("*.png"))) == 3


IN_THE_MIDST = """
import os, signal, sys
from lipac.scripts.lipac import main
import lipac.lipac_addon.demo as demo
build = demo.build
demo.build = lambda *args: (build(*args), os.kill(os.getpid(), signal.SIGINT), sum(range(10**6)))
sys.exit(main(sys.argv[1:]))
"""


def test_ctrl_c_ends_a_demo(tmp_path: Path) -> None:
    """Between building and saving, where an exception in the midst of Blender's work would be lost: nothing is
    written."""
    arguments = ["demo", "mirror-city", "-o", str(tmp_path / "city.blend"), "--instances", "1000"]
    done = subprocess.run(
        [sys.executable, "-c", IN_THE_MIDST, *arguments], capture_output=True, text=True, check=False, **INTERRUPTIBLE
    )
    assert done.returncode == 130
    assert done.stderr.endswith("stopped; finished frames and their report are kept\n")
    assert not list(tmp_path.iterdir())


def test_progress_goes_on_after_what_a_terminal_cannot_show() -> None:
    """A view layer's name, say, where streams are ASCII."""
    code = (
        "from lipac.scripts.command.streams import progress_of\n"
        "with progress_of(False) as told:\n"
        "    told.interval = 0.0\n"
        "    for what in ('\\u2603', 'more'):\n"
        "        told(0.5, what)\n"
    )
    plain = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    command = [sys.executable, "-c", code]
    said = subprocess.run(command, env=os.environ | plain, check=True, capture_output=True, text=True).stderr
    assert "\\u2603" in said and "more" in said
