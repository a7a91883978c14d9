"""Analyses in a process of their own, while frames are rendered: what comes out is what comes out one after the
other."""

import json
import subprocess
import sys
import time
from argparse import Namespace
from pathlib import Path

import bpy
import numpy as np
import pytest

from lipac.core.errors import Cancelled, InputError
from lipac.lipac_addon.batch.ahead import Ahead
from lipac.lipac_addon.batch.engines.choices import DeviceChoice
from lipac.lipac_addon.batch.job import never
from lipac.lipac_addon.pictures import read_picture
from lipac.scripts.command import frames
from lipac.scripts.lipac import main

pytestmark = pytest.mark.slow
FRAMES = (1, 2, 3)


@pytest.fixture
def file(boxes, tmp_path):
    boxes.camera.keyframe_insert("location", frame=1)
    boxes.camera.location.x += 3
    boxes.camera.keyframe_insert("location", frame=3)
    boxes.cycles.samples = 1
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "moving.blend"))
    return tmp_path / "moving.blend"


def entries(folder):
    return json.loads((folder / "report.json").read_text())["frames"]


def test_states_and_pictures_are_those_of_one_after_the_other(file, tmp_path):
    common = [
        "render",
        str(file),
        "--frames",
        "1-3",
        "--max-error",
        "0.05",
        "--resolution",
        "48x27",
        "--seed",
        "3",
        "--quiet",
    ]
    assert main([*common, "-o", str(tmp_path / "a"), "--no-ahead"]) == 0
    assert main([*common, "-o", str(tmp_path / "b"), "--ahead"]) == 0
    assert [(tmp_path / "a" / "states" / f"frame_000{k}.npz").read_bytes() for k in FRAMES] == [
        (tmp_path / "b" / "states" / f"frame_000{k}.npz").read_bytes() for k in FRAMES
    ]
    for k in FRAMES:
        a, b = (read_picture(tmp_path / name / f"frame_000{k}.exr") for name in "ab")
        assert np.array_equal(a, b)
    theirs, ours = entries(tmp_path / "a"), entries(tmp_path / "b")
    for one, other in zip(theirs, ours, strict=True):
        assert {k: one[k] for k in ("frame", "instances", "active", "culled", "paths", "writeback", "device")} == {
            k: other[k] for k in ("frame", "instances", "active", "culled", "paths", "writeback", "device")
        }
        assert other["culled"] > 0
        assert other["wait_s"] >= 0 and "wait_s" not in one
        assert other["analysis_peak_bytes"] >= 0
    assert sorted(p.name for p in (tmp_path / "b").iterdir()) == sorted(p.name for p in (tmp_path / "a").iterdir())


def test_a_single_frame_is_analysed_elsewhere_by_wish(file, tmp_path):
    """The process that renders then has not loaded what an analysis needs."""
    common = ["render", str(file), "--max-error", "0.05", "--resolution", "48x27", "--quiet"]
    for name in ("--no-ahead", "--ahead"):
        code = (
            "import sys; from lipac.scripts.lipac import main; status = main(sys.argv[1:]); "
            "print(*(f'lipac.core.{name}' in sys.modules for name in ('culling.loop', 'tracing.tracer'))); "
            "sys.exit(status)"
        )
        done = subprocess.run(
            [sys.executable, "-c", code, *common, "-o", str(tmp_path / name), name],
            capture_output=True,
            text=True,
            check=True,
        )
        assert done.stdout.splitlines()[-1] == ("False False" if name == "--ahead" else "True True")
    a, b = ((tmp_path / name / "states" / "frame_0001.npz").read_bytes() for name in ("--no-ahead", "--ahead"))
    assert a == b
    assert "analysis_peak_bytes" in entries(tmp_path / "--ahead")[0]


def test_what_the_process_says_is_said(file, tmp_path):
    with Ahead([str(file), "--camera", "nobody"], FRAMES) as ahead:
        folder = ahead.folder
        with pytest.raises(InputError, match=r"^no camera 'nobody'"):
            ahead.take(1, tmp_path / "states.npz", never)
    assert not folder.exists()
    assert not (tmp_path / "states.npz").exists()


def test_waiting_can_be_cancelled(file, tmp_path):
    with Ahead([str(file)], FRAMES) as ahead, pytest.raises(Cancelled):
        ahead.take(1, tmp_path / "states.npz", lambda: True)
    assert ahead._process.returncode is not None


PARENT = """
import os, sys
from lipac.lipac_addon.batch.ahead import Ahead
ahead = Ahead(sys.argv[1:], (1, 3))
print("AHEAD", ahead._process.pid, ahead.folder, flush=True)
sys.stdin.read()
"""


def test_it_ends_with_who_waits_for_it_and_leaves_nothing(file, tmp_path):
    """Killed, as a farm does; whatever lies in the current folder is no module of Python's."""
    (tmp_path / "random.py").write_text("raise SystemExit('the wrong module')")
    command = [sys.executable, "-P", "-c", PARENT, str(file)]
    pipe = subprocess.PIPE
    parent = subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True, cwd=tmp_path)
    assert parent.stdin is not None and parent.stdout is not None
    line = next(line for line in parent.stdout if line.startswith("AHEAD "))  # Blender says something before
    _, pid, folder = line.strip().split(" ", 2)
    states, limit = Path(folder) / "states", time.monotonic() + 120
    while not states.exists() and time.monotonic() < limit:
        time.sleep(0.05)
    assert states.exists()
    parent.kill()
    parent.wait()
    while (Path(folder).exists() or is_alive(int(pid))) and time.monotonic() < limit:
        time.sleep(0.05)
    assert not Path(folder).exists()
    assert not is_alive(int(pid))
    parent.stdin.close()
    parent.stdout.close()


def is_alive(pid):
    """Whether there is a process, and it has not ended: nobody may have waited for it."""
    stat = Path(f"/proc/{pid}/stat")
    return stat.exists() and stat.read_text().rpartition(")")[2].split()[0] != "Z"


def test_when_it_is_done(monkeypatch):
    """By itself where the render is not on the CPU, and by wish; never where frames depend on renders, or there is no
    file for another process to open."""
    plain = {
        "scene": Path("a.blend"),
        "ahead": None,
        "cull": "light-paths",
        "bake": "frame",
        "enforce": False,
        "warm": True,
        "no_mitigation": False,
        "no_parts": False,
        "levels": False,
        "memory": None,
        "frames": (1, 2),
    }
    plain |= {
        "resolution": (64, 36),
        "blas_budget": None,
        "threads": 0,
        "seed": 3,
        "camera": "C",
        "max_error": "0.02",
        "min_share": None,
        "paths": None,
    }
    off = [False]
    monkeypatch.setattr(frames, "_off_the_cpu", lambda _args: off[0])

    def arguments(alone=True, **more):
        return frames.ahead_arguments(Namespace(**plain | more), alone)

    assert arguments() == ()
    off[0] = True
    expected = (
        "a.blend",
        "--warm",
        "--resolution",
        "64x36",
        "--threads",
        "0",
        "--seed",
        "3",
        "--camera",
        "C",
        "--max-error",
        "0.02",
    )
    assert arguments() == expected
    assert arguments(frames=None) == arguments(frames=(1,)) == ()
    assert arguments(frames=(1,), ahead=True) == expected
    assert arguments(ahead=False) == arguments(alone=False) == arguments(scene=None) == ()
    assert arguments(cull="frustum") == arguments(enforce=True) == ()
    assert arguments(bake="shot") == ()  # warm
    assert "--bake=shot" in arguments(bake="shot", warm=False, shot=None, blas_budget=None)
    assert arguments(bake="shot", warm=False, shot=(1, 2, 3, 4), blas_budget=None) == ()
    off[0] = False
    assert arguments(ahead=True) == expected
    assert arguments(ahead=False, memory=8_000, no_parts=True)[1:4] == ("--warm", "--no-parts", "--resolution")
    assert "8000" in arguments(memory=8_000)
    off[0] = True
    with pytest.raises(InputError, match="add --device cpu"):
        arguments(memory=8_000)
    off[0] = False


def test_it_begins_before_blender_is_loaded(monkeypatch):
    """Where the command line says all of it: frames, and that the render is not on the CPU, or the wish."""
    from lipac.scripts.command.options import scene_parser

    def begun(*options):
        args = scene_parser("render", "").parse_args(["a.blend", "-o", "out", *" ".join(options).split()])
        more = {"ahead": None, "engine": "cycles", "device": None, "as_scene": False} | extra
        return frames.begun_early(Namespace(**vars(args) | more))

    extra = {}
    monkeypatch.setattr("lipac.lipac_addon.batch.ahead.Ahead", lambda *given: given)
    assert begun("--frames 1-3") is None
    monkeypatch.delitem(sys.modules, "bpy")
    assert begun("--frames 1-3") is None  # the file may say a card, or the CPU
    extra = {"device": DeviceChoice("cpu")}
    assert begun("--frames 1-3") is None
    for extra in ({"device": DeviceChoice("cuda")}, {"engine": "eevee"}, {"ahead": True}):
        arguments, which = begun("--frames 1-3", "--bake shot")
        assert arguments[0] == "a.blend" and "--bake=shot" in arguments
        assert tuple(which) == FRAMES
        assert begun() is begun("--frames 1-3 --resume") is begun("--frames 1-3 --cull frustum") is None
        extra |= {"as_scene": True}
        assert begun("--frames 1-3") is None
