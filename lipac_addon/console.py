"""Keeping Blender's own chatter out of a command's output."""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager

DEBUG = "LIPAC_DEBUG"


def debugging() -> bool:
    """Whether the user asked for Blender's output and tracebacks, by LIPAC_DEBUG=1."""
    return os.environ.get(DEBUG, "") not in ("", "0")


@contextmanager
def muted() -> Iterator[None]:
    """Redirect what is written to file descriptors 1 and 2, Blender's C code included; shown on stderr where LIPAC_DEBUG is set, else dropped."""
    sys.stdout.flush()
    sys.stderr.flush()
    saved = os.dup(1), os.dup(2)
    with tempfile.TemporaryFile() as sink:
        os.dup2(2 if debugging() else sink.fileno(), 1)
        if not debugging():
            os.dup2(sink.fileno(), 2)
        try:
            yield
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            for fd, copy in enumerate(saved, 1):
                os.dup2(copy, fd)
                os.close(copy)
