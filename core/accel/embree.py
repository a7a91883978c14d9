"""Embree 4, bound to the library inside the `embreex` wheel: device, memory monitor, and the two ray queries that numba
kernels call without overhead.

The Python interface of embreex knows no instancing, no instance ids and one thread; its wheel carries the whole
library. Functions are taken from the library's own handle, never by global name: a Blender process has another Embree
in global scope.
"""

from __future__ import annotations

import ctypes
import importlib.util
import os
import sys
import threading
import weakref
from ctypes import c_char_p, c_int, c_size_t, c_ssize_t, c_uint, c_void_p
from pathlib import Path
from typing import Any

import llvmlite.binding as llvm
import numpy as np
from numba import cfunc, njit, types

from ..errors import InputError
from ..jit import healing as _healing  # noqa: F401
from ..jit.atomics import atomic_add_int64, pointer
from ..threads import processors

# Indices into a ray: float32[RAY] (RTCRayHit, embree4/rtcore_ray.h); integers are read through a uint32 view of the
# same memory.
RAY = 32
ORG, TNEAR, DIR, TIME, TFAR, MASK, ID, FLAGS = 0, 3, 4, 7, 8, 9, 10, 11
NG, HIT_U, HIT_V, PRIM_ID, GEOM_ID, INST_ID, INST_PRIM_ID = 12, 15, 16, 17, 18, 19, 20
INVALID = 0xFFFFFFFF

GEOMETRY_TRIANGLE, GEOMETRY_USER, GEOMETRY_INSTANCE_ARRAY = 0, 120, 122
BUFFER_INDEX, BUFFER_VERTEX, BUFFER_TRANSFORM = 0, 1, 23
FORMAT_UINT, FORMAT_UINT3, FORMAT_FLOAT3, FORMAT_FLOAT3X4_COLUMN_MAJOR = 0x5001, 0x5003, 0x9003, 0x9234
SCENE_DYNAMIC, SCENE_COMPACT, SCENE_ROBUST = 1, 2, 4
QUALITY_LOW, QUALITY_MEDIUM, QUALITY_REFIT = 0, 1, 3
DEVICE_VERSION = 0
VERSIONS = range(40400, 40500)  # whose structs these are: 4.4

_SIGNATURES: dict[str, tuple[Any, list[Any]]] = {
    "rtcNewDevice": (c_void_p, [c_char_p]),
    "rtcReleaseDevice": (None, [c_void_p]),
    "rtcGetDeviceError": (c_int, [c_void_p]),
    "rtcGetDeviceProperty": (c_ssize_t, [c_void_p, c_int]),
    "rtcSetDeviceMemoryMonitorFunction": (None, [c_void_p, c_void_p, c_void_p]),
    "rtcNewScene": (c_void_p, [c_void_p]),
    "rtcReleaseScene": (None, [c_void_p]),
    "rtcSetSceneFlags": (None, [c_void_p, c_int]),
    "rtcSetSceneBuildQuality": (None, [c_void_p, c_int]),
    "rtcCommitScene": (None, [c_void_p]),
    "rtcNewGeometry": (c_void_p, [c_void_p, c_int]),
    "rtcReleaseGeometry": (None, [c_void_p]),
    "rtcCommitGeometry": (None, [c_void_p]),
    "rtcAttachGeometry": (c_uint, [c_void_p, c_void_p]),
    "rtcSetGeometryBuildQuality": (None, [c_void_p, c_int]),
    "rtcUpdateGeometryBuffer": (None, [c_void_p, c_int, c_uint]),
    "rtcSetGeometryMask": (None, [c_void_p, c_uint]),
    "rtcSetSharedGeometryBuffer": (None, [c_void_p, c_int, c_uint, c_int, c_void_p, c_size_t, c_size_t, c_size_t]),
    "rtcSetGeometryInstancedScenes": (None, [c_void_p, c_void_p, c_size_t]),
    "rtcSetGeometryUserPrimitiveCount": (None, [c_void_p, c_uint]),
    "rtcSetGeometryUserData": (None, [c_void_p, c_void_p]),
    "rtcSetGeometryBoundsFunction": (None, [c_void_p, c_void_p, c_void_p]),
    "rtcSetGeometryIntersectFunction": (None, [c_void_p, c_void_p]),
}


def _library_path() -> Path:
    """The Embree library that the embreex wheel carries, by platform: an absolute path."""
    spec = importlib.util.find_spec("embreex")
    if spec is None or spec.origin is None:
        raise InputError(
            "the package 'embreex' is missing: install it with pip, or reinstall the extension built for this platform"
        )
    package = Path(spec.origin).resolve().parent
    folders = (package.with_name("embreex.libs"), package / ".dylibs", package)
    pattern = {"win32": "embree4*.dll", "darwin": "libembree4*.dylib"}.get(sys.platform, "libembree4*.so*")
    for folder in folders:
        for path in sorted(folder.glob(pattern)):
            return path
    raise InputError(f"embreex at {package} carries no {pattern}: reinstall the wheel built for this platform")


def _load() -> ctypes.CDLL:
    path = _library_path()
    if sys.platform == "win32":
        # by its full path: another file than an embree4.dll that is loaded already (docs/internals.md)
        library = ctypes.CDLL(str(path))
    else:
        # DEEPBIND: the library's own symbols before those of another Embree in the process.
        library = ctypes.CDLL(str(path), mode=getattr(os, "RTLD_DEEPBIND", 0) | os.RTLD_LOCAL | os.RTLD_NOW)
    for name, (result, arguments) in _SIGNATURES.items():
        function = getattr(library, name)
        function.restype, function.argtypes = result, arguments
    for name in ("rtcIntersect1", "rtcOccluded1"):
        # Under names of our own, which no other Embree can answer.
        llvm.add_symbol("lipac_" + name, ctypes.cast(getattr(library, name), c_void_p).value)
    return library


lib = _load()

_intersect1 = types.ExternalFunction("lipac_rtcIntersect1", types.void(types.voidptr, types.voidptr, types.voidptr))
_occluded1 = types.ExternalFunction("lipac_rtcOccluded1", types.void(types.voidptr, types.voidptr, types.voidptr))


@njit(nogil=True, cache=True, error_model="numpy")
def set_ray(ray, ox, oy, oz, dx, dy, dz, tnear, tfar, mask):
    """Fill ray (float32[RAY]) for a query; mask: bits of the ray types that may see an instance."""
    ray[0] = ox
    ray[1] = oy
    ray[2] = oz
    ray[3] = tnear
    ray[4] = dx
    ray[5] = dy
    ray[6] = dz
    ray[7] = 0.0
    ray[8] = tfar
    words = ray.view(np.uint32)
    words[9] = mask
    words[10] = 0
    words[11] = 0
    words[18] = INVALID
    words[19] = INVALID
    words[20] = INVALID


@njit(nogil=True, cache=True, error_model="numpy")
def intersect(scene, ray):
    """Closest hit of a ray filled by `set_ray` in scene (uint64, RTCScene). True on a hit; then TFAR, NG (object space,
    not normalised), HIT_U, HIT_V and the ids are set. Units: those of the scene; TFAR is in lengths of the
    direction."""
    _intersect1(pointer(scene), pointer(np.uint64(ray.ctypes.data)), pointer(np.uint64(0)))
    return ray.view(np.uint32)[18] != INVALID


@njit(nogil=True, cache=True, error_model="numpy")
def occluded(scene, ray):
    """True where anything lies on the ray between TNEAR and TFAR. TFAR is overwritten."""
    _occluded1(pointer(scene), pointer(np.uint64(ray.ctypes.data)), pointer(np.uint64(0)))
    return ray[8] < 0.0


@njit(nogil=True, cache=True, error_model="numpy")
def intersect_with(scene, ray, arguments):
    """`intersect` with RTCIntersectArguments at address arguments (uint64): for scenes of user geometry with a query
    context."""
    _intersect1(pointer(scene), pointer(np.uint64(ray.ctypes.data)), pointer(arguments))


@cfunc(types.boolean(types.uintp, types.intp, types.boolean), cache=True)
def _count_bytes(user, change, post):
    # Native, so that builder threads need no interpreter lock.
    atomic_add_int64(user, change)
    return True


OUT_OF_MEMORY = 4  # RTCError


class Device:
    """An Embree device whose allocations are counted.

    threads: builder threads, 0 for all.
    """

    def __init__(self, threads: int = 0) -> None:
        self.handle = lib.rtcNewDevice(f"threads={threads},set_affinity=0".encode())
        if not self.handle:
            if lib.rtcGetDeviceError(None) == OUT_OF_MEMORY:
                raise MemoryError("Embree has no memory to start")
            raise InputError("Embree found no usable processor: it needs SSE2 on x86-64, or an arm64 processor")
        weakref.finalize(self, lib.rtcReleaseDevice, self.handle).atexit = False
        version = lib.rtcGetDeviceProperty(self.handle, DEVICE_VERSION)
        if version not in VERSIONS:
            raise InputError(
                f"Embree {version // 10000}.{version // 100 % 100} was loaded, 4.4 is needed: reinstall the package "
                "'embreex', or the extension"
            )
        self._bytes = np.zeros(1, np.int64)
        self._unreported = 0
        self._commits = threading.RLock()  # one at a time, so that each knows its bytes
        lib.rtcSetDeviceMemoryMonitorFunction(self.handle, _count_bytes.address, self._bytes.ctypes.data)

    @property
    def bytes(self) -> int:
        """Bytes that Embree holds on this device now."""
        return int(self._bytes[0]) - self._unreported

    def check(self, doing: str) -> None:
        """Raise MemoryError or RuntimeError if Embree reported an error since the last call; doing completes "Embree
        failed to ..."."""
        code = lib.rtcGetDeviceError(self.handle)
        if code:
            error = MemoryError if code == OUT_OF_MEMORY else RuntimeError
            raise error(f"Embree failed to {doing} (error {code})")

    def new_scene(self, flags: int, quality: int = QUALITY_MEDIUM) -> int:
        """A new empty scene (RTCScene) with SCENE_* flags and QUALITY_*."""
        scene = lib.rtcNewScene(self.handle)
        lib.rtcSetSceneFlags(scene, flags)
        lib.rtcSetSceneBuildQuality(scene, quality)
        return scene

    def _release(self, scene: int, unreported: int) -> None:
        with self._commits:
            lib.rtcReleaseScene(scene)
            self._unreported += unreported

    def own(self, scene: int, owner: object, unreported: int = 0) -> None:
        """Release a scene when owner is garbage. unreported: bytes that Embree then frees without telling its
        monitor."""
        # the bound method keeps the device and its counter alive until then
        weakref.finalize(owner, self._release, scene, unreported).atexit = False

    def commit(self, scene: int, doing: str) -> int:
        """Build a scene's structure, or bring it up to date. Returns the bytes that this left allocated. From any
        thread; doing as for `check`."""
        with self._commits:
            before = self.bytes
            lib.rtcCommitScene(scene)
            self.check(doing)
            return self.bytes - before


_shared: dict[int, Device] = {}
_shared_lock = threading.Lock()


def shared_device(threads: int = 0) -> Device:
    """The process's device for this many builder threads, made on first use."""
    threads = threads or processors()
    with _shared_lock:
        if threads not in _shared:
            _shared[threads] = Device(threads)
        return _shared[threads]


def shared_buffer(geometry: int, kind: int, layout: int, array: np.ndarray, stride: int) -> None:
    """Give geometry an array to read from in place; the caller keeps it alive. stride: bytes from row to row. Embree
    reads 16 bytes at the last row."""
    lib.rtcSetSharedGeometryBuffer(geometry, kind, 0, layout, array.ctypes.data, 0, stride, len(array))
