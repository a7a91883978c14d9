"""What an artist sees: the panel "LiPaC" in the sidebar of the 3D viewport, its operators, the overlay and the render handlers.

Data flows one way: `props` (what the user set) -> `job` (reads Blender on the main thread, analyses in a worker) -> `results` (plain arrays) -> `panel`,
`overlay`, `applying` (what is written back) and `handlers`. Modules here load neither numba nor Embree when they are imported.
"""

from __future__ import annotations

from . import handlers, operators, overlay, panel, props

_MODULES = (props, operators, panel, overlay, handlers)


def register() -> None:
    """Register properties, classes, draw handlers and application handlers."""
    for module in _MODULES:
        module.register()


def unregister() -> None:
    """Stop a running analysis and remove everything that `register` added. What was applied to a file stays in it: the file has the record."""
    for module in reversed(_MODULES):
        module.unregister()
