"""What is asked of a shot, read back; what the sample stands for."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest

from lipac.core.errors import InputError
from lipac.lipac_addon.farm.layout import JOB, FarmShot, read_json, rendered_from, write_json


def test_read_back(shot: FarmShot) -> None:
    loaded = FarmShot.load(shot.folder)
    assert loaded == shot
    assert loaded.key == shot.key
    assert json.loads((shot.folder / JOB).read_text())["key"] == shot.key


def test_the_key_goes_by_what_is_asked_not_by_where_it_lies(shot: FarmShot, tmp_path: Path) -> None:
    moved = dataclasses.replace(shot, folder=tmp_path, scene=tmp_path / "x.blend")
    assert moved.key == shot.key
    others: list[dict[str, Any]] = [
        {"digest": "0"},
        {"last": 5},
        {"samples": 3},
        {"resolution": (32, 18)},
        {"mean": 0.5},
        {"checks": 3},
    ]
    for other in others:
        assert dataclasses.replace(shot, **other).key != shot.key, other


def test_another_machine_sees_the_scene_elsewhere(shot: FarmShot, tmp_path: Path) -> None:
    assert FarmShot.load(shot.folder, tmp_path / "mapped.blend").scene == (tmp_path / "mapped.blend").resolve()


@pytest.mark.parametrize("text", ["", "{}", "[1]", '{"schema": 2}'])
def test_no_job(shot: FarmShot, text: str) -> None:
    (shot.folder / JOB).write_text(text)
    with pytest.raises(InputError, match="holds no shot"):
        FarmShot.load(shot.folder)


@pytest.mark.parametrize("checks", [1, 2, 4, 5, 17])
def test_spans_are_all_frames_once(shot: FarmShot, checks: int) -> None:
    long = dataclasses.replace(shot, last=17, checks=checks)
    spans = [long.span(number) for number in range(1, checks + 1)]
    assert [frame for span in spans for frame in span] == list(long.frames)
    assert max(map(len, spans)) - min(map(len, spans)) <= 1
    assert all(long.checked(number) in span for number, span in enumerate(spans, 1))


def test_the_sample_is_drawn_by_the_seed(shot: FarmShot) -> None:
    drawn = {
        tuple(dataclasses.replace(shot, last=100, checks=4, seed=seed).checked(k) for k in range(1, 5))
        for seed in range(8)
    }
    assert len(drawn) == 8


def test_json_that_is_not_of_this_job_or_not_whole_does_not_count(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    assert read_json(path) is None
    write_json(path, {"key": "a"})
    assert read_json(path, key="a") == {"key": "a"}
    assert read_json(path, key="b") is None
    path.write_text('{"key": "a"')
    assert read_json(path) is None


def test_a_picture_counts_only_whole_and_from_its_set(shot: FarmShot) -> None:
    shot.picture(1).parent.mkdir()
    shot.picture(1).write_bytes(b"no picture")
    write_json(shot.rendered(1), {"key": shot.key, "set": "s", "mended": "", "bytes": 10})
    assert rendered_from(shot, 1, "s") is None
