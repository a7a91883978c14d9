"""Everything that touches Blender: scene in, culling out, renders, panel and overlay."""


def register() -> None:
    """Register classes with Blender. Neither numba nor Embree is loaded before the first analysis."""
    from .ui.state import preferences

    preferences.register()  # says where `core`, which the other modules import, keeps compiled kernels
    from .ui import registration

    registration.register()


def unregister() -> None:
    """Take back what `register` did."""
    from .ui import registration
    from .ui.state import preferences

    registration.unregister()
    preferences.unregister()
