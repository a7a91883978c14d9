"""Files of strangers: every case of field.py holds, and what their rows do not say."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import bpy
import pytest

from lipac.scripts.lipac import main

from . import field
from .case import CASES, Case

pytestmark = pytest.mark.skipif(
    not field.FIELD.is_dir(), reason="the supplied cases (../shared/cases/field) are not here"
)
OWN = [case for case in CASES if case.function.__module__ == field.__name__]


@pytest.fixture(autouse=True)
def nothing_left_open() -> Iterator[None]:
    yield
    bpy.ops.wm.read_factory_settings(use_empty=True)


@pytest.mark.parametrize("case", OWN, ids=lambda c: c.name)
def test_holds(case: Case) -> None:
    broken = [f"{f.stressed}: {f.measure} {f.figure:.4g}, limit {f.limit:.4g}" for f in case.figures() if not f.holds]
    assert not broken, "\n".join(broken)


def test_every_file_has_its_case() -> None:
    source = Path(field.__file__).read_text()
    assert [path.stem for path in field.FIELD.glob("*.blend") if f'"{path.stem}"' not in source] == []


def test_the_path_tracer_shows_points_by_faces_and_says_so(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert (
        main(
            [
                "render", str(field.FIELD / "points_only.blend"), "-o", str(tmp_path), "--engine", "path",
                "--resolution", "16x9", "--quiet"
            ]
        )
        == 0
    )
    assert "point cloud rendered as faces" in capfd.readouterr().err


@pytest.mark.parametrize(("engine", "status"), [("path", 2), ("cycles", 0)])
def test_nothing_that_light_paths_can_be_traced_in(
    engine: str, status: int, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """A volume alone: Cycles renders all there is, the path tracer refuses, and both say why."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    for item in (scene.camera, bpy.data.objects.new("Smoke", bpy.data.volumes.new("Smoke"))):
        scene.collection.objects.link(item)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "smoke.blend"))
    arguments = ["render", str(tmp_path / "smoke.blend"), "-o", str(tmp_path / "out"), "--engine", engine]
    assert main([*arguments, "--cull", "light-paths", "--resolution", "16x9", "--samples", "1", "--quiet"]) == status
    said = capfd.readouterr().err
    assert "volume" in said
    assert ("all is rendered" in said) == (status == 0)
