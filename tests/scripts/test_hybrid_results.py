"""Tables of the hybrid renderer: known answers, and docs that say what was measured."""

import json
from pathlib import Path

import pytest

from lipac.scripts import evaluate_report
from lipac.scripts.hybrid_results import CULLED, PATHS, RASTER, STAGES, TRUTH, WHOLE, cost_table, seconds
from lipac.scripts.options import cull_options, scene_parser

DOCS = Path(__file__).parents[2] / "docs"
RESULTS = DOCS / "results"


def test_docs_hold_what_was_measured():
    """The sections in docs/results.md are those of the figures beside it, and every picture that they show is there."""
    text = evaluate_report.hybrid(RESULTS)
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


@pytest.mark.parametrize(("frame", "wanted"), [({"render_s": 2.0}, 2.0), ({"render_s": 9.0, "timeline": [{"end_s": 1.0}, {"end_s": 3.0}]}, 3.0)])
def test_seconds(frame, wanted):
    assert seconds(frame) == wanted


@pytest.mark.parametrize(("engine", "said", "worst"), [("hybrid", "0.02", 0.02), ("hybrid", "0.02,0.1", 0.1), ("cycles", "0.02", 0.1), ("hybrid", None, 0.01)])
def test_budget_bounds_every_tile(engine, said, worst):
    """In hybrid pictures E bounds the worst tile too, unless T is said."""
    args = scene_parser("render", "").parse_args(["a.blend", "-o", "out", *(["--max-error", said] if said else [])])
    args.engine = engine
    assert cull_options(args).max_error.worst == pytest.approx(worst)
