"""Figures that pages quote are those of the page that the measuring code wrote; constants are the code's."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from lipac.core.accel import region_tree
from lipac.core.culling import activation, analysis, certificate, frame_tracer, loop, measurement, options
from lipac.core.error_budget import budget, error_estimate, search, units
from lipac.core.feedback import hits, path_log, tiles
from lipac.core.scene import mesh
from lipac.core.tracing import path_state, seen_emitters

from .pages import ROOT

SOURCES = ("benchmarks.md", "animation.md", "family.md", "results.md", "fuzz.md")
QUOTING = (ROOT / "README.md", ROOT / "docs" / "for-my-scene.md")
_SOURCE = re.compile(r"\]\((?:docs/)?(" + "|".join(map(re.escape, SOURCES)) + r")[^)]*\)")
_FIGURE = re.compile(r"(?<![\w.#])\d[\d,]*(?:\.\d+)?(?![\w]*x\d)")
# What is no measurement: a condition that is measured under, or a goal
CONDITIONS = {"1920", "1080", "320", "180", "4", "32", "128", "5", "2", "1"}


def quoted(page: Path) -> list[tuple[str, str, set[str]]]:
    """Of rows of tables and paragraphs that name a source: the text, each figure in it, and the pages that may have
    it."""
    lines = page.read_text().split("\n")
    rows = [line for line in lines if line.startswith("|")]
    paragraphs = "\n".join("" if line.startswith("|") else line for line in lines).split("\n\n")
    found = []
    for text in rows + paragraphs:
        sources = set(_SOURCE.findall(text))
        if sources and "```" not in text:
            shown = re.sub(r"\]\([^)]*\)", "]", text)
            found += [(text, figure.rstrip(","), sources) for figure in _FIGURE.findall(shown)]
    return found


@pytest.mark.parametrize("page", QUOTING, ids=lambda page: page.name)
def test_quoted_figures_are_those_of_their_source(page: Path) -> None:
    """Each figure stands there, as a number of its own."""
    rows = quoted(page)
    assert len(rows) > 20
    for row, figure, sources in rows:
        text = "\n".join((ROOT / "docs" / source).read_text() for source in sorted(sources))
        there = re.search(rf"(?<![\d.,]){re.escape(figure)}(?![\d]|[.,]\d)", text)
        assert there or figure in CONDITIONS, f"{page.name}: {figure} is not in {sources}: {row}"


@pytest.mark.parametrize("page", QUOTING, ids=lambda page: page.name)
def test_rows_with_seconds_or_bytes_name_their_source(page: Path) -> None:
    for row in page.read_text().splitlines():
        if row.startswith("|") and re.search(r"\d (?:s|MB|GB|times)\b", row):
            assert _SOURCE.search(row), f"{page.name}: {row}"


def missed(text: str) -> list[str]:
    """Rows of the benchmarks that do not reach their target, by their first cell."""
    out = []
    for row in text.splitlines():
        cells = [cell.strip() for cell in row.strip("|").split("|")]
        goal = re.match(r"(>=|<=) ([\d.]+)", cells[-1]) if len(cells) == 6 else None
        measured = re.match(r"[\d.]+", cells[4] or cells[2]) if goal else None
        if goal and measured:
            holds = float(measured[0]) >= float(goal[2]) if goal[1] == ">=" else float(measured[0]) <= float(goal[2])
            if not holds:
                out.append(row)
    return out


def test_missed_targets_are_marked() -> None:
    """In the benchmarks themselves, and where README quotes them."""
    rows = missed((ROOT / "docs" / "benchmarks.md").read_text())
    assert len(rows) > 2
    assert all("missed" in row for row in rows), rows
    for page in QUOTING:
        for row in page.read_text().splitlines():
            if "3.41" in row and row.startswith("|"):
                assert "miss" in row


CONSTANTS = {
    "TILES": f"{tiles.COLUMNS} \\times {tiles.ROWS}",
    "BLOCK": tiles.BLOCK,
    "SHRINKAGE": error_estimate.SHRINKAGE,
    "FEW_BLOCKS": error_estimate.FEW_BLOCKS,
    "DARK": tiles.DARK,
    "RECORD": path_log.RECORD,
    "MAX_VERTICES": path_state.MAX_VERTICES,
    "EVIDENCE": units.EVIDENCE,
    "SMALL": seen_emitters.SMALL,
    "POLISHED": seen_emitters.POLISHED,
    "UNASKED": activation.UNASKED,
    "PRICELESS": analysis.PRICELESS,
    "TILE_PATHS": options.TILE_PATHS,
    "MOST_PATHS": options.MOST_PATHS,
    "ENTRY_BYTES": budget.ENTRY_BYTES,
    "LIKELY": search.LIKELY,
    "DEVIATIONS": search.DEVIATIONS,
    "SHARE": search.SHARE,
    "AIM": search.AIM,
    "PATIENCE": search.PATIENCE,
    "TRIALS": search.TRIALS,
    "PATHS": search.PATHS,
    "WIDER": search.WIDER,
    "WIDENINGS": search.WIDENINGS,
    "DENSER": search.DENSER,
    "WORTH_WHILE": search.WORTH_WHILE,
    "LEAST_GAIN": search.LEAST_GAIN,
    "UNMET": search.UNMET,
    "NEAR": error_estimate.NEAR,
    "CONFIDENCE": error_estimate.CONFIDENCE,
    "ATTEMPTS": analysis.ATTEMPTS,
    "CROWDED": analysis.CROWDED,
    "LOOKS": certificate.LOOKS,
    "LEVELS": certificate.LEVELS,
    "TOLERATED": certificate.TOLERATED,
    "FAILURES": certificate.FAILURES,
    "NEGLIGIBLE": certificate.NEGLIGIBLE,
    "PIECES": search.PIECES,
    "DENSEST": certificate.DENSEST,
    "STEEPEST": certificate.STEEPEST,
    "MORE": certificate.MORE,
    "DOUBTS": analysis.DOUBTS,
    "DENSER_TIMES": analysis.DENSER_TIMES,
    "RENDERED": certificate.RENDERED,
    "ENTRIES_PER_PATH": loop.ENTRIES_PER_PATH,
    "OPENINGS": loop.OPENINGS,
    "LIT": measurement.LIT,
    "COINCIDENT": frame_tracer.COINCIDENT,
    "LARGE": activation.LARGE,
    "COLD_HITS": activation.COLD_HITS,
    "SETTLED": activation.SETTLED,
    "UNKNOWN": loop.UNKNOWN,
    "BOXES_PER_SEGMENT": frame_tracer.BOXES_PER_SEGMENT,
    "BOXES_AMONG_PARTS": frame_tracer.BOXES_AMONG_PARTS,
    "DIVIDED_SHARE": mesh.DIVIDED_SHARE,
    "DIVIDED_LEAST": mesh.DIVIDED_LEAST,
    "DIVIDED_MOST": mesh.DIVIDED_MOST,
    "FANOUT": region_tree.FANOUT,
    "MERGE_BELOW": region_tree.MERGE_BELOW,
    "RESPLIT_WINDOW": region_tree.RESPLIT_WINDOW,
    "MIN_OPEN": region_tree.MIN_OPEN,
}


def test_constants_of_the_method() -> None:
    """The table of docs/method.md has the values of the code, in the order of the names in its first column."""
    table = (ROOT / "docs" / "method.md").read_text().split("## 10. Constants")[1].split("## 11.")[0]
    found: dict[str, str] = {}
    for row in (line.split(" | ") for line in table.splitlines() if line.startswith("| `")):
        names = re.findall(r"`(\w+)`", row[0])
        values = [row[1]] if len(names) == 1 else row[1].split(", ")
        found |= dict(zip(names, values, strict=True))
    assert found.pop("_FIXED") == "$2^{20}$"
    assert hits._FIXED == 2**20
    assert found.pop("ROUND_PATHS") == "$2^{14}$"
    assert loop.ROUND_PATHS == 2**14
    assert set(found) == set(CONSTANTS)
    for name, value in CONSTANTS.items():
        numbers = value if isinstance(value, str) else value if isinstance(value, tuple) else (value,)
        if isinstance(numbers, str):
            assert numbers in found[name], name
            continue
        said = [float(x) for x in re.findall(r"[\d.]+", found[name])]
        assert said == [float(x) for x in numbers], name
