"""Five frames of a small flythrough as a job, and the same shot done by one process."""

from pathlib import Path

import pytest

from lipac.lipac_addon.farm.layout import FarmShot
from lipac.scripts.lipac import main

FARM = [
    "--frames",
    "1-5",
    "--resolution",
    "64x36",
    "--samples",
    "2",
    "--paths",
    "2",
    "--max-error",
    "0.05,0.3",
    "--chunk",
    "3",
    "--quiet",
]


@pytest.fixture(scope="session")
def flythrough(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The scene."""
    path = tmp_path_factory.mktemp("scene") / "fly.blend"
    assert main(["demo", "flythrough", "-o", str(path), "--instances", "1000", "--quiet"]) == 0
    return path


@pytest.fixture(scope="session")
def one_process(flythrough: Path, tmp_path_factory: pytest.TempPathFactory) -> FarmShot:
    """The shot, analysed and rendered at once."""
    folder = tmp_path_factory.mktemp("whole")
    assert main(["farm", str(flythrough), "-o", str(folder), "--no-measure", *FARM]) == 0
    for step in ("analyze", "unite", "render"):
        assert main(["shot", step, str(folder), "--quiet"]) == 0
    return FarmShot.load(folder)
