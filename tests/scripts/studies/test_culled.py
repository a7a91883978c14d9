"""The table of Cycles' memory: what was rendered both ways."""

from __future__ import annotations

from lipac.scripts.studies.memory.culled import table


def test_what_was_rendered_in_full_and_culled_is_compared() -> None:
    culled = {
        "device_bytes": 25_000_000,
        "active": 1,
        "instances": 3,
        "parts": 80,
        "parts_active": 7,
        "certified_mean": 0.009,
        "certified_worst": 0.04,
        "verified_mean": 0.007,
        "verified_worst": 0.03,
        "verified_least_mean": 0.005,
        "verified_least_worst": 0.01,
    }
    text = table({"a": {"full": {"device_bytes": 100_000_000}, "culled": culled}, "b": {"full": {}}})
    (row,) = [line for line in text.splitlines() if "MB" in line]
    cells = [cell.strip() for cell in row.strip("|").split("|")]
    assert cells[:5] == ["a", "100 MB", "25 MB", "25 %", "1 of 3; 7 of 80 parts"]
    assert cells[5:] == ["0.90, 4.0 %", "0.70, 3.0 %", "0.50, 1.0 %"]
