"""Small files after public reports and strangers' files, each by the real command with the value that is right: `../shared/cases/README.md` lists them."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lipac.core.report import States, load_states
from lipac.lipac_addon.pictures import read_picture
from lipac.scripts.lipac import main

FIELD = Path(__file__).parents[2] / ".." / "shared" / "cases" / "field"
pytestmark = pytest.mark.skipif(not FIELD.is_dir(), reason="the supplied cases (../shared/cases/field) are not here")
SMALL = ("--resolution", "96x54", "--samples", "2", "--quiet")


def rendered(case: str, folder: Path, *options: str) -> tuple[dict[str, Any], States]:
    """What `lipac render` leaves of a case: the report, and the states of its frame."""
    assert main(["render", str(FIELD / f"{case}.blend"), "-o", str(folder), *SMALL, *options]) == 0
    report = json.loads((folder / "report.json").read_text())
    assert read_picture(next(folder.glob("frame_*.exr"))).shape[:2] == (54, 96)
    return report, load_states(next((folder / "states").glob("*.npz")))


def kept(states: States) -> set[str]:
    """Names of the objects that stay."""
    return {states.names[k] for k in states.keys["object"][states.state == 2]}


EDITED = [("edit_mode_plain", 104, "item1"), ("edit_mode_mirror", 104, "item1"), ("edit_mode_mirrorfloor", 409, "Ground")]


@pytest.mark.parametrize(("case", "instances", "edited"), EDITED)
def test_saved_in_edit_mode(case: str, instances: int, edited: str, tmp_path: Path) -> None:
    """What was being edited is there, and stays where the camera sees it."""
    report, states = rendered(case, tmp_path)
    assert report["frames"][0]["instances"] == instances
    assert edited in kept(states)


def test_edit_mode_with_all(tmp_path: Path) -> None:
    report, _ = rendered("edit_mode_mirror", tmp_path, "--cull", "none")
    assert report["frames"][0]["active"] == 104


@pytest.mark.parametrize("case", ["film_rgba_h264", "render_result_renamed"])
def test_saved_whatever_the_files_output_is(case: str, tmp_path: Path) -> None:
    """A film format with a colour mode that its codec lacks; a Render Result by another name."""
    report, _ = rendered(case, tmp_path)
    assert report["frames"][0]["instances"] == 64


def test_freestyle(tmp_path: Path) -> None:
    """In a process of its own, which it used to end. Its lines are said to be left out for what is culled."""
    arguments = ["render", str(FIELD / "freestyle.blend"), "-o", str(tmp_path), *SMALL]
    done = subprocess.run([sys.executable, "-m", "lipac.scripts.lipac", *arguments], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["frames"][0]["instances"] == 64
    assert any("Freestyle" in line for line in report["approximated"])


def test_two_view_layers(tmp_path: Path) -> None:
    """The second, which lacks the wall, shows what stands behind it."""
    report, states = rendered("r_viewlayers", tmp_path / "culled", "--seed", "1")
    rendered("r_viewlayers", tmp_path / "full", "--cull", "none", "--seed", "1")
    assert report["frames"][0]["view_layers"] == 2
    assert {"Wall", *(f"item{k}" for k in range(7))} <= kept(states)
    culled, full = (read_picture(tmp_path / name / "frame_0001.exr") for name in ("culled", "full"))
    assert np.abs(culled - full).mean() < 0.01 * full.mean()


def test_points_alone(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """What light paths cannot be traced in is rendered, and that is said."""
    report, _ = rendered("points_only", tmp_path / "culled")
    assert "all is rendered" in capfd.readouterr().err
    assert report["frames"][0]["culled"] == 0
    rendered("points_only", tmp_path / "full", "--cull", "none")
    culled, full = (read_picture(tmp_path / name / "frame_0001.exr") for name in ("culled", "full"))
    assert (culled == full).all()
    assert main(["render", str(FIELD / "points_only.blend"), "-o", str(tmp_path / "path"), "--engine", "path", *SMALL]) == 2
    assert "point cloud" in capfd.readouterr().err
