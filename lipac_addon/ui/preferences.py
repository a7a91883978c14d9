"""Preferences: what belongs to the machine, not to a scene. Loads nothing of the engine, whose cache folder it says."""

from __future__ import annotations

import os
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import bpy
from bpy.props import FloatProperty, IntProperty, StringProperty

ROOT = __package__.rpartition(".lipac_addon")[0]
GIB = 1 << 30
_CACHE = "LIPAC_CACHE_DIR"
_EXTENSIONS = "bl_ext."
_given: str | None = None  # what the variable was before


@dataclass(frozen=True)
class Defaults:
    """Values of the preferences where the add-on is not enabled there: scripts and tests that register it by themselves."""

    threads: int = 0
    memory: float = 0.0
    cache: str = ""
    max_error: float = 1.0
    worst_error: float = 5.0


DEFAULTS = Defaults()


class LipacPreferences(bpy.types.AddonPreferences):
    """Preferences of the add-on."""

    bl_idname = ROOT

    threads: IntProperty(name="Threads", description="Threads of the analysis; 0 takes all cores", default=DEFAULTS.threads, min=0, max=1024)  # type: ignore[valid-type]
    memory: FloatProperty(  # type: ignore[valid-type]
        name="Memory budget",
        description="GiB that acceleration structures of an analysis may take; what is worth least goes first. 0: no limit",
        default=DEFAULTS.memory,
        min=0.0,
        soft_max=64.0,
    )
    cache: StringProperty(  # type: ignore[valid-type]
        name="Cache folder",
        description="Where compiled kernels are kept. Empty: the extension's own folder. Takes effect when Blender starts again",
        subtype="DIR_PATH",
        default=DEFAULTS.cache,
    )
    max_error: FloatProperty(  # type: ignore[valid-type]
        name="Error budget",
        description="Error budget of scenes that do not set their own: how much the picture may change on average",
        subtype="PERCENTAGE",
        default=DEFAULTS.max_error,
        min=0.0,
        max=100.0,
    )
    worst_error: FloatProperty(  # type: ignore[valid-type]
        name="Worst tile",
        description="The same for any one tile of the picture (a 16th of its width)",
        subtype="PERCENTAGE",
        default=DEFAULTS.worst_error,
        min=0.0,
        max=100.0,
    )

    def draw(self, _context: bpy.types.Context) -> None:
        """The preferences' own page."""
        layout = self.layout
        layout.use_property_split = True
        for names in (("max_error", "worst_error"), ("threads", "memory"), ("cache",)):
            column = layout.column(align=True)
            for name in names:
                column.prop(self, name)
        layout.operator(LIPAC_OT_clear_cache.bl_idname, text=f"Clear Cache ({cache_bytes() / 1e6:.0f} MB)")


class LIPAC_OT_clear_cache(bpy.types.Operator):
    """Remove compiled kernels from the disk. The next start of Blender compiles them again, which takes a minute"""

    bl_idname = "lipac.clear_cache"
    bl_label = "Clear Cache"
    bl_options: ClassVar[set[str]] = {"REGISTER"}

    def execute(self, _context: bpy.types.Context) -> set[str]:
        freed = cache_bytes()
        for folder in _cached():
            shutil.rmtree(folder, ignore_errors=True)
        self.report({"INFO"}, f"Removed {freed / 1e6:.0f} MB of compiled kernels")
        return {"FINISHED"}


def get() -> Any:
    """The preferences, or `DEFAULTS`."""
    addon = bpy.context.preferences.addons.get(ROOT)
    return addon.preferences if addon is not None and addon.preferences is not None else DEFAULTS


def _cached() -> list[Path]:
    from ...core.kernel_cache import user_cache

    return list(user_cache().glob("kernels-*"))


def cache_bytes() -> int:
    """Size of the compiled kernels on disk."""
    return sum(path.stat().st_size for folder in _cached() for path in folder.rglob("*") if path.is_file())


def compiled_kernels() -> int:
    """How many kernels have been compiled and kept."""
    return sum(1 for folder in _cached() for _ in folder.rglob("*.nbi"))


def _use_cache() -> None:
    """Have the engine keep compiled kernels in the folder that the preferences name, an installed extension in its own one; before `core` is imported."""
    global _given  # noqa: PLW0603
    _given = os.environ.get(_CACHE)
    if get().cache:
        os.environ[_CACHE] = bpy.path.abspath(get().cache)
    elif ROOT.startswith(_EXTENSIONS) and _given is None:
        os.environ[_CACHE] = bpy.utils.extension_path_user(ROOT, path="kernels", create=True)


_CLASSES = (LIPAC_OT_clear_cache, LipacPreferences)


def register() -> None:
    """Register the preferences, and do what they say of the cache."""
    for cls in _CLASSES:
        bpy.utils.register_class(cls)
    _use_cache()


def unregister() -> None:
    """Unregister them."""
    for cls in reversed(_CLASSES):
        bpy.utils.unregister_class(cls)
    if _given is None:
        os.environ.pop(_CACHE, None)
    else:
        os.environ[_CACHE] = _given
