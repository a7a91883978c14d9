"""`import lipac`: what it offers, and that it loads nothing before it is used."""

from __future__ import annotations

import subprocess
import sys
import tomllib
from importlib import metadata
from pathlib import Path

import bpy
import numpy as np
import pytest

import lipac
from lipac.core.culling.analysis import analyze as analyze_arrays
from lipac.lipac_addon.pictures import read_picture
from lipac.scripts.dev.pages import api_page

from .core.culling.test_loop import stage
from .lipac_addon.conftest import boxes, boxes_file  # noqa: F401

ROOT = Path(lipac.__file__).parent


def test_nothing_is_loaded_before_it_is_used() -> None:
    code = "import sys, lipac; dir(lipac); assert not {'bpy', 'numpy', 'numba', 'lipac.core'} & set(sys.modules)"
    code += "; lipac.analyze; assert 'bpy' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_every_name_is_there() -> None:
    assert set(lipac.__all__) <= set(dir(lipac))
    assert all(getattr(lipac, name) is not None for name in lipac.__all__)
    with pytest.raises(AttributeError, match="no attribute 'analyse'"):
        lipac.analyse  # noqa: B018


def test_one_version() -> None:
    assert (
        lipac.__version__
        == tomllib.loads((ROOT / "blender_manifest.toml").read_text())["version"]
        == metadata.version("lipac")
    )


def test_arrays_need_no_blender() -> None:
    options = lipac.CullOptions(width=48, seed=3)
    result = lipac.analyze(stage(), 0.05, options=options)
    assert (
        result.state.tobytes()
        == analyze_arrays(
            stage(), lipac.CullOptions(width=48, seed=3, max_error=lipac.Budget(0.05, 0.25))
        ).state.tobytes()
    )
    assert 0 < result.active.sum() < 100


def test_a_scene_is_culled_and_taken_back(boxes: bpy.types.Scene) -> None:  # noqa: F811
    options = lipac.CullOptions(policy="distance", setting=19.5)
    analysis = lipac.analyze(boxes, options=options)
    applied = lipac.apply(analysis)
    assert applied.removed.sum() == (analysis.state == 0).sum() == 4
    hidden = {ob.name for ob in bpy.data.objects if ob.hide_render}
    assert hidden == {f"box{k}" for k in range(4, 8)}
    again = lipac.analyze(boxes, options=options)  # sees nothing of what is applied
    assert again.state.tobytes() == analysis.state.tobytes()
    assert not any(ob.hide_render for ob in bpy.data.objects)
    assert not lipac.restore()
    lipac.apply(again)
    assert lipac.restore()
    assert not any(ob.hide_render for ob in bpy.data.objects)
    boxes.render.use_multiview = True
    with pytest.raises(lipac.InputError, match="several cameras"):
        lipac.apply(again)
    assert not any(ob.hide_render for ob in bpy.data.objects)


def test_the_current_frame_stays(boxes: bpy.types.Scene, tmp_path: Path) -> None:  # noqa: F811
    options = lipac.CullOptions(policy="distance", setting=19.5)
    boxes.frame_set(3, subframe=0.5)
    lipac.analyze(boxes, options=options, frame=9)
    assert (boxes.frame_current, boxes.frame_subframe) == (3, 0.5)
    boxes.render.resolution_percentage = 25
    lipac.render(boxes, tmp_path, engine="path", samples=1, frames=(5, 7), options=options)
    assert (boxes.frame_current, boxes.frame_subframe) == (3, 0.5)


def test_what_cannot_be_analysed_is_said(boxes: bpy.types.Scene, tmp_path: Path) -> None:  # noqa: F811
    with pytest.raises(lipac.InputError, match="no such file"):
        lipac.analyze(tmp_path / "none.blend")
    with pytest.raises(lipac.InputError, match="only the open scene"):
        lipac.analyze(bpy.data.scenes.new("other"))
    boxes.camera = None
    with pytest.raises(lipac.InputError, match="has no camera"):
        lipac.analyze(boxes)
    with pytest.raises(lipac.InputError, match="no engine 'best'"):
        lipac.render(stage_with_camera(boxes), tmp_path, engine="best")


def stage_with_camera(scene: bpy.types.Scene) -> bpy.types.Scene:
    scene.camera = next(ob for ob in scene.objects if ob.type == "CAMERA")
    return scene


@pytest.mark.slow
def test_render_writes_pictures_and_a_report(boxes_file: Path, tmp_path: Path) -> None:  # noqa: F811
    report = lipac.render(
        boxes_file, tmp_path / "out", 0.02, frames=(1, 2), samples=1, options=lipac.CullOptions(width=64)
    )
    assert [frame["frame"] for frame in report.frames] == [1, 2]
    assert (report.lipac, report.policy, report.engine) == (lipac.__version__, "light-paths", "cycles")
    assert np.isfinite(read_picture(tmp_path / "out" / "frame_0002.exr")).all()
    assert (tmp_path / "out" / "report.json").exists()
    assert "<html" in (tmp_path / "out" / "report.html").read_text()


@pytest.mark.slow
def test_the_example_runs(boxes_file: Path, tmp_path: Path) -> None:  # noqa: F811
    done = subprocess.run(
        [sys.executable, ROOT / "examples" / "cull_and_render.py", boxes_file, tmp_path],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "instances stay" in done.stdout
    assert {path.name for path in tmp_path.iterdir()} >= {"whole.png", "culled.png"}


def test_the_page_is_current() -> None:
    """`python -m lipac.scripts.dev.pages` writes it."""
    assert api_page.PAGE.read_text() == api_page.page()
