"""The list of who takes the memory of a render: sorted, and a click selects."""

from types import SimpleNamespace

import bpy
import pytest

from lipac.lipac_addon.ui import memory_panel
from lipac.lipac_addon.ui.memory_panel import LIPAC_OT_select_memory, LIPAC_PT_memory
from lipac.lipac_addon.ui.state import results


@pytest.fixture
def textured(scene):
    """Two boxes that stay have an image; box2 has many faces."""
    image = bpy.data.images.new("grain", 1024, 1024)
    material = bpy.data.materials.new("grainy")
    if material.node_tree is None:
        material.use_nodes = True
    material.node_tree.nodes.new("ShaderNodeTexImage").image = image
    for name in ("box0", "box1"):
        bpy.data.objects[name].data = bpy.data.objects[name].data.copy()
        bpy.data.objects[name].data.materials.append(material)
    fine = bpy.data.objects["box2"]
    fine.data = fine.data.copy()
    fine.modifiers.new("fine", "SUBSURF").render_levels = 5
    return scene


def test_before_an_analysis(scene, drawn):
    assert "Analyze this frame" in drawn(LIPAC_PT_memory)


def test_the_largest_first(textured, drawn):
    bpy.ops.lipac.analyze()
    rows = [row for row in results.at(textured).memory if row.kind != "mesh" and row.bytes]
    assert [row.bytes for row in rows] == sorted((row.bytes for row in rows), reverse=True)
    assert {row.name for row in rows[:4]} == {"grain", "box0", "box1", "box2"}
    text = drawn(LIPAC_PT_memory)
    places = [text.index(f"'{row.name}'") for row in rows[: memory_panel.ROWS] if f"'{row.name}'" in text]
    assert len(places) == len(rows)
    assert places == sorted(places)
    assert "4.0 MiB" in text
    assert not any(f"'{name}'" in text for name in ("box4", "box5"))  # culled: they take nothing


def test_more_than_the_list_shows(textured, drawn, monkeypatch):
    monkeypatch.setattr(memory_panel, "ROWS", 2)
    bpy.ops.lipac.analyze()
    assert "more; the objects take" in drawn(LIPAC_PT_memory)


def test_a_click_selects(textured):
    bpy.ops.lipac.analyze()
    assert bpy.ops.lipac.select_memory(kind="object", name="box2") == {"FINISHED"}
    assert {ob.name for ob in bpy.context.selected_objects} == {"box2"}
    assert bpy.context.view_layer.objects.active.name == "box2"
    assert bpy.ops.lipac.select_memory(kind="image", name="grain") == {"FINISHED"}
    assert {ob.name for ob in bpy.context.selected_objects} == {"box0", "box1"}
    bpy.data.objects["box2"].name = "renamed"
    assert bpy.ops.lipac.select_memory(kind="object", name="box2") == {"FINISHED"}
    assert bpy.context.view_layer.objects.active.name == "renamed"
    bpy.data.objects.remove(bpy.data.objects["renamed"])
    assert bpy.ops.lipac.select_memory(kind="object", name="box2") == {"CANCELLED"}


def test_a_name_that_a_linked_object_shares(textured, tmp_path, monkeypatch):
    """It is in no view layer, though one of its name is."""
    library = str(tmp_path / "library.blend")
    bpy.data.libraries.write(library, {bpy.data.objects["box0"]})
    with bpy.data.libraries.load(library, link=True) as (_found, wanted):
        wanted.objects = ["box0"]
    monkeypatch.setattr(results, "shown", lambda _scene: SimpleNamespace(find=lambda _name: wanted.objects[0]))
    assert bpy.ops.lipac.select_memory(kind="object", name="box0") == {"CANCELLED"}


def test_the_tooltip_says_why(textured):
    bpy.ops.lipac.analyze()
    text = LIPAC_OT_select_memory.description(bpy.context, SimpleNamespace(kind="object", name="box2"))
    assert text.startswith("box2: ")
    assert "1 of 1 stay" in text
