"""Application handlers: culling during renders, recovery on load."""

from __future__ import annotations

from typing import Any

import bpy
from bpy.app.handlers import persistent

from . import applying, job, overlay, results

_ENGINE = "LIPAC_EXTRACT"  # our own reading of the scene is a render, too


@persistent
def before_frame(scene: bpy.types.Scene, *_: Any) -> None:
    """render_pre: cull the frame that is about to be rendered, if it was analysed; other frames are rendered in full."""
    settings = scene.lipac
    if scene.render.engine == _ENGINE or settings.applied or not settings.use_for_renders:
        return
    result = results.at(scene)
    if result is not None:
        applying.apply(scene, result, in_render=True)
    elif settings.in_render:
        applying.restore()


@persistent
def after_render(scene: bpy.types.Scene, *_: Any) -> None:
    """render_complete, render_cancel: put everything back."""
    if scene.render.engine != _ENGINE and scene.lipac.in_render:
        applying.restore()


@persistent
def before_load(*_: Any) -> None:
    """load_pre: the file that is analysed goes away."""
    job.stop()


@persistent
def after_load(*_: Any) -> None:
    """load_post: results were of another file; what a render hid that never ended (a crash, a file saved meanwhile) is shown again."""
    results.clear()
    overlay.forget()
    if any(scene.lipac.in_render for scene in bpy.data.scenes):
        applying.restore()


_HANDLERS = (
    (bpy.app.handlers.render_pre, before_frame),
    (bpy.app.handlers.render_complete, after_render),
    (bpy.app.handlers.render_cancel, after_render),
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
