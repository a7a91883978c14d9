"""What the extension adds to Blender, and takes away again."""

from __future__ import annotations

import atexit

from . import handlers, manual, memory_panel, operators, panel, submit
from .draw import overlay
from .jobs import job, live
from .state import props, results

_MODULES = (props, operators, submit, panel, memory_panel, manual, overlay, handlers)


def register() -> None:
    """Register properties, classes, draw handlers and application handlers."""
    for module in _MODULES:
        module.register()
    atexit.register(_stop, quitting=True)


def unregister() -> None:
    """Stop a running analysis and remove everything that `register` added. What was applied to a file stays in it: the
    file has the record."""
    atexit.unregister(_stop)
    _stop()
    results.clear()
    for module in reversed(_MODULES):
        module.unregister()


def _stop(quitting: bool = False) -> None:
    """End all threads: also when Blender quits, before Python is taken down under them."""
    live.stop(quitting)
    job.stop()
