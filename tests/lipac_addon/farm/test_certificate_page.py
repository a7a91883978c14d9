"""The certificate's page says what certificate.json says."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from lipac.lipac_addon.farm import certificate as certificates
from lipac.lipac_addon.farm.certificate_page import page, worst_of

from ...page.folder import Page, picture


def attempt(mean: float, broken: bool = False, mended: str = "") -> dict[str, Any]:
    least = {"verified_least_mean": mean / 2, "verified_least_worst": 2 * mean}
    tiles = {"verified_grid": [4, 3], "verified_crops": [[0, 0], [2, 1]], "verified_tiles": [[mean] * 12] * 2}
    change = {"verified_mean": mean, "verified_worst": 4 * mean, **least, **tiles}
    asked = {
        "mended": mended,
        "broken": broken,
        "max_error": [0.01, 0.05],
        "uncertified": [],
        "certified": [[0.004, 0.02]],
    }
    return {**change, **asked, "seconds": 3.0, "peak_bytes": 5e8}


def frame(number: int, *attempts: dict[str, Any]) -> dict[str, Any]:
    own = {"instances": 900, "active": 40 + number, "seconds": 2.5, "peak_bytes": 700_000_000}
    paths = {
        "certified": {"mean": 0.004, "worst": 0.02},
        "judgement": {"holds": True, "seconds": 1.0, "peak_bytes": 6e8},
    }
    render = {"seconds": 7.0, "peak_bytes": 400_000_000, "mended": "", "blender": "5.2.3 LTS"}
    found = {"attempts": list(attempts), "full": {"seconds": 9.0, "peak_bytes": 6e8}, "seconds": 15.0}
    return {"frame": number, "analysis": own, **paths, "render": render, "verified": found if attempts else None}


def made(broken: int = 0) -> dict[str, Any]:
    mended = frame(3, attempt(0.03, True), attempt(0.006, bool(broken), "2"))
    header = {"schema": 1, "scene": "<a> street.blend", "lipac": "0.1.0", "blender": "5.2.3 LTS"}
    header |= {"key": "0123456789abcdef", "set": "fedcba9876543210", "max_error": [0.01, 0.05]}
    counts = {"instances": 900, "active": 55, "warnings": ["one & two"], "verified": 2, "failed": 1, "broken": broken}
    counts |= {"certified_mean": 0.004, "certified_worst": 0.02, "uncertified": []}
    seconds = {
        "analysis": 10.0,
        "judgement": 4.0,
        "render": 28.0,
        "unite": 1.2,
        "verify": 30.0,
        "full": 84.0,
        "ratio": 3.0,
    }
    memory = {"analysis": 7e8, "judgement": 6e8, "unite": 3e8, "render": 4e8, "crops_culled": 5e8, "crops_full": 6e8}
    frames = [frame(1), frame(2, attempt(0.002)), mended, frame(4)]
    found = {**header, **counts, "at_most": 0.6, "mended": [[3, 3]], "seconds": seconds, "peak_bytes": memory}
    found |= {"frames": frames}
    return found | {"statement": certificates.statement(found)}


@pytest.mark.parametrize("broken", [0, 1])
def test_figures_are_those_of_the_certificate(broken: int) -> None:
    data = made(broken)
    read = Page.of(page(data))
    figures = read.all("data")
    assert len(figures) > 20
    for figure in figures:
        value: Any = data
        for name in figure.attributes["data-of"].split("/"):
            value = value[int(name)] if isinstance(value, list) else value[name]
        assert float(figure.attributes["value"]) == value
    assert [e.text for e in read.all("p")][1 : 1 + len(data["statement"])] == data["statement"]
    assert ("Above" if broken else "Certified") in read.all("h1")[0].text
    assert len(read.all("td", "bad-text")) == 1 + broken
    assert {e.text for e in read.all("li")} >= {"one & two"}
    assert "<a> street.blend" in read.all("title")[0].text


def test_the_frame_that_changes_most_as_delivered_is_shown(tmp_path: Path) -> None:
    data = made()
    assert worst_of(data) == 2
    picture(tmp_path / "frame_0003.png", (90, 120, 60))
    read = Page.of(page(data, tmp_path / "frame_0003.png"))
    assert [image.attributes["alt"] for image in read.all("img")] == ["Frame 3 as it was delivered, dimmed"]
    assert len(read.all("svg", "tiles")) == 1
    assert not Page.of(page(data, tmp_path / "nothing.png")).all("img")


def test_without_libraries_there_is_no_page_and_that_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    assert "certificate.html and certificate.json hold" in certificates.summary(made())
    monkeypatch.setattr(certificates, "missing", lambda: ["jinja2"])
    said = certificates.summary(made()).splitlines()[-1]
    assert said.startswith("certificate.json holds") and "no jinja2" in said
