"""Blender's session: scenes found again, windows drawn again, what the user is at."""

from __future__ import annotations

import bpy
import numpy as np
from numpy.typing import NDArray

GONE = "the scene was removed meanwhile"


def find_scene(uid: int) -> bpy.types.Scene | None:
    """A scene by its session uid: undo makes new ones of everything, so references are not kept."""
    return next((s for s in bpy.data.scenes if s.session_uid == uid), None)


def is_rendering() -> bool:
    """Whether Blender renders beside the user's work: what the render shows must not change meanwhile."""
    return bool(bpy.app.is_job_running("RENDER"))


def is_edited() -> bool:
    """Whether something is in Edit Mode: Blender then gives out no faces of a mesh, and rest poses of armatures."""
    return bool((_modes() == bpy.types.Object.bl_rna.properties["mode"].enum_items["EDIT"].value).any())


def not_in_object_mode() -> list[bpy.types.Object]:
    """Objects that are edited, sculpted, painted or posed."""
    return [bpy.data.objects[int(n)] for n in np.flatnonzero(_modes())]


def _modes() -> NDArray[np.int32]:
    modes = np.zeros(len(bpy.data.objects), np.int32)
    bpy.data.objects.foreach_get("mode", modes)  # of all: the active object may have become another meanwhile
    return modes


def redraw() -> None:
    """Have all 3D viewports drawn again."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                area.tag_redraw()
