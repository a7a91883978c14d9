"""The panel "LiPaC" in the sidebar of the 3D viewport."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import bpy

from ...core.culling.policies import POLICIES
from .. import roles
from .draw.boxes import KINDS
from .draw.figures import LONGEST, lines, rows_of, rows_of_difference, rows_of_object, rows_of_renders
from .jobs import engine, job, live
from .operators import (
    LIPAC_OT_analyze,
    LIPAC_OT_apply,
    LIPAC_OT_bake_shot,
    LIPAC_OT_difference,
    LIPAC_OT_live,
    LIPAC_OT_mark,
    LIPAC_OT_restore,
)
from .overview import draw_live, draw_overview, draw_running, draw_without_engine, write
from .state import applying, results
from .submit import LIPAC_OT_submit_shot


def _table(layout: bpy.types.UILayout, rows: list[tuple[str, str]]) -> None:
    column = layout.column(align=True)
    for label, text in rows:
        for k, line in enumerate(lines(text, LONGEST // 2)):
            split = column.split(factor=0.45)
            split.label(text="" if k else label)
            split.label(text=line)


def _lines(layout: bpy.types.UILayout, texts: Iterable[str]) -> None:
    column = layout.column(align=True)
    for text in texts:
        for k, line in enumerate(lines(text)):
            column.label(text=line, icon="INFO" if k == 0 else "BLANK1")


class _Sidebar:
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "LiPaC"


class Child(_Sidebar):
    """A panel below that of LiPaC."""

    bl_parent_id = "LIPAC_PT_main"

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        return not engine.missing()


class LIPAC_PT_main(_Sidebar, bpy.types.Panel):
    """Analyze, apply, restore, and what came of it."""

    bl_label = "LiPaC"

    def draw(self, context: bpy.types.Context) -> None:
        layout, settings = self.layout, context.scene.lipac
        if engine.missing():
            why = f"LiPaC cannot run: missing {', '.join(engine.missing())}. Please {engine.REINSTALL}."
            draw_without_engine(layout, context.scene, why)
            return
        draw_overview(layout, context.scene)
        layout.use_property_split = True
        layout.use_property_decorate = False
        layout.prop(settings, "policy")
        own = POLICIES[settings.policy].setting
        if own is not None:
            layout.prop(settings, own.name)
        else:
            column = layout.column(align=True)
            column.prop(settings, "max_error")
            column.prop(settings, "worst_error")
            column = layout.column(align=True)
            column.prop(settings, "levels")
            column.prop(settings, "limit_memory")
            if settings.limit_memory:
                column.prop(settings, "memory_limit")
        layout.prop(settings, "frames")
        if job.running is not None and not job.running.done:
            draw_running(layout, job.running)
        else:
            row = layout.row(align=True)
            row.operator(LIPAC_OT_analyze.bl_idname, icon="LIGHT_SUN")
            row.operator(LIPAC_OT_live.bl_idname, icon="PLAY" if not live.is_on() else "PAUSE", depress=live.is_on())
        draw_live(layout, context.scene)
        if job.running is not None and job.running.error:
            write(layout, job.running.error, alert=not job.running.cancelled)
        layout.separator()
        row = layout.row(align=True)
        row.operator(LIPAC_OT_apply.bl_idname, depress=settings.applied)
        row.operator(LIPAC_OT_restore.bl_idname)
        row = layout.row(align=True)
        row.operator(LIPAC_OT_bake_shot.bl_idname)
        row.operator(LIPAC_OT_submit_shot.bl_idname, text="Submit Shot...")
        layout.prop(settings, "use_for_renders")
        if settings.applied or settings.use_for_renders:
            _lines(layout, applying.notes)


class LIPAC_PT_results(Child, bpy.types.Panel):
    """Figures of the current frame."""

    bl_label = "Results"

    def draw(self, context: bpy.types.Context) -> None:
        layout, scene = self.layout, context.scene
        found, result = results.of(scene), results.shown(scene)
        if result is None:
            layout.label(text="This frame was not analyzed" if found else "Nothing analyzed yet")
            return
        measured = results.differences.get((scene.session_uid, result.frame)) if result is results.at(scene) else None
        _table(layout, rows_of(result) + (rows_of_difference(measured) if measured is not None else []))
        if scene.session_uid in results.live:
            layout.label(text=f"Live, frame {result.frame}: what the viewport shows")
        elif len(found) > 1:
            layout.label(text=f"{len(found)} frames analyzed")
        layout.operator(LIPAC_OT_difference.bl_idname)
        _lines(layout, result.warnings)


class LIPAC_PT_object(Child, bpy.types.Panel):
    """Why the active object stays or goes; Pin and Ignore."""

    bl_label = "Object and Collection"

    def draw(self, context: bpy.types.Context) -> None:
        layout, ob, result = self.layout, context.object, results.shown(context.scene)
        layout.use_property_split = True
        layout.use_property_decorate = False
        if ob is not None:
            layout.prop(ob, "lipac_role", text=ob.name)
            _table(layout, rows_of_renders(applying.marks().get(ob.session_uid, [])))
            if result is not None:
                _table(layout, rows_of_object(result, ob) or [("This frame", "shows no instances")])
        if context.collection is not None:
            layout.prop(context.collection, "lipac_role", text=context.collection.name)
        row = layout.row(align=True)
        row.label(text="Selected")
        for name, label, *_ in roles.ROLES:
            row.operator(LIPAC_OT_mark.bl_idname, text=label).role = name


class LIPAC_PT_overlay(Child, bpy.types.Panel):
    """What the viewport shows of the result."""

    bl_label = "Overlay"

    def draw_header(self, context: bpy.types.Context) -> None:
        self.layout.prop(context.scene.lipac, "show_overlay", text="")

    def draw(self, context: bpy.types.Context) -> None:
        layout, settings = self.layout, context.scene.lipac
        layout.active = settings.show_overlay
        grid = layout.grid_flow(columns=2, align=True)
        for kind in KINDS:
            grid.prop(settings, f"show_{kind}", toggle=True)
        layout.prop(settings, "heat_map")
        layout.label(text="Through the camera")
        row = layout.row(align=True)
        row.prop(settings, "show_tiles", toggle=True)
        row.prop(settings, "show_memory", toggle=True)
        layout.prop(settings, "opacity", slider=True)
        layout.prop(settings, "in_front")
        layout.prop(settings, "freeze")


class LIPAC_PT_advanced(Child, bpy.types.Panel):
    """Settings that rarely need a change."""

    bl_label = "Advanced"
    bl_options: Any = {"DEFAULT_CLOSED"}  # noqa: RUF012

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        layout.use_property_split = True
        layout.use_property_decorate = False
        for name in ("paths", "width", "seed"):
            layout.prop(context.scene.lipac, name)


_CLASSES = (LIPAC_PT_main, LIPAC_PT_results, LIPAC_PT_object, LIPAC_PT_overlay, LIPAC_PT_advanced)
register, unregister = bpy.utils.register_classes_factory(_CLASSES)
