"""What the commands leave behind: report.json, states per frame, and the table at the end.

All files are written under another name and put in place at once (`files`), so whoever reads meets a whole file, also
after a crash or Ctrl-C.
"""

from __future__ import annotations

import io
import itertools
import json
import os
import time
import zipfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ..arrays import F32, F64, I32, I64, U8, Records
from ..errors import InputError
from ..progress import clock
from .atomic import alone, check_writable, replacing
from .figures import percent, size
from .level import AnyLevel, level_arrays, read_levels
from .memory_table import MemoryRow, merged, read_rows, write_rows
from .usage import peak_memory

SCHEMA = 1
HEADER = ("scene", "blender", "lipac", "policy", "engine", "seed")
SECONDS = ("sync_s", "build_s", "trace_s", "feedback_s", "writeback_s", "render_s")
SUMS = (*SECONDS, "verify_s", "blas_built", "paths", "rays", "iterations")
LARGEST = ("blas_bytes", "tlas_bytes")
COUNTS = ("instances", "active", "pending", "culled", "hitboxes", "meshes")
UNREADABLE = (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile)  # what reading states raises
FIELDS = ("frame", *COUNTS, "blas_built", *LARGEST, *SECONDS, "paths", "rays", "iterations")


def found_report(folder: Path) -> dict[str, Any] | None:
    """The report in a folder, None where there is none of this schema."""
    path = folder / "report.json"
    try:
        data = json.loads(path.read_text()) if path.is_file() else None
    except (OSError, ValueError, RecursionError):
        return None
    return data if isinstance(data, dict) and _is_report(data) else None


def _is_report(data: dict[str, Any]) -> bool:
    """Whether it has all that is read of a report."""
    frames, totals, options = (data.get(name) for name in ("frames", "totals", "options"))
    lines = [data.get(name) for name in ("approximated", "warnings")]
    return (
        data.get("schema") == SCHEMA
        and {*HEADER} <= data.keys()
        and isinstance(options, dict)
        and isinstance(totals, dict)
        and isinstance(totals.get("peak_bytes"), int)
        and all(isinstance(part, list) and all(isinstance(line, str) for line in part) for part in lines)
        and isinstance(frames, list)
        and all(
            isinstance(f, dict)
            and isinstance(f.get("frame"), int)
            and all(isinstance(f.get(name), int | float) for name in FIELDS)
            for f in frames
        )
    )


def output_folder(path: Path) -> Path:
    """The folder, created where it is missing. Raises InputError where nothing can be written into it."""
    try:
        path.mkdir(parents=True, exist_ok=True)
        check_writable(path)
    except OSError as error:
        raise InputError(
            f"cannot write to the output folder {path}: {error.strerror or error}; choose another with -o"
        ) from error
    return path


@dataclass
class Report:
    """report.json of one command.

    Header fields as in the file; options: whatever else the results depend on, by name, plain values. frames: one dict
    per frame that this command finished, with `FIELDS` and where measured `error`; missing fields count as 0.
    approximated: what the engine renders differently from Blender; warnings: other lines for the user. Both without
    repetitions, in order of appearance.

    broken: a verification found that a frame's change is above its budget. began: `time.monotonic()` when the command
    did.

    memory: who takes the memory of a render, of all frames, for memory.csv.

    A folder may be filled by several commands, one after the other or at the same time: the file keeps the frames of
    all that had the same header, but for the number of threads.
    """

    scene: str
    blender: str
    lipac: str
    policy: str
    engine: str
    seed: int
    threads: int
    options: dict[str, Any] = field(default_factory=dict)
    frames: list[dict[str, Any]] = field(default_factory=list)
    approximated: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    began: float = field(default_factory=time.monotonic)
    broken: bool = False
    memory: list[MemoryRow] = field(default_factory=list)
    _counted: float = field(default=0.0, init=False, repr=False)

    def add_frame(
        self,
        frame: dict[str, Any],
        approximated: Iterable[str] = (),
        warnings: Iterable[str] = (),
        memory: Iterable[MemoryRow] = (),
    ) -> None:
        """Add a finished frame, what was noticed in it, and who takes the memory of its render."""
        self.frames.append(dict.fromkeys(FIELDS, 0) | frame)
        self.add_memory(memory)
        self.note(self.approximated, approximated)
        self.note(self.warnings, warnings)

    def add_memory(self, rows: Iterable[MemoryRow]) -> None:
        """Take in who takes the memory of a frame's render."""
        self.memory = merged([*self.memory, *rows])

    @staticmethod
    def note(lines: list[str], new: Iterable[str]) -> None:
        """Append those of `new` that are not in `lines` yet."""
        known = set(lines)
        for line in new:
            if line not in known:
                known.add(line)
                lines.append(line)

    @property
    def status(self) -> int:
        """Exit status of the command: 3 where a verification found a budget broken."""
        return 3 if self.broken else 0

    def totals(self, frames: Sequence[dict[str, Any]] | None = None) -> dict[str, Any]:
        """Sums over frames, by default this command's, of seconds and of work done, the largest of bytes held, and the
        process's peak memory (0: unknown).

        wall_s: seconds from the command's begin until now, all that it did included.
        """
        frames = self.frames if frames is None else frames
        sums = {name: sum(f.get(name, 0) for f in frames) for name in SUMS}
        largest = {name: max((f[name] for f in frames), default=0) for name in LARGEST}
        return {"frames": len(frames), **sums, **largest, "wall_s": self.seconds(), "peak_bytes": peak_memory()}

    def seconds(self) -> float:
        """From the command's begin until now."""
        return time.monotonic() - self.began

    def as_dict(self) -> dict[str, Any]:
        """The contents of report.json, of this command alone."""
        header = {name: getattr(self, name) for name in (*HEADER, "threads")}
        lines = {"approximated": self.approximated, "warnings": self.warnings}
        return {
            "schema": SCHEMA,
            **header,
            "frames": self.frames,
            "totals": self.totals(),
            **lines,
            "options": self.options,
        }

    def other_options(self, folder: Path) -> list[str]:
        """Names of what differs between this command and the report in a folder; empty where that is of the same kind,
        or where there is none."""
        found = found_report(folder)
        return [] if found is None else self._differences(found)

    def finished(self, folder: Path) -> set[int] | None:
        """Numbers of the frames that the report in a folder has; None where there is none of the same kind."""
        found = found_report(folder)
        return None if found is None or self._differences(found) else {frame["frame"] for frame in found["frames"]}

    def write(self, folder: Path) -> None:
        """Write folder/report.json: the frames that it has already, where it is of the same kind, and this command's.
        Another is kept beside."""
        with alone(folder):
            data, found = self.as_dict(), found_report(folder)
            if (found is None or self._differences(found)) and (found is None or found["frames"]):
                keep_beside(folder / "report.json")
            if found is not None and not self._differences(found):
                own = {frame["frame"] for frame in self.frames}
                data["frames"] = sorted(
                    [*(f for f in found["frames"] if f["frame"] not in own), *self.frames],
                    key=lambda f: int(f["frame"]),
                )
                totals = self.totals(data["frames"])
                # what this command spent since it last wrote
                spent = found["totals"].get("wall_s", 0.0) + data["totals"]["wall_s"] - self._counted
                data["totals"] = totals | {
                    "wall_s": spent,
                    "peak_bytes": max(totals["peak_bytes"], found["totals"]["peak_bytes"]),
                }
                for name in ("approximated", "warnings"):
                    data[name] = list(dict.fromkeys([*found[name], *data[name]]))
                self.memory = merged([*self.memory, *read_rows(folder)])
            self._counted = self.seconds()
            if self.memory:
                write_rows(folder, self.memory)
            with replacing(folder / "report.json") as part:
                part.write_text(json.dumps(data, indent=1, default=_number) + "\n")

    def _differences(self, found: dict[str, Any]) -> list[str]:
        own = json.loads(json.dumps({name: getattr(self, name) for name in HEADER} | self.options, default=_number))
        theirs = {name: found[name] for name in HEADER} | found["options"]
        return sorted(name for name in own.keys() | theirs.keys() if own.get(name) != theirs.get(name))

    def table(self) -> str:
        """Frames and totals as text."""
        head = (
            "frame", "instances", "active", "hitboxes", "BLAS", "TLAS", "sync", "build", "trace", "write-back",
            "render"
        )
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
        everything = totals["wall_s"]
        last = f"{everything:.1f} s in all, of which {totals['render_s']:.1f} s rendering"
        if totals["verify_s"]:
            last += f", {totals['verify_s']:.1f} s verifying"
        peak = f"; peak memory {size(totals['peak_bytes'])}" if totals["peak_bytes"] else ""
        return "\n".join([*_aligned([head, *rows]), *self._error(), last + peak])

    def _error(self) -> list[str]:
        """How far the pictures may have changed, as the analysis found, and as --verify measured; why nothing was."""
        whole = next((f["not_analysed"] for f in self.frames if "not_analysed" in f), "")
        out = [f"{whole}; --cull light-paths analyses all the same"] * bool(whole)
        measured = f"measured on crops that {self.engine or 'path'} rendered in full and culled"
        sure = min((f["confidence"] for f in self.frames if "confidence" in f), default=0.0)
        unmeasured = not any("verified_mean" in f for f in self.frames)
        doubt = "as far as the analysis models the scene (see what is approximated), " * unmeasured
        for kind, text in (
            (
                "certified",
                f"{doubt * bool(self.approximated)}with {100 * sure:.0f} % confidence the picture changes by no more "
                "than",
            ),
            ("verified", measured),
        ):
            found = [f for f in self.frames if f"{kind}_mean" in f]
            if found:
                mean, worst = (max(f[f"{kind}_{what}"] for f in found) for what in ("mean", "worst"))
                out.append(
                    f"{text}: {percent(mean)} in the mean, {percent(worst)} in the worst tile"
                    + (" (of all frames)" if len(found) > 1 else "")
                )
        return out


@dataclass(frozen=True)
class States:
    """The states of a frame's instances, as `save_states` writes them. keys: kind (N,), host (N,), object (N,) and path
    (N, depth) by name. faces: by name of an object, (F,) bool, those of its mesh that stay; of others that stay all
    do. levels: by name of an object, what takes the place of its mesh."""

    state: U8
    score: F32
    hits: I64
    keys: dict[str, np.ndarray]
    names: tuple[str, ...]
    note: str = ""
    faces: Mapping[str, np.ndarray] = field(default_factory=dict)
    levels: Mapping[str, AnyLevel] = field(default_factory=dict)


def save_states(
    path: Path,
    state: U8,
    score: F32,
    hits: I64,
    keys: Records,
    names: Sequence[str],
    note: str = "",
    boxes: F64 | None = None,
    faces: Mapping[str, np.ndarray] | None = None,
    certified: F32 | None = None,
    levels: Mapping[str, AnyLevel] | None = None,
) -> None:
    """Write the states of a frame (states/frame_0001.npz).

    state (N,), score (N,), hits (N, RAY_TYPES), as in `core.culling.result.CullingResult`; key_kind, key_host,
    key_object (N,) and key_path (N, depth) are the fields of `lipac_addon.keys.KEY`, the path without the columns that
    no instance uses; names: strings that host and object index, those that are used, sorted, so that a frame's file is
    the same whatever other frames were looked at. Integers have the smallest type that holds them. note: a text to keep
    with it.
    boxes: (H, 2, 3) world boxes that stand in for what is culled. faces: as in `States`; in the file face_names (K,),
    face_counts (K,) and face_bits, packed. levels: as in `States`; in the file level_names (L,), level_counts (L,),
    level_corners (sum, 3) and level_faces (sum,). certified: (TILES,), as `CullingResult.tiles`. Not compressed: at a
    million instances that would take longer than the analysis.
    """
    depth = int((keys["path"] >= 0).any(axis=0).sum()) if len(keys) else 0
    host, ob, used = _renamed(keys["host"], keys["object"], names)
    arrays: dict[str, Any] = {
        "state": state,
        "score": score,
        "hits": hits.astype(np.min_scalar_type(int(hits.max(initial=0)))),
        "key_kind": keys["kind"],
        "key_host": host,
        "key_object": ob,
        "key_path": np.ascontiguousarray(keys["path"][:, :depth]),
        "names": np.array(used, dtype=np.str_) if used else np.zeros(0, "U1"),
    }
    if boxes is not None:
        arrays["boxes"] = boxes
    if faces:
        faces = dict(sorted(faces.items()))
        arrays["face_names"] = np.array(list(faces), dtype=np.str_)
        arrays["face_counts"] = np.array([len(mask) for mask in faces.values()])
        arrays["face_bits"] = np.packbits(np.concatenate(list(faces.values())))
    arrays |= level_arrays(levels or {})
    if certified is not None:
        arrays["certified"] = certified
    if note:
        arrays["note"] = np.array(note)
    # in memory first: a ZipFile that cannot write to a full disk complains again where it is freed, on Python 3.11
    archive = io.BytesIO()
    np.savez(archive, **arrays)
    with replacing(path) as part:
        part.write_bytes(archive.getbuffer())


def load_states(path: Path) -> States:
    """What `save_states` wrote. Raises one of UNREADABLE where it is not such a file."""
    with np.load(path) as data:
        keys = {name: data[f"key_{name}"] for name in ("kind", "host", "object", "path")}
        note = str(data["note"]) if "note" in data.files else ""
        faces = {}
        if "face_names" in data.files:
            ends = np.cumsum(data["face_counts"])
            masks = np.split(np.unpackbits(data["face_bits"], count=int(ends[-1])).astype(bool), ends[:-1])
            faces = dict(zip(data["face_names"].tolist(), masks, strict=True))
        state, score, hits, names = (data[name] for name in ("state", "score", "hits", "names"))
        return States(state, score, hits, keys, tuple(names.tolist()), note, faces, read_levels(data))


def _renamed(host: I32, ob: I32, names: Sequence[str]) -> tuple[I32, I32, list[str]]:
    """host and ob, (N,) indices into names (-1: none), as indices into the sorted list of those names that they use;
    and that list."""
    count = np.bincount(host[host >= 0], minlength=len(names)) + np.bincount(ob[ob >= 0], minlength=len(names))
    used = sorted(np.flatnonzero(count).tolist(), key=lambda n: names[n])
    place = np.full(len(names) + 1, -1, np.int32)  # the last is that of -1
    place[used] = np.arange(len(used))
    return place[host], place[ob], [names[n] for n in used]


def keep_beside(path: Path) -> None:
    """Give a file, if there is one, a name of its own: report_earlier_1.json."""
    if not os.path.lexists(path):
        return
    for k in itertools.count(1):
        other = path.with_name(f"{path.stem}_earlier_{k}{path.suffix}")
        if not os.path.lexists(other):
            os.rename(path, other)
            return


def _aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    widths = [max(len(row[c]) for row in rows) for c in range(len(rows[0]))]
    return ["  ".join(cell.rjust(w) for cell, w in zip(row, widths, strict=True)) for row in rows]


def _number(value: Any) -> Any:
    """NumPy numbers and arrays for json."""
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} is not for a report")
