"""`lipac report`: the page anew, without Blender."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from lipac.core.errors import Cancelled
from lipac.page import html
from lipac.scripts.command.page import leave, leaving
from lipac.scripts.lipac import main

from ..lipac_addon.conftest import boxes  # noqa: F401 (a fixture)
from ..page.folder import Page, frame, rendered


def test_it_writes_the_page_and_says_where(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    rendered(tmp_path / "out", frame())
    rendered(tmp_path / "full", frame(culled=0), policy="none")
    assert main(["report", str(tmp_path / "out"), "--full", str(tmp_path / "full")]) == 0
    assert capfd.readouterr().out.strip() == str(tmp_path / "out" / "report.html")
    assert Page.of((tmp_path / "out" / "report.html").read_text()).all("input")


def test_it_needs_no_blender(tmp_path: Path) -> None:
    rendered(tmp_path, frame())
    code = "import sys; from lipac.scripts.lipac import main; "
    code += f"assert main(['report', {str(tmp_path)!r}]) == 0; assert 'bpy' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True, stdout=subprocess.DEVNULL)


def test_a_folder_without_report_is_bad_input(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["report", str(tmp_path)]) == 2
    error = capfd.readouterr().err
    assert error.count("\n") == 1 and "no report.json" in error


def test_what_was_stopped_has_a_page_of_what_is_there(tmp_path: Path) -> None:
    """And none that speaks of what was there before, while a command is at work."""
    rendered(tmp_path, frame())
    leave(tmp_path)
    before = (tmp_path / "report.html").read_text()
    with pytest.raises(Cancelled), leaving(tmp_path):
        assert not (tmp_path / "report.html").exists()
        rendered(tmp_path, frame(1), frame(2, active=77))
        raise Cancelled
    assert (tmp_path / "report.html").read_text() != before
    assert "77" in (tmp_path / "report.html").read_text()


def test_a_report_that_nobody_wrote_ends_no_command(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = rendered(tmp_path, frame()) / "report.json"
    data = json.loads(path.read_text())
    data["frames"][0]["certified_mean"] = "much"
    path.write_text(json.dumps(data))
    leave(tmp_path)
    said = capfd.readouterr().err
    assert said.startswith("warning: report.html cannot be made") and said.count("\n") == 1


def test_where_libraries_are_missing_a_line_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """As in Blender's own Python: the command goes on to its end, and the page can be written elsewhere."""
    rendered(tmp_path, frame())
    monkeypatch.setattr(html, "LIBRARIES", ("no_such_library",))
    leave(tmp_path)
    said = capfd.readouterr().err
    assert said.count("\n") == 1 and "no_such_library" in said and f"lipac report {tmp_path}" in said
    assert not (tmp_path / "report.html").exists()
    assert main(["report", str(tmp_path)]) == 2


@pytest.mark.blender
def test_the_scene_from_outside(boxes: Any, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:  # noqa: F811
    """Drawn by the states of the folder, and shown on the page; not of another scene."""
    import bpy

    scene, out = tmp_path / "boxes.blend", tmp_path / "out"
    bpy.ops.wm.save_as_mainfile(filepath=str(scene), copy=True)
    assert main(["analyze", str(scene), "-o", str(out), "--cull", "distance", "--quiet"]) == 0
    assert main(["report", str(out)]) == 0
    assert "from outside" not in (out / "report.html").read_text()
    assert main(["report", str(out), "--outside", str(scene)]) == 0
    assert (out / "tlas.png").stat().st_size > 1000
    assert "from outside" in (out / "report.html").read_text()
    bpy.ops.wm.open_mainfile(filepath=str(scene))
    bpy.data.objects.remove(next(ob for ob in bpy.data.objects if ob.type == "MESH"))
    other = tmp_path / "other.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(other), copy=True)
    capfd.readouterr()
    assert main(["report", str(out), "--outside", str(other)]) == 2
    assert "instances, and" in capfd.readouterr().err
