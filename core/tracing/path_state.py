"""What path kernels read, and the work space of the thread that traces one: settings, limits, addresses.

Kernels get one array of addresses, so that no scene has them compiled for other argument types.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit

from ..accel.embree import RAY
from ..accel.hitboxes import QUERY
from ..jit.pointers import f32_pointer, f64_pointer, i32_pointer, i64_pointer, u64_pointer
from ..jit.sampling import INNER
from .bsdf.lobes import CLOSURE, FRAME, OUT, PARAMS
from .lights.lights import LIGHT_SAMPLE
from .surface import SURF

# settings, int64[SETTINGS]
(
    I_WIDTH, I_HEIGHT, I_FIRST_SAMPLE, I_SAMPLES, I_SEED, I_TOTAL, I_DIFFUSE, I_GLOSSY, I_TRANSMISSION, I_TRANSPARENT,
    I_REFLECTIVE, I_REFRACTIVE, I_SHADING, I_TRANSPARENT_FILM, I_TRANSPARENT_SHADOWS, I_HITBOX_EVERY, I_HITBOX_NEAREST,
    I_STRATEGY, I_LAMPS_KNOWN, I_CAMERAS, I_WEIGHED_FROM, I_UNBUILT, I_FAST_GI, I_WORLD,
    I_CATCHERS
) = range(25)
# I_WEIGHED_FROM: `Weights.first`; I_UNBUILT: the number that stands for boxes in records and weights, -1 for none
SETTINGS = 25
BOTH, LIGHT_ONLY, BSDF_ONLY = 0, 1, 2  # I_STRATEGY: for tests, all agree in the mean

# limits, float32[LIMITS]: clamps (sum over channels, FAR where off), inverse of filter glossy (0: off), exposure, world
# colour
# (3), for weights (feedback.Weights) mean luminance of the picture and fixed-point units to one of luminance, Fast GI's
# reach and factor, the film's glass, and `PathLog.backdrop`
V_CLAMP_DIRECT, V_CLAMP_INDIRECT, V_FILTER_GLOSSY, V_EXPOSURE, V_WORLD, V_AMBIENT, V_UNITS = 0, 1, 2, 3, 4, 7, 8
V_FAST_REACH, V_FAST_FACTOR, V_GLASS, V_BACKDROP = 9, 10, 11, 12
LIMITS = 13

# Parts of the light of paths that start at raster hits, float32[PARTS] per pixel. Emission and background seen at the
# first hit; light of lamps from their own sampling or from the path's next ray at the first hit, free of what is built:
# without (CLEAR) and with (MAYBE) boxes of culled instances on the way. Then the luminance of light sampling alone at
# the first hit: clear, maybe, and denied by what is built (BLOCKED).
STRAIGHT, CLEAR, MAYBE, SAMPLED_CLEAR, SAMPLED_MAYBE, SAMPLED_BLOCKED = 0, 3, 6, 9, 10, 11
PARTS = 12
NO_PART = -1
PARTS_AT = 4  # in Scratch.total

# stats, int64[STATS]: rays and paths in all; places where paths looked for coincident surfaces, and found some
RAYS, PATHS, LOOKS, COINCIDENT = range(4)
STATS = 4
# of a thread's own stats: coarse tile of the pixel, how many instances the path has met, address of its record
W_TILE, W_VERTICES, W_RECORD = 4, 5, 6
MAX_VERTICES = 64  # met by one path and weighed; what is met after them gets nothing, and only certificates see it


class Scenery(NamedTuple):
    """All that a path reads, as pointers or addresses; arrays as their owners describe them (SceneTable, Lights, Tlas,
    BlasCache, Hitboxes)."""

    table: Any
    lights: Any
    lamps: Any
    nodes: Any
    children: Any
    meshes: Any
    tlas: Any
    full: Any
    others: Any
    ids: Any
    first: Any
    hitboxes: Any
    counters: Any
    counters_length: Any
    feedback: Any
    weights: Any
    tile_light: Any
    entries: Any
    log: Any
    primary_meshes: Any
    boxes: Any
    box_counters: Any
    box_count: Any
    settings: Any
    limits: Any


class Scratch(NamedTuple):
    """Work space of one thread. `far_*`: for the point on a light or on the way to it."""

    ray: Any
    shadow: Any
    ray_words: Any
    shadow_words: Any
    query: Any
    surf: Any
    frame: Any
    params: Any
    closure: Any
    out: Any
    light: Any
    chosen: Any
    far_surf: Any
    far_frame: Any
    far_params: Any
    far_closure: Any
    radiance: Any
    total: Any
    stats: Any
    vertex: Any
    carried: Any


# Where the kernel finds things, uint64[ADDRESSES]: A_* addresses, N_* lengths, handles as they are.
(
    A_TABLE, A_LIGHTS, A_LAMPS, A_NODES, A_CHILDREN, A_MESHES, TLAS, FULL, OTHERS, A_IDS, A_FIRST, HITBOXES, A_COUNTERS,
    N_COUNTERS, A_FEEDBACK, A_WEIGHTS, A_TILE_LIGHT, A_ENTRIES, A_LOG, A_COLOR, A_ONLY, A_PRIMARY, A_PRIMARY_MESHES,
    A_PARTS, BOXES, A_BOX_COUNTERS, N_BOXES, A_SETTINGS, A_LIMITS, A_CAMERA, A_FILTER, A_SUMS, A_STATS
) = range(33)
ADDRESSES = 33


@njit(**INNER)
def scenery(a):
    return Scenery(
        u64_pointer(a[A_TABLE]),
        u64_pointer(a[A_LIGHTS]),
        a[A_LAMPS],
        a[A_NODES],
        i32_pointer(a[A_CHILDREN]),
        a[A_MESHES],
        a[TLAS],
        a[FULL],
        a[OTHERS],
        i32_pointer(a[A_IDS]),
        i64_pointer(a[A_FIRST]),
        a[HITBOXES],
        a[A_COUNTERS],
        a[N_COUNTERS],
        a[A_FEEDBACK],
        a[A_WEIGHTS],
        a[A_TILE_LIGHT],
        i32_pointer(a[A_ENTRIES]),
        a[A_LOG],
        a[A_PRIMARY_MESHES],
        a[BOXES],
        a[A_BOX_COUNTERS],
        a[N_BOXES],
        i64_pointer(a[A_SETTINGS]),
        f32_pointer(a[A_LIMITS]),
    )


# Parts of the work space, in bytes, each a multiple of 16 (Embree wants rays so).
_RAY_AT = 0
_SHADOW_AT = _RAY_AT + 4 * RAY
_QUERY_AT = _SHADOW_AT + 4 * RAY
_CLOSURE_AT = _QUERY_AT + 8 * (QUERY + QUERY % 2)
_FAR_CLOSURE_AT = _CLOSURE_AT + 8 * (CLOSURE + CLOSURE % 2)
_REST_AT = _FAR_CLOSURE_AT + 8 * (CLOSURE + CLOSURE % 2)
_PART = (max(8 * OUT, 4 * SURF, 4 * FRAME, 4 * PARAMS, 4 * LIGHT_SAMPLE) + 63) // 64 * 64  # of each of the small parts
_VERTICES_AT = _REST_AT + 12 * _PART
WORK = _VERTICES_AT + (8 + 8) * MAX_VERTICES


@njit(**INNER)
def scratch(start):
    """Work space at an address of WORK bytes, 16-byte aligned."""
    rest = start + np.uint64(_REST_AT)
    part = np.uint64(_PART)
    return Scratch(
        f32_pointer(start + np.uint64(_RAY_AT)),
        f32_pointer(start + np.uint64(_SHADOW_AT)),
        start + np.uint64(_RAY_AT),
        start + np.uint64(_SHADOW_AT),
        start + np.uint64(_QUERY_AT),
        f32_pointer(rest),
        f32_pointer(rest + part),
        f32_pointer(rest + np.uint64(2) * part),
        f64_pointer(start + np.uint64(_CLOSURE_AT)),
        f64_pointer(rest + np.uint64(3) * part),
        f32_pointer(rest + np.uint64(4) * part),
        i64_pointer(rest + np.uint64(5) * part),
        f32_pointer(rest + np.uint64(6) * part),
        f32_pointer(rest + np.uint64(7) * part),
        f32_pointer(rest + np.uint64(8) * part),
        f64_pointer(start + np.uint64(_FAR_CLOSURE_AT)),
        f32_pointer(rest + np.uint64(9) * part),
        f32_pointer(rest + np.uint64(10) * part),
        i64_pointer(rest + np.uint64(11) * part),
        i64_pointer(start + np.uint64(_VERTICES_AT)),
        f32_pointer(start + np.uint64(_VERTICES_AT + 8 * MAX_VERTICES)),
    )
