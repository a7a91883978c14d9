"""Step `verify`: what culling changes in a frame of the sample, against the full scene, by the Blender that renders;
and a larger set for the frames around it where that is too much, or where paths do not certify the shot's set in one of
them.
"""

from __future__ import annotations

import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from ...core.error_budget.budget import Budget
from ...core.progress import Progress, part, silent
from ..batch.job import Cancel, check, never
from ..batch.verify import change, random_crops
from .analyse import decide_frames, note_of
from .children import crops_of, render
from .judge import FIGURES, judged, of_frames
from .layout import FarmShot, read_json, rendered_from, write_json
from .opening import open_shot
from .unite import chosen_of, parts_of, save_culled, united

MENDS = 3  # larger sets that are tried, the last one with everything
ALL = "all"


def verify(
    shot: FarmShot,
    number: int,
    blender: str = "",
    threads: int = 0,
    progress: Progress = silent,
    cancelled: Cancel = never,
) -> dict[str, Any]:
    """Verify a frame of the sample, by its number from 1, and mend its span; returns what was found, which is kept.
    Raises InputError, Cancelled."""
    chosen, span = chosen_of(shot), shot.span(number)
    known = read_json(shot.verified(number), key=shot.key, set=chosen)
    if known is not None and all(
        rendered_from(shot, frame, chosen) == known["attempts"][-1]["mended"] for frame in span
    ):
        return known
    told = of_frames(shot, span)
    start, frame = time.perf_counter(), shot.checked(number)
    crops = random_crops(shot.crops, shot.seed + frame)
    with tempfile.TemporaryDirectory(prefix="lipac") as temporary:
        place = Path(temporary)
        progress(0.0, f"frame {frame}, in full")
        full, in_full = crops_of(shot, frame, shot.scene, crops, place / "full", blender, cancelled)
        attempts: list[dict[str, Any]] = []
        for attempt in range(MENDS + 1):
            check(cancelled)
            within = part(progress, (attempt + 1) / (MENDS + 2), (attempt + 2) / (MENDS + 2), f"frame {frame}: ")
            budget = shot.budget if not attempt else tighter(shot.budget, attempts[-1], attempt)
            file = shot.culled
            if attempt:
                file, told = mend(shot, number, attempt, budget, threads, within, cancelled)
            culled, taken = crops_of(shot, frame, file, crops, place / str(attempt), blender, cancelled)
            found = change(full, culled, crops)
            broken = found.breaks(shot.budget)
            name = "" if not attempt else ALL if attempt == MENDS else file.stem
            paths = {
                "uncertified": [one["frame"] for one in told if not one["holds"]],
                "certified": [[one["certified_mean"], one["certified_worst"]] for one in told],
            }
            asked = {"mended": name, "broken": broken, "max_error": [budget.mean, budget.worst]}
            attempts.append({**found.entry(), **asked, **paths, **taken})
            if not broken and not paths["uncertified"]:
                break
    last = attempts[-1]
    if last["mended"]:
        progress(0.9, f"rendering frames around {frame} again")
        render(shot, span, blender, file, last["mended"], cancelled)
    kept = {
        "key": shot.key,
        "set": chosen,
        "frame": frame,
        "span": [span[0], span[-1]],
        "attempts": attempts,
    }
    entry = {**kept, "max_error": [shot.mean, shot.worst], "full": in_full, "seconds": time.perf_counter() - start}
    write_json(shot.verified(number), entry)
    return entry


def tighter(budget: Budget, found: dict[str, Any], attempt: int) -> Budget:
    """A budget that is as much smaller as the picture is above it, and by half more each time; in the end nothing may
    change."""
    if attempt == MENDS:
        return Budget(0.0, 0.0)
    share = (
        min(budget.mean / max(found["verified_mean"], 1e-9), budget.worst / max(found["verified_worst"], 1e-9), 1.0)
        / 2**attempt
    )
    return Budget(share * budget.mean, share * budget.worst)


def mend(
    shot: FarmShot, number: int, attempt: int, budget: Budget, threads: int, progress: Progress, cancelled: Cancel
) -> tuple[Path, list[dict[str, Any]]]:
    """A file with what the shot's set has, and what the span's frames need by a smaller budget; at the last attempt the
    scene itself. And what paths say of it in these frames."""
    if attempt == MENDS:
        nothing = {"holds": True, **dict.fromkeys(FIGURES, 0.0)}
        return shot.scene, [{"frame": frame, **nothing} for frame in shot.span(number)]
    file, span = shot.mended(number, attempt), shot.span(number)

    def place(frame: int) -> Path:
        return file.parent / file.stem / f"frame_{frame:04}.npz"

    open_shot(shot)
    asked = [budget.mean, budget.worst]
    todo = [
        frame
        for frame in span
        if any(note_of(place(frame)).get(name) != value for name, value in (("key", shot.key), ("max_error", asked)))
    ]
    half = part(progress, 0.0, 0.5)
    if todo:
        decide_frames(shot, todo, replace(shot.options(threads), max_error=budget), place, half, cancelled)
    together = united(shot, [*parts_of(shot), *map(place, span)])
    found = list(judged(shot, together, span, attempt, threads, part(progress, 0.5, 1.0), cancelled))
    save_culled(together, file)
    return file, found


def of_sample(shot: FarmShot) -> list[dict[str, Any]]:
    """What was found of the sample, for the set that is there; frames that were not looked at are missing."""
    chosen = chosen_of(shot)
    found = [read_json(shot.verified(number), key=shot.key, set=chosen) for number in range(1, shot.checks + 1)]
    return [one for one in found if one is not None]
