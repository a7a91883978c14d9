"""Open Image Denoise, from the library that Blender brings along."""

from __future__ import annotations

import ctypes
import sys
from ctypes import byref, c_bool, c_char_p, c_int, c_size_t, c_void_p
from functools import cache
from pathlib import Path

import bpy
import numpy as np

from ...core.arrays import F32
from ...core.errors import InputError

_CPU, _FLOAT3, _HIGH = 1, 3, 6
_NAMES = {"linux": "libOpenImageDenoise.so.2", "darwin": "libOpenImageDenoise.2.dylib", "win32": "OpenImageDenoise.dll"}
_SIGNATURES = {
    "oidnNewDevice": (c_void_p, [c_int]),
    "oidnSetDeviceInt": (None, [c_void_p, c_char_p, c_int]),
    "oidnSetDeviceBool": (None, [c_void_p, c_char_p, c_bool]),
    "oidnCommitDevice": (None, [c_void_p]),
    "oidnGetDeviceError": (c_int, [c_void_p, c_void_p]),
    "oidnReleaseDevice": (None, [c_void_p]),
    "oidnNewFilter": (c_void_p, [c_void_p, c_char_p]),
    "oidnSetSharedFilterImage": (
        None,
        [c_void_p, c_char_p, c_void_p, c_int, c_size_t, c_size_t, c_size_t, c_size_t, c_size_t],
    ),
    "oidnSetFilterBool": (None, [c_void_p, c_char_p, c_bool]),
    "oidnSetFilterInt": (None, [c_void_p, c_char_p, c_int]),
    "oidnCommitFilter": (None, [c_void_p]),
    "oidnExecuteFilter": (None, [c_void_p]),
    "oidnReleaseFilter": (None, [c_void_p]),
}


def _folders() -> list[Path]:
    """Where Blender keeps its libraries: Linux and macOS, Windows."""
    base = Path(bpy.utils.resource_path("LOCAL")).parent
    return [base / "lib", base / "blender.shared", base]


@cache
def _library() -> ctypes.CDLL:
    name = _NAMES.get(sys.platform, _NAMES["linux"])
    found = next((folder / name for folder in _folders() if (folder / name).exists()), None)
    if found is None:
        raise InputError(f"this Blender brings no Open Image Denoise ({name}): use --denoise off")
    try:
        library = ctypes.CDLL(str(found))
    except OSError as error:
        raise InputError(f"Open Image Denoise of this Blender cannot be loaded ({error}): use --denoise off") from error
    for function, (result, arguments) in _SIGNATURES.items():
        getattr(library, function).restype, getattr(library, function).argtypes = result, arguments
    return library


def require() -> None:
    """Raises InputError, one line that says what to do, where this Blender brings no library to denoise with."""
    _library()


def denoise(light: F32, albedo: F32 | None = None, normal: F32 | None = None, threads: int = 0) -> F32:
    """Light without its noise: (H, W, 3) float32, linear, any range. albedo (0 to 1), normal: of the same shape, free
    of noise. threads: 0 for all.

    Raises InputError where the library is missing (`require`), RuntimeError with its message where it fails.
    """
    library = _library()
    height, width = light.shape[:2]
    out = np.zeros((height, width, 3), np.float32)
    images = {b"color": light, b"albedo": albedo, b"normal": normal if albedo is not None else None}
    kept = {name: np.ascontiguousarray(image, np.float32) for name, image in images.items() if image is not None} | {
        b"output": out
    }
    device = library.oidnNewDevice(_CPU)
    try:
        if threads:
            library.oidnSetDeviceInt(device, b"numThreads", threads)
        library.oidnSetDeviceBool(device, b"setAffinity", False)
        library.oidnCommitDevice(device)
        run = library.oidnNewFilter(device, b"RT")
        for name, image in kept.items():
            library.oidnSetSharedFilterImage(run, name, image.ctypes.data, _FLOAT3, width, height, 0, 0, 0)
        library.oidnSetFilterBool(run, b"hdr", True)
        library.oidnSetFilterBool(run, b"cleanAux", albedo is not None)
        library.oidnSetFilterInt(run, b"quality", _HIGH)
        library.oidnCommitFilter(run)
        library.oidnExecuteFilter(run)
        message = c_char_p()
        failed = library.oidnGetDeviceError(device, byref(message))
        library.oidnReleaseFilter(run)
    finally:
        library.oidnReleaseDevice(device)
    if failed:
        raise RuntimeError(f"Open Image Denoise: {(message.value or b'').decode()}")
    return out
