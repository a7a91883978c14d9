"""The page of what was tried names tests that are there."""

from __future__ import annotations

import re

from .pages import ROOT


def test_each_row_names_tests() -> None:
    rows = [line.split(" | ") for line in (ROOT / "docs" / "tried.md").read_text().splitlines() if line[:2] == "| "]
    rows = [row for row in rows if row[0] != "| kind"]
    assert len(rows) > 50
    for row in rows:
        named = re.findall(r"`([\w/]+\.py)::(\w+)`", row[-1])
        assert named and len(named) == row[-1].count("`") // 2, row
        for file, function in named:
            path = ROOT / "tests" / file
            assert path.is_file(), file
            assert f"def {function}(" in path.read_text(), f"{file}::{function}"
