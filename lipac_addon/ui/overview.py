"""The head of the panel: the verdict, what renders show, and what wants to be read; and what is running."""

from __future__ import annotations

import bpy

from .draw import verdict
from .draw.figures import lines
from .jobs import job, live
from .operators import LIPAC_OT_cancel, LIPAC_OT_restore


def draw_overview(layout: bpy.types.UILayout, scene: bpy.types.Scene) -> None:
    """What came of it, before all settings."""
    first, *rest = verdict.verdict(scene)
    write(layout, first, icon="CHECKMARK" if scene.lipac.applied else "INFO")
    for text in rest:
        write(layout, text, icon="BLANK1")
    line, alert = verdict.status(scene)
    write(layout, line, alert)
    for warning in verdict.warnings(scene):
        write(layout, warning, icon="ERROR")
    layout.separator()


def draw_without_engine(layout: bpy.types.UILayout, scene: bpy.types.Scene, why: str) -> None:
    """Where nothing can be analysed: why, and what a file may have hidden all the same, with the way back."""
    write(layout, why, alert=True)
    line, alert = verdict.status(scene)
    write(layout, line, alert)
    layout.operator(LIPAC_OT_restore.bl_idname)


def draw_running(layout: bpy.types.UILayout, running: job.Job) -> None:
    """How far the job is, how long it still takes, and the way to stop it."""
    row = layout.row(align=True)
    row.progress(factor=running.progress, text=f"{100 * running.progress:.0f} %")
    row.operator(LIPAC_OT_cancel.bl_idname, icon="CANCEL")
    write(layout, running.line)
    if running.note:
        write(layout, running.note)
    if running.compiled:
        write(layout, f"Compiling, once: {running.compiled} kernels so far")


def draw_live(layout: bpy.types.UILayout, scene: bpy.types.Scene) -> None:
    """Live mode: what it does, and what the viewport goes without."""
    current = live.current
    if current is None:
        return
    write(layout, f"Live: {current.error or current.message}", alert=bool(current.error))
    layout.prop(scene.lipac, "cull_viewport")
    if current.culling.message:
        write(layout, f"The viewport {current.culling.message}")


def write(layout: bpy.types.UILayout, text: str, alert: bool = False, icon: str = "") -> None:
    """A text over as many lines as it takes. icon: before the first."""
    column = layout.column(align=True)
    column.alert = alert
    for k, line in enumerate(lines(text)):
        column.label(text=line, icon=(icon if k == 0 else "BLANK1") if icon else "NONE")
