"""Submit Shot: the open file's range of frames as a job for a render farm, in a folder that is shown then."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

import bpy
from bpy.props import EnumProperty, IntProperty, StringProperty

from ...core.culling.policies import LIGHT_PATHS
from ...core.errors import InputError
from .jobs import engine
from .modal import Explained
from .state import applying, props

FARMS = (
    ("OPENJD", "Open Job Description", "A job template: for Deadline Cloud, and the openjd command"),
    ("FLAMENCO", "Flamenco", "A job type for Flamenco's manager, and a job of it"),
)


class LIPAC_OT_submit_shot(Explained, bpy.types.Operator):
    """Write the scene's range of frames as a job for a render farm: analysed there, rendered with what it needs,
    verified. Nothing is sent"""

    bl_idname = "lipac.submit_shot"
    bl_label = "Submit Shot"
    bl_options: ClassVar[set[str]] = {"REGISTER"}

    farm: EnumProperty(name="Farm", description="Who runs it", items=FARMS)  # type: ignore[valid-type]
    folder: StringProperty(  # type: ignore[valid-type]
        name="Folder", description="For the job and all of the shot; all machines must see it", subtype="DIR_PATH"
    )
    chunk: IntProperty(  # type: ignore[valid-type]
        name="Frames to a task",
        description="So many frames are analyzed or rendered by a machine at a time",
        default=10,
        min=1,
    )
    lipac: StringProperty(name="LiPaC", description="The lipac command of the farm's machines", default="lipac")  # type: ignore[valid-type]
    blender: StringProperty(name="Blender", description="The Blender of the farm's machines", default="blender")  # type: ignore[valid-type]

    @classmethod
    def obstacle(cls, context: bpy.types.Context) -> str:
        if engine.missing():
            return engine.obstacle()
        # before 5.1 a file counts as unsaved in the background, whatever was done
        sure = not bpy.app.background or bpy.app.version >= (5, 1)
        if not bpy.data.filepath or (sure and bpy.data.is_dirty):
            return "Save the file first: that is what a farm's machines open"
        if context.scene.lipac.policy != LIGHT_PATHS:
            return "Keep by light paths: that is what a farm analyzes by"
        if applying.marks():
            return "Restore first: frames are rendered in full, too, to compare"
        return "" if context.scene.camera is not None else "The scene has no active camera"

    def invoke(self, context: bpy.types.Context, _event: Any) -> set[str]:
        if not self.folder:
            self.folder = f"//{Path(bpy.data.filepath).stem}_shot"
        return context.window_manager.invoke_props_dialog(self, width=500)  # type: ignore[return-value]

    def execute(self, context: bpy.types.Context) -> set[str]:
        from ..farm.jobs.submitting import submit

        wanted = props.cull_options(context.scene.lipac)
        folder = Path(bpy.path.abspath(self.folder or f"//{Path(bpy.data.filepath).stem}_shot"))
        try:
            told = submit(folder, self.farm.lower(), wanted, self.chunk, self.lipac, self.blender)
        except (InputError, OSError) as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self.report({"INFO"}, told)
        if wanted.levels or wanted.memory:
            self.report({"WARNING"}, "Levels of Detail and Limit Memory are no part of a farm's job: frames go without")
        if not bpy.app.background:
            bpy.ops.wm.path_open(filepath=str(folder))
        return {"FINISHED"}


register, unregister = bpy.utils.register_classes_factory((LIPAC_OT_submit_shot,))
