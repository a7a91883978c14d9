"""Processes that tests start."""

from __future__ import annotations

import os
import signal
from typing import Any


def _interruptible() -> None:
    signal.signal(signal.SIGINT, signal.default_int_handler)


# For subprocess: Ctrl-C reaches the process, also where whoever started the tests had them ignore it
INTERRUPTIBLE: dict[str, Any] = {} if os.name == "nt" else {"preexec_fn": _interruptible}
