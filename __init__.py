"""LiPaC for Blender: light path guided culling.

    import lipac

    analysis = lipac.analyze("scene.blend", max_error=0.01)
    print(analysis.state, analysis.entry)
    lipac.apply(analysis)  # renders of the open file are culled from here on
    lipac.restore()

Nothing is loaded before it is used: `lipac.analyze` of arrays needs no Blender. As a Blender extension this package
registers `lipac_addon`; `lipac.core` and the commands need no registration.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from .version import __version__

__all__ = ["Budget", "CullOptions", "InputError", "Scene", "__version__", "analyze", "apply", "render", "restore"]

if TYPE_CHECKING:
    from .core.culling.options import CullOptions
    from .core.error_budget.budget import Budget
    from .core.errors import InputError
    from .core.scene.model import Scene
    from .lipac_addon.library import analyze, apply, render, restore

_HOMES = {
    "Budget": "core.error_budget.budget",
    "CullOptions": "core.culling.options",
    "InputError": "core.errors",
    "Scene": "core.scene.model",
    **dict.fromkeys(("analyze", "apply", "render", "restore"), "lipac_addon.library"),
}


def __getattr__(name: str) -> Any:
    """Load what is asked for (PEP 562)."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(f".{_HOMES[name]}", __name__), name)


def __dir__() -> list[str]:
    """What `dir(lipac)` shows."""
    return sorted({*globals(), *_HOMES})


def register() -> None:
    """Register the add-on (called by Blender)."""
    from . import lipac_addon

    lipac_addon.register()


def unregister() -> None:
    """Unregister the add-on (called by Blender)."""
    from . import lipac_addon

    lipac_addon.unregister()
