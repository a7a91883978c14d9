"""A full disk, a folder that goes away, an Embree without memory, another Embree in the process: what the user is told,
and what is left."""

from __future__ import annotations

import ctypes
import gc
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import bpy
import numpy as np
import pytest
from numba import cfunc, types

from lipac.core.accel import embree
from lipac.core.accel.blas import BlasCache
from lipac.core.culling.options import CullOptions
from lipac.core.files.report import Report
from lipac.lipac_addon.batch.job import Job
from lipac.lipac_addon.batch.pipeline import run

from ..core import scenes
from ..processes import saved
from .inside_blender import stage

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def blend(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The stage as a .blend."""
    return saved(stage, tmp_path_factory.mktemp("scene") / "stage.blend")


def command(limit: int, *arguments: object) -> subprocess.CompletedProcess[str]:
    """`lipac ARGUMENTS` in a process whose files can be no larger than limit bytes: to it, the disk is full."""

    def full() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)

    return subprocess.run(
        # Python keeps half of what it compiles, too
        [sys.executable, "-B", "-m", "lipac.scripts.lipac", *map(str, arguments)],
        capture_output=True,
        text=True,
        preexec_fn=full,
        timeout=300,
        check=False,
    )


@pytest.mark.parametrize(
    ("limit", "how"),
    [(500, ["--engine", "path"]), (4000, ["--engine", "path"]), (20_000, ["--engine", "cycles", "--cull", "none"])],
)
def test_full_disk(blend: Path, tmp_path: Path, limit: int, how: list[str]) -> None:
    """500 bytes: not even the report fits; 4,000: the picture does not; 20,000: a part of it does, and Blender says
    nothing of the rest."""
    before = blend.read_bytes()
    done = command(
        limit, "render", blend, "-o", tmp_path / "out", *how, "--samples", 1, "--resolution", "160x90", "--quiet"
    )
    assert done.returncode == 1
    lines = done.stderr.strip().splitlines()
    assert len(lines) == 1 and "cannot read or write" in lines[0] and "free space" in lines[0]
    assert blend.read_bytes() == before
    left = [p for p in (tmp_path / "out").rglob("*") if p.is_file()]
    assert not [p for p in left if p.suffix in (".png", ".exr") or ".part" in p.name], "half a file is left"
    report = tmp_path / "out" / "report.json"
    assert not report.exists() or json.loads(report.read_text())["frames"] == []


def test_full_temporary_folder(blend: Path, tmp_path: Path) -> None:
    """It is named, and what to do about it: not the output folder is full. The picture is there."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    code = (
        "import sys, lipac.lipac_addon.batch.verify as verify, os, lipac.core.files.atomic as files; whole = "
        "files.is_whole\n"
        f"files.is_whole = lambda path: whole(path) and not str(path).startswith({str(folder)!r})\n"
        "from lipac.scripts.lipac import main; sys.exit(main(sys.argv[1:]))"
    )
    arguments = [
        "render",
        blend,
        "-o",
        tmp_path / "out",
        "--samples",
        1,
        "--resolution",
        "32x18",
        "--verify",
        1,
        "--quiet",
    ]
    environment = os.environ | {"TMPDIR": str(folder)}
    done = subprocess.run(
        [sys.executable, "-c", code, *map(str, arguments)], capture_output=True, text=True, env=environment, check=False
    )
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1
    assert f"free space in {folder}, or name another folder by TMPDIR" in done.stderr
    assert (tmp_path / "out" / "frame_0001.png").exists()


def test_output_folder_removed_in_the_midst(tmp_path: Path) -> None:
    """The frame that cannot be written is an error that names the file; the open file is as it was."""
    scene = stage()
    folder, report = tmp_path / "out", Report("stage", "", "", "light-paths", "path", 0, 1)
    hidden = [ob.hide_render for ob in bpy.data.objects]

    def gone() -> bool:
        if scene.frame_current == 2 and folder.exists():
            shutil.rmtree(folder)
        return False

    with pytest.raises(OSError, match="out"):
        run(Job(folder, (1, 2, 3), CullOptions(width=48), "path", samples=1), report, cancelled=gone)
    assert [f["frame"] for f in report.frames] == [1]
    assert [ob.hide_render for ob in bpy.data.objects] == hidden


@cfunc(types.boolean(types.uintp, types.intp, types.boolean))
def _refuse(user, change, post):
    return change < 20_000


def test_embree_without_memory() -> None:
    """A build that its memory monitor refuses is a MemoryError that says which mesh; the device still builds what fits,
    and nothing leaks."""
    device = embree.Device(2)
    monitor = embree.lib.rtcSetDeviceMemoryMonitorFunction
    meshes = [scenes.sphere(128), scenes.cube()]
    monitor(device.handle, _refuse.address, ctypes.c_void_p(0))
    blas = BlasCache(meshes, device)
    with pytest.raises(MemoryError, match="mesh 0 with 65,024 triangles"):
        blas.need(np.array([0]))
    assert blas.scenes[0] == 0
    gc.collect()
    assert blas.need(np.array([1])) == 1
    assert blas.scenes[1] != 0


def blenders(pattern: str) -> Path:
    """A library that this Blender brings."""
    found = [path for folder in Path(bpy.__file__).parents for path in (folder / "lib").glob(pattern)]
    assert found, f"this Blender brings no {pattern}"
    return found[0]


def traced(**environment: str) -> None:
    """The core's tests of tracing, in a process of its own."""
    names = (
        "accel/test_tlas.py",
        "accel/test_hitboxes.py",
        "tracing/test_tracer.py::test_same_picture_and_counts_at_any_number_of_threads",
    )
    tests = [str(ROOT / "tests" / "core" / name) for name in names]
    arguments = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *tests]
    done = subprocess.run(
        arguments, cwd=ROOT, env=os.environ | environment, capture_output=True, text=True, timeout=600, check=False
    )
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]


@pytest.mark.skipif(sys.platform != "linux", reason="LD_PRELOAD")
def test_beside_another_embree() -> None:
    """With Blender's own Embree in global scope, as in a Blender program."""
    traced(LD_PRELOAD=str(blenders("libembree4.so*")))


@pytest.mark.skipif(sys.platform != "linux", reason="names of libraries on Linux")
def test_with_blenders_tbb(tmp_path: Path) -> None:
    """Our Embree on the TBB that Blender brings, which is another version: so it comes about on Windows, where both
    have one name."""
    package = Path(embree._library_path())
    needed = next(package.parent.glob("libtbb*.so*")).name
    (tmp_path / "embreex").mkdir()
    (tmp_path / "embreex" / "__init__.py").touch()
    (tmp_path / "embreex.libs").mkdir()
    shutil.copy(package, tmp_path / "embreex.libs")
    shutil.copy(blenders("libtbb.so*").resolve(), tmp_path / "embreex.libs" / needed)
    traced(PYTHONPATH=str(tmp_path))
