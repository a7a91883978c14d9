"""What `make demo` leaves behind, at a small size."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

from lipac.scripts.dev import make_demo
from lipac.scripts.studies import compare


def test_demo_end_to_end(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert make_demo.main(["-o", str(tmp_path), "--instances", "1500", "--resolution", "96x54", "--samples", "2"]) == 0
    full, culled, flip = (imread(tmp_path / f"{name}.png") for name in ("full", "culled", "flip"))
    assert full.shape[:2] == culled.shape[:2] == flip.shape[:2] == (54, 96)
    assert full[..., :3].std() > 0.05  # a picture, not a blank
    tlas = imread(tmp_path / "tlas.png")
    assert tlas.shape[:2] == (540, 960)
    report = json.loads((tmp_path / "report.json").read_text())
    frame = report["frames"][0]
    assert frame["instances"] > 1500 > frame["active"] > 0
    assert frame["error"]["flip"] < report["demo"]["error_between_seeds"]["flip"]
    assert frame["error"]["relmse"] < report["demo"]["error_between_seeds"]["relmse"]
    page = (tmp_path / "report.html").read_text()
    assert f"Its mean is {frame['error']['flip']:.3f} of 1" in page
    assert page.count("<img") == 6  # before, after, under both maps of tiles, FLIP, from outside
    assert f"{frame['active']:,}" in page
    table = capfd.readouterr().out
    for word in (
        "instances",
        "active",
        "hitboxes",
        "BLAS",
        "TLAS",
        "trace",
        "Cycles",
        "peak memory",
        "mean FLIP",
        "relMSE",
    ):
        assert word in table


def test_flip_map_is_dark_where_pictures_agree(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    full = np.full((32, 32, 4), 0.5, np.float32)
    culled = full.copy()
    culled[:, 24:] = 1.0
    monkeypatch.setattr(compare, "pictures", lambda folder, name: (None, full if name == compare.FULL else culled))
    picture = compare.flip_picture(tmp_path).astype(int).sum(axis=2)
    assert picture[:, 28:].min() > picture[:, :8].max()
