"""Operators: analyse, apply, restore, mark."""

from __future__ import annotations

from typing import Any, ClassVar

import bpy
from bpy.props import EnumProperty

from . import applying, job, props, results, wheels

INTERVAL = 0.05  # seconds between steps of an analysis


class LIPAC_OT_analyze(bpy.types.Operator):
    """Find out which instances the picture needs, by tracing light paths. Nothing is hidden yet. Esc cancels"""

    bl_idname = "lipac.analyze"
    bl_label = "Analyze"
    bl_options: ClassVar[set[str]] = {"REGISTER"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if wheels.missing():
            cls.poll_message_set(f"missing: {', '.join(wheels.missing())}; {wheels.REINSTALL}")
        elif job.is_running():
            cls.poll_message_set("An analysis is running; Esc cancels it")
        elif context.scene.camera is None:
            cls.poll_message_set("The scene has no active camera")
        else:
            return True
        return False

    def execute(self, context: bpy.types.Context) -> set[str]:
        """For scripts: analyse, and return when it is done."""
        self.job = job.start(context.scene)
        self.job.run()
        return self.finish(context)

    def invoke(self, context: bpy.types.Context, _event: Any) -> set[str]:
        """From the panel: analyse beside the user's work."""
        self.job = job.start(context.scene)
        self.timer = context.window_manager.event_timer_add(INTERVAL, window=context.window)
        context.window_manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context: bpy.types.Context, event: Any) -> set[str]:
        """Step the job at each tick of the timer."""
        if self.job is not job.running:  # ended by a file that was opened
            context.window_manager.event_timer_remove(self.timer)
            return {"CANCELLED"}
        if event.type == "ESC":
            self.job.cancel()
            return {"RUNNING_MODAL"}
        if event.type != "TIMER":
            return {"PASS_THROUGH"}
        props.redraw()
        going = False
        try:
            going = self.job.step()
        finally:  # also after an error of ours, which Blender shows
            if not going:
                context.window_manager.event_timer_remove(self.timer)
        return {"PASS_THROUGH"} if going else self.finish(context)

    def cancel(self, _context: bpy.types.Context) -> None:
        """Called when the window closes."""
        self.job.close()

    def finish(self, _context: bpy.types.Context) -> set[str]:
        """Report how it ended; where renders were culled before, they are culled anew, which is a step of undo."""
        if self.job.was_applied:
            bpy.ops.ed.undo_push(message="Analyze")
        if self.job.error:
            self.report({"WARNING" if self.job.cancelled else "ERROR"}, self.job.error)
            return {"CANCELLED"}
        culled = [int(r.culled.sum()) for r in self.job.results.values()]
        total = [len(r.culled) for r in self.job.results.values()]
        self.report({"INFO"}, f"The picture needs {sum(total) - sum(culled):,} of {sum(total):,} instances")
        return {"FINISHED"}


class LIPAC_OT_apply(bpy.types.Operator):
    """Hide culled instances from renders of this file, until Restore. The viewport does not change"""

    bl_idname = "lipac.apply"
    bl_label = "Apply to Render"
    bl_options: ClassVar[set[str]] = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if results.at(context.scene) is None:
            cls.poll_message_set("Analyze this frame first")
            return False
        if job.is_running():
            cls.poll_message_set("An analysis is running; Esc cancels it")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        result = results.at(context.scene)
        if result is None:
            self.report({"ERROR"}, "analyze this frame first")
            return {"CANCELLED"}
        applied = applying.apply(context.scene, result)
        removed, kept = int(applied.removed.sum()), applied.kept
        self.report({"INFO"}, f"Hidden from renders: {removed:,} instances")
        for reason, count in kept.items():
            self.report({"WARNING"}, f"{count:,} culled instances stay in renders: {reason}")
        return {"FINISHED"}


class LIPAC_OT_restore(bpy.types.Operator):
    """Show everything in renders again, as you had set it; also what a crash or another scene left hidden"""

    bl_idname = "lipac.restore"
    bl_label = "Restore"
    bl_options: ClassVar[set[str]] = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        if job.is_running():
            cls.poll_message_set("An analysis is running; Esc cancels it")
            return False
        return True

    def execute(self, _context: bpy.types.Context) -> set[str]:
        if not applying.restore():
            self.report({"INFO"}, "Nothing was hidden by LiPaC")
            return {"CANCELLED"}
        self.report({"INFO"}, "Everything is shown in renders again")
        return {"FINISHED"}


class LIPAC_OT_mark(bpy.types.Operator):
    """Set what LiPaC may do with all selected objects"""

    bl_idname = "lipac.mark"
    bl_label = "Mark Selected"
    bl_options: ClassVar[set[str]] = {"REGISTER", "UNDO"}

    role: EnumProperty(name="Culling", description="Whether the analysis may cull them", items=props.ROLES)  # type: ignore[valid-type]

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if not context.selected_objects:
            cls.poll_message_set("Select objects first")
            return False
        return True

    @classmethod
    def description(cls, _context: bpy.types.Context, properties: Any) -> str:
        return next(text for name, _label, text, *_ in props.ROLES if name == properties.role)

    def execute(self, context: bpy.types.Context) -> set[str]:
        editable = [ob for ob in context.selected_objects if ob.is_editable]
        for ob in editable:
            ob.lipac.role = self.role
        if len(editable) < len(context.selected_objects):
            self.report({"WARNING"}, f"{len(context.selected_objects) - len(editable)} linked objects cannot be marked: make library overrides of them")
        return {"FINISHED"} if editable else {"CANCELLED"}


_CLASSES = (LIPAC_OT_analyze, LIPAC_OT_apply, LIPAC_OT_restore, LIPAC_OT_mark)


def register() -> None:
    """Register the operators."""
    for cls in _CLASSES:
        bpy.utils.register_class(cls)


def unregister() -> None:
    """End a running analysis; unregister the operators."""
    job.stop()
    results.clear()
    for cls in reversed(_CLASSES):
        bpy.utils.unregister_class(cls)
