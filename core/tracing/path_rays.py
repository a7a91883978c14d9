"""Rays of path kernels: their queries to Embree, and the hitboxes that they cross."""

from __future__ import annotations

import numpy as np
from numba import carray, njit

from ..accel.embree import DIR, FLAGS, GEOM_ID, ID, INST_ID, INST_PRIM_ID, INVALID, MASK, ORG, RAY, TFAR, TIME, TNEAR
from ..accel.embree import _intersect1 as rtc_intersect
from ..accel.hitboxes import QUERY, count_crossings
from ..jit.atomics import pointer
from ..jit.pointers import load_u32, u32_pointer
from ..jit.sampling import INNER
from ..scene.model import RAY_TYPES

_ZERO = np.float32(0.0)


# Exactly flat ground at 0 has no error to move by: a hit at distance 0 must not count.
_NEAR = np.float32(1e-30)


@njit(**INNER)
def set_ray(ray, words, ox, oy, oz, dx, dy, dz, far, ray_type):
    """Fill a ray for a query: ray as float32, words its address."""
    ray[ORG] = ox
    ray[ORG + 1] = oy
    ray[ORG + 2] = oz
    ray[TNEAR] = _NEAR
    ray[DIR] = dx
    ray[DIR + 1] = dy
    ray[DIR + 2] = dz
    ray[TIME] = _ZERO
    ray[TFAR] = far
    w = u32_pointer(words)
    w[MASK] = np.uint32(1 << ray_type)
    w[ID] = np.uint32(0)
    w[FLAGS] = np.uint32(0)
    w[GEOM_ID] = w[INST_ID] = w[INST_PRIM_ID] = np.uint32(INVALID)


@njit(**INNER)
def intersect(tlas, words):
    """Closest hit of the ray at address words."""
    rtc_intersect(pointer(tlas), pointer(words), pointer(np.uint64(0)))
    return load_u32(words, GEOM_ID) != np.uint32(INVALID)


@njit(**INNER)
def entry_of(s, words):
    """TLAS entry that the ray at address words met."""
    return s.first[np.int64(load_u32(words, INST_ID))] + np.int64(load_u32(words, INST_PRIM_ID))


@njit(**INNER)
def count_boxes(hitboxes, counters, length, query, words, far, ray_type, nearest):
    """`count_crossings` of what lies at addresses."""
    return count_crossings(
        hitboxes,
        carray(pointer(counters), (np.int64(length), RAY_TYPES), np.int64),
        carray(pointer(query), (QUERY,), np.int64),
        carray(pointer(words), (RAY,), np.float32),
        far,
        ray_type,
        nearest,
    )
