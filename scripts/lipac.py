"""The `lipac` command: `lipac COMMAND ...`.

Exit status: 0 success, 1 an error of ours, 2 unusable input, 3 done, but a verification found the error budget broken, 130 stopped by Ctrl-C.
"""

from __future__ import annotations

import importlib
import os
import sys
import time
from collections.abc import Sequence

from ..version import __version__
from . import streams
from .streams import say

# Command: module of this folder, with a main(argv), and what it does
COMMANDS = {
    "demo": ("demo", "write a procedural demo scene to a .blend file"),
    "analyze": ("analyze", "decide which instances light paths need; no picture"),
    "render": ("render", "cull and render by Cycles, EEVEE or the path tracer"),
    "evaluate": ("evaluate", "measure speed against error for every culling policy"),
    "bench": ("bench", "measure speed against peers"),
}


_began = time.monotonic()


def began() -> float:
    """`time.monotonic()` when this command began."""
    return _began


def usage() -> str:
    """What `lipac --help` prints."""
    width = max(map(len, COMMANDS))
    lines = [f"  {name.ljust(width)}  {help_}" for name, (_, help_) in COMMANDS.items()]
    return "\n".join(["usage: lipac COMMAND [options]", "", *lines, "", "lipac COMMAND --help tells the options."])


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command line, the program's own by default; returns the exit status."""
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
    return guarded(name, rest)


def guarded(name: str, arguments: Sequence[str]) -> int:
    """Run a command; errors become one line on stderr and an exit status. LIPAC_DEBUG=1 shows where they come from."""
    global _began  # noqa: PLW0603
    _began = time.monotonic()
    from ..core.errors import Cancelled, InputError

    try:
        status = importlib.import_module(f".{COMMANDS[name][0]}", __package__).main(arguments)
        return int(status or 0)
    except InputError as error:
        line, status = str(error), 2
    except (KeyboardInterrupt, Cancelled):
        line, status = "stopped; finished frames and their report are kept", 130
    except MemoryError:
        line, status = "out of memory; lower --resolution or the number of instances, or close other programs", 1
    except OSError as error:
        line, status = _lost(error), 1
    except Exception as error:
        if os.environ.get("LIPAC_DEBUG", "") not in ("", "0"):
            raise
        if "can't start new thread" in str(error):
            say(f"lipac {name}: the system allows no more threads; allow this user more processes, or give --threads 1", sys.stderr)
            return 1
        first = str(error).strip().splitlines()[:1]
        line, status = f"internal error: {type(error).__name__}: {''.join(first)} (LIPAC_DEBUG=1 shows more)", 1
    say(f"lipac {name}: {line}", sys.stderr)
    return status


def _lost(error: OSError) -> str:
    """What to do about files that cannot be read or written."""
    import tempfile

    name = str(error.filename or "")
    where = f" {name}" if name else " its files"
    folder = tempfile.tempdir
    if folder and name.startswith(os.path.join(folder, "lipac")):
        return f"cannot read or write{where}: {error.strerror or error}; finished frames are kept; free space in {folder}, or name another folder by TMPDIR"
    return f"cannot read or write{where}: {error.strerror or error}; finished frames are kept; free space or choose another folder with -o"


if __name__ == "__main__":
    sys.exit(main())
