"""What came of an analysis and what renders show, in a line each: what the panel says first."""

from __future__ import annotations

import bpy

from ....core.files.figures import percent, size
from ..state import applying, results

MOST = 3  # warnings that are shown at once; Results has all


def verdict(scene: bpy.types.Scene) -> list[str]:
    """What is kept of the current frame, how much that changes and what it saves, a line each; what is not known is
    said."""
    result = results.at(scene)
    if result is None:
        found = results.of(scene)
        return [f"Frame {scene.frame_current} is not analyzed" if found else "Nothing is analyzed in this session"]
    total = len(result.state)
    said = [f"Keeps {total - int(result.culled.sum()):,} of {total:,} instances"]
    stats = result.stats
    if "certified_mean" in stats:
        mean, worst = (percent(stats[f"certified_{what}"]) for what in ("mean", "worst"))
        said.append(f"Changes the picture by at most {mean}, any tile by {worst} (95 % confidence)")
    else:
        said.append("How much the picture changes is not certified")
    said += _memory(result, scene)
    measured = results.differences.get((scene.session_uid, result.frame))
    if measured is not None:
        full_s, culled_s = measured.seconds
        said.append(f"Renders in {culled_s:.1f} s instead of {full_s:.1f} s")
    elif result.futile:
        said.append(result.futile)
    return said


def _memory(result: results.FrameResult, scene: bpy.types.Scene) -> list[str]:
    """What a render takes, where that was limited."""
    taken, limit, settings = result.taken, result.stats.get("memory_limit_bytes"), scene.lipac
    if taken is None or not limit:
        return []
    fits = taken.most <= limit
    said = [
        f"Renders take {size(taken.culled)} instead of {size(taken.full)}, and {size(taken.most)} at most: "
        f"{'within' if fits else 'MORE than'} the limit of {size(limit)}"
    ]
    budget = settings.max_error / 100, settings.worst_error / 100
    if result.stats["certified_mean"] > budget[0] or result.stats["certified_worst"] > budget[1]:
        said.append("That is more than the error budget: with less the limit would not hold")
    return said


def warnings(scene: bpy.types.Scene) -> list[str]:
    """The first lines that the analysis of the current frame wants to be read, and how many more there are."""
    result = results.at(scene)
    found = [] if result is None else list(result.warnings)
    more = len(found) - MOST
    return found if more <= 0 else [*found[:MOST], f"{more} more in Results"]


def status(scene: bpy.types.Scene) -> tuple[str, bool]:
    """What renders of a scene show, and whether that wants a look: `applying.status`, with frames that are not analyzed
    though renders go by analyses."""
    line, alert = applying.status(scene)
    settings, known = scene.lipac, results.of(scene)
    frames = range(scene.frame_start, scene.frame_end + 1, scene.frame_step)
    missing = sum(frame not in known for frame in frames)
    if settings.use_for_renders and not applying.marks() and scene.frame_current in known and 0 < missing < len(frames):
        line += f". {missing:,} of {len(frames):,} frames of the range are not analyzed: they render in full"
    return line, alert
