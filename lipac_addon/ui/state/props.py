"""What the user sets: on the scene, and per object and collection."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import bpy
from bpy.props import BoolProperty, EnumProperty, FloatProperty, IntProperty, PointerProperty

from ....core.culling.policies import LIGHT_PATHS, NOTHING, POLICIES
from ... import roles
from . import preferences, results, session

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from ....core.arrays import I64
    from ....core.culling.options import CullOptions
    from ...keys import Keys

_OFFERED = [policy for policy in POLICIES.values() if policy.listed and policy.name != NOTHING]
CURRENT, RANGE = "CURRENT", "RANGE"


def _lock_interface(settings: LipacSettings, _context: bpy.types.Context) -> None:
    """Renders that change visibility need a locked interface; the scene's own setting comes back with the switch."""
    render = settings.id_data.render
    if settings.use_for_renders and not render.use_lock_interface:
        render.use_lock_interface = settings.locked = True
    elif settings.locked and not settings.use_for_renders:
        render.use_lock_interface = settings.locked = False


def _redraw(settings: LipacSettings, _context: bpy.types.Context) -> None:
    session.redraw()


def _freeze(settings: LipacSettings, _context: bpy.types.Context) -> None:
    results.freeze(settings.id_data, settings.freeze)
    session.redraw()


def _preferred(name: str) -> Callable[[Any, float, bool], float]:
    """The value of the preferences, for a scene that sets none."""
    return lambda _settings, value, is_set: value if is_set else getattr(preferences.get(), name)


class LipacSettings(bpy.types.PropertyGroup):
    """Settings of a scene."""

    policy: EnumProperty(  # type: ignore[valid-type]
        name="Keep",
        description="What decides which instances stay in the render",
        items=[(policy.name, policy.label, policy.description, "NONE", policy.rank) for policy in _OFFERED],
    )
    max_error: preferences.percentage(  # type: ignore[valid-type]
        "Error Budget",
        "Largest change of the picture that you allow: the mean over its 16 x 9 tiles. Less keeps more instances",
        preferences.DEFAULTS.max_error,
        get_transform=_preferred("max_error"),
    )
    worst_error: preferences.percentage(  # type: ignore[valid-type]
        "Worst Tile",
        "Largest change that you allow in any one tile (a 16th of the picture's width)",
        preferences.DEFAULTS.worst_error,
        get_transform=_preferred("worst_error"),
    )
    levels: BoolProperty(  # type: ignore[valid-type]
        name="Levels of Detail",
        description=(
            "Render what stays with simplified meshes, fewer levels of subdivision and coarser curves, where the error "
            "budget has room for it. The analysis takes up to twice as long"
        ),
    )
    limit_memory: BoolProperty(  # type: ignore[valid-type]
        name="Limit Memory",
        description=(
            "Have Blender take no more memory than this while it renders by Cycles on the processor. Where culling by "
            "the error budget does not save enough, go on with what changes the picture least"
        ),
    )
    memory_limit: FloatProperty(  # type: ignore[valid-type]
        name="Memory Limit",
        description="GB that Blender may take while it renders, all that it takes before included",
        default=8.0,
        min=0.1,
        soft_max=256.0,
        precision=2,
        step=10,
    )
    frames: EnumProperty(  # type: ignore[valid-type]
        name="Frames",
        description="Which frames to analyze; a render is culled only at frames that were",
        items=(
            (CURRENT, "Current Frame", "Analyze the current frame"),
            (RANGE, "Frame Range", "Analyze each frame of the scene's range, with its step"),
        ),
    )
    paths: IntProperty(  # type: ignore[valid-type]
        name="Paths",
        description=(
            "Light paths per pixel of the analysis picture. 0: as many as the error needs. More find smaller "
            "things, and take longer"
        ),
        default=0,
        min=0,
        soft_max=64,
    )
    width: IntProperty(  # type: ignore[valid-type]
        name="Width",
        description="Width of the analysis picture in pixels",
        default=240,
        min=16,
        soft_max=1920,
        subtype="PIXEL",
    )
    seed: IntProperty(  # type: ignore[valid-type]
        name="Seed",
        description="Seed of the random numbers; the same seed gives the same result",
        default=0,
        min=0,
    )
    use_for_renders: BoolProperty(  # type: ignore[valid-type]
        name="Use for Renders",
        description=(
            "Cull during renders and animations, and put everything back afterwards. Locks the interface while "
            "rendering"
        ),
        update=_lock_interface,
    )
    cull_viewport: BoolProperty(  # type: ignore[valid-type]
        name="Cull Viewport",
        description=(
            "While Live is on, viewports in Rendered shading that look through the camera do not show what is "
            "culled. Renders do, and the file keeps it"
        ),
        update=_redraw,
    )
    show_overlay: BoolProperty(  # type: ignore[valid-type]
        name="Overlay", description="Draw the analyzed instances as boxes in the viewport", update=_redraw
    )
    show_active: BoolProperty(name="Active", description="Boxes of instances that stay", default=True, update=_redraw)  # type: ignore[valid-type]
    show_pending: BoolProperty(  # type: ignore[valid-type]
        name="Pending",
        description="Boxes of instances that are wanted and still being built (live mode)",
        default=True,
        update=_redraw,
    )
    show_culled: BoolProperty(name="Culled", description="Boxes of single culled instances", update=_redraw)  # type: ignore[valid-type]
    show_regions: BoolProperty(  # type: ignore[valid-type]
        name="Regions", description="Boxes that stand in for what is culled", default=True, update=_redraw
    )
    heat_map: BoolProperty(  # type: ignore[valid-type]
        name="Heat Map",
        description=(
            "Color instances by how many light paths meet them, from dark (none) to bright (most), not by state"
        ),
        update=_redraw,
    )
    show_tiles: BoolProperty(  # type: ignore[valid-type]
        name="Worst Tiles",
        description=(
            "In the camera view: how much each of the picture's 16 x 9 tiles changes at most, brighter for more, "
            "with the figures of the worst"
        ),
        update=_redraw,
    )
    show_memory: BoolProperty(  # type: ignore[valid-type]
        name="Memory List",
        description="In the camera view: the objects and images that take most of the memory of a render",
        update=_redraw,
    )
    opacity: FloatProperty(  # type: ignore[valid-type]
        name="Opacity",
        description="Opacity of the boxes",
        subtype="FACTOR",
        default=0.6,
        min=0.0,
        max=1.0,
        update=_redraw,
    )
    in_front: BoolProperty(  # type: ignore[valid-type]
        name="In Front", description="Draw boxes in front of the geometry that hides them", update=_redraw
    )
    freeze: BoolProperty(  # type: ignore[valid-type]
        name="Freeze",
        description="Keep showing these boxes while you fly around, change frames and analyze again",
        update=_freeze,
    )
    applied: BoolProperty(  # type: ignore[valid-type]
        name="Applied", description="Culled instances are hidden from renders of this file", options={"HIDDEN"}
    )
    applied_from: IntProperty(  # type: ignore[valid-type]
        name="Applied from", description="The first frame that what is applied holds for", options={"HIDDEN"}
    )
    applied_to: IntProperty(  # type: ignore[valid-type]
        name="Applied to", description="The last frame that what is applied holds for", options={"HIDDEN"}
    )
    applied_step: IntProperty(  # type: ignore[valid-type]
        name="Applied step", description="From one frame that what is applied holds for to the next", options={"HIDDEN"}
    )
    applied_count: IntProperty(  # type: ignore[valid-type]
        name="Applied count", description="Instances that are hidden from renders", options={"HIDDEN"}
    )
    applied_as: IntProperty(  # type: ignore[valid-type]
        name="Applied as", description="Which of this session's results is applied", options={"HIDDEN"}
    )
    in_render: BoolProperty(  # type: ignore[valid-type]
        name="In a render", description="Culled instances are hidden until the running render ends", options={"HIDDEN"}
    )
    locked: BoolProperty(  # type: ignore[valid-type]
        name="Interface lock", description="LiPaC locked the interface during renders", options={"HIDDEN"}
    )


for _own in [policy.setting for policy in _OFFERED if policy.setting is not None]:
    LipacSettings.__annotations__[_own.name] = FloatProperty(
        name=_own.label,
        description=_own.description,
        default=_own.default,
        min=0.0,
        max=min(_own.most, 3.4e38),
        subtype=_own.kind,
    )


def own_setting(settings: LipacSettings) -> float | None:
    """The number that the chosen policy goes by; None where it has none."""
    own = POLICIES[settings.policy].setting
    return None if own is None else float(getattr(settings, own.name))


def own_levels(settings: LipacSettings) -> bool:
    """Whether what stays may be exchanged for simplified meshes."""
    return bool(settings.levels and settings.policy == LIGHT_PATHS)


def memory_limit(settings: LipacSettings) -> int:
    """Bytes that Blender may take while it renders; 0: no limit."""
    limited = settings.limit_memory and settings.policy == LIGHT_PATHS
    return round(settings.memory_limit * 1e3) * 1_000_000 if limited else 0


def cull_options(settings: LipacSettings, parts: bool = False) -> CullOptions:
    """The options of the analysis that the settings ask for; loads the engine. parts: large meshes are culled by
    parts."""
    from ....core.culling.options import CullOptions
    from ....core.error_budget.budget import Budget

    return CullOptions(
        policy=settings.policy,
        setting=own_setting(settings),
        max_error=Budget(settings.max_error / 100, settings.worst_error / 100),
        paths=settings.paths,
        width=settings.width,
        seed=settings.seed,
        threads=preferences.get().threads,
        blas_budget_bytes=int(preferences.get().memory * preferences.GIB),
        parts=parts,
        levels=own_levels(settings),
        memory=memory_limit(settings),
    )


def pinned(keys: Keys, uids: I64) -> NDArray[np.bool_] | None:
    """(N,) bool: instances that stay whatever paths meet; None where nothing is pinned. keys, uids: as of
    `results.FrameResult`."""
    pins = roles.marked(roles.PIN)
    return roles.instances_of(keys, results.among(uids, pins)) if pins else None


def asked_frames(scene: bpy.types.Scene) -> tuple[int, ...]:
    """Frames that the settings of a scene ask for."""
    return tuple(frame_range(scene)) if scene.lipac.frames == RANGE else (scene.frame_current,)


def frame_range(scene: bpy.types.Scene) -> range:
    """The scene's frames, with its step."""
    return range(scene.frame_start, scene.frame_end + 1, scene.frame_step)


def register() -> None:
    """Put the settings on scenes, and roles on objects and collections."""
    bpy.utils.register_class(LipacSettings)
    bpy.types.Scene.lipac = PointerProperty(type=LipacSettings, name="LiPaC", description="Light path guided culling")
    roles.register()


def unregister() -> None:
    """Take them away again."""
    roles.unregister()
    del bpy.types.Scene.lipac
    bpy.utils.unregister_class(LipacSettings)
