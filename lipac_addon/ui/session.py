"""Blender's session: scenes found again, windows drawn again, renders under way."""

from __future__ import annotations

import bpy


def find_scene(uid: int) -> bpy.types.Scene | None:
    """A scene by its session uid: undo makes new ones of everything, so references are not kept."""
    return next((s for s in bpy.data.scenes if s.session_uid == uid), None)


def is_rendering() -> bool:
    """Whether Blender renders beside the user's work: what the render shows must not change meanwhile."""
    return bool(bpy.app.is_job_running("RENDER"))


def redraw() -> None:
    """Have all 3D viewports drawn again."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                area.tag_redraw()
