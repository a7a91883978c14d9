"""Step `unite`: one set for all frames of a shot, in a copy of the scene."""

from __future__ import annotations

import errno
import hashlib
import json
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import bpy

from ...core.errors import InputError
from ...core.files.atomic import is_whole, sweep
from ...core.files.report import UNREADABLE, load_states
from ...core.files.usage import peak_memory
from ...core.progress import Progress, silent
from ..batch.baked import save_copy
from ..batch.frame import write_back
from ..batch.job import Cancel, check, never
from ..batch.shot_set import ShotSet
from ..console import muted
from ..keys import packed
from .layout import FarmShot, read_json, write_json
from .opening import open_shot
from .stripping import strip


def unite(shot: FarmShot, progress: Progress = silent, cancelled: Cancel = never) -> dict[str, Any]:
    """Save the scene with what any frame needs, and which set that is; returns the latter. Raises InputError where an
    analysis is missing, Cancelled."""
    start = time.perf_counter()
    together = united(shot, (shot.analysis(frame) for frame in shot.frames), progress)
    chosen = digest_of(together)
    known = read_json(shot.united, key=shot.key, set=chosen)
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


def united(shot: FarmShot, analyses: Iterable[Path], progress: Progress = silent) -> ShotSet:
    """What any of the frames needs whose analyses these are. Raises InputError where one is missing, or of another
    job."""
    together, missing = ShotSet(), []
    for k, path in enumerate(analyses):
        progress(0.5 * k / len(shot.frames), f"reading {path.stem}")
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
        raise InputError(f"not analysed, or damaged: {few}; run lipac shot analyze {shot.folder} for these first")
    return together


def digest_of(together: ShotSet) -> str:
    """SHA-256 of a set: which instances there are, and which of them and of their faces stay."""
    keys = together.keys
    faces = (part for name in sorted(together.faces) for part in (name.encode(), together.faces[name].tobytes()))
    return hashlib.sha256(
        b"\0".join((packed(keys.records).tobytes(), "\0".join(keys.names).encode(), together.active.tobytes(), *faces))
    ).hexdigest()


def save_culled(together: ShotSet, path: Path) -> dict[str, Any]:
    """Save the open scene with only a set's active instances in renders, without what it then does not need; what came
    of that. It has to be opened again.

    Raises OSError.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    written: dict[str, Any] = {}
    warnings, _ = write_back(~together.active, together.keys, written, together.faces, lasting=True)
    with muted():
        removed = strip()
    try:
        save_copy(path)
    except RuntimeError as error:
        raise OSError(errno.EIO, str(error).strip().removeprefix("Error: ").splitlines()[0], str(path)) from error
    return {**written, "warnings": warnings, "removed": removed, "blender": bpy.app.version_string}
