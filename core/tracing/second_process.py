"""The first time, a second process compiles a part of the kernels: numba compiles one at a time in a process.

Both processes share the cache folder. Neither waits for the other: what one of them has compiled the other finds there
and loads, whenever it comes to it.
"""

from __future__ import annotations

import atexit
import json
import subprocess
import sys
import threading
from pathlib import Path

from numba import types
from numba.core import event

from ..jit import healing as _healing  # noqa: F401
from ..threads import processors

_ROOT = __name__.rpartition(".core.")[0]  # `lipac`, or what an extension is called: what is cached holds for one name
# What the second process runs. It ends with this one: then its input does. Packages around `core` are stood in for:
# they need Blender.
_WORKER = """
import importlib, json, os, sys, threading, types
given = json.loads(sys.stdin.buffer.readline())
threading.Thread(target=lambda: (os.read(0, 1), os._exit(0)), daemon=True).start()
sys.path[:] = given["path"]
parts = given["root"].split(".")
for k in range(len(parts)):
    package = sys.modules[".".join(parts[:k + 1])] = types.ModuleType(".".join(parts[:k + 1]))
    package.__path__ = [given["folder"]] if k + 1 == len(parts) else []
importlib.import_module(given["root"] + ".core.tracing.second_process").compile_part()
"""


def compile_part() -> None:
    """Compile those inner functions of the path tracing kernel, with all that they call, that take about half of the
    time until only the kernel is left.

    The kernel itself comes to them late, so they are there by then. Signatures are those that it calls them with.
    """
    # Not when this module is imported: whoever shares the work imports the kernels when it needs them.
    from .bsdf.sample import bsdf_sample
    from .bsdf.setup import bsdf_setup
    from .direct_light import add_direct_light
    from .path_state import scenery, scratch

    f32, i64, u64, flag = types.float32, types.int64, types.uint64, types.boolean
    f32s, f64s = types.CPointer(f32), types.CPointer(types.float64)
    s = scenery.compile((types.Array(u64, 1, "C"),)) and scenery.nopython_signatures[0].return_type
    w = scratch.compile((u64,)) and scratch.nopython_signatures[0].return_type
    bsdf_setup.compile((f64s, f32s, i64, f32s, i64))
    add_direct_light.compile((s, w, u64, u64, i64, *(6 * (f32,)), i64, i64, flag, flag))
    bsdf_sample.compile((f64s, f32, f32, f32, f64s))


def start_worker() -> subprocess.Popen[bytes] | None:
    """A process that runs `compile_part`, and ends when this one does; None where there is no Python to run it by."""
    if not Path(sys.executable or "").stem.lower().startswith("python"):  # Blender itself, in some builds
        return None
    command = [sys.executable, "-I", "-c", _WORKER]
    hidden = getattr(subprocess, "CREATE_NO_WINDOW", 0)  # on Windows
    try:
        worker = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, creationflags=hidden
        )
        assert worker.stdin is not None
        given = {
            "path": [entry for entry in sys.path if isinstance(entry, str)],
            "root": _ROOT,
            "folder": str(Path(__file__).parents[2]),
        }
        worker.stdin.write(json.dumps(given).encode() + b"\n")
        worker.stdin.flush()
    except OSError:
        return None
    atexit.register(worker.kill)  # before a temporary folder that it writes to is removed
    return worker


class _FirstCompilation(event.Listener):
    """Starts the worker when the first of our kernels has to be compiled."""

    def __init__(self) -> None:
        self._lock, self._started = threading.Lock(), False

    def on_start(self, event: event.Event) -> None:
        """Something is to be compiled."""
        kernel = event.data["dispatcher"].py_func.__module__
        with self._lock:
            if self._started or not kernel.startswith(f"{_ROOT}."):
                return
            self._started = True
        worker = start_worker()
        if worker is not None:
            threading.Thread(target=worker.wait, daemon=True).start()

    def on_end(self, event: event.Event) -> None:
        """It is compiled."""


_watching = threading.Event()


def share() -> None:
    """From now on, have a second process help when kernels must be compiled. Where no process can be started, or one
    core is all there is, none does."""
    if processors() > 1 and not _watching.is_set():
        _watching.set()
        event.register("numba:compile", _FirstCompilation())
