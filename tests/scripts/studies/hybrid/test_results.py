"""Tables of the hybrid renderer: known answers, and docs that say what was measured."""

import json
import shutil
from pathlib import Path

import pytest

from lipac.scripts.command.options import cull_options, scene_parser
from lipac.scripts.studies.hybrid.report import (
    CULLED,
    RASTER,
    ROUGH,
    STAGES,
    TRUTH,
    WHOLE,
    cost_table,
    mixtures,
    sections,
)
from lipac.scripts.studies.hybrid.results import PATHS, main, render, seconds, write

DOCS = Path(__file__).parents[4] / "docs"
RESULTS = DOCS / "results"


def test_docs_hold_what_was_measured():
    """The sections in docs/results.md are those of the figures beside it, and every picture that they show is there."""
    text = sections(RESULTS)
    assert (DOCS / "results.md").read_text().endswith(text)
    shown = [line.partition("](")[2].rstrip(")") for line in text.splitlines() if line.startswith("![")]
    assert len(shown) >= 4 and all((DOCS / name).exists() for name in shown)


def test_measured_promises():
    """On every scene FLIP of the hybrid renderer is at most half that of EEVEE."""
    for row in json.loads((RESULTS / "hybrid.json").read_text())["scenes"].values():
        assert max(row["flip"][WHOLE], row["flip"][CULLED]) <= 0.5 * row["flip"][RASTER]


def test_cost_table():
    """Cycles' error falls as the square root of its time, here: in four seconds it is half that of one."""
    stages = dict.fromkeys(STAGES, 0.0) | {"EEVEE": 3.0, "tracing": 1.0}
    rows = [{"way": TRUTH, "paths": n, "seconds": float(n), "stages": {}, "flip": 0.1 / n**0.5} for n in (1, 16)]
    rows += [{"way": WHOLE, "paths": n, "seconds": 4.0, "stages": stages, "flip": 0.2} for n in PATHS]
    table = cost_table("city", rows).splitlines()
    assert len(table) == 2 + len(PATHS)
    cells = [cell.strip() for cell in table[2].strip("|").split("|")]
    assert cells[:2] == ["hybrid", "1"] and cells[-3:] == ["0.2000", "0.0500", "0.1000"]
    assert cells[3] == "75%"


@pytest.mark.parametrize(
    ("frame", "wanted"),
    [({"render_s": 2.0}, 2.0), ({"render_s": 9.0, "timeline": [{"end_s": 1.0}, {"end_s": 3.0}]}, 3.0)],
)
def test_seconds(frame, wanted):
    assert seconds(frame) == wanted


@pytest.mark.parametrize(
    ("engine", "said", "worst"),
    [("hybrid", "0.02", 0.02), ("hybrid", "0.02,0.1", 0.1), ("cycles", "0.02", 0.1), ("hybrid", None, 0.01)],
)
def test_budget_bounds_every_tile(engine, said, worst):
    """In hybrid pictures E bounds the worst tile too, unless T is said."""
    args = scene_parser("render", "").parse_args(["a.blend", "-o", "out", *(["--max-error", said] if said else [])])
    args.engine = engine
    assert cull_options(args).max_error.worst == pytest.approx(worst)


@pytest.fixture
def measured(tmp_path):
    """A copy of what was measured: its folder, in a folder with the page."""
    folder = tmp_path / "docs" / "results"
    folder.mkdir(parents=True)
    for name in ("hybrid.json", "hybrid_pop.json"):
        shutil.copy(RESULTS / name, folder)
    shutil.copy(DOCS / "results.md", folder.parent)
    return folder


def test_one_scene_anew(measured):
    """A row that is measured anew takes its place; the others, and the rest of the page, stay as they are."""
    results = json.loads((measured / "hybrid.json").read_text())
    write(results, measured)  # with the stamp of this code
    page = (measured.parent / "results.md").read_text()
    order = list(results["scenes"])
    row = results["scenes"].pop(order[0])
    old = f"{row['flip'][WHOLE]:.4f}"
    row["flip"][WHOLE] = 0.0777
    results["scenes"][order[0]] = row  # as if added last
    write(results, measured)
    assert list(json.loads((measured / "hybrid.json").read_text())["scenes"]) == order
    after = (measured.parent / "results.md").read_text()
    lines = [(a, b) for a, b in zip(page.splitlines(), after.splitlines(), strict=True) if a != b]
    assert len(lines) == 1 and old in lines[0][0] and "0.0777" in lines[0][1]
    write(json.loads((RESULTS / "hybrid.json").read_text()), measured)
    assert (measured.parent / "results.md").read_text() == page


def test_rows_of_one_page_have_the_same_settings(measured, tmp_path, capsys):
    """Another resolution for one scene of many is refused in one line, as is a scene that there is not; nothing is
    rendered or written."""
    before = (measured / "hybrid.json").read_text()
    for words, said in (
        (["indoor", "--resolution", "64x36"], "--resolution 320x180"),
        (["nowhere"], "no such scene: nowhere"),
    ):
        assert main([*words, "-o", str(measured), "--work", str(tmp_path / "work")]) == 2
        line = capsys.readouterr().err.strip()
        assert said in line and "\n" not in line
    assert not (tmp_path / "work").exists() and (measured / "hybrid.json").read_text() == before


def test_renders_are_of_their_scene(tmp_path, monkeypatch):
    """What was rendered of a file is not rendered again; that of another file of the same name, or with other samples
    of the raster, is."""
    from argparse import Namespace

    from lipac.scripts.studies.hybrid import results

    done = []

    def rendered(*words: object) -> None:
        folder = Path(str(words[3]))
        folder.mkdir(parents=True)
        (folder / "report.json").write_text('{"frames": [{}]}')
        done.append(folder)

    monkeypatch.setattr(results, "lipac", rendered)
    args = Namespace(work=tmp_path / "work", resolution="8x8", raster_samples=2)
    for name, count in (("a", 2), ("b", 4)):
        scene = tmp_path / name / "city.blend"
        scene.parent.mkdir()
        scene.write_text(name)
        for way in (TRUTH, CULLED, CULLED, TRUTH):
            render("city", scene, way, 4, args)
        assert len(done) == count
    args.raster_samples = 4
    render("city", scene, TRUTH, 4, args)
    assert len(done) == 4
    render("city", scene, CULLED, 4, args)
    assert len(set(done)) == 5


def test_mixtures_are_named():
    said = "\n".join(
        mixtures({"city": {"path_share": {ROUGH: 0.25}}, "hall": {"path_share": {}}, "old": {"raster_only": [ROUGH]}})
    )
    assert f"city ({ROUGH}: 25%)" in said and f"old ({ROUGH})" in said and "hall" not in said
