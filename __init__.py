"""LiPaC for Blender: light path guided culling.

As a Blender extension this package registers `lipac_addon`; `lipac.core` and the commands need no registration.
"""


def register() -> None:
    """Register the add-on (called by Blender)."""
    from . import lipac_addon

    lipac_addon.register()


def unregister() -> None:
    """Unregister the add-on (called by Blender)."""
    from . import lipac_addon

    lipac_addon.unregister()
