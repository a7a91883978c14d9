"""The `lipac` command: `lipac COMMAND ...`."""

from __future__ import annotations

import importlib
import os
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from ..version import __version__
from .command import clock, streams
from .command.streams import say

# Command: module of this folder, with a main(argv), and what it does
COMMANDS = {
    "demo": ("demo", "write a procedural demo scene to a .blend file"),
    "analyze": ("analyze", "decide which instances light paths need; no picture"),
    "render": ("render", "cull and render by Cycles, EEVEE or the path tracer"),
    "report": ("report", "write report.html, a page to look at, from what these two left"),
    "evaluate": ("evaluate", "measure speed against error for every culling policy"),
    "farm": (
        "farm.write",
        "describe a shot as a job for a render farm: Open Job Description, Flamenco, or this machine",
    ),
    "shot": ("farm.step", "do a step of such a job"),
    "bench": ("bench", "measure speed against peers"),
}

# Exit status: what it means. docs/reference.md is written from this and the next.
STATUSES = {
    0: "success",
    1: "an error that is not of the input: out of memory, a full disk, a fault of ours",
    2: "unusable input: one line says what is wrong and what to do",
    3: "done, but a verification found the error budget broken",
    130: "stopped by Ctrl-C; finished frames and their report are kept",
    143: "`lipac shot`: asked to end (SIGTERM), as farms ask; what is finished is kept",
}
ENVIRONMENT = {
    "LIPAC_CACHE_DIR": "folder for compiled kernels; by default in the user's cache folder",
    "LIPAC_DEBUG": "`1`: tracebacks of errors, and Blender's own output",
}

STOPPED = "stopped; finished frames and their report are kept"
NO_MEMORY = (
    "out of memory; lower --resolution or the number of instances, close other programs, or allow this one more memory"
)


def usage() -> str:
    """What `lipac --help` prints."""
    width = max(map(len, COMMANDS))
    lines = [f"  {name.ljust(width)}  {help_}" for name, (_, help_) in COMMANDS.items()]
    return "\n".join(["usage: lipac COMMAND [options]", "", *lines, "", "lipac COMMAND --help tells the options."])


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command line, the program's own by default; returns the exit status."""
    if argv is None and sys.getfilesystemencoding() != "utf-8":
        # names of files would be of that encoding, and Blender takes them for UTF-8: Python begins anew
        os.execv(sys.executable, [sys.executable, "-X", "utf8", *sys.orig_argv[1:]])
    streams.repair()
    try:
        return _run(argv)
    finally:
        streams.finish()


def _run(argv: Sequence[str] | None) -> int:
    arguments = list(sys.argv[1:] if argv is None else argv)
    if not arguments or arguments[0] in ("-h", "--help"):
        say(usage(), sys.stdout)
        return 0 if arguments else 2
    name, *rest = arguments
    if name == "--version":
        say(__version__, sys.stdout)
        return 0
    if name not in COMMANDS:
        say(f"lipac: unknown command '{name}'; choose one of {', '.join(COMMANDS)}", sys.stderr)
        return 2
    status = guarded(name, rest)
    if argv is None and status:  # the process ends
        from .command.last_words import nothing_more

        nothing_more(status)
    return status


def guarded(name: str, arguments: Sequence[str]) -> int:
    """Run a command; errors become one line on stderr and an exit status. LIPAC_DEBUG=1 shows where they come from."""
    clock.begin()
    with _ctrl_c_noted() as stopped:
        return _guarded(name, arguments, stopped)


def _reserve() -> None:
    """Take what linear algebra works in while there is memory: where none is left, the OpenBLAS of NumPy 1 asks for it
    again and again, for ever."""
    import numpy as np

    if np.lib.NumpyVersion(np.__version__) < "2.0.0":
        np.linalg.inv(np.eye(2))


def _guarded(name: str, arguments: Sequence[str], stopped: threading.Event) -> int:
    from ..core.errors import Cancelled, InputError

    _reserve()
    try:
        status = importlib.import_module(f".{COMMANDS[name][0]}", __package__).main(arguments)
        return int(status or 0)
    except InputError as error:
        line, status = str(error), 2
    except (KeyboardInterrupt, Cancelled):
        line, status = STOPPED, 130
    except MemoryError:
        line, status = NO_MEMORY, 1
    except OSError as error:
        line, status = NO_MEMORY if _unmapped(error) else _lost(error), 1
    except Exception as error:
        if os.environ.get("LIPAC_DEBUG", "") not in ("", "0") and not stopped.is_set():
            raise
        line, status = _internal(error), 1
    if stopped.is_set():  # what was being imported says something else
        line, status = STOPPED, 130
    say(f"lipac {name}: {line}", sys.stderr)
    return status


def _internal(error: Exception) -> str:
    """What to say of an error that none of ours is."""
    if "can't start new thread" in str(error):
        return "the system allows no more threads; allow this user more processes, or give --threads 1"
    first = str(error).strip().splitlines()[:1]
    return (
        NO_MEMORY
        if _unmapped(error)
        else f"internal error: {type(error).__name__}: {''.join(first)} (LIPAC_DEBUG=1 shows more)"
    )


@contextmanager
def _ctrl_c_noted() -> Iterator[threading.Event]:
    """Set from when Ctrl-C is pressed on, which raises KeyboardInterrupt as always."""
    stopped = threading.Event()

    def note(*_: object) -> None:
        stopped.set()
        raise KeyboardInterrupt

    ours = (
        threading.current_thread() is threading.main_thread()
        and signal.getsignal(signal.SIGINT) == signal.default_int_handler
    )
    if ours:
        signal.signal(signal.SIGINT, note)
    try:
        yield stopped
    finally:
        if ours:
            signal.signal(signal.SIGINT, signal.default_int_handler)


def _unmapped(error: Exception) -> bool:
    """Whether a library finds no room in memory."""
    return any(
        text in str(error)
        for text in (
            "failed to map segment",
            "cannot allocate memory",
            "Cannot allocate memory",
            "load shared object file",
        )
    )


def _lost(error: OSError) -> str:
    """What to do about files that cannot be read or written."""
    import tempfile

    name = str(error.filename or "")
    where = f" {name}" if name else " its files"
    folder = tempfile.tempdir
    if folder and name.startswith(os.path.join(folder, "lipac")):
        return (
            f"cannot read or write{where}: {error.strerror or error}; finished frames are kept; free space in "
            f"{folder}, or name another folder by TMPDIR"
        )
    return (
        f"cannot read or write{where}: {error.strerror or error}; finished frames are kept; free space or choose "
        "another folder with -o"
    )


if __name__ == "__main__":
    sys.exit(main())
