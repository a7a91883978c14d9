"""Boxes that stand in for what is culled: rays pass through them and are counted."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import carray, cfunc, njit, types

from ..arrays import F32, I64
from ..jit.atomics import atomic_add_int64, pointer
from ..scene.model import RAY_TYPES
from . import embree
from .embree import RAY, intersect_with

ALL_CROSSINGS = 0
MAX_NEAREST = 16

# Words of a query: int64[QUERY], scratch of one thread. First what Embree takes for an RTCRayQueryContext, extended by
# what the callback needs.
_COUNTERS, _COLUMN, _NEAREST, _FOUND, _IDS, _ENTRIES = 1, 2, 3, 4, 5, 5 + MAX_NEAREST
# RTCIntersectArguments: flags and feature mask, context, filter, intersect, width factor
_ARGUMENTS = 5 + 2 * MAX_NEAREST
_RAY = _ARGUMENTS + 5
_RAY += _RAY % 2  # rays are 16-byte aligned
QUERY = _RAY + RAY // 2


@njit(nogil=True, cache=True, error_model="numpy")
def box_entry(low0, low1, low2, high0, high1, high2, org0, org1, org2, dir0, dir1, dir2, far):
    """Where a ray enters a box, in lengths of its direction: 0 from inside, -1 where it misses or enters beyond far.

    Slabs in float64 over float32 input (Kay and Kajiya 1986): a zero component of the direction is decided by the
    origin alone, so no 0 x inf arises.
    """
    near = 0.0
    for axis in range(3):
        low, high, org, direction = low0, high0, org0, dir0
        if axis == 1:
            low, high, org, direction = low1, high1, org1, dir1
        elif axis == 2:
            low, high, org, direction = low2, high2, org2, dir2
        low, high, org, direction = float(low), float(high), float(org), float(direction)
        if direction == 0.0:
            if org < low or org > high:
                return -1.0
        else:
            a = (low - org) / direction
            b = (high - org) / direction
            near = max(near, min(a, b))
            far = min(far, max(a, b))
    return near if near <= far else -1.0


@cfunc(types.void(types.CPointer(types.uintp)), cache=True)
def _bounds(arguments):
    # RTCBoundsFunctionArguments: user pointer, primitive and time step, RTCBounds*. Grown a little: the callback alone
    # decides, no box may be pruned before.
    prim = np.int64(arguments[1] & np.uintp(0xFFFFFFFF))
    box = carray(pointer(arguments[0]), (6 * (prim + 1),), np.float32)
    out = carray(pointer(arguments[2]), (8,), np.float32)
    for axis in range(3):
        low, high = box[6 * prim + axis], box[6 * prim + 3 + axis]
        grow = np.float32(4e-7) * max(abs(low), abs(high)) + np.float32(1e-30)
        out[axis] = low - grow
        out[4 + axis] = high + grow


@cfunc(types.void(types.CPointer(types.uintp)), cache=True)
def _cross(arguments):
    # RTCIntersectFunctionNArguments: valid, user pointer, primitive, context, ray, N and geometry. Never reports a hit.
    prim = np.int64(arguments[2] & np.uintp(0xFFFFFFFF))
    box = carray(pointer(arguments[1]), (6 * (prim + 1),), np.float32)
    ray = carray(pointer(arguments[4]), (12,), np.float32)
    context = carray(pointer(arguments[3]), (_ARGUMENTS,), np.int64)
    i = 6 * prim
    entry = box_entry(
        box[i], box[i + 1], box[i + 2], box[i + 3], box[i + 4], box[i + 5], ray[0], ray[1], ray[2], ray[4], ray[5],
        ray[6], float(ray[8])
    )
    if entry < 0.0:
        return
    nearest = context[_NEAREST]
    if nearest == ALL_CROSSINGS:
        atomic_add_int64(np.uint64(context[_COUNTERS]) + np.uint64(8 * (prim * RAY_TYPES + context[_COLUMN])), 1)
        return
    # Insertion into the nearest few, ordered by (entry, box): the same few whatever order Embree visits them in.
    entries = carray(pointer(arguments[3]), (_ARGUMENTS,), np.float64)
    found = context[_FOUND]
    slot = found
    while slot > 0:
        before = entries[_ENTRIES + slot - 1]
        if before < entry or (before == entry and context[_IDS + slot - 1] < prim):
            break
        slot -= 1
    if slot >= nearest:
        return
    last = min(found, nearest - 1)
    while last > slot:
        entries[_ENTRIES + last] = entries[_ENTRIES + last - 1]
        context[_IDS + last] = context[_IDS + last - 1]
        last -= 1
    entries[_ENTRIES + slot] = entry
    context[_IDS + slot] = prim
    if found < nearest:
        context[_FOUND] = found + 1
    if found + 1 >= nearest:
        # Nothing beyond the last of the few can matter: shorten the ray, rounded up so that ties stay in reach.
        limit = np.float32(entries[_ENTRIES + nearest - 1] * (1.0 + 2e-7) + 1e-37)
        if limit < ray[8]:
            ray[8] = limit


@njit(nogil=True, cache=True, error_model="numpy")
def count_crossings(hitboxes, counters, query, ray, far, ray_type, nearest):
    """Count the boxes that a segment crosses. Returns how many were counted, or 0 where every one is.

    hitboxes: uint64 handle (`Hitboxes.handle`), 0 for none; counters: int64 (H, RAY_TYPES), added to atomically; query:
    int64[QUERY] scratch of this thread, 16-byte aligned, as NumPy and numba allocate; ray: float32[RAY], origin and
    direction are read, nothing is changed; far: end of the segment, in lengths of the direction; ray_type: column;
    nearest: only that many boxes, in order of entry (at most MAX_NEAREST), ALL_CROSSINGS for every one.
    """
    if hitboxes == 0:
        return np.int64(0)
    probe = query.view(np.float32)[2 * _RAY :]
    for i in range(RAY):
        probe[i] = ray[i]
    probe[3] = 0.0
    probe[8] = far
    words = probe.view(np.uint32)
    words[9] = 0xFFFFFFFF
    words[18] = embree.INVALID
    query[0] = -1
    query[_COUNTERS] = counters.ctypes.data
    query[_COLUMN] = ray_type
    query[_NEAREST] = nearest
    query[_FOUND] = 0
    query[_ARGUMENTS] = -4294967296  # no flags; every feature
    query[_ARGUMENTS + 1] = query.ctypes.data
    query[_ARGUMENTS + 2] = 0
    query[_ARGUMENTS + 3] = 0
    query[_ARGUMENTS + 4] = 0
    intersect_with(hitboxes, probe, np.uint64(query.ctypes.data + 8 * _ARGUMENTS))
    for i in range(query[_FOUND]):
        atomic_add_int64(np.uint64(query[_COUNTERS]) + np.uint64(8 * (query[_IDS + i] * RAY_TYPES + ray_type)), 1)
    return query[_FOUND]


class Hitboxes:
    """Boxes of culled instances or regions in an Embree scene of their own.

    bounds: (H, 2, 3) float32; counters: (H, RAY_TYPES) int64, crossings counted so far; handle: uint64, 0 where there
    is no box; bytes: Embree's memory plus the bounds.
    """

    def __init__(self, bounds: F32, device: embree.Device | None = None, crossing: Any = _cross.address) -> None:
        """crossing: address of Embree's intersect callback; the default counts for `count_crossings`."""
        device, lib = device or embree.shared_device(), embree.lib
        self._device = device
        self.bounds: F32 = np.ascontiguousarray(bounds, np.float32)
        self.counters: I64 = np.zeros((len(bounds), RAY_TYPES), np.int64)
        self.handle = np.uint64(0)
        self.bytes = 0
        if not len(bounds):
            return
        geometry = lib.rtcNewGeometry(device.handle, embree.GEOMETRY_USER)
        lib.rtcSetGeometryUserPrimitiveCount(geometry, len(bounds))
        lib.rtcSetGeometryUserData(geometry, self.bounds.ctypes.data)
        lib.rtcSetGeometryBoundsFunction(geometry, _bounds.address, None)
        lib.rtcSetGeometryIntersectFunction(geometry, crossing)
        lib.rtcSetGeometryMask(geometry, 0xFFFFFFFF)
        lib.rtcCommitGeometry(geometry)
        scene = device.new_scene(embree.SCENE_ROBUST)
        lib.rtcAttachGeometry(scene, geometry)
        lib.rtcReleaseGeometry(geometry)
        device.own(scene, self)
        self.bytes = device.commit(scene, f"build {len(bounds):,} hitboxes") + self.bounds.nbytes
        self.handle = np.uint64(scene)

    def __len__(self) -> int:
        return len(self.bounds)
