"""Operators that say why they cannot run, and those that step a job beside the user's work."""

from __future__ import annotations

from typing import Any, ClassVar

import bpy

from ...core.errors import InputError
from .jobs import engine, job
from .state import session

BUSY = "An analysis is running: wait, or cancel it"
INTERVAL = 0.05  # seconds between steps of a job


class Explained:
    """An operator that can run where `obstacle` finds nothing in its way; its tooltip says what there is."""

    @classmethod
    def obstacle(cls, context: bpy.types.Context) -> str:
        """Why it cannot run now, "" where it can."""
        raise NotImplementedError

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        why = cls.obstacle(context)
        if why:
            cls.poll_message_set(why)  # type: ignore[attr-defined]
        return not why


class JobOperator(Explained):
    """An operator that steps a job. `create_job` makes it, `success_message` tells what came of it, `needs_undo_step`
    whether the file has changed."""

    job: Any
    bl_label: str
    bl_options: ClassVar[set[str]] = {"REGISTER"}

    @classmethod
    def obstacle(cls, context: bpy.types.Context) -> str:
        if engine.missing():
            return engine.obstacle()
        if job.is_running():
            return BUSY
        return "" if context.scene.camera is not None else "The scene has no active camera"

    def create_job(self, context: bpy.types.Context) -> job.Job:
        """The job."""
        raise NotImplementedError

    def success_message(self) -> str:
        """A line about the job that has succeeded."""
        raise NotImplementedError

    def needs_undo_step(self) -> bool:
        """Whether the file is other than before, which is a step of undo."""
        return False

    def begin(self, context: bpy.types.Context) -> set[str]:
        """Start the job; where that cannot be, say why."""
        try:
            self.job = job.start(lambda: self.create_job(context))
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
        if event.type != "TIMER":
            return {"PASS_THROUGH"}
        session.redraw()
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
        """Report how it ended."""
        if self.needs_undo_step():
            bpy.ops.ed.undo_push(message=self.bl_label)
        if self.job.error:
            self.report({"WARNING" if self.job.cancelled else "ERROR"}, self.job.error)  # type: ignore[attr-defined]
            return {"CANCELLED"}
        self.report({"INFO"}, self.success_message())  # type: ignore[attr-defined]
        return {"FINISHED"}
