"""The commands, from a shell and inside Blender: what they leave behind, and what they say about bad input."""

import hashlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from subprocess import PIPE

import bpy
import numpy as np
import pytest

import lipac
from lipac.core.culling.policies import RULES
from lipac.lipac_addon.pictures import read_picture
from lipac.scripts.lipac import main

from ..processes import INTERRUPTIBLE
from ..reports import check_report

ROOT = Path(lipac.__file__).parent
SMALL = ["--samples", "1", "--resolution", "32x18"]


def command(*arguments, **options):
    """`lipac ARGUMENTS` as a process of its own."""
    return subprocess.run(
        [sys.executable, "-m", "lipac.scripts.lipac", *map(str, arguments)],
        capture_output=True,
        text=True,
        check=False,
        **options,
    )


@pytest.fixture(scope="module")
def blend(tmp_path_factory):
    """A ground, a row of boxes before a wall and one behind it, a scatter of pebbles behind it, as a .blend; its
    path."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    bpy.ops.mesh.primitive_plane_add(size=40)
    bpy.ops.mesh.primitive_cube_add(size=1, location=(0, 6, 8))
    bpy.context.object.name, bpy.context.object.scale = "wall", (40, 0.2, 16)
    bpy.ops.mesh.primitive_cube_add(size=1)
    cube = bpy.context.object
    for k in range(8):
        ob = bpy.data.objects.new(f"box{k}", cube.data)
        ob.location = (2.0 * (k % 4) - 3, 12.0 if k > 3 else 0.0, 0.5)
        scene.collection.objects.link(ob)
    cube.hide_render = True
    scene.collection.objects.link(scatter(cube))
    bpy.ops.object.light_add(type="POINT", location=(0, -5, 6))
    bpy.context.object.data.energy = 2000
    bpy.ops.object.camera_add(location=(0, -12, 5), rotation=(1.25, 0, 0))
    scene.camera = bpy.context.object
    scene.render.engine, scene.cycles.samples, scene.cycles.use_denoising = "CYCLES", 2, False
    scene.render.resolution_x, scene.render.resolution_y = 32, 18
    path = tmp_path_factory.mktemp("scene") / "boxes.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    bpy.ops.wm.read_factory_settings(use_empty=True)
    return path


def scatter(source):
    """A geometry-nodes host with 30 copies of an object behind the wall."""
    tree = bpy.data.node_groups.new("scatter", "GeometryNodeTree")
    for way in ("INPUT", "OUTPUT"):
        tree.interface.new_socket("Geometry", in_out=way, socket_type="NodeSocketGeometry")
    inputs, output = tree.nodes.new("NodeGroupInput"), tree.nodes.new("NodeGroupOutput")
    info, put = tree.nodes.new("GeometryNodeObjectInfo"), tree.nodes.new("GeometryNodeInstanceOnPoints")
    info.inputs["Object"].default_value, put.inputs["Scale"].default_value = source, (0.3, 0.3, 0.3)
    tree.links.new(inputs.outputs[0], put.inputs["Points"])
    tree.links.new(info.outputs["Geometry"], put.inputs["Instance"])
    tree.links.new(put.outputs[0], output.inputs[0])
    mesh = bpy.data.meshes.new("pebbles")
    mesh.from_pydata([(k % 6 - 2.5, 14 + k // 6, 0.2) for k in range(30)], [], [])
    host = bpy.data.objects.new("pebbles", mesh)
    host.modifiers.new("scatter", "NODES").node_group = tree
    return host


def test_render_from_a_shell(blend, tmp_path):
    """Two frames by Cycles: files, report, states, clean output, the .blend untouched; what is behind the wall is
    culled and changes nothing in the picture."""
    before = hashlib.sha256(blend.read_bytes()).hexdigest(), sorted(p.name for p in blend.parent.iterdir())
    done = command("render", blend, "-o", tmp_path / "a", "--cull", "light-paths", "--frames", "1-2", *SMALL)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[0].split()[:3] == ["frame", "instances", "active"]
    assert len(done.stdout.splitlines()) == 5
    assert {line[:4].strip().isdigit() for line in done.stderr.splitlines()} <= {True}  # progress only
    folder = tmp_path / "a"
    names = sorted(str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file())
    pictures = [f"frame_000{k}.{end}" for k in (1, 2) for end in ("exr", "png")]
    assert names == [
        *pictures, "memory.csv", "report.html", "report.json", "states/frame_0001.npz", "states/frame_0002.npz"
    ]
    check_report(folder)
    report = json.loads((folder / "report.json").read_text())
    assert (report["engine"], report["policy"], report["scene"]) == ("cycles", "light-paths", str(blend))
    frame = report["frames"][0]
    assert frame["instances"] == 40
    assert frame["active"] + frame["culled"] == 40
    assert frame["culled"] >= 34
    assert frame["writeback"]["removed"] == frame["culled"]
    assert frame["render_s"] > 0
    assert frame["device"].startswith("CPU: ")
    assert frame["device_bytes"] is None or frame["device_bytes"] > 0
    assert frame["first_sample_s"] is None or 0 < frame["first_sample_s"] < frame["render_s"]
    with np.load(folder / "states" / "frame_0001.npz") as states:
        names = states["names"][states["key_object"]]
        culled = set(names[(states["state"] == 0) & (states["key_host"] < 0)])
        assert {f"box{k}" for k in range(4, 8)} <= culled
        assert not {"wall", "box0", "box1"} & culled
        assert (states["state"][states["key_host"] >= 0] == 0).all()
    full = command("render", blend, "-o", tmp_path / "b", "--cull", "none", "--quiet", *SMALL)
    assert (full.returncode, full.stderr) == (0, "")
    assert (read_picture(folder / "frame_0001.exr") == read_picture(tmp_path / "b" / "frame_0001.exr")).all()
    check_report(tmp_path / "b")
    assert json.loads((tmp_path / "b" / "report.json").read_text())["frames"][0]["active"] == 40
    assert before == (hashlib.sha256(blend.read_bytes()).hexdigest(), sorted(p.name for p in blend.parent.iterdir()))


def test_a_scene_with_nothing_to_win_is_rendered_in_full(blend, tmp_path, capfd):
    assert main(["render", str(blend), "-o", str(tmp_path), "--device", "cpu", "--quiet", *SMALL]) == 0
    out, err = capfd.readouterr()
    said = next(line for line in out.splitlines() if line.startswith("nothing is culled"))
    assert said.endswith("; --cull light-paths analyses all the same")
    assert err == ""
    check_report(tmp_path)
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["policy"] == "light-paths"
    (frame,) = report["frames"]
    assert frame["active"] == frame["instances"] == 40
    assert "nothing is culled" in frame["not_analysed"]
    assert "Nothing is culled" in (tmp_path / "report.html").read_text()


@pytest.mark.parametrize("policy", [name for name, policy in RULES.items() if policy.listed])
def test_analyze_by_policy(blend, tmp_path, policy, capfd):
    """Each of the rules that users are offered, by its own option."""
    setting = RULES[policy].setting
    value = 0.8 * setting.default
    arguments = ["analyze", str(blend), "-o", str(tmp_path), "--cull", policy, setting.option, str(value), "--quiet"]
    assert main(arguments) == 0
    report = json.loads((tmp_path / "report.json").read_text())
    assert (report["policy"], report["options"]["setting"]) == (policy, value)
    assert 0 < report["frames"][0]["active"] <= 40
    assert report["frames"][0]["render_s"] == 0
    assert not list(tmp_path.glob("*.png"))
    assert capfd.readouterr().err == ""


def test_path_engine(blend, tmp_path):
    assert main(["render", str(blend), "-o", str(tmp_path), "--engine", "path", "--quiet", *SMALL]) == 0
    assert (tmp_path / "frame_0001.exr").stat().st_size > 0


def test_what_is_approximated_is_said(blend, tmp_path, capfd):
    """On the console, not in report.json alone; a long list is cut there."""
    bpy.ops.wm.open_mainfile(filepath=str(blend))
    bpy.context.scene.render.use_border = bpy.context.scene.render.use_multiview = True
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "border.blend"))
    assert (
        main(["render", str(tmp_path / "border.blend"), "-o", str(tmp_path), "--cull", "none", "--quiet", *SMALL]) == 0
    )
    out, err = capfd.readouterr()
    assert "approximated: render region: the whole picture is rendered\n" in err
    assert "approximated: stereo: one view is rendered" in err
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["totals"]["wall_s"] > report["frames"][0]["render_s"]
    # it is printed after the report is written, and rounded to 0.1 s
    assert float(out.splitlines()[-1].split()[0]) >= report["totals"]["wall_s"] - 0.05


def test_a_shot_of_a_million_frames_begins_at_once(blend, tmp_path):
    """What is left of earlier commands is looked for where it is, not by its names."""
    arguments = ["analyze", str(blend), "-o", str(tmp_path), "--frames", "1-1048574", "--cull", "frustum", "--quiet"]
    process = subprocess.Popen(
        [sys.executable, "-m", "lipac.scripts.lipac", *arguments], stdout=PIPE, stderr=PIPE, text=True, **INTERRUPTIBLE
    )
    limit = time.monotonic() + 120
    while not (tmp_path / "states" / "frame_0001.npz").exists() and process.poll() is None and time.monotonic() < limit:
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=60)
    assert (tmp_path / "states" / "frame_0001.npz").exists()


def test_camera_auto_and_import(tmp_path):
    (tmp_path / "t.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    assert (
        main(
            [
                "render", str(tmp_path / "t.obj"), "-o", str(tmp_path), "--cull", "none", "--camera", "auto", "--quiet",
                *SMALL
            ]
        )
        == 0
    )


@pytest.mark.parametrize("script", ["analyze", "render"])
def test_inside_blender(blend, tmp_path, script):
    """As `blender -b FILE -P scripts/X.py -- ARGS` runs it: by path, the file open, arguments after two dashes. The
    package is not importable by name there."""
    code = f"""
import bpy, runpy, sys
bpy.ops.wm.open_mainfile(filepath={str(blend)!r})
sys.meta_path = [finder for finder in sys.meta_path if "lipac" not in getattr(finder, "__module__", "")]
sys.argv = ["blender", "-b", "x.blend", "-P", "x.py", "--", "-o", {str(tmp_path)!r}, "--cull", "frustum", "--quiet"]
runpy.run_path({str(ROOT / "scripts" / f"{script}.py")!r}, run_name="__main__")
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["scene"] == str(blend)
    assert len(report["frames"]) == 1


BAD = [
    (["render", "missing.blend", "-o", "out"], "no such file"),
    (["render", "-o", "out", "a", "b"], "unrecognized arguments"),
    (["render", "BLEND"], "required: -o"),
    (["render", "BLEND", "-o", "BLEND"], "cannot write to the output folder"),
    (["render", "BLEND", "-o", "BLEND/below"], "cannot write to the output folder"),
    (["render", "FOLDER", "-o", "out"], "is a folder"),
    (["render", "HALF", "-o", "out"], "cannot read"),
    (["render", "NOCAMERA", "-o", "out"], "no camera"),
    (["render", "NOTHING", "-o", "out"], "nothing to render"),
    (["render", "BLEND", "-o", "out", "--frames", "5-2"], "no frame range"),
    (["render", "BLEND", "-o", "out", "--frames", "x"], "no frame range"),
    (["render", "BLEND", "-o", "out", "--frames=-2-"], "no frame range"),
    (["farm", "BLEND", "-o", "out", "--frames=-2-3"], "begin at -2"),
    (["render", "BLEND", "-o", "out", "--resolution", "0x5"], "no resolution"),
    (["render", "BLEND", "-o", "out", "--samples", "0"], "not a whole number"),
    (["render", "BLEND", "-o", "out", "--threads", "-1"], "--threads"),
    (["render", "BLEND", "-o", "out", "--seed", "-1"], "--seed"),
    (["render", "BLEND", "-o", "out", "--distance", "nan"], "not a number"),
    (["render", "BLEND", "-o", "out", "--seed", "9" * 5000], "not a whole number from 0"),
    (["render", "BLEND", "-o", "out", "--samples", "99999999"], "from 1 to 16,777,216"),
    (["render", "BLEND", "-o", "out", "--paths", "1" + "0" * 12], "from 1 to 4,096"),
    (["demo", "crowd", "-o", "x.blend", "--seed", "-1"], "not a whole number from 0"),
    (["render", "BLEND", "-o", "out", "--max-error", "2"], "--max-error 2"),
    (["render", "BLEND", "-o", "out", "--camera", "x"], "no camera 'x'"),
    (["render", "BLEND", "-o", "out", "--engine", "x"], "invalid choice"),
    (["render", "BLEND", "-o", "out", "--device", "gpu"], "'gpu' is no device: give one of auto, cpu"),
    (
        ["render", "BLEND", "-o", "out", "--device", "hip"],
        "--device hip: no HIP device that Cycles can use is here; there is CPU",
    ),
    (
        ["render", "BLEND", "-o", "out", "--device", "cpu", "--engine", "path"],
        "--device chooses where Cycles renders; the path tracer is on the CPU",
    ),
    (
        ["render", "BLEND", "-o", "out", "--texture-cache", "--engine", "path"],
        "--texture-cache is of Cycles; the path tracer is on the CPU",
    ),
    (["render", "BLEND", "-o", "out", "--gi", "none"], "--gi is of --engine hybrid"),
    (["render", "BLEND", "-o", "out", "--raster-samples", "2"], "--raster-samples is of --engine hybrid"),
    (["evaluate", "BLEND", "-o", "out", "--all"], "--all evaluates all scenes"),
    (["demo", "x", "-o", "x.blend"], "no demo scene"),
    (["demo", "mirror-city", "-o", "x.txt"], ".blend"),
    (["foo"], "unknown command"),
]


@pytest.fixture(scope="module")
def bad_files(blend, tmp_path_factory):
    """Stand-ins of BAD."""
    folder = tmp_path_factory.mktemp("bad")
    (folder / "half.blend").write_bytes(blend.read_bytes()[:5000])
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "empty.blend"))
    bpy.ops.object.camera_add()
    bpy.context.scene.camera = bpy.context.object
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "nothing.blend"))
    files = {
        "BLEND": blend,
        "FOLDER": folder,
        "HALF": folder / "half.blend",
        "NOCAMERA": folder / "empty.blend",
        "NOTHING": folder / "nothing.blend",
    }
    return {name: str(path) for name, path in files.items()}


@pytest.mark.parametrize(("arguments", "says"), BAD, ids=[" ".join(a) for a, _ in BAD])
def test_bad_input_is_one_line(arguments, says, bad_files, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    filled = ["/".join(bad_files.get(part, part) for part in a.split("/")) for a in arguments]
    quiet = ["--quiet"] if len(arguments) > 1 else []
    assert main([*filled, *quiet]) == 2
    out, err = capfd.readouterr()
    assert out == ""
    assert says in err
    assert err.count("\n") == 1
    assert not list(tmp_path.rglob("*.png"))


def test_scene_is_missing(tmp_path):
    done = command("render", "-o", tmp_path)
    assert (done.returncode, done.stderr) == (
        2,
        "lipac render: SCENE is missing: name a .blend or another scene file\n",
    )


def test_help_is_quick_and_needs_no_blender():
    heavy = "{'bpy', 'numba', 'numpy', 'lipac.core'} & set(sys.modules)"
    code = f"import sys; from lipac.scripts.lipac import main; main(['--help']); sys.exit(bool({heavy}))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, check=False).returncode == 0
    assert main([]) == 2
    assert main(["--version"]) == 0


def no_thread(*_arguments):
    """As `threading` fails where a user may have no more processes."""
    raise RuntimeError("can't start new thread")


def test_our_own_errors_show_no_traceback(blend, tmp_path, monkeypatch, capfd):
    from lipac.scripts.command import frames

    monkeypatch.setattr(frames, "new_report", lambda *_: 1 / 0)
    arguments = ["analyze", str(blend), "-o", str(tmp_path), "--quiet"]
    monkeypatch.delenv("LIPAC_DEBUG", raising=False)
    assert main(arguments) == 1
    err = capfd.readouterr().err
    assert err.count("\n") == 1
    assert "internal error: ZeroDivisionError" in err
    monkeypatch.setattr(frames, "new_report", no_thread)
    assert main(arguments) == 1
    assert "allows no more threads" in capfd.readouterr().err
    monkeypatch.setattr(frames, "new_report", lambda *_: 1 / 0)
    monkeypatch.setenv("LIPAC_DEBUG", "1")
    with pytest.raises(ZeroDivisionError):
        main(arguments)


@pytest.mark.skipif(os.name == "nt", reason="POSIX signals")
def test_ctrl_c_keeps_finished_frames(blend, tmp_path):
    arguments = [
        "render", str(blend), "-o", str(tmp_path), "--frames", "1-5000", "--cull", "frustum", "--quiet", *SMALL
    ]
    process = subprocess.Popen(
        [sys.executable, "-m", "lipac.scripts.lipac", *arguments], stdout=PIPE, stderr=PIPE, text=True, **INTERRUPTIBLE
    )
    limit = time.monotonic() + 120
    while not (tmp_path / "frame_0002.png").exists() and process.poll() is None and time.monotonic() < limit:
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    _out, err = process.communicate(timeout=60)
    assert process.returncode in (130, -signal.SIGINT)  # the latter is what a shell calls 130
    assert "Traceback" not in err
    report = json.loads((tmp_path / "report.json").read_text())
    assert len(report["frames"]) >= 1
    for frame in report["frames"]:
        assert (tmp_path / f"frame_{frame['frame']:04}.png").exists()


def test_demo(tmp_path):
    """The file opens, and has the number of instances that was asked for, to a per cent."""
    done = command("demo", "mirror-city", "-o", tmp_path / "city.blend", "--instances", "1000")
    assert (done.returncode, done.stdout) == (0, f"{tmp_path / 'city.blend'}\n"), done.stderr
    assert [p.name for p in tmp_path.iterdir()] == ["city.blend"]
    assert (
        main(["analyze", str(tmp_path / "city.blend"), "-o", str(tmp_path / "a"), "--cull", "frustum", "--quiet"]) == 0
    )
    report = json.loads((tmp_path / "a" / "report.json").read_text())
    assert abs(report["frames"][0]["instances"] - 1000) <= 10
