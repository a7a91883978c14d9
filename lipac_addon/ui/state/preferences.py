"""Preferences: what belongs to the machine, not to a scene. Loads nothing of the engine, whose cache folder it says."""

from __future__ import annotations

import os
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import bpy
from bpy.props import FloatProperty, IntProperty, StringProperty

from . import kernel_folder

ROOT = __package__.rpartition(".lipac_addon")[0]
GIB = 1 << 30
_CACHE = "LIPAC_CACHE_DIR"
_EXTENSIONS = "bl_ext."
_given: str | None = None  # what the variable was before


@dataclass(frozen=True)
class Defaults:
    """Values of the preferences where the add-on is not enabled there: scripts and tests that register it by
    themselves."""

    threads: int = 0
    memory: float = 0.0
    cache: str = ""
    max_error: float = 1.0
    worst_error: float = 5.0


DEFAULTS = Defaults()


def percentage(name: str, description: str, default: float, **more: Any) -> Any:
    """A property from 0 to 100 percent."""
    return FloatProperty(
        name=name, description=description, subtype="PERCENTAGE", default=default, min=0.0, max=100.0, **more
    )


class LipacPreferences(bpy.types.AddonPreferences):
    """Preferences of the add-on."""

    bl_idname = ROOT

    threads: IntProperty(  # type: ignore[valid-type]
        name="Threads",
        description="Threads of the analysis; 0 takes all cores",
        default=DEFAULTS.threads,
        min=0,
        max=1024,
    )
    memory: FloatProperty(  # type: ignore[valid-type]
        name="Memory Budget",
        description=(
            "GiB that an analysis may take for acceleration structures; what is worth least goes first. 0: no limit"
        ),
        default=DEFAULTS.memory,
        min=0.0,
        soft_max=64.0,
    )
    cache: StringProperty(  # type: ignore[valid-type]
        name="Cache Folder",
        description=(
            "Where compiled kernels are kept. Empty: the extension's own folder. Takes effect when Blender starts again"
        ),
        subtype="DIR_PATH",
        default=DEFAULTS.cache,
    )
    max_error: percentage(  # type: ignore[valid-type]
        "Error Budget",
        "Error budget of scenes that do not set their own: the mean change of the picture's tiles",
        DEFAULTS.max_error,
    )
    worst_error: percentage(  # type: ignore[valid-type]
        "Worst Tile", "The same for any one tile of the picture (a 16th of its width)", DEFAULTS.worst_error
    )

    def draw(self, _context: bpy.types.Context) -> None:
        """The preferences' own page."""
        layout = self.layout
        layout.use_property_split = True
        for names in (("max_error", "worst_error"), ("threads", "memory"), ("cache",)):
            column = layout.column(align=True)
            for name in names:
                column.prop(self, name)
        layout.operator("lipac.clear_cache", text=f"Clear Cache ({kernel_folder.size() / 1e6:.0f} MB)")


def get() -> Any:
    """The preferences, or `DEFAULTS`."""
    addon = bpy.context.preferences.addons.get(ROOT)
    return addon.preferences if addon is not None and addon.preferences is not None else DEFAULTS


def _use_cache() -> None:
    """Have the engine keep compiled kernels in the folder that the preferences name, an installed extension in its own
    one; before `core` is imported."""
    global _given  # noqa: PLW0603
    _given = os.environ.get(_CACHE)
    if get().cache:
        os.environ[_CACHE] = bpy.path.abspath(get().cache)
    elif ROOT.startswith(_EXTENSIONS) and _given is None:
        with suppress(OSError):  # a user whose folder is read-only has the cache where the engine puts it
            os.environ[_CACHE] = bpy.utils.extension_path_user(ROOT, path="kernels", create=True)


def register() -> None:
    """Register the preferences, and do what they say of the cache."""
    bpy.utils.register_class(LipacPreferences)
    _use_cache()


def unregister() -> None:
    """Unregister them."""
    bpy.utils.unregister_class(LipacPreferences)
    if _given is None:
        os.environ.pop(_CACHE, None)
    else:
        os.environ[_CACHE] = _given
