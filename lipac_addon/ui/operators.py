"""Operators: analyse, live, bake, apply, restore, measure, mark."""

from __future__ import annotations

from typing import Any, ClassVar

import bpy
from bpy.props import EnumProperty

from ...core.errors import InputError
from . import applying, job, live, props, results, wheels
from .difference import DifferenceJob

BUSY = "An analysis is running; Esc cancels it"
INTERVAL = 0.05  # seconds between steps of an analysis


class _Modal:
    """An operator that steps a job beside the user's work. `make` begins it, `finish` says what came of it."""

    job: Any
    bl_label: str
    bl_options: ClassVar[set[str]] = {"REGISTER"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if wheels.missing():
            cls.poll_message_set(f"missing: {', '.join(wheels.missing())}; {wheels.REINSTALL}")  # type: ignore[attr-defined]
        elif job.is_running():
            cls.poll_message_set(BUSY)  # type: ignore[attr-defined]
        elif context.scene.camera is None:
            cls.poll_message_set("The scene has no active camera")  # type: ignore[attr-defined]
        else:
            return True
        return False

    def make(self, context: bpy.types.Context) -> Any:
        """The job."""
        raise NotImplementedError

    def said(self) -> str:
        """A line about the job that has succeeded."""
        raise NotImplementedError

    def begin(self, context: bpy.types.Context) -> set[str]:
        """Start the job; where that cannot be, say why."""
        try:
            self.job = job.start(lambda: self.make(context))
        except InputError as error:
            self.report({"ERROR"}, str(error))  # type: ignore[attr-defined]
            return {"CANCELLED"}
        return {"RUNNING_MODAL"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        """For scripts: return when it is done."""
        if self.begin(context) == {"CANCELLED"}:
            return {"CANCELLED"}
        self.job.run()
        return self.finish(context)

    def invoke(self, context: bpy.types.Context, _event: Any) -> set[str]:
        """From the panel: beside the user's work."""
        begun = self.begin(context)
        if begun == {"RUNNING_MODAL"}:
            self.timer = context.window_manager.event_timer_add(INTERVAL, window=context.window)
            context.window_manager.modal_handler_add(self)
        return begun

    def modal(self, context: bpy.types.Context, event: Any) -> set[str]:
        """Step the job at each tick of the timer."""
        ended = self.job is not job.running  # by a file that was opened
        if ended:
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

    def wrote(self) -> bool:
        """Whether the file is other than before, which is a step of undo."""
        return False

    def finish(self, _context: bpy.types.Context) -> set[str]:
        """Report how it ended."""
        if self.wrote():
            bpy.ops.ed.undo_push(message=self.bl_label)
        if self.job.error:
            self.report({"WARNING" if self.job.cancelled else "ERROR"}, self.job.error)  # type: ignore[attr-defined]
            return {"CANCELLED"}
        self.report({"INFO"}, self.said())  # type: ignore[attr-defined]
        return {"FINISHED"}


class LIPAC_OT_analyze(_Modal, bpy.types.Operator):
    """Find out which instances the picture needs, by tracing light paths. Nothing is hidden yet. Esc cancels"""

    bl_idname = "lipac.analyze"
    bl_label = "Analyze"

    def make(self, context: bpy.types.Context) -> job.AnalysisJob:
        return job.AnalysisJob(context.scene)

    def said(self) -> str:
        culled = [int(r.culled.sum()) for r in self.job.results.values()]
        total = [len(r.culled) for r in self.job.results.values()]
        return f"The picture needs {sum(total) - sum(culled):,} of {sum(total):,} instances"

    def wrote(self) -> bool:
        """Where renders were culled before, they are culled anew."""
        return self.job.was_applied


class LIPAC_OT_bake_shot(_Modal, bpy.types.Operator):
    """Analyze all frames of the scene's range, and hide from renders what none of them needs, until Restore. Nothing flickers. Esc cancels"""

    bl_idname = "lipac.bake_shot"
    bl_label = "Bake Shot"

    def make(self, context: bpy.types.Context) -> job.AnalysisJob:
        return job.AnalysisJob(context.scene, job.frame_range(context.scene), bake=True)

    def said(self) -> str:
        kept, total = self.job.baked
        return f"The shot needs {kept:,} of {total:,} instances"

    def wrote(self) -> bool:
        return self.job.was_applied or self.job.baked is not None


class LIPAC_OT_difference(_Modal, bpy.types.Operator):
    """Render this frame in full and culled, and measure what culling saves and changes. The difference is an image of the file. Esc cancels"""

    bl_idname = "lipac.difference"
    bl_label = "Render Difference"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if not super().poll(context):
            return False
        if results.at(context.scene) is None:
            cls.poll_message_set("Analyze this frame first")
            return False
        if any(scene.lipac.applied for scene in bpy.data.scenes):
            cls.poll_message_set("Restore first: the frame is to be rendered in full, too")
            return False
        return True

    def make(self, context: bpy.types.Context) -> DifferenceJob:
        return DifferenceJob(context.scene)

    def said(self) -> str:
        found = self.job.difference
        full, culled = found.seconds
        return f"{full:.1f} s in full, {culled:.1f} s culled; the picture changes by {100 * found.mean:.2f} %"


class LIPAC_OT_live(bpy.types.Operator):
    """Keep analyzing what the viewport shows, while you work and play back; the overlay follows. Renders go by Analyze"""

    bl_idname = "lipac.live"
    bl_label = "Live"
    bl_options: ClassVar[set[str]] = {"REGISTER"}

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        if wheels.missing():
            cls.poll_message_set(f"missing: {', '.join(wheels.missing())}; {wheels.REINSTALL}")
        return not wheels.missing()

    def execute(self, context: bpy.types.Context) -> set[str]:
        if live.is_on():
            live.stop()
        else:
            live.start()
            context.scene.lipac.show_overlay = True
        props.redraw()
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
            cls.poll_message_set(BUSY)
            return False
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        result = results.at(context.scene)
        if result is None:
            self.report({"ERROR"}, "analyze this frame first")
            return {"CANCELLED"}
        applied = applying.apply(context.scene, result)
        self.report({"INFO"}, f"Hidden from renders: {int(applied.removed.sum()):,} instances")
        for line in applying.notes:
            self.report({"WARNING"}, line)
        return {"FINISHED"}


class LIPAC_OT_restore(bpy.types.Operator):
    """Show everything in renders again, as you had set it; also what a crash or another scene left hidden"""

    bl_idname = "lipac.restore"
    bl_label = "Restore"
    bl_options: ClassVar[set[str]] = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        if job.is_running():
            cls.poll_message_set(BUSY)
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


_CLASSES = (LIPAC_OT_analyze, LIPAC_OT_live, LIPAC_OT_bake_shot, LIPAC_OT_apply, LIPAC_OT_restore, LIPAC_OT_difference, LIPAC_OT_mark)


def register() -> None:
    """Register the operators."""
    for cls in _CLASSES:
        bpy.utils.register_class(cls)


def unregister() -> None:
    """Forget all results; unregister the operators."""
    results.clear()
    for cls in reversed(_CLASSES):
        bpy.utils.unregister_class(cls)
