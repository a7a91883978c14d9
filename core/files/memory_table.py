"""memory.csv: who takes the memory of a render, the largest first."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from .atomic import replacing

NAME = "memory.csv"
RAYS = ("camera", "diffuse", "glossy", "transmission", "shadow")


@dataclass(frozen=True)
class MemoryRow:
    """What an object, a mesh or an image takes of a render by Cycles on the CPU. `bytes` of all objects, or of all
    meshes and images, together are what the scene takes; the process and the picture come on top.

    kind: object, mesh or image; name: full name in Blender. bytes: in the render as it was decided; full_bytes: with
    nothing culled; geometry_bytes, bvh_bytes, image_bytes: parts of bytes; of what several objects share each has its
    part. instances, kept: how many show it, and how many of these the render has. worth: share of the picture that it
    may be worth, None where that was not measured; camera to shadow: light paths that met it, None where none were
    traced. frame: the one in which it takes most, which the figures are of. why: why it stays or goes.
    """

    kind: str
    name: str
    bytes: int
    full_bytes: int
    geometry_bytes: int
    bvh_bytes: int
    image_bytes: int
    instances: int
    kept: int
    worth: float | None
    camera: int | None
    diffuse: int | None
    glossy: int | None
    transmission: int | None
    shadow: int | None
    frame: int
    why: str

    @property
    def size(self) -> tuple[int, int]:
        """What rows are sorted by."""
        return self.bytes, self.full_bytes


COLUMNS = tuple(field.name for field in fields(MemoryRow))
_TEXTS = ("kind", "name", "why")


def merged(rows: Iterable[MemoryRow]) -> list[MemoryRow]:
    """Each thing once, in the frame in which it takes most; the largest first."""
    found: dict[tuple[str, str], MemoryRow] = {}
    for row in rows:
        known = found.get((row.kind, row.name))
        if known is None or row.size > known.size:
            found[row.kind, row.name] = row
    return sorted(found.values(), key=lambda row: (-row.bytes, -row.full_bytes, row.kind, row.name))


def write_rows(folder: Path, rows: Sequence[MemoryRow]) -> None:
    """Write folder/memory.csv."""
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    for row in rows:
        values = [getattr(row, name) for name in COLUMNS]
        writer.writerow(["" if v is None else f"{v:.6g}" if isinstance(v, float) else v for v in values])
    with replacing(folder / NAME) as part:
        part.write_text(text.getvalue(), encoding="utf-8")


def read_rows(folder: Path) -> list[MemoryRow]:
    """What `write_rows` wrote; nothing where there is no such file, or another kind of file."""
    try:
        with (folder / NAME).open(newline="", encoding="utf-8") as file:
            table = list(csv.DictReader(file))
        return [MemoryRow(**{name: _value(name, row[name]) for name in COLUMNS}) for row in table]
    except (OSError, ValueError, KeyError, TypeError, csv.Error):
        return []


def _value(name: str, text: str) -> Any:
    if name in _TEXTS:
        return text
    if name in ("worth", *RAYS) and not text:
        return None
    return float(text) if name == "worth" else int(text)
