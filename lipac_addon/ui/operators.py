"""Operators: analyse, live, bake, apply, restore, measure, mark, clear the cache. Each first line of a docstring is a
tooltip."""

from __future__ import annotations

from typing import Any, ClassVar

import bpy
from bpy.props import EnumProperty

from .. import roles
from .jobs import analysis, engine, job, live
from .jobs.analysis import AnalysisJob
from .jobs.difference import DifferenceJob
from .modal import BUSY, Explained, JobOperator
from .state import applying, asking, kernel_folder, props, results, session

_UNANALYZED = "Analyze this frame first"
EDITED = "Go to Object Mode first: a simplified mesh is being edited"


class _Analysis(JobOperator):
    """An operator that analyses the scene."""

    @classmethod
    def obstacle(cls, context: bpy.types.Context) -> str:
        return super().obstacle(context) or analysis.obstacle(context.scene)


class LIPAC_OT_analyze(_Analysis, bpy.types.Operator):
    """Find out which instances the picture needs, by tracing light paths. Nothing is hidden yet"""

    bl_idname = "lipac.analyze"
    bl_label = "Analyze"

    def create_job(self, context: bpy.types.Context) -> AnalysisJob:
        return AnalysisJob(context.scene)

    def success_message(self) -> str:
        culled = [int(r.culled.sum()) for r in self.job.results.values()]
        total = [len(r.culled) for r in self.job.results.values()]
        needs = f"The picture needs {sum(total) - sum(culled):,} of {sum(total):,} instances{_futile(self.job)}"
        return f"{needs}. {analysis.LOST}" if self.job.lost else needs

    def needs_undo_step(self) -> bool:
        """Where renders were culled before, they are culled anew."""
        return self.job.was_applied


class LIPAC_OT_bake_shot(_Analysis, bpy.types.Operator):
    """Analyze all frames of the scene's range, certify one set for all of them, and hide all else from renders, until
    Restore. Nothing flickers"""

    bl_idname = "lipac.bake_shot"
    bl_label = "Bake Shot"

    @classmethod
    def obstacle(cls, context: bpy.types.Context) -> str:
        limited = props.memory_limit(context.scene.lipac) > 0
        return super().obstacle(context) or (asking.OF_FRAMES if limited else "")

    def create_job(self, context: bpy.types.Context) -> AnalysisJob:
        return AnalysisJob(context.scene, props.frame_range(context.scene), bake=True)

    def success_message(self) -> str:
        kept, total, coarser = self.job.baked
        levels = f", {coarser:,} objects coarser" if coarser else ""
        return f"The shot needs {kept:,} of {total:,} instances{levels}{_futile(self.job)}"

    def needs_undo_step(self) -> bool:
        return self.job.was_applied or self.job.baked is not None


class LIPAC_OT_difference(JobOperator, bpy.types.Operator):
    """Render this frame in full and culled, and measure what culling saves and changes. The difference is an image of
    the file"""

    bl_idname = "lipac.difference"
    bl_label = "Render Difference"

    @classmethod
    def obstacle(cls, context: bpy.types.Context) -> str:
        own = _unanalyzed(context) or (
            "Restore first: the frame is to be rendered in full, too" if applying.marks() else ""
        )
        return super().obstacle(context) or own

    def create_job(self, context: bpy.types.Context) -> DifferenceJob:
        return DifferenceJob(context.scene)

    def success_message(self) -> str:
        found = self.job.difference
        full, culled = found.seconds
        return f"{full:.1f} s in full, {culled:.1f} s culled; the picture changes by {100 * found.mean:.2f} %"

    def needs_undo_step(self) -> bool:
        """The image."""
        return self.job.difference is not None


class LIPAC_OT_cancel(Explained, bpy.types.Operator):
    """Stop what is running: an analysis, or the renders of Render Difference"""

    bl_idname = "lipac.cancel"
    bl_label = "Cancel"
    bl_options: ClassVar[set[str]] = {"REGISTER"}

    @classmethod
    def obstacle(cls, _context: bpy.types.Context) -> str:
        return "" if job.is_running() else "Nothing is running"

    def execute(self, _context: bpy.types.Context) -> set[str]:
        job.cancel()
        return {"FINISHED"}


class LIPAC_OT_live(Explained, bpy.types.Operator):
    """Keep analyzing what the viewport shows, while you work and play back; the overlay follows. Renders go by
    Analyze"""

    bl_idname = "lipac.live"
    bl_label = "Live"
    bl_options: ClassVar[set[str]] = {"REGISTER", "UNDO"}  # of the overlay, which it switches on

    @classmethod
    def obstacle(cls, _context: bpy.types.Context) -> str:
        return engine.obstacle()

    def execute(self, context: bpy.types.Context) -> set[str]:
        if live.is_on():
            live.stop()
        else:
            live.start()
            context.scene.lipac.show_overlay = True
        session.redraw()
        return {"FINISHED"}


class LIPAC_OT_apply(Explained, bpy.types.Operator):
    """Hide culled instances from renders of this file, until Restore. The viewport does not change, but for meshes that
    Levels of Detail has simplified"""

    bl_idname = "lipac.apply"
    bl_label = "Apply to Render"
    bl_options: ClassVar[set[str]] = {"REGISTER", "UNDO"}

    @classmethod
    def obstacle(cls, context: bpy.types.Context) -> str:
        return _unanalyzed(context) or _occupied()

    def execute(self, context: bpy.types.Context) -> set[str]:
        applied = applying.apply(context.scene, results.of(context.scene)[context.scene.frame_current])
        faces = f", {applied.faces_removed:,} faces of others" if applied.faces_removed else ""
        levels = f"; coarser: {applied.simplified:,} objects" if applied.simplified else ""
        self.report({"INFO"}, f"Hidden from renders: {int(applied.removed.sum()):,} instances{faces}{levels}")
        for line in applying.notes:
            self.report({"WARNING"}, line)
        return {"FINISHED"}


class LIPAC_OT_restore(Explained, bpy.types.Operator):
    """Show everything in renders again, as you had set it; also what a crash or another scene left hidden"""

    bl_idname = "lipac.restore"
    bl_label = "Restore"
    bl_options: ClassVar[set[str]] = {"REGISTER", "UNDO"}

    @classmethod
    def obstacle(cls, _context: bpy.types.Context) -> str:
        return _occupied() or (EDITED if applying.edits_level() else "")

    def execute(self, _context: bpy.types.Context) -> set[str]:
        before = applying.edited_levels()
        if not applying.restore():
            self.report({"INFO"}, "Nothing was hidden by LiPaC")
            return {"CANCELLED"}
        self.report({"INFO"}, "Everything is shown in renders again")
        if applying.comes_back():
            self.report({"WARNING"}, applying.comes_back())
        if kept := applying.edited_levels() - before:
            self.report({"WARNING"}, f"What you edited of simplified meshes is kept: {', '.join(sorted(kept))}")
        return {"FINISHED"}


class LIPAC_OT_mark(Explained, bpy.types.Operator):
    """Set what LiPaC may do with all selected objects"""

    bl_idname = "lipac.mark"
    bl_label = "Mark Selected"
    bl_options: ClassVar[set[str]] = {"REGISTER", "UNDO"}

    role: EnumProperty(name="Culling", description="Whether the analysis may cull them", items=roles.ROLES)  # type: ignore[valid-type]

    @classmethod
    def obstacle(cls, context: bpy.types.Context) -> str:
        return "" if context.selected_objects else "Select objects first"

    @classmethod
    def description(cls, _context: bpy.types.Context, properties: Any) -> str:
        return next(text for name, _label, text, *_ in roles.ROLES if name == properties.role)

    def execute(self, context: bpy.types.Context) -> set[str]:
        editable = [ob for ob in context.selected_objects if ob.is_editable]
        for ob in editable:
            ob.lipac_role = self.role
        if len(editable) < len(context.selected_objects):
            self.report(
                {"WARNING"},
                f"{len(context.selected_objects) - len(editable)} linked objects cannot be marked: make library "
                "overrides of them",
            )
        return {"FINISHED"} if editable else {"CANCELLED"}


class LIPAC_OT_clear_cache(Explained, bpy.types.Operator):
    """Remove compiled kernels from the disk. The next start of Blender compiles them again, which takes a minute"""

    bl_idname = "lipac.clear_cache"
    bl_label = "Clear Cache"
    bl_options: ClassVar[set[str]] = {"REGISTER"}

    @classmethod
    def obstacle(cls, _context: bpy.types.Context) -> str:
        return BUSY if job.is_running() else ""

    def execute(self, _context: bpy.types.Context) -> set[str]:
        self.report({"INFO"}, f"Removed {kernel_folder.clear() / 1e6:.0f} MB of compiled kernels")
        return {"FINISHED"}


def _futile(done: AnalysisJob) -> str:
    """A sentence more where no frame could win anything."""
    found = [result.futile for result in done.results.values()]
    return f". {found[0]}" if found and all(found) else ""


def _unanalyzed(context: bpy.types.Context) -> str:
    if context.scene.render.use_multiview:
        return applying.MULTI_VIEW
    return _UNANALYZED if results.at(context.scene) is None else ""


def _occupied() -> str:
    """Why what renders show cannot be changed now."""
    return BUSY if job.is_running() else "A render is running: wait for its end" if session.is_rendering() else ""


_CLASSES = (
    *(LIPAC_OT_analyze, LIPAC_OT_live, LIPAC_OT_bake_shot, LIPAC_OT_apply, LIPAC_OT_restore),
    *(LIPAC_OT_cancel, LIPAC_OT_difference, LIPAC_OT_mark, LIPAC_OT_clear_cache),
)
register, unregister = bpy.utils.register_classes_factory(_CLASSES)
