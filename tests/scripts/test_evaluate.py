"""`lipac evaluate` on a small scene: every file, and the one line for bad input."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest
from matplotlib.image import imread

from lipac.core.evaluation import evaluate, oracle
from lipac.scripts import lipac
from lipac.scripts.studies import evaluate_report
from lipac.scripts.studies.pictures.strips import BAR

from ..docs.pages import ROOT
from ..page.folder import Page


def test_evaluate_end_to_end(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    fewer = {"BUDGETS": (0.01, 0.02), "PATHS": (1, 2), "EVERY": (4,), "LADDER": 3, "REFINEMENTS": 1}
    for name, value in (fewer | {"SHARES": (1e-4, 1e-2)}).items():  # rows of each kind
        monkeypatch.setattr(evaluate, name, value)
    monkeypatch.setattr(oracle, "SHARES", (1.0,))
    scene, out = tmp_path / "city.blend", tmp_path / "out"
    assert lipac.main(["demo", "mirror-city", "-o", str(scene), "--instances", "1000", "--quiet"]) == 0
    capfd.readouterr()
    command = [
        "evaluate", str(scene), "-o", str(out), "--resolution", "64x36", "--samples", "2", "--budget-check", "1",
        "--ray-budget"
    ]
    assert lipac.main(command) == 0
    shown = capfd.readouterr()
    assert "left)" in shown.err  # progress with the time left
    summary = json.loads((out / "evaluation.json").read_text())
    assert summary["instances"] > 1000
    assert len(summary["equal_error"]) == 2
    assert summary["budget_check"]["cases"] == 2
    assert [row["paths"] for row in summary["ray_budget"]][:2] == [1, 2]
    with (out / "evaluation.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == len(summary["rows"]) > 12
    assert float(rows[0]["mean"]) == 0.0
    for name in ("error_memory", "error_time", "error_active"):
        assert imread(out / f"{name}.png").shape[1] > 600
    assert imread(out / "pictures.jpg").shape[0] == 72 + BAR
    report = (out / "report.md").read_text()
    assert report.rstrip() in shown.out
    for word in ("oracle", "heuristic", "Budget check", "Paths and boxes"):
        assert word in report
    page = Page.of((out / "report.html").read_text())
    figures = {e.attributes["data-of"]: float(e.attributes["value"]) for e in page.all("data")}
    for k, entry in enumerate(summary["equal_error"]):
        assert figures[f"equal_error/{k}/mean"] == entry["mean"]
    assert len(page.all("svg")) == 3 + 1 and len(page.all("img")) == 1
    assert lipac.main([*command, "--quiet"]) == 0  # from what is there
    assert json.loads((out / "evaluation.json").read_text())["equal_error"] == summary["equal_error"]


@pytest.mark.parametrize(
    ("arguments", "says"), [([], "SCENE is missing"), (["gone.blend"], "no such file: gone.blend")]
)
def test_bad_input_is_one_line(
    arguments: list[str], says: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert lipac.main(["evaluate", *arguments, "-o", str(tmp_path)]) == 2
    error = capfd.readouterr().err
    assert says in error
    assert error.count("\n") == 1


def test_results_are_written_after_their_mark(tmp_path: Path) -> None:
    """What is above it, which is by hand, stays; below it each scene's figures say which code they are of, or that
    nobody knows. Twice is as once."""
    for source in sorted((ROOT / "docs" / "results").glob("*/evaluation.json"))[:2]:
        folder = tmp_path / "results" / source.parent.name
        folder.mkdir(parents=True)
        summary = json.loads(source.read_text())
        if len(list((tmp_path / "results").iterdir())) == 2:
            del summary["made_by"]
        (folder / "evaluation.json").write_text(json.dumps(summary))
    page = tmp_path / "results.md"
    evaluate_report.write_results(tmp_path / "results")
    assert page.read_text().startswith("# Results\n")
    page.write_text(page.read_text().replace("# Results\n", "# Results\n\nBy hand.\n"))
    written = [evaluate_report.write_results(tmp_path / "results") and page.read_text() for _ in range(2)]
    assert written[0] == written[1]
    flat = " ".join(written[0].split())
    assert "By hand." in flat.split(evaluate_report.MARK)[0]
    assert "Measured by LiPaC " in flat and "Measured by code that did not note its version: crowd." in flat
