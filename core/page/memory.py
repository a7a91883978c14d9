"""Who takes the memory: memory.csv of a folder, where there is one."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

MOST = 12  # rows of a kind


@dataclass(frozen=True)
class Taker:
    """What an object, a mesh or an image takes. share, full_share: of the largest of its kind, of bytes and full_bytes;
    worth: the share of the picture that it may be worth, None where that was not measured; why: why it stays or
    goes."""

    name: str
    kind: str
    bytes: int
    full_bytes: int
    share: float
    full_share: float
    kept: int
    instances: int
    worth: float | None
    why: str


@dataclass(frozen=True)
class Takers:
    """Those that take most, with nothing culled, of `total` things that take `bytes`, of `full_bytes` with nothing
    culled."""

    what: str
    rows: tuple[Taker, ...]
    total: int
    bytes: int
    full_bytes: int


def takers(path: Path) -> list[Takers]:
    """Objects, and meshes and images, of a table as `lipac render` writes it; nothing where there is no such table."""
    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
        parts = [
            _those(what, [row for row in rows if row["kind"] in kinds])
            for what, kinds in (("objects", ("object",)), ("meshes and images", ("mesh", "image")))
        ]
    except (OSError, ValueError, KeyError, TypeError, csv.Error):
        return []
    return [part for part in parts if part.rows]


def _those(what: str, rows: Iterable[Mapping[str, str]]) -> Takers:
    """Raises KeyError, TypeError or ValueError where a row is not of that table."""
    found = sorted(rows, key=lambda row: (-int(row["full_bytes"]), -int(row["bytes"]), row["name"]))
    taken = [(int(row["bytes"]), int(row["full_bytes"])) for row in found]
    top = max((max(pair) for pair in taken), default=0) or 1
    shown = tuple(
        Taker(
            row["name"],
            row["kind"],
            own,
            full,
            own / top,
            full / top,
            int(row["kept"]),
            int(row["instances"]),
            float(row["worth"]) if row["worth"] else None,
            row["why"],
        )
        for row, (own, full) in zip(found[:MOST], taken, strict=False)
    )
    return Takers(what, shown, len(found), sum(own for own, _ in taken), sum(full for _, full in taken))
