"""Ctrl-C, as work can poll for it."""

from __future__ import annotations

import os
import signal
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

PATIENCE = 0.5  # seconds that work may take to notice Ctrl-C


@contextmanager
def ctrl_c() -> Iterator[Callable[[], bool]]:
    """A function that tells whether Ctrl-C was pressed within the block, for work to poll: an exception in the midst of
    Blender's would not come through.

    Where the work does not end soon (Blender evaluates a scene, a large structure is built), the process ends as it is:
    whatever it leaves on disk is whole. A second Ctrl-C ends it at once. Where whoever started the process had it
    ignore Ctrl-C, it does.
    """
    pressed = threading.Event()

    def note(_number: int, _frame: object) -> None:
        pressed.set()
        signal.signal(signal.SIGINT, signal.SIG_DFL)

    if threading.current_thread() is not threading.main_thread() or signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
        yield pressed.is_set
        return
    old = signal.signal(signal.SIGINT, note)
    with _impatient():
        try:
            yield pressed.is_set
        finally:
            signal.signal(signal.SIGINT, old)


@contextmanager
def _impatient() -> Iterator[None]:
    """Ends the process where Ctrl-C has no effect for a while. Python's handlers wait for the main thread; a thread of
    its own learns of signals at once."""
    here, there = socket.socketpair()
    there.setblocking(False)
    done = threading.Event()
    stderr = os.dup(2)  # what is written while Blender's chatter is muted

    def watch() -> None:
        while number := here.recv(1):
            if number[0] == signal.SIGINT and not done.wait(PATIENCE):
                with suppress(OSError):
                    os.write(stderr, b"lipac: stopped; finished frames and their report are kept\n")
                os._exit(130)

    thread = threading.Thread(target=watch, name="Ctrl-C", daemon=True)
    thread.start()
    old = signal.set_wakeup_fd(there.fileno(), warn_on_full_buffer=False)
    try:
        yield
    finally:
        done.set()
        signal.set_wakeup_fd(old)
        there.close()
        thread.join()
        here.close()
        os.close(stderr)
