"""What steps take, measured on one frame before the job is written: the analysis is kept, and counts; of the full scene
a part of the picture is rendered."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ....core.progress import Progress, silent
from ...batch.job import Cancel, never
from ...batch.verify import GRID, random_crops
from ..analyse import note_of
from ..children import crops_of, run
from ..layout import FarmShot, read_json, write_json


def measure(
    shot: FarmShot, lipac: Sequence[str], blender: str = "", progress: Progress = silent, cancelled: Cancel = never
) -> dict[str, Any]:
    """Seconds of a frame and peak memory of its process, `analysis` and `full`, in bytes; kept as measured.json. lipac:
    as of `children.lipac_program`.

    Raises InputError where the frame cannot be analysed or rendered, Cancelled.
    """
    path = shot.folder / "measured.json"
    if (known := read_json(path, key=shot.key)) is not None:
        return known
    frame = shot.frames[len(shot.frames) // 2]
    progress(0.0, f"measuring the analysis of frame {frame}")
    run([*lipac, "analyze", str(shot.folder), "--scene", str(shot.scene), "--frames", str(frame), "--quiet"], cancelled)
    note = note_of(shot.analysis(frame))
    progress(0.5, f"measuring the render of frame {frame}")
    with tempfile.TemporaryDirectory(prefix="lipac") as place:
        _, taken = crops_of(shot, frame, shot.scene, random_crops(1, shot.seed), Path(place), blender, cancelled)
    analysis = {name: note[name] for name in ("seconds", "peak_bytes")}
    full = {"seconds": taken["seconds"] * GRID[0] * GRID[1], "peak_bytes": taken["peak_bytes"]}
    found = {"key": shot.key, "frame": frame, "analysis": analysis, "full": full}
    write_json(path, found)
    return found
