"""Files are whole or not there, whoever else is at work, and whatever lies in the way."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from lipac.core.files.atomic import is_whole, replacing, sweep
from lipac.core.files.report import output_folder

TEXT = '{"a": 1}'


def pictures(folder: Path) -> list[Path]:
    """A picture of each kind, as OpenEXR and matplotlib write them, an archive and a text."""
    import OpenEXR
    from matplotlib.image import imsave

    pixels = np.random.default_rng(0).random((45, 31, 3), np.float32)
    for name, compression in (
        ("zip", OpenEXR.ZIP_COMPRESSION),
        ("none", OpenEXR.NO_COMPRESSION),
        ("piz", OpenEXR.PIZ_COMPRESSION),
    ):
        OpenEXR.File({"compression": compression, "type": OpenEXR.scanlineimage}, {"RGB": pixels}).write(
            str(folder / f"{name}.exr")
        )
    imsave(folder / "p.png", pixels)
    np.savez(folder / "s.npz", a=pixels)
    (folder / "r.json").write_text(TEXT)
    return sorted(folder.iterdir())


def test_what_lacks_its_end_is_not_whole(tmp_path: Path) -> None:
    for path in pictures(tmp_path):
        assert is_whole(path), path
        data = path.read_bytes()
        for part in (data[:0], data[: len(data) // 9], data[: len(data) // 2], data[:-1]):
            path.write_bytes(part)
            assert not is_whole(path), (path, len(part))
    assert not is_whole(tmp_path / "none.png")
    assert not is_whole(tmp_path)


def test_what_has_a_hole_is_not_whole(tmp_path: Path) -> None:
    """A disk that is full only for a while."""
    for path in pictures(tmp_path):
        if path.suffix in (".png", ".exr") and path.stem in ("zip", "p"):
            data = bytearray(path.read_bytes())
            data[len(data) // 3 : 2 * len(data) // 3] = bytes(2 * len(data) // 3 - len(data) // 3)
            path.write_bytes(data)
            assert not is_whole(path), path


def test_a_half_file_does_not_take_the_name(tmp_path: Path) -> None:
    target = tmp_path / "p.json"
    target.write_text(TEXT)
    with pytest.raises(OSError, match="not written whole") as error, replacing(target) as part:
        part.write_text(TEXT[:4])
    assert error.value.filename == str(target)
    assert [p.name for p in tmp_path.iterdir()] == ["p.json"]
    assert target.read_text() == TEXT


@pytest.mark.skipif(os.name == "nt", reason="links")
def test_links_and_what_has_our_names_are_left_alone(tmp_path: Path) -> None:
    """Neither what a link points to nor a file that the user has given such a name is written to; a link in the place
    of the target is replaced itself."""
    precious = tmp_path / "precious"
    precious.write_text("mine")
    folder = tmp_path / "out"
    folder.mkdir()
    for name in (".lipac", ".report.part.json", "report.json"):
        (folder / name).symlink_to(precious)
    output_folder(folder)
    with replacing(folder / "report.json") as part:
        part.write_text(TEXT)
    assert precious.read_text() == "mine"
    assert json.loads((folder / "report.json").read_text()) == {"a": 1}
    assert sorted(p.name for p in folder.iterdir()) == [".lipac", ".report.part.json", "report.json"]
    (folder / ".report.part.json").unlink()
    (folder / ".lipac").unlink()
    (folder / ".lipac").mkdir()
    output_folder(folder)
    assert (folder / ".lipac").is_dir()


MANY = """
import sys
from pathlib import Path
from lipac.core.files.atomic import replacing
from lipac.core.files.report import output_folder
folder = Path(sys.argv[1])
for k in range(150):
    output_folder(folder)
    with replacing(folder / "x.json") as part:
        part.write_text('{"a": 1}')
"""


def test_processes_with_one_target_do_not_fail_each_other(tmp_path: Path) -> None:
    processes = [
        subprocess.Popen([sys.executable, "-c", MANY, str(tmp_path)], stderr=subprocess.PIPE, text=True)
        for _ in range(3)
    ]
    while any(p.poll() is None for p in processes):
        sweep(tmp_path, {"x"})  # as a fourth command that begins
    assert [p.communicate()[1] for p in processes] == [""] * 3
    assert [p.returncode for p in processes] == [0] * 3
    assert [p.name for p in tmp_path.iterdir()] == ["x.json"]


def test_permissions_are_the_users(tmp_path: Path) -> None:
    """A file has those that any other new file has."""
    (tmp_path / "plain").write_text("")
    with replacing(tmp_path / "x.txt") as part:
        part.write_text("x")
    assert (tmp_path / "x.txt").stat().st_mode == (tmp_path / "plain").stat().st_mode
