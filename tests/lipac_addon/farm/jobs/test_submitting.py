"""What is told of a job that is written, and that it works as it stands, whatever folders are called."""

from __future__ import annotations

import json
import shlex
from pathlib import Path

import pytest

from lipac.lipac_addon.farm.jobs.graph import Programs
from lipac.lipac_addon.farm.jobs.submitting import describe
from lipac.lipac_addon.farm.jobs.writing import Wanted, write_shot
from lipac.lipac_addon.open import open_scene

LIPAC = "/opt/my tools/lipac"


@pytest.mark.parametrize("farm", ["openjd", "flamenco"])
def test_paths_with_spaces(farm: str, rising: Path, tmp_path: Path) -> None:
    open_scene(rising)
    shot = write_shot(tmp_path / "shot 7", rising, Wanted())
    told = describe(shot, farm, 2, Programs((LIPAC, "shot"), ("/opt/my tools/blender", "-b")))
    words = shlex.split(told.partition("holds the job: ")[2].replace("Flamenco's", "the"))
    if farm == "openjd":
        assert words[2] == str(shot.folder / "template.json")
        assert words[4] == f"file://{shot.folder / 'parameters.json'}"
        return
    assert f"@{shot.folder / 'flamenco_job.json'}" in words
    assert str(shot.folder / "lipac_shot.js") in words
    settings = json.loads((shot.folder / "flamenco_job.json").read_text())["settings"]
    assert shlex.split(settings["lipac"]) == [LIPAC]


def test_links_are_named_as_they_were(rising: Path, tmp_path: Path) -> None:
    """Other machines may have other links to the same place."""
    (tmp_path / "real").mkdir()
    try:
        (tmp_path / "projects").symlink_to(tmp_path / "real", target_is_directory=True)
    except OSError:
        pytest.skip("no links here")
    scene = tmp_path / "projects" / "scene.blend"
    scene.write_bytes(rising.read_bytes())
    open_scene(scene)
    shot = write_shot(tmp_path / "projects" / "shot", scene, Wanted())
    describe(shot, "openjd", 2, Programs(("lipac", "shot"), ("blender",)))
    values = json.loads((shot.folder / "parameters.json").read_text())
    assert (values["Scene"], values["Folder"]) == (str(scene), str(scene.with_name("shot")))
    assert json.loads((shot.folder / "job.json").read_text())["scene"] == "../scene.blend"
    loaded = type(shot).load(shot.folder)
    assert loaded.folder == shot.folder
    assert loaded.scene.samefile(scene)
