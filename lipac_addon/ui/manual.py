"""Blender's "Online Manual" of each control: a place in the user guide."""

from __future__ import annotations

from pathlib import Path

import bpy

_DOCS = Path(__file__).parents[2] / "docs"
# The first pattern that fits counts
_MANUAL = (
    ("bpy.types.lipacsettings.show_*", "overlay"),
    *((f"bpy.types.lipacsettings.{name}", "overlay") for name in ("opacity", "in_front", "freeze", "heat_map")),
    ("bpy.types.lipacsettings.cull_viewport", "culling-in-the-viewport"),
    ("bpy.types.lipacsettings.*", "settings"),
    *((f"bpy.types.{owner}.lipac_role", "pin-and-ignore") for owner in ("object", "collection")),
    ("bpy.types.lipacpreferences.*", "preferences"),
    ("bpy.ops.lipac.live", "live"),
    ("bpy.ops.lipac.mark", "pin-and-ignore"),
    ("bpy.ops.lipac.clear_cache", "preferences"),
    ("bpy.ops.lipac.difference", "what-it-saves"),
    *((f"bpy.ops.lipac.{name}", "animations-and-shots") for name in ("bake_shot", "submit_shot")),
    ("bpy.ops.lipac.*", "three-clicks"),
)


def manual() -> tuple[str, tuple[tuple[str, str], ...]]:
    """Where the guide explains each control: the start of all addresses, and pairs of pattern and rest. A zip brings
    the guide as a page for browsers."""
    page = next((path for name in ("user-guide.html", "user-guide.md") if (path := _DOCS / name).exists()), _DOCS)
    return page.as_uri(), tuple((pattern, f"#{place}") for pattern, place in _MANUAL)


def register() -> None:
    """Make the guide the manual of all controls."""
    bpy.utils.register_manual_map(manual)


def unregister() -> None:
    """Take it away again."""
    bpy.utils.unregister_manual_map(manual)
