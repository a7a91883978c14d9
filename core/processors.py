"""How many threads are worth while."""

from __future__ import annotations

import os


def processors() -> int:
    """Processors that this process may run on: of a machine whose others are another's, those alone."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
