"""What the commands leave behind: report.json, states per frame, and the table at the end.

All files are written under another name and put in place at once, so whoever reads meets a whole file, also after a crash or Ctrl-C.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from .errors import InputError
from .progress import clock
from .scene import F32, I64, U8, Records
from .usage import peak_memory

SCHEMA = 1
SECONDS = ("sync_s", "build_s", "trace_s", "feedback_s", "writeback_s", "render_s")
SUMS = (*SECONDS, "blas_built", "paths", "rays", "iterations")
LARGEST = ("blas_bytes", "tlas_bytes")
COUNTS = ("instances", "active", "pending", "culled", "hitboxes", "meshes")
FIELDS = ("frame", *COUNTS, "blas_built", *LARGEST, *SECONDS, "paths", "rays", "iterations")


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A path to write to, in the same folder and with the same suffix, that takes the place of `path` when the block ends without an error."""
    part = path.with_name(f".{path.stem}.part{path.suffix}")
    try:
        yield part
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


def output_folder(path: Path) -> Path:
    """The folder, created where it is missing. Raises InputError where nothing can be written into it."""
    try:
        path.mkdir(parents=True, exist_ok=True)
        probe = path / ".lipac"
        probe.write_bytes(b"")
        probe.unlink()
    except OSError as error:
        raise InputError(f"cannot write to the output folder {path}: {error.strerror or error}; choose another with -o") from error
    return path


@dataclass
class Report:
    """report.json of one command.

    Header fields as in the file. frames: one dict per finished frame, with `FIELDS` and where measured `error`; missing fields count as 0.
    approximated: what the engine renders differently from Blender; warnings: other lines for the user. Both without repetitions, in order of appearance.
    """

    scene: str
    blender: str
    lipac: str
    policy: str
    engine: str
    seed: int
    threads: int
    frames: list[dict[str, Any]] = field(default_factory=list)
    approximated: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)

    def add_frame(self, frame: dict[str, Any], approximated: Iterable[str] = (), warnings: Iterable[str] = ()) -> None:
        """Add a finished frame and what was noticed in it."""
        self.frames.append(dict.fromkeys(FIELDS, 0) | frame)
        self.note(self.approximated, approximated)
        self.note(self.warnings, warnings)

    @staticmethod
    def note(lines: list[str], new: Iterable[str]) -> None:
        """Append those of `new` that are not in `lines` yet."""
        known = set(lines)
        for line in new:
            if line not in known:
                known.add(line)
                lines.append(line)

    def totals(self) -> dict[str, Any]:
        """Sums over frames of seconds and of work done, the largest of bytes held, and the process's peak memory (0: unknown)."""
        sums = {name: sum(f[name] for f in self.frames) for name in SUMS}
        largest = {name: max((f[name] for f in self.frames), default=0) for name in LARGEST}
        return {"frames": len(self.frames), **sums, **largest, "peak_bytes": peak_memory()}

    def as_dict(self) -> dict[str, Any]:
        """The contents of report.json."""
        header = {name: getattr(self, name) for name in ("scene", "blender", "lipac", "policy", "engine", "seed", "threads")}
        return {
            "schema": SCHEMA,
            **header,
            "frames": self.frames,
            "totals": self.totals(),
            "approximated": self.approximated,
            "warnings": self.warnings,
        }

    def write(self, folder: Path) -> None:
        """Write folder/report.json."""
        with replacing(folder / "report.json") as part:
            part.write_text(json.dumps(self.as_dict(), indent=1, default=_number) + "\n")

    def table(self) -> str:
        """Frames and totals as text."""
        head = ("frame", "instances", "active", "hitboxes", "BLAS", "TLAS", "sync", "build", "trace", "write-back", "render")
        rows = [
            (
                str(f["frame"]),
                *(f"{f[name]:,}" for name in ("instances", "active", "hitboxes")),
                *(size(f[name]) for name in LARGEST),
                *(clock(f[name]) for name in ("sync_s", "build_s", "trace_s", "writeback_s", "render_s")),
            )
            for f in self.frames
        ]
        totals = self.totals()
        last = f"{sum(totals[name] for name in SECONDS):.1f} s in all, of which {totals['render_s']:.1f} s rendering"
        peak = f"; peak memory {size(totals['peak_bytes'])}" if totals["peak_bytes"] else ""
        return "\n".join([*_aligned([head, *rows]), last + peak])


def save_states(path: Path, state: U8, score: F32, hits: I64, keys: Records, names: Sequence[str]) -> None:
    """Write the states of a frame (states/frame_0001.npz).

    state (N,), score (N,), hits (N, RAY_TYPES), as in `core.loop.CullingResult`; key_kind, key_host, key_object (N,) and key_path (N, depth) are the fields of
    `lipac_addon.keys.KEY`, the path without the columns that no instance uses; names: strings that host and object index. Integers have the smallest type that
    holds them. Not compressed: at a million instances that would take longer than the analysis.
    """
    depth = int((keys["path"] >= 0).any(axis=0).sum()) if len(keys) else 0
    with replacing(path) as part:
        np.savez(
            part,
            state=state,
            score=score,
            hits=hits.astype(np.min_scalar_type(int(hits.max(initial=0)))),
            key_kind=keys["kind"],
            key_host=keys["host"],
            key_object=keys["object"],
            key_path=np.ascontiguousarray(keys["path"][:, :depth]),
            names=np.array(names, dtype=np.str_) if names else np.zeros(0, "U1"),
        )


def size(count: float) -> str:
    """Bytes as people read them."""
    for unit in ("B", "kB", "MB"):
        if count < 1000:
            return f"{count:.3g} {unit}" if unit != "B" else f"{count:.0f} B"
        count /= 1000
    return f"{count:.3g} GB"


def _aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    widths = [max(len(row[c]) for row in rows) for c in range(len(rows[0]))]
    return ["  ".join(cell.rjust(w) for cell, w in zip(row, widths, strict=True)) for row in rows]


def _number(value: Any) -> Any:
    """NumPy numbers and arrays for json."""
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} is not for a report")
