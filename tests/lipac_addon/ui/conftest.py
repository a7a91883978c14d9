"""The extension registered, and a small scene whose boxes behind the wall a policy by distance culls: quick to
analyse."""

from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import bpy
import pytest

import lipac

FAR = {"box4", "box5", "box6", "box7"}  # behind the wall


@pytest.fixture
def ui() -> Iterator[None]:
    lipac.register()
    yield
    lipac.unregister()


@pytest.fixture
def scene(ui: None, boxes: bpy.types.Scene) -> bpy.types.Scene:
    """The scene of `boxes` with settings that cull FAR."""
    boxes.lipac.policy, boxes.lipac.distance = "distance", 19.5
    return boxes


@pytest.fixture
def analyzed(scene: bpy.types.Scene) -> bpy.types.Scene:
    assert bpy.ops.lipac.analyze() == {"FINISHED"}
    return scene


@pytest.fixture
def drawn(capfd: pytest.CaptureFixture[str]) -> Callable[[Any], str]:
    """A panel's draw() with a real layout; returns what is in it as text. Wrong property names, which Blender only
    prints, fail the test."""

    def run(cls: Any) -> str:
        popup = bpy.context.window_manager.popmenu_begin__internal("test", icon="NONE")
        capfd.readouterr()
        cls.draw(SimpleNamespace(layout=popup.layout), bpy.context)
        out, err = capfd.readouterr()
        assert not err.strip(), err
        assert "Error" not in out
        return str(popup.layout.introspect())

    return run


@pytest.fixture
def hidden():
    """Names of objects that are hidden from renders."""
    return lambda: {ob.name for ob in bpy.data.objects if ob.hide_render}


@pytest.fixture
def snapshot():
    """Plain and custom properties of all objects and collections, their modifiers, and the names of all data-blocks."""

    def run() -> dict:
        blocks = {
            (kind, b.name_full)
            for kind in ("objects", "meshes", "node_groups", "cameras", "images", "scenes")
            for b in getattr(bpy.data, kind)
        }
        values = {}
        for b in (*bpy.data.objects, *bpy.data.collections):
            plain = {
                p.identifier: str(getattr(b, p.identifier))
                for p in b.bl_rna.properties
                if p.type in {"BOOLEAN", "ENUM", "INT"} and not p.is_readonly
            }
            values[b.name_full] = plain | {key: str(b[key]) for key in b.keys()}  # noqa: SIM118
        return {
            "blocks": blocks,
            "values": values,
            "modifiers": {(ob.name, m.name) for ob in bpy.data.objects for m in ob.modifiers},
        }

    return run
