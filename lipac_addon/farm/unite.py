"""Step `unite`: one set for all frames of a shot, in a copy of the scene."""

from __future__ import annotations

import errno
import hashlib
import json
import time
import zipfile
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from ...core.culling.options import State
from ...core.errors import InputError
from ...core.files.atomic import is_whole, sweep
from ...core.files.report import UNREADABLE, load_states, save_states
from ...core.files.shell import quoted
from ...core.files.usage import peak_memory
from ...core.progress import Progress, silent
from ..batch.baked import save_copy
from ..batch.frame import write_back
from ..batch.job import Cancel, check, never
from ..batch.shots.shot_set import ShotSet
from ..console import muted
from ..keys import packed
from .analyse import note_of
from .layout import FarmShot, read_json, write_json
from .opening import open_shot
from .stripping import drop_linked, strip

_LOOKS = 16  # files at a time that are looked at


def unite(shot: FarmShot, progress: Progress = silent, cancelled: Cancel = never) -> dict[str, Any]:
    """Save the scene with what any frame needs, and which set that is; returns the latter. Raises InputError where an
    analysis is missing, Cancelled."""
    start = time.perf_counter()
    together = united(shot, parts_of(shot), progress)
    chosen = digest_of(together)
    known = read_json(shot.united, key=shot.key, set=chosen)
    if note_of(shot.set).get("set") != chosen:
        save_set(shot.set, together, {"key": shot.key, "set": chosen})
    if known is not None and is_whole(shot.culled) and shot.culled.stat().st_size == known["blend_bytes"]:
        return known
    check(cancelled)
    open_shot(shot)
    sweep(shot.folder, {shot.culled.stem})
    written = save_culled(together, shot.culled)
    counts = {
        "instances": len(together.active),
        "active": int(together.active.sum()),
        "blend_bytes": shot.culled.stat().st_size,
    }
    found = {
        "key": shot.key,
        "set": chosen,
        **counts,
        **written,
        "seconds": time.perf_counter() - start,
        "peak_bytes": peak_memory(),
    }
    write_json(shot.united, found)
    return found


def unite_chunk(shot: FarmShot, frames: Sequence[int]) -> None:
    """Save what frames that follow each other need together, and of which files that is the union. Raises InputError
    where one is missing."""
    path, of = shot.chunk(frames), [contents(shot.analysis(frame)) for frame in frames]
    if len(frames) < 2 or note_of(path).get("of") == of:
        return
    save_set(path, united(shot, map(shot.analysis, frames)), {"key": shot.key, "of": of})


def save_set(path: Path, together: ShotSet, note: dict[str, Any]) -> None:
    """Save a set as a file of states, in which what was met has a hit."""
    keys, hits = together.keys, together.met.astype(np.int64)[:, None]
    state = np.where(together.active, np.uint8(State.ACTIVE), np.uint8(State.CULLED))
    score = np.zeros(len(state), np.float32)
    sweep(path.parent, {path.stem})
    save_states(path, state, score, hits, keys.records, keys.names, json.dumps(note), faces=together.faces)


def chosen_of(shot: FarmShot) -> str:
    """Which set the shot has. Raises InputError where there is none yet."""
    chosen = (read_json(shot.united, key=shot.key) or {}).get("set")
    if chosen is None:
        raise InputError(f"there is no set yet: run lipac shot unite {quoted(shot.folder)} first")
    return str(chosen)


def set_of(shot: FarmShot) -> ShotSet:
    """The shot's set. Raises InputError where there is none, or its file is missing or damaged."""
    if note_of(shot.set).get("set") != chosen_of(shot):
        raise InputError(f"{shot.set} is missing or damaged: run lipac shot unite {quoted(shot.folder)} again")
    together = ShotSet()
    together.add(load_states(shot.set))
    return together


def parts_of(shot: FarmShot) -> list[Path]:
    """Files whose union is what all frames need, in the frames' order: of chunks where there are any of the analyses
    that are there, and of frames."""
    last: dict[int, int] = {}
    for path in sorted(shot.analysis(shot.first).parent.glob("frames_*-*.npz")):
        first, _, end = path.stem.removeprefix("frames_").partition("-")
        if first.isdecimal() and end.isdecimal():
            last[int(first)] = max(int(end), last.get(int(first), 0))
    with ThreadPoolExecutor(_LOOKS) as pool:  # a shared folder answers late, not slowly
        of = list(pool.map(contents, map(shot.analysis, shot.frames if last else ())))
    parts, frame = [], shot.first
    while frame <= shot.last:
        chunk = range(frame, min(last.get(frame, frame), shot.last) + 1)
        path = shot.chunk(chunk)
        known = len(chunk) > 1 and note_of(path).get("of") == of[frame - shot.first :][: len(chunk)]
        parts.append(path if known else shot.analysis(frame))
        frame += len(chunk) if known else 1
    return parts


def contents(path: Path) -> str:
    """What tells an analysis from any other: of the check sums in its directory, so that it need not be read. Empty
    where it is missing or damaged."""
    try:
        with zipfile.ZipFile(path) as archive:
            found = [(entry.filename, entry.file_size, entry.CRC) for entry in archive.infolist()]
    except UNREADABLE:
        return ""
    return hashlib.sha256(json.dumps(found).encode()).hexdigest() if is_whole(path) else ""


def united(shot: FarmShot, analyses: Iterable[Path], progress: Progress = silent) -> ShotSet:
    """What any of the frames needs whose analyses these are. Raises InputError where one is missing, or of another
    job."""
    together, missing, paths = ShotSet(), [], list(analyses)
    for k, path in enumerate(paths):
        progress(0.5 * k / len(paths), f"reading {path.stem}")
        try:
            states = load_states(path)
            if json.loads(states.note)["key"] != shot.key:
                raise ValueError
        except UNREADABLE:
            missing.append(path.stem)
            continue
        together.add(states)
    if missing:
        few = ", ".join(missing[:5]) + (f" and {len(missing) - 5} more" if len(missing) > 5 else "")
        raise InputError(
            f"not analysed, or damaged: {few}; run lipac shot analyze {quoted(shot.folder)} for these first"
        )
    return together


def digest_of(together: ShotSet) -> str:
    """SHA-256 of a set, in whatever order it was united: which instances there are, and which of them and of their
    faces stay."""
    names, records = sorted(together.keys.names), together.keys.records.copy()
    place = np.append(np.searchsorted(names, together.keys.names), -1)  # the last is that of -1
    records["host"], records["object"] = place[records["host"]], place[records["object"]]
    rows = packed(records)
    order = np.argsort(rows)
    faces = (part for name in sorted(together.faces) for part in (name.encode(), together.faces[name].tobytes()))
    parts = rows[order].tobytes(), "\0".join(names).encode(), together.active[order].tobytes()
    return hashlib.sha256(b"\0".join((*parts, *faces))).hexdigest()


def save_culled(together: ShotSet, path: Path) -> dict[str, Any]:
    """Save the open scene with only a set's active instances in renders, without what it then does not need; what came
    of that. It has to be opened again.

    Raises OSError.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    written: dict[str, Any] = {}
    with muted():
        gone = drop_linked(~together.active, together.keys)
    warnings, _ = write_back(~together.active & ~gone, together.keys, written, together.faces, lasting=True)
    with muted():
        removed = strip() + len(np.unique(together.keys.records["object"][gone]))
    try:
        save_copy(path)
    except RuntimeError as error:
        raise OSError(errno.EIO, str(error).strip().removeprefix("Error: ").splitlines()[0], str(path)) from error
    return {**written, "warnings": warnings, "removed": removed, "blender": bpy.app.version_string}
