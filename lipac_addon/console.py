"""Keeping Blender's own chatter out of a command's output."""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, redirect_stderr, redirect_stdout, suppress
from typing import TextIO

DEBUG = "LIPAC_DEBUG"


def debugging() -> bool:
    """Whether the user asked for Blender's output and tracebacks, by LIPAC_DEBUG=1."""
    return os.environ.get(DEBUG, "") not in ("", "0")


@contextmanager
def muted() -> Iterator[None]:
    """Redirect what Python prints and what is written to file descriptors 1 and 2: shown on stderr where LIPAC_DEBUG is
    set, else dropped."""
    _flush()
    with ExitStack() as stack:
        sink = os.dup(2) if debugging() else os.open(os.devnull, os.O_WRONLY)
        text = os.fdopen(sink, "w")
        stack.callback(_close, text)
        for fd in (1, 2):
            try:
                saved = os.dup(fd)
            except OSError:  # it is closed
                continue
            stack.callback(os.close, saved)
            stack.callback(os.dup2, saved, fd)
            os.dup2(sink, fd)
        stack.callback(_flush)
        stack.enter_context(redirect_stdout(text))
        stack.enter_context(redirect_stderr(text))
        yield


def _close(text: TextIO) -> None:
    with suppress(OSError, ValueError):  # nobody reads it any more
        text.close()


def _flush() -> None:
    """Empty the buffers of Python and of C, so that what was printed lands where it belongs."""
    for stream in (sys.stdout, sys.stderr):
        if stream is not None:
            with suppress(OSError, ValueError):
                stream.flush()
    library = ctypes.CDLL("ucrtbase" if os.name == "nt" else None)
    library.fflush(None)
