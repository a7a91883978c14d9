"""Everything that touches Blender: scene in, culling out, renders, panel and overlay."""

import os

_CACHE = "LIPAC_CACHE_DIR"
_EXTENSIONS = "bl_ext."
_set_here: list[str] = []


def register() -> None:
    """Register classes with Blender. Neither numba nor Embree is loaded before the first analysis."""
    _use_own_cache()
    from .ui import registration

    registration.register()


def unregister() -> None:
    """Take back what `register` did."""
    from .ui import registration

    registration.unregister()
    for name in _set_here:
        os.environ.pop(name, None)
    _set_here.clear()


def _use_own_cache() -> None:
    """Have an installed extension keep compiled kernels in its own user folder; must run before `core` is imported."""
    import bpy

    root = __package__.rpartition(".")[0]
    if root.startswith(_EXTENSIONS) and _CACHE not in os.environ:
        os.environ[_CACHE] = bpy.utils.extension_path_user(root, path="kernels", create=True)
        _set_here.append(_CACHE)
