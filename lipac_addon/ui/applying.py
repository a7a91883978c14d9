"""Culling renders of the open file by a result, and taking that back; the scene's switches say that it is so."""

from __future__ import annotations

import bpy
import numpy as np

from .. import writeback
from ..keys import Kind
from . import props, scatters
from .results import FrameResult

CHANGED = "their scatter has changed since the analysis: analyze again"
notes: tuple[str, ...] = ()  # of the last `apply`: which culled instances stay, and why


def apply(scene: bpy.types.Scene, result: FrameResult, in_render: bool = False) -> writeback.WritebackResult:
    """Hide what a result culls from renders; pinned and ignored objects stay as they are, and scatters that are others than those that were analysed.

    in_render: until the running render ends. Write-back speaks of the whole file, so this takes the place of what another scene's result had hidden.
    """
    global notes  # noqa: PLW0603
    writeback.restore(in_render)
    _clear_switches()
    culled = result.culled & ~result.of_objects(props.marked(props.PIN) | props.marked(props.IGNORE))
    changed = culled & _of_changed(scene, result)
    keys = result.current_keys()
    rows = {} if scene.render.use_motion_blur else {name: result.scatters[uid] for name, uid in _names(result, keys.names) if uid in result.scatters}
    applied = writeback.apply(culled & ~changed, keys, rows, scene=scene, lasting=not in_render, in_render=in_render)
    if changed.any():
        applied.kept[CHANGED] = int(changed.sum())
    notes = tuple(f"{count:,} culled instances stay in renders: {why}" for why, count in applied.kept.items())
    if in_render:
        scene.lipac.in_render = True
    else:
        scene.lipac.applied = True
    return applied


def forget() -> None:
    """Another file is open."""
    global notes  # noqa: PLW0603
    notes = ()


def restore(in_render: bool = False) -> bool:
    """Show again all that was hidden, by whichever scene; True where there was something. in_render: a handler of a render calls."""
    found = writeback.restore(in_render)
    _clear_switches()
    return found


def _names(result: FrameResult, names: tuple[str, ...]) -> list[tuple[str, int]]:
    return [(name, uid) for name, uid in zip(names, result.uids.tolist(), strict=True) if name]


def _of_changed(scene: bpy.types.Scene, result: FrameResult) -> np.ndarray:
    """(N,) bool: instances of scatters that have changed. Nothing is known of a frame that the viewport does not show."""
    now = scatters.prints_of(scene, result.prints) if result.prints else {}
    changed = np.array([uid for uid, seen in now.items() if seen != result.prints[uid]], np.int64)
    host = result.keys.records["host"]
    table = np.append(np.isin(result.uids, changed), False)  # index -1: no host
    return np.asarray(table[host] & (result.keys.records["kind"] == Kind.GEOMETRY_NODES))


def _clear_switches() -> None:
    for scene in bpy.data.scenes:
        for name in ("applied", "in_render"):
            if scene.library is None and getattr(scene.lipac, name):
                setattr(scene.lipac, name, False)
