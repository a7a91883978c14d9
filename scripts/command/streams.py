"""Standard streams that may be closed, full, or without a reader: nothing that a command does depends on them."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, TextIO

if TYPE_CHECKING:
    from ...core.progress import Progress


def repair() -> None:
    """Stand in for standard streams that are closed: else the next file that is opened would get what is meant for
    them."""
    for number, flags in ((0, os.O_RDONLY), (1, os.O_WRONLY), (2, os.O_WRONLY)):
        try:
            os.fstat(number)
        except OSError:
            handle = os.open(os.devnull, flags)
            if handle != number:
                os.dup2(handle, number)
                os.close(handle)
    for name, number in (("stdout", 1), ("stderr", 2)):
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(number, "w", closefd=False))


def say(text: str, stream: TextIO) -> None:
    """Print a line, where there is anybody to read it."""
    try:
        print(text, file=stream, flush=True)
    except (OSError, ValueError):
        _drop(stream)


def finish() -> None:
    """Empty the buffers, so that Python need not at its end, where it would complain."""
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except (OSError, ValueError):
            _drop(stream)


def _drop(stream: TextIO) -> None:
    """Let what is written to a stream go nowhere from now on."""
    with suppress(OSError, ValueError):
        handle = os.open(os.devnull, os.O_WRONLY)
        os.dup2(handle, stream.fileno())
        os.close(handle)
        stream.flush()


@contextmanager
def progress_of(quiet: bool) -> Iterator[Progress]:
    """Progress on stderr: on a copy of it, which stays ours while Blender's chatter is muted."""
    from ...core.progress import Terminal, silent

    if quiet:
        yield silent
        return
    stream = os.fdopen(os.dup(2), "w", errors="backslashreplace")  # as stderr itself
    try:
        with Terminal(stream) as terminal:
            yield terminal
    finally:
        with suppress(OSError):  # what nobody reads any more
            stream.close()
