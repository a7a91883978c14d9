"""Who takes the memory: memory.csv of a folder, where there is one."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

from ..files.report import size

MOST = 15  # rows of a page
UNIT = "bytes"


@dataclass(frozen=True)
class Takers:
    """columns: names; rows: those of the file that take most, as people read them, each with its share of the first of
    them; of: how many rows the file has."""

    columns: tuple[str, ...]
    rows: tuple[tuple[float, tuple[str, ...]], ...]
    of: int


def takers(path: Path) -> Takers | None:
    """The rows of a table that take most memory, by its first column of bytes; None where there is no such table."""
    try:
        with path.open(newline="", encoding="utf-8") as file:
            head, *rows = csv.reader(file)
    except (OSError, ValueError, csv.Error):
        return None
    by = next((k for k, name in enumerate(head) if UNIT in name), None)
    if by is None:
        return None
    rows = sorted((row for row in rows if len(row) == len(head)), key=lambda row: -_number(row[by]))
    top = max(_number(rows[0][by]), 1.0) if rows else 1.0
    shown = tuple((_number(row[by]) / top, tuple(map(_cell, head, row))) for row in rows[:MOST])
    return Takers(
        tuple(name.replace("_", " ").replace(UNIT, "").strip() or "memory" for name in head), shown, len(rows)
    )


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return 0.0


def _cell(name: str, text: str) -> str:
    return size(_number(text)) if UNIT in name and text else text
