"""Culling renders of the open file by a result, and taking that back; the scene's switches say that it is so."""

from __future__ import annotations

import bpy

from .. import writeback
from . import props
from .results import FrameResult


def apply(scene: bpy.types.Scene, result: FrameResult, in_render: bool = False) -> writeback.WritebackResult:
    """Hide what a result culls from renders; pinned and ignored objects stay as they are. in_render: until the running render ends.

    Write-back speaks of the whole file, so this takes the place of what another scene's result had hidden.
    """
    untouched = result.of_objects(props.marked(props.PIN) | props.marked(props.IGNORE))
    applied = writeback.apply(result.culled & ~untouched, result.current_keys())
    _clear_switches()
    if in_render:
        scene.lipac.in_render = True
    else:
        scene.lipac.applied = True
    return applied


def restore() -> bool:
    """Show again all that was hidden, by whichever scene; True where there was something."""
    found = writeback.restore()
    _clear_switches()
    return found


def _clear_switches() -> None:
    for scene in bpy.data.scenes:
        for name in ("applied", "in_render"):
            if scene.library is None and getattr(scene.lipac, name):
                setattr(scene.lipac, name, False)
