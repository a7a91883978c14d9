"""Ranges of frames by the commands: killed, resumed, stopped in the midst of work that looks at nothing, and bad
options."""

import json
import os
import random
import signal
import subprocess
import sys
import time
from subprocess import PIPE

import bpy
import pytest

from lipac.core.files.report import load_states
from lipac.lipac_addon.pictures import read_picture
from lipac.scripts.command.arguments import byte_count
from lipac.scripts.lipac import main

from ..lipac_addon.conftest import save_rising
from ..processes import INTERRUPTIBLE

SMALL = ["--samples", "1", "--resolution", "32x18", "--paths", "1", "--quiet"]
POSIX = pytest.mark.skipif(os.name == "nt", reason="POSIX signals")


@pytest.fixture(scope="module")
def blend(tmp_path_factory):
    """The boxes, whose camera goes up from frame 1 to 6 and then sees over the wall; as a .blend."""
    return save_rising(tmp_path_factory.mktemp("scene"))


def started(*arguments):
    return subprocess.Popen(
        [sys.executable, "-m", "lipac.scripts.lipac", *map(str, arguments)],
        stdout=PIPE,
        stderr=PIPE,
        text=True,
        **INTERRUPTIBLE,
    )


def waited_for(path, process, limit=120.0):
    """The moment at which the file was there, or the process had ended, or time was over."""
    end = time.monotonic() + limit
    while not path.exists() and process.poll() is None and time.monotonic() < end:
        time.sleep(0.005)
    return time.monotonic()


def states(folder):
    return {p.name: p.read_bytes() for p in sorted((folder / "states").glob("frame_*.npz"))}


@POSIX
def test_killed_again_and_again_then_resumed(blend, tmp_path):
    """At no moment is there a half-written file, and in the end all is as if nothing had happened."""
    arguments = ["render", blend, "-o", tmp_path / "killed", "--engine", "path", "--frames", "1-8", *SMALL]
    rng = random.Random(1)
    for wanted in (2, 4):
        process = started(*arguments, *(["--resume"] if wanted > 2 else []))
        before, there = (waited_for(tmp_path / "killed" / f"frame_{k:04}.exr", process) for k in (wanted - 1, wanted))
        time.sleep(rng.random() * (there - before))  # within the next frame, however fast frames are here
        process.kill()
        process.communicate()
        for path in tmp_path.rglob("frame_*"):
            if path.suffix == ".npz":
                load_states(path)
            else:
                assert read_picture(path).shape[:2] == (18, 32)
        report = json.loads((tmp_path / "killed" / "report.json").read_text())
        assert report["totals"]["frames"] == len(report["frames"]) < 8
    done = started(*arguments, "--resume")
    _, err = done.communicate(timeout=300)
    assert done.returncode == 0, err
    assert (
        main(["render", str(blend), "-o", str(tmp_path / "at once"), "--engine", "path", "--frames", "1-8", *SMALL])
        == 0
    )
    assert states(tmp_path / "killed") == states(tmp_path / "at once")
    assert [f["frame"] for f in json.loads((tmp_path / "killed" / "report.json").read_text())["frames"]] == list(
        range(1, 9)
    )
    assert not list(tmp_path.rglob(".*.part.*"))


@pytest.mark.parametrize("bake", [[], ["--bake", "shot"]], ids=["frames", "shot"])
def test_two_processes_at_a_time_for_one_folder(blend, tmp_path, bake):
    """Halves of a range give the states of the whole, and one report."""
    arguments, shot = ["analyze", blend, *SMALL[2:], *bake], ["--shot", "1-4"] if bake else []
    halves = [started(*arguments, "-o", tmp_path / "halves", "--frames", part, *shot) for part in ("1-2", "3-4")]
    assert [p.communicate()[1] for p in halves] == ["", ""]
    assert main([*map(str, arguments), "-o", str(tmp_path / "whole"), "--frames", "1-4"]) == 0
    assert len(states(tmp_path / "whole")) == 4
    assert states(tmp_path / "halves") == states(tmp_path / "whole")
    report = json.loads((tmp_path / "halves" / "report.json").read_text())
    assert [f["frame"] for f in report["frames"]] == [1, 2, 3, 4]


def test_resuming_with_other_options_is_refused(blend, tmp_path, capfd):
    base = ["analyze", str(blend), "-o", str(tmp_path), *SMALL[2:]]
    assert main(base) == 0
    assert main([*base, "--resume"]) == 0
    capfd.readouterr()
    assert main([*base, "--resume", "--max-error", "0.5", "--seed", "3", "--threads", "1"]) == 2
    err = capfd.readouterr().err
    assert err.count("\n") == 1
    assert "otherwise (max_error, seed);" in err
    assert main([*base, "--max-error", "0.5"]) == 0


def test_what_a_library_holds_counts_for_resuming(blend, tmp_path, capfd):
    """A linked file that changed makes other pictures, although the scene's own file is the same."""
    library, scene = tmp_path / "library.blend", tmp_path / "scene.blend"
    bpy.ops.wm.open_mainfile(filepath=str(blend))
    bpy.data.libraries.write(str(library), {bpy.data.objects["wall"]}, fake_user=True)
    bpy.data.objects.remove(bpy.data.objects["wall"])
    with bpy.data.libraries.load(str(library), link=True) as (_, into):
        into.objects = ["wall"]
    bpy.context.scene.collection.objects.link(into.objects[0])
    bpy.ops.wm.save_as_mainfile(filepath=str(scene))
    base = ["analyze", str(scene), "-o", str(tmp_path / "out"), "--cull", "distance", "--quiet"]
    assert main(base) == 0
    assert main([*base, "--resume"]) == 0
    bpy.ops.wm.open_mainfile(filepath=str(library))
    bpy.data.objects["wall"].location.z += 100
    bpy.ops.wm.save_as_mainfile(filepath=str(library))
    capfd.readouterr()
    assert main([*base, "--resume"]) == 2
    assert "otherwise (file);" in capfd.readouterr().err


def test_save_a_baked_copy(blend, tmp_path):
    """The copy hides what no frame needs; the scene's own file is not touched."""
    before = blend.read_bytes()
    baked = tmp_path / "baked.blend"
    assert (
        main(
            [
                "analyze", str(blend), "-o", str(tmp_path), "--frames", "1-2", "--bake", "shot", "--save", str(baked),
                *SMALL[2:]
            ]
        )
        == 0
    )
    assert blend.read_bytes() == before
    kept = load_states(tmp_path / "states" / "frame_0001.npz")
    culled = {kept.names[k] for k in kept.keys["object"][kept.state == 0]}
    assert culled
    bpy.ops.wm.open_mainfile(filepath=str(baked))
    assert {ob.name for ob in bpy.data.objects if ob.hide_render} == culled
    bpy.ops.wm.read_factory_settings(use_empty=True)


BAD = [
    (["--save", "x.blend"], "--bake shot"),
    (["--bake", "shot", "--save", "x.txt"], "name a .blend"),
    (["--bake", "shot", "--save", "BLEND"], "the scene itself"),
    (["--bake", "shot", "--save", "nowhere/x.blend"], "no such folder"),
    (["--bake", "x"], "invalid choice"),
    (["--blas-budget", "much"], "is no size"),
    (["--blas-budget", "2"], "is no size"),
    (["--no-mitigation"], "--warm"),
    (["--verify", "13"], "1 to 12"),
    (["--verify", "2", "--bake", "shot"], "--bake frame"),
    (["--verify", "2", "--cull", "none"], "nothing does"),
    (["--shot", "1-4"], "--bake shot"),
    (["--shot", "1-4", "--bake", "shot"], "--frames"),
    (["--shot", "1-4", "--bake", "shot", "--frames", "4-5"], "a part of it"),
]


@pytest.mark.parametrize(("arguments", "says"), BAD, ids=[" ".join(a) for a, _ in BAD])
def test_bad_options(blend, tmp_path, arguments, says, capfd, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert (
        main(["analyze", str(blend), "-o", "out", "--quiet", *(str(blend) if a == "BLEND" else a for a in arguments)])
        == 2
    )
    err = capfd.readouterr().err
    assert says in err
    assert err.count("\n") == 1


def test_sizes():
    good = {
        "2G": 2_000_000_000,
        "500M": 500_000_000,
        "64k": 64_000,
        "2Gi": 2**31,
        "1.5g": 1_500_000_000,
        "10MB": 10_000_000,
        "1234": 1234,
    }
    assert {text: byte_count(text) for text in good} == good
    for text in ("", "G", "-1", "2X", "1e9", "0", "2i", "99999999T", "1 2", "2", "512", "0.5k"):
        with pytest.raises(Exception, match="is no size"):
            byte_count(text)


def test_a_budget_of_bytes_is_kept(blend, tmp_path):
    """With room for half of what is built without a limit, no more than that is built."""
    base = ["analyze", str(blend), *SMALL[2:]]
    assert main([*base, "-o", str(tmp_path / "free")]) == 0
    free = json.loads((tmp_path / "free" / "report.json").read_text())["frames"][0]["blas_bytes"]
    assert main([*base, "-o", str(tmp_path / "tight"), "--blas-budget", str(free // 2)]) == 0
    tight = json.loads((tmp_path / "tight" / "report.json").read_text())
    assert 0 < tight["frames"][0]["blas_bytes"] <= free // 2
    assert tight["options"]["blas_budget_bytes"] == free // 2


STUCK = """
import ctypes, sys, threading, os
from lipac.scripts import lipac
from lipac.lipac_addon.batch import session
sync = session.Session.sync
def stuck(self, frame):
    if frame == 2:
        print("stuck", flush=True)
        {work}
    return sync(self, frame)
session.Session.sync = stuck
sys.exit(lipac.main(sys.argv[1:]))
"""


STARTING = """
import os, signal, sys
class Note:
    def find_spec(self, name, *_):
        if name == "cycles":  # Blender's add-on, which it loads while it starts
            sys.meta_path.remove(self)
            os.write(stdout, b"starting\\n")
            os.kill(os.getpid(), signal.SIGINT)
stdout = os.dup(1)
sys.meta_path.insert(0, Note())
from lipac.scripts.lipac import main
sys.exit(main(sys.argv[1:]))
"""


@POSIX
def test_ctrl_c_while_blender_starts(blend, tmp_path):
    """It is not lost, and does not leave a Blender without Cycles to go on with."""
    arguments = ["analyze", str(blend), "-o", str(tmp_path), "--frames", "1-3", *SMALL[2:]]
    done = subprocess.run(
        [sys.executable, "-c", STARTING, *arguments],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
        **INTERRUPTIBLE,
    )
    assert done.stdout == "starting\n"
    assert done.returncode == 130
    assert done.stderr.endswith(": stopped; finished frames and their report are kept\n")


@POSIX
@pytest.mark.parametrize(
    "work",
    ["ctypes.CDLL(None).sleep(300)", "__import__('time').sleep(0.01) or [0 for _ in iter(int, 1)]"],
    ids=["in C", "in Python"],
)
def test_ctrl_c_in_work_that_looks_at_nothing(blend, tmp_path, work):
    """The process ends although the main thread is in the midst of minutes of work, and says so; the report of the
    first frame is whole."""
    code = STUCK.format(work=work)
    arguments = ["analyze", str(blend), "-o", str(tmp_path), "--frames", "1-3", *SMALL[2:]]
    process = subprocess.Popen(
        [sys.executable, "-c", code, *arguments], stdout=PIPE, stderr=PIPE, text=True, **INTERRUPTIBLE
    )
    assert any(line == "stuck\n" for line in process.stdout)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130
    # by the watchdog, or, where C's sleep is cut short, by the command
    assert err.splitlines(keepends=True)[-1].endswith(": stopped; finished frames and their report are kept\n")
    assert [f["frame"] for f in json.loads((tmp_path / "report.json").read_text())["frames"]] == [1]
