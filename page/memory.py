"""Who takes the memory of a render: what a page shows of memory.csv."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ..core.files.memory_table import MemoryRow, read_rows

MOST = 12  # rows of a kind


@dataclass(frozen=True)
class Takers:
    """What takes most with nothing culled, `rows`, of `total` objects, or meshes and images, which take `bytes`, of
    `full_bytes` with nothing culled. top: bytes that a bar of full length stands for."""

    what: str
    rows: tuple[MemoryRow, ...]
    total: int
    bytes: int
    full_bytes: int
    top: int


def takers(folder: Path) -> list[Takers]:
    """Objects, and meshes and images, of a folder's table; nothing where it has none."""
    rows = read_rows(folder)
    parts = {"objects": ("object",), "meshes and images": ("mesh", "image")}
    return [_those(what, found) for what, kinds in parts.items() if (found := [r for r in rows if r.kind in kinds])]


def _those(what: str, rows: Sequence[MemoryRow]) -> Takers:
    first = sorted(rows, key=lambda row: (-max(row.full_bytes, row.bytes), row.name))[:MOST]
    own, full = sum(row.bytes for row in rows), sum(row.full_bytes for row in rows)
    return Takers(what, tuple(first), len(rows), own, full, max(first[0].full_bytes, first[0].bytes, 1))
