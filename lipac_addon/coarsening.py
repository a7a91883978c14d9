"""Settings of objects by which a render has fewer of their triangles, and which the viewport does not look at: levels
of subdivision, and the resolution of curves and text."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import bpy

SUBDIVIDES = frozenset({"SUBSURF", "MULTIRES"})
# at most: levels that a subdivision goes without, each of which has a quarter of the triangles of the one before, and
# times that a resolution is halved
STEPS = 3
RENDERED = {"modifier": "render_levels", "data": "render_resolution_u"}  # the property, by what has it

# Why levels of subdivision stay as they are
FOREIGN = "their object is linked, or a library override"
ANIMATED = "a keyframe or driver sets them"
ADAPTIVE = "Cycles dices what they subdivide (adaptive subdivision)"
SHARED = "several objects have the same curve"


@dataclass(frozen=True)
class Setting:
    """A number of a modifier, or of an object's data. name: of the property; values: what it can be, one step coarser
    after the other."""

    owner: Any
    name: str
    values: tuple[int, ...]

    @property
    def now(self) -> int:
        """What it is."""
        return int(getattr(self.owner, self.name))

    def set(self, value: int) -> None:
        """Have it be another."""
        setattr(self.owner, self.name, value)


def setting_of(ob: bpy.types.Object, scene: bpy.types.Scene) -> Setting | str:
    """By what a render of a scene has fewer triangles of an object: the levels of its last subdivision, or the
    resolution of a curve. Or why these must stay, "" where there are none."""
    for modifier in reversed(ob.modifiers):
        if modifier.type in SUBDIVIDES and modifier.show_render:
            level = _levels(modifier, scene)
            if level > 0:
                why = _obstacle(ob, modifier)
                return why or Setting(modifier, RENDERED["modifier"], tuple(range(level))[::-1][:STEPS])
    return _of_curve(ob) if ob.type in {"CURVE", "FONT"} else ""


def _of_curve(ob: bpy.types.Object) -> Setting | str:
    """By what a render has fewer triangles of a curve or a text."""
    data, name = ob.data, RENDERED["data"]
    finest = data.render_resolution_u or max([data.resolution_u, *(spline.resolution_u for spline in data.splines)])
    values = tuple(value for k in range(1, STEPS + 1) if (value := finest >> k))
    if not values:
        return ""
    if ob.library or ob.override_library or data.library or data.override_library:
        return FOREIGN
    if any(is_animated(data, path) for path in (name, "resolution_u")):
        return ANIMATED
    return SHARED if data.users > 1 else Setting(data, name, values)


def _obstacle(ob: bpy.types.Object, modifier: bpy.types.Modifier) -> str:
    """Why render levels must stay as they are, "" where they need not."""
    if ob.library is not None or ob.override_library is not None:
        return FOREIGN
    if is_animated(ob, f'modifiers["{bpy.utils.escape_identifier(modifier.name)}"].{RENDERED["modifier"]}'):
        return ANIMATED
    return ADAPTIVE if _is_adaptive(ob, modifier) else ""


def _levels(modifier: bpy.types.Modifier, scene: bpy.types.Scene) -> int:
    """By how many levels a render subdivides: Simplify limits them."""
    render = scene.render
    most = render.simplify_subdivision_render if render.use_simplify else modifier.render_levels
    return int(min(modifier.render_levels, most))


def _is_adaptive(ob: bpy.types.Object, modifier: bpy.types.Modifier) -> bool:
    """Whether Cycles dices what a modifier subdivides; of the object until Blender 4.5."""
    return bool(
        getattr(modifier, "use_adaptive_subdivision", False)
        or getattr(getattr(ob, "cycles", None), "use_adaptive_subdivision", False)
    )


def is_animated(block: Any, path: str) -> bool:
    """Whether a driver, an action or an NLA strip of an object, or of its data, controls the property `path`."""
    data = block.animation_data
    if data is None:
        return False
    actions = [data.action, *(strip.action for track in data.nla_tracks for strip in track.strips)]
    return any(d.data_path == path for d in data.drivers) or any(
        _moves(action, path) for action in actions if action is not None
    )


def _moves(action: bpy.types.Action, path: str) -> bool:
    curves = (c for layer in action.layers for strip in layer.strips for bag in strip.channelbags for c in bag.fcurves)
    return any(c.data_path == path for c in curves)
