"""Application handlers: culling during renders, recovery on load, and what live mode has to know."""

from __future__ import annotations

from typing import Any

import bpy
from bpy.app.handlers import persistent

from ..writeback import viewport
from .draw import overlay
from .jobs import job, live
from .state import applying, results

_ENGINE = "LIPAC_EXTRACT"  # our own reading of the scene is a render, too


@persistent
def before_frame(scene: bpy.types.Scene, *_: Any) -> None:
    """render_pre: cull the frame that is about to be rendered, if it was analysed; other frames are rendered in
    full."""
    if scene.render.engine != _ENGINE and scene.lipac.use_for_renders:
        applying.cull_frame(scene)


@persistent
def after_render(scene: bpy.types.Scene, *_: Any) -> None:
    """render_complete, render_cancel: put everything back."""
    if scene.render.engine != _ENGINE:
        applying.end_render(scene)


@persistent
def before_load(*_: Any) -> None:
    """load_pre: the file that is analysed goes away."""
    job.stop()
    live.suspend()


@persistent
def after_load(*_: Any) -> None:
    """load_post: results were of another file; what a render hid that never ended (a crash, a file saved meanwhile) is
    shown again."""
    results.clear()
    applying.forget()
    overlay.forget()
    for scene in bpy.data.scenes:
        if scene.library is None and scene.lipac.freeze:
            scene.lipac.freeze = False  # the boxes that it kept are gone
    if any(scene.lipac.in_render for scene in bpy.data.scenes):
        applying.restore()
    viewport.restore()  # of a file that Blender saved by itself


@persistent
def before_save(*_: Any) -> None:
    """save_pre: what live culling took out of the viewport is not saved."""
    if live.current is not None:
        live.current.culling.switches.lift(masks_only=False)


@persistent
def after_save(*_: Any) -> None:
    """save_post, save_post_fail: it goes out again."""
    if live.current is not None:
        live.current.culling.switches.put_back()


@persistent
def after_change(_scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph | None = None) -> None:
    """depsgraph_update_post, frame_change_post: Blender evaluated what the user changed, or another frame."""
    if live.current is not None and depsgraph is not None:
        live.current.note(depsgraph)


@persistent
def before_undo(*_: Any) -> None:
    """undo_pre, redo_pre: all references into the file are about to die."""
    if live.current is not None:
        live.current.forget()
        live.current.culling.switches.lift(masks_only=True)


@persistent
def after_undo(*_: Any) -> None:
    """undo_post, redo_post: what is hidden may be something else."""
    applying.recount()
    if live.current is not None:
        live.current.culling.switches.put_back()
    else:
        viewport.restore()  # of a step that was taken while live mode was on


_HANDLERS = (
    (bpy.app.handlers.depsgraph_update_post, after_change),
    (bpy.app.handlers.frame_change_post, after_change),
    (bpy.app.handlers.undo_pre, before_undo),
    (bpy.app.handlers.redo_pre, before_undo),
    (bpy.app.handlers.undo_post, after_undo),
    (bpy.app.handlers.redo_post, after_undo),
    (bpy.app.handlers.render_pre, before_frame),
    (bpy.app.handlers.render_complete, after_render),
    (bpy.app.handlers.render_cancel, after_render),
    (bpy.app.handlers.save_pre, before_save),
    (bpy.app.handlers.save_post, after_save),
    (bpy.app.handlers.save_post_fail, after_save),
    (bpy.app.handlers.load_pre, before_load),
    (bpy.app.handlers.load_post, after_load),
)


def register() -> None:
    """Add the handlers."""
    for handlers, handler in _HANDLERS:
        handlers.append(handler)


def unregister() -> None:
    """Remove them."""
    for handlers, handler in _HANDLERS:
        if handler in handlers:
            handlers.remove(handler)
