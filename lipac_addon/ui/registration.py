"""What the extension adds to Blender, and takes away again."""

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
