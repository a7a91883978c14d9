"""Frames of a shot that are rendered while its set is still looked for: what comes out is what comes out one after the
other."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import bpy
import numpy as np
import pytest

from lipac.core.culling import union
from lipac.core.culling.loop import Loop
from lipac.core.culling.options import CullOptions
from lipac.core.culling.result import CullingResult
from lipac.core.error_budget.budget import Budget
from lipac.core.errors import InputError
from lipac.core.files.report import Report
from lipac.core.progress import Progress, silent
from lipac.core.scene.model import RAY_TYPES
from lipac.lipac_addon.batch.ahead import Said
from lipac.lipac_addon.batch.job import SHOT, Job
from lipac.lipac_addon.batch.pipeline import run
from lipac.lipac_addon.batch.shots.meanwhile import Judged
from lipac.lipac_addon.pictures import read_picture
from lipac.scripts.lipac import main

pytestmark = pytest.mark.slow
FRAMES = tuple(range(1, 7))
OPTIONS = CullOptions(width=96, paths=6, max_error=Budget(0.02, 0.1))


def shot(folder: Path, progress: Progress = silent, **how: Any) -> Report:
    report = Report("boxes", "", "", "light-paths", "cycles", 0, 1)
    run(Job(folder, FRAMES, OPTIONS, "cycles", samples=1, bake=SHOT, **how), report, progress)
    return report


def assert_the_same(a: Path, b: Path, frames: Sequence[int] = FRAMES) -> None:
    """Pictures and states of two folders."""
    for frame in frames:
        name = f"frame_{frame:04}"
        assert np.array_equal(read_picture(a / f"{name}.exr"), read_picture(b / f"{name}.exr"))
        assert len({(folder / "states" / f"{name}.npz").read_bytes() for folder in (a, b)}) == 1


class Recorded:
    """An analysis that was done before, which tells one thing more whenever it is asked."""

    def __init__(self, done: Path, folder: Path, fails_after: int = 1 << 30) -> None:
        self.folder, self._left = folder, fails_after
        self._files = sorted((done / "analysis").glob("*.npz"), key=lambda path: path.stat().st_mtime_ns)
        (folder / "analysis").mkdir(parents=True)

    def __enter__(self) -> Recorded:
        return self

    def __exit__(self, *_: object) -> None: ...

    def has_ended(self) -> bool:
        if not self._left or not self._files:
            return True
        self._left -= 1
        shutil.copy2(self._files.pop(0), self.folder / "analysis")
        return False

    def go_on(self, ended: bool, what: str, _cancelled: object) -> None:
        if ended:
            raise InputError(f"{what}: no more")

    def said(self) -> Said:
        return Said({}, ("about so",), ("beware",), [], 0)


@pytest.fixture
def growing(moving: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A shot whose set holds in some of its frames at first, and grows for the sake of the others: done one after the
    other."""
    moving.render.resolution_x, moving.render.resolution_y, moving.render.resolution_percentage = 96, 54, 100
    judge, asked = union.check, list[int]()

    def stricter(loop: Loop, keep: np.ndarray, *more: Any) -> union.Check:
        asked.append(len(asked))
        found = judge(loop, keep, *more)
        return replace(found, holds=found.holds and (len(asked) <= 4 or bool(keep.all())))

    monkeypatch.setattr(union, "check", stricter)
    propose, proposed = union.propose, list[int]()

    def first_alone(loop: Loop, progress: Any) -> CullingResult:
        proposed.append(len(proposed))
        n = len(loop.activation)
        if len(proposed) == 1:
            return propose(loop, progress)
        return loop.result(np.arange(n) == 0, np.zeros(n, np.float32), np.zeros((n, RAY_TYPES), np.int64))

    monkeypatch.setattr(union, "propose", first_alone)
    shot(tmp_path / "after")
    return tmp_path / "after"


def test_a_set_that_grows(growing: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What was rendered too early is rendered again, and nothing else; nothing is analysed here."""
    rendered, told = list[int](), set[str]()
    monkeypatch.setattr(union, "check", None)
    monkeypatch.setattr(union, "propose", None)
    bpy.app.handlers.render_post.append(lambda scene, _: rendered.append(scene.frame_current))
    try:
        begun = Recorded(growing, tmp_path / "other")
        report = shot(tmp_path / "meanwhile", lambda _, what: told.add(what), ahead=("scene.blend",), begun=begun)
    finally:
        bpy.app.handlers.render_post.pop()
    assert any("the shot's set has to grow" in what for what in told)
    first = {json.loads(str(np.load(path)["note"]))["set"] for path in (growing / "analysis").glob("*_checked0.npz")}
    assert len(first) == 1
    assert set(rendered) == set(FRAMES)
    assert len(FRAMES) < len(rendered) < 2 * len(FRAMES)
    assert_the_same(growing, tmp_path / "meanwhile")
    assert report.approximated == ["about so"]
    assert "beware" in report.warnings
    assert any(entry["wait_s"] >= 0 for entry in report.frames if "wait_s" in entry)


def test_what_is_waited_for_is_said(tmp_path: Path) -> None:
    judged = Judged(tmp_path)
    judged.count, judged.began = 1, 100.0
    assert judged.waited_for(False, 6, 110.0) == "waiting for the analysis: judged in 1 of 6 frames"
    judged.count = 3
    line = "waiting for the analysis: the shot's set has grown, judged in 3 of 6 frames, about 15 s left"
    assert judged.waited_for(True, 6, 110.0) == line
    judged.fails = True
    assert judged.waited_for(True, 6, 110.0) == "waiting for the analysis: the shot's set has to grow"


def test_an_analysis_that_ends_early_ends_the_command(growing: Path, tmp_path: Path) -> None:
    begun = Recorded(growing, tmp_path / "other", fails_after=4)
    with pytest.raises(InputError, match="the shot: no more"):
        shot(tmp_path / "meanwhile", ahead=("scene.blend",), begun=begun)
    assert not any(ob.hide_render for ob in bpy.data.objects)


def test_by_the_command(boxes: Any, tmp_path: Path) -> None:
    """Another process does look."""
    for frame, x in ((1, 0), (3, 3)):
        boxes.camera.location.x += x
        boxes.camera.keyframe_insert("location", frame=frame)
    file = tmp_path / "moving.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(file))
    common = [
        "render",
        str(file),
        "--frames=1-6",
        "--bake=shot",
        "--max-error=0.1,0.5",
        "--resolution=96x54",
        "--paths=6",
        "--quiet",
    ]
    for name in ("--no-ahead", "--ahead"):
        assert main([*common, name, "--samples=1", "-o", str(tmp_path / name)]) == 0
    assert_the_same(tmp_path / "--no-ahead", tmp_path / "--ahead", (1, 2, 3))
    entries = [
        json.loads((tmp_path / name / "report.json").read_text())["frames"] for name in ("--no-ahead", "--ahead")
    ]
    assert [[e[name] for name in ("active", "culled", "paths")] for e in entries[0]] == [
        [e[name] for name in ("active", "culled", "paths")] for e in entries[1]
    ]
    assert all(e["culled"] > 0 for e in entries[1])
    assert any("wait_s" in e for e in entries[1])
    assert all(e["analysis_peak_bytes"] > 0 for e in entries[1])
    assert sorted(p.name for p in (tmp_path / "--ahead").iterdir()) == sorted(
        p.name for p in (tmp_path / "--no-ahead").iterdir()
    )
