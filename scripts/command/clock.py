"""When the running command began."""

from __future__ import annotations

import time

_began = time.monotonic()


def begin() -> None:
    """A command begins now."""
    global _began  # noqa: PLW0603
    _began = time.monotonic()


def began() -> float:
    """`time.monotonic()` when this command began."""
    return _began
