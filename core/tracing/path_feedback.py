"""What a path leaves behind: light in its pixel, and counts, worth and record of the instances that it met."""

from __future__ import annotations

import numpy as np
from numba import njit

from ..feedback.hits import MOST, TILES
from ..feedback.path_log import RECORD
from ..jit.atomics import atomic_add_int64
from ..jit.pointers import i32_pointer
from ..jit.sampling import INNER
from ..scene.film import LUMINANCE
from ..scene.model import RAY_TYPES
from .lights.lamps import FAR
from .path_state import (
    I_UNBUILT,
    I_WEIGHED_FROM,
    MAX_VERTICES,
    NO_PART,
    PARTS_AT,
    V_AMBIENT,
    V_CLAMP_DIRECT,
    V_CLAMP_INDIRECT,
    V_UNITS,
    W_RECORD,
    W_TILE,
    W_VERTICES,
)

_RED, _GREEN, _BLUE = (np.float32(x) for x in LUMINANCE)
_ONE = np.float32(1.0)


@njit(**INNER)
def count_hit(s, instance, ray_type):
    """Count a hit of an instance by a type of ray."""
    atomic_add_int64(s.feedback + np.uint64(8) * np.uint64(instance * RAY_TYPES + ray_type), np.int64(1))


@njit(**INNER)
def luminance_of(r, g, b):
    """Luminance of a linear Rec. 709 colour."""
    return _RED * r + _GREEN * g + _BLUE * b


@njit(**INNER)
def add_worth(s, w, entry, luminance):
    """Credit a TLAS entry with luminance of the current tile."""
    units = luminance * s.limits[V_UNITS]
    row = entry - s.settings[I_WEIGHED_FROM]
    if units >= _ONE and row >= 0:
        atomic_add_int64(
            s.weights + np.uint64(8) * np.uint64(row * TILES + w.stats[W_TILE]), np.int64(min(units, MOST))
        )


@njit(**INNER)
def log_entry(s, w, entry):
    """Write a TLAS entry that the path met into the path's record (path_log.PathLog)."""
    if s.log == np.uint64(0):
        return
    record = i32_pointer(np.uint64(w.stats[W_RECORD]))
    n = record[0]
    if n == RECORD:
        return
    for k in range(1, n + 1):
        if record[k] == entry:
            return
    if n + 1 < RECORD:
        record[n + 1] = entry
    record[0] = n + 1


@njit(**INNER)
def record_vertex(s, w, entry, tr, tg, tb):
    """Note a TLAS entry that the path meets for the first time: what it has gathered so far, and what it carries."""
    n = w.stats[W_VERTICES]
    for k in range(n):
        if w.vertex[k] == entry:
            return
    log_entry(s, w, entry)
    if n < MAX_VERTICES:
        w.vertex[n] = entry
        w.carried[2 * n] = luminance_of(w.total[0], w.total[1], w.total[2])
        w.carried[2 * n + 1] = luminance_of(tr, tg, tb) * s.limits[V_AMBIENT]
        w.stats[W_VERTICES] = n + 1


@njit(**INNER)
def credit_unbuilt(s, w, luminance):
    """Light of the path that something which is not built might block, or sends: credited to what is not built."""
    unbuilt = s.settings[I_UNBUILT]
    if unbuilt >= 0:
        log_entry(s, w, unbuilt)
        add_worth(s, w, unbuilt, luminance)


@njit(**INNER)
def flush_path_contributions(s, w):
    """At the end of a path: credit what it met with what it gathered behind it, or with what it carried there where
    that is more."""
    total = luminance_of(w.total[0], w.total[1], w.total[2])
    for k in range(w.stats[W_VERTICES]):
        add_worth(s, w, w.vertex[k], max(total - w.carried[2 * k], w.carried[2 * k + 1]))
    units = total * s.limits[V_UNITS]
    if units >= _ONE:
        atomic_add_int64(s.tile_light + np.uint64(8) * np.uint64(w.stats[W_TILE]), np.int64(min(units, MOST)))


@njit(**INNER)
def add_light(s, w, r, g, b, bounce, part):
    """Add a contribution to the path's total, and to a part of it, clamped as Cycles does; bounce: how many bounces lie
    before the light's last one."""
    total = abs(r) + abs(g) + abs(b)
    limit = s.limits[V_CLAMP_INDIRECT] if bounce > 0 else s.limits[V_CLAMP_DIRECT]
    if not total < FAR:  # also NaN
        return
    f = limit / total if total > limit else _ONE
    w.total[0] += r * f
    w.total[1] += g * f
    w.total[2] += b * f
    if part != NO_PART:
        w.total[PARTS_AT + part] += r * f
        w.total[PARTS_AT + part + 1] += g * f
        w.total[PARTS_AT + part + 2] += b * f
