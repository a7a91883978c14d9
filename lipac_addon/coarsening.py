"""Settings of objects by which a render has fewer of their triangles, and which the viewport does not look at: levels
of subdivision."""

from __future__ import annotations

from dataclasses import dataclass

import bpy

SUBDIVIDES = frozenset({"SUBSURF", "MULTIRES"})
STEPS = 3  # levels that a subdivision goes without at most: each has a quarter of the triangles of the one before

# Why levels of subdivision stay as they are
FOREIGN = "their object is linked, or a library override"
ANIMATED = "a keyframe or driver sets them"
ADAPTIVE = "Cycles dices what they subdivide (adaptive subdivision)"


@dataclass(frozen=True)
class Setting:
    """The render levels of a modifier. values: what they can be, one step coarser after the other."""

    modifier: bpy.types.Modifier
    values: tuple[int, ...]


def setting_of(ob: bpy.types.Object, scene: bpy.types.Scene) -> Setting | str:
    """By what a render of a scene has fewer triangles of an object: the levels of its last subdivision. Or why these
    must stay, "" where there are none."""
    for modifier in reversed(ob.modifiers):
        if modifier.type in SUBDIVIDES and modifier.show_render:
            level = _levels(modifier, scene)
            if level > 0:
                why = _obstacle(ob, modifier)
                return why or Setting(modifier, tuple(range(level))[::-1][:STEPS])
    return ""


def _obstacle(ob: bpy.types.Object, modifier: bpy.types.Modifier) -> str:
    """Why render levels must stay as they are, "" where they need not."""
    if ob.library is not None or ob.override_library is not None:
        return FOREIGN
    if is_animated(ob, f'modifiers["{bpy.utils.escape_identifier(modifier.name)}"].render_levels'):
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


def is_animated(ob: bpy.types.Object, path: str) -> bool:
    """Whether a driver, an action or an NLA strip of the object controls the property `path`."""
    data = ob.animation_data
    if data is None:
        return False
    actions = [data.action, *(strip.action for track in data.nla_tracks for strip in track.strips)]
    return any(d.data_path == path for d in data.drivers) or any(
        _moves(action, path) for action in actions if action is not None
    )


def _moves(action: bpy.types.Action, path: str) -> bool:
    curves = (c for layer in action.layers for strip in layer.strips for bag in strip.channelbags for c in bag.fcurves)
    return any(c.data_path == path for c in curves)
