"""Who takes the memory of a render: a list in the sidebar, the largest first, which selects what is clicked."""

from __future__ import annotations

from typing import Any, ClassVar

import bpy
from bpy.props import StringProperty

from ..memory.images import images_of
from .draw.figures import size
from .panel import Child
from .state import results

ROWS = 12  # that the list shows
ICONS = {"object": "OBJECT_DATA", "image": "IMAGE_DATA"}


class LIPAC_OT_select_memory(bpy.types.Operator):
    """Select what takes so much memory in a render"""

    bl_idname = "lipac.select_memory"
    bl_label = "Select"
    bl_options: ClassVar[set[str]] = {"REGISTER", "UNDO"}

    kind: StringProperty(name="Kind", description="Object or image", options={"HIDDEN"})  # type: ignore[valid-type]
    name: StringProperty(name="Name", description="Its full name", options={"HIDDEN"})  # type: ignore[valid-type]

    @classmethod
    def description(cls, context: bpy.types.Context, properties: Any) -> str:
        result = results.shown(context.scene)
        rows = () if result is None else result.memory
        found = [row for row in rows if (row.kind, row.name) == (properties.kind, properties.name)]
        if not found:
            return "Select it"
        row = found[0]
        sizes = (
            f"{size(row.bytes)} of {size(row.full_bytes)} with nothing culled; {row.kept:,} of {row.instances:,} stay"
        )
        worth = "" if row.worth is None else f"; worth at most {100 * row.worth:.3g} % of the picture"
        return f"{row.name}: {sizes}{worth}. {row.why.capitalize()}"

    def execute(self, context: bpy.types.Context) -> set[str]:
        there = set(context.view_layer.objects)  # not by name, which a linked object may share
        found = [ob for ob in self._objects(context.scene) if ob in there]
        if not found:
            self.report({"WARNING"}, f"{self.name} is not in this view layer")
            return {"CANCELLED"}
        for ob in context.view_layer.objects:
            ob.select_set(ob in found)
        context.view_layer.objects.active = found[0]
        return {"FINISHED"}

    def _objects(self, scene: bpy.types.Scene) -> list[bpy.types.Object]:
        """The object, or those that have the image, in the order of their names."""
        if self.kind == "image":
            image = next((image for image in bpy.data.images if image.name_full == self.name), None)
            users = {m for m in bpy.data.materials if image in images_of(m.node_tree)}
            return [ob for ob in bpy.data.objects if any(slot.material in users for slot in ob.material_slots)]
        result = results.shown(scene)
        found = None if result is None else result.find(self.name)
        return [] if found is None else [found]


class LIPAC_PT_memory(Child, bpy.types.Panel):
    """Objects and images by what they take of a render."""

    bl_label = "Memory"
    bl_options: Any = {"DEFAULT_CLOSED"}  # noqa: RUF012

    def draw(self, context: bpy.types.Context) -> None:
        layout, result = self.layout, results.shown(context.scene)
        if result is None or not result.memory:
            layout.label(text="Analyze this frame to see who takes the memory")
            return
        rows = [row for row in result.memory if row.kind in ICONS and row.bytes]
        column = layout.column(align=True)
        for row in rows[:ROWS]:
            line = column.split(factor=0.7, align=True)
            select = line.operator(LIPAC_OT_select_memory.bl_idname, text=row.name, icon=ICONS[row.kind])
            select.kind, select.name = row.kind, row.name
            line.label(text=size(row.bytes))
        if len(rows) > ROWS:
            rest = sum(row.bytes for row in rows[ROWS:] if row.kind == "object")
            column.label(text=f"{len(rows) - ROWS:,} more; the objects take {size(rest)}")


_CLASSES = (LIPAC_OT_select_memory, LIPAC_PT_memory)
register, unregister = bpy.utils.register_classes_factory(_CLASSES)
