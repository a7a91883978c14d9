"""What the process has used so far."""

from __future__ import annotations

import gc
import sys
from contextlib import suppress
from pathlib import Path


def resident_memory() -> int:
    """Resident memory of this process now, bytes; where the system does not tell, the largest up to now."""
    if sys.platform == "linux":
        return _status("VmRSS:")
    return peak_memory()


def give_back() -> None:
    """Give memory that nobody holds any more back to the system, as far as that can be asked for."""
    gc.collect()
    if sys.platform == "linux":
        import ctypes

        with suppress(AttributeError):  # only glibc has it
            ctypes.CDLL(None).malloc_trim(0)


def _status(name: str) -> int:
    """A number of kilobytes in /proc/self/status, in bytes."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next((int(line.split()[1]) * 1024 for line in lines if line.startswith(name)), 0)


def peak_memory() -> int:
    """Largest resident memory of this process up to now, bytes; 0 where the system does not tell.

    On Linux from VmHWM: `ru_maxrss` would begin with the size of the process that started this one.
    """
    if sys.platform == "linux":
        return _status("VmHWM:")
    if sys.platform == "win32":
        return _windows_peak()
    import resource

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def _windows_peak() -> int:
    """PeakWorkingSetSize of PROCESS_MEMORY_COUNTERS."""
    import ctypes
    from ctypes import wintypes

    class Counters(ctypes.Structure):
        _fields_ = [
            ("cb", wintypes.DWORD),
            ("faults", wintypes.DWORD),
            *((name, ctypes.c_size_t) for name in ("peak", *"abcdefg")),
        ]

    kernel = ctypes.WinDLL("kernel32")  # type: ignore[attr-defined]
    kernel.GetCurrentProcess.restype = wintypes.HANDLE
    kernel.K32GetProcessMemoryInfo.argtypes = [wintypes.HANDLE, ctypes.c_void_p, wintypes.DWORD]
    counters = Counters(cb=ctypes.sizeof(Counters))
    return (
        counters.peak
        if kernel.K32GetProcessMemoryInfo(kernel.GetCurrentProcess(), ctypes.byref(counters), counters.cb)
        else 0
    )
