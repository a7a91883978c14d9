"""The kernel that traces tiles of pixels: every sample of each starts a path of `path_kernel`."""

from __future__ import annotations

import numpy as np
from numba import njit

from ..feedback.hits import COLUMNS, ROWS
from ..feedback.path_log import RECORD
from ..jit.atomics import atomic_add_int64
from ..jit.pointers import f32_pointer, load_u8
from ..jit.sampling import INNER, OPTIONS, path_key, uniform2
from ..scene.camera import CAMERA, camera_ray
from ..scene.film import filter_offset
from .path_feedback import flush_path_contributions
from .path_kernel import trace_path
from .path_state import (
    A_CAMERA,
    A_COLOR,
    A_FILTER,
    A_ONLY,
    A_PARTS,
    A_PRIMARY,
    A_STATS,
    A_SUMS,
    CLEAR,
    COINCIDENT,
    I_CAMERAS,
    I_FIRST_SAMPLE,
    I_HEIGHT,
    I_LAMPS_KNOWN,
    I_SAMPLES,
    I_SEED,
    I_WIDTH,
    LOOKS,
    MAYBE,
    PARTS,
    PARTS_AT,
    PATHS,
    RAYS,
    V_BACKDROP,
    V_EXPOSURE,
    W_RECORD,
    W_TILE,
    W_VERTICES,
    WORK,
    scenery,
    scratch,
)

_ZERO = np.float32(0.0)
_LENS, _FILTER, _TIME = np.uint64(1 << 40), np.uint64((1 << 40) + 1), np.uint64((1 << 40) + 2)


@njit(**INNER)
def _trace_tile(s, w, a, x0, y0, x1, y1):
    """Trace all samples of the pixels [x0, x1) x [y0, y1), or those paths that A_ONLY marks. Returns how many."""
    width, height = s.settings[I_WIDTH], s.settings[I_HEIGHT]
    camera, cameras = f32_pointer(a[A_CAMERA]), s.settings[I_CAMERAS]
    pixel_filter = f32_pointer(a[A_FILTER])
    sums = f32_pointer(a[A_SUMS])
    parts = f32_pointer(a[A_PARTS])
    seed = np.uint64(s.settings[I_SEED])
    exposure = s.limits[V_EXPOSURE]
    samples = s.settings[I_SAMPLES]
    color = f32_pointer(a[A_COLOR])
    paths = 0
    for y in range(y0, y1):
        for x in range(x0, x1):
            w.stats[W_TILE] = (y * ROWS // height) * COLUMNS + x * COLUMNS // width
            r = g = b = t = _ZERO
            for k in range(samples):
                path = (y * width + x) * samples + k
                if a[A_ONLY] != np.uint64(0) and load_u8(a[A_ONLY], path) == 0:
                    continue
                paths += 1
                key = path_key(seed, np.uint64(y * width + x), np.uint64(s.settings[I_FIRST_SAMPLE] + k))
                f0, f1 = uniform2(key, _FILTER)
                l0, l1 = uniform2(key, _LENS)
                if cameras > 1:
                    time, _ = uniform2(key, _TIME)
                    camera = f32_pointer(
                        a[A_CAMERA]
                        + np.uint64(4 * CAMERA) * np.uint64(min(np.int64(time * np.float32(cameras)), cameras - 1))
                    )
                record = np.uint64(0)
                if a[A_PRIMARY] != np.uint64(0):  # its jitter is in the camera
                    record = a[A_PRIMARY] + np.uint64(16) * np.uint64(y * width + x)
                    f0 = f1 = np.float32(0.5)
                u = (np.float32(x) + np.float32(0.5) + filter_offset(pixel_filter, f0)) / np.float32(width)
                v = (np.float32(y) + np.float32(0.5) + filter_offset(pixel_filter, f1)) / np.float32(height)
                ox, oy, oz, dx, dy, dz, far = camera_ray(camera, u, v, l0, l1)
                w.stats[W_VERTICES] = 0
                w.stats[W_RECORD] = np.int64(s.log + np.uint64(4 * RECORD) * np.uint64(path))
                trace_path(s, w, key, record, ox, oy, oz, dx, dy, dz, far)
                if record != np.uint64(0):
                    for c in range(PARTS):
                        parts[PARTS * (y * width + x) + c] += exposure * w.total[PARTS_AT + c]
                if s.weights != np.uint64(0):
                    flush_path_contributions(s, w)
                if a[A_COLOR] != np.uint64(0):
                    known = record != np.uint64(0) and s.settings[I_LAMPS_KNOWN] != 0
                    for c in range(3):
                        color[3 * path + c] = w.total[c] - s.limits[V_BACKDROP] * w.total[3]
                        if known:
                            color[3 * path + c] -= w.total[PARTS_AT + CLEAR + c] + w.total[PARTS_AT + MAYBE + c]
                r += w.total[0]
                g += w.total[1]
                b += w.total[2]
                t += w.total[3]
            i = 4 * (y * width + x)
            sums[i] += r * exposure
            sums[i + 1] += g * exposure
            sums[i + 2] += b * exposure
            sums[i + 3] += np.float32(samples) - t
    return paths


@njit(**OPTIONS)
def trace_tiles(tiles, taken, a):
    """Trace tiles, (n, 4) int64 of x, y and where it ends, one after the other: each the next one that no thread has
    taken. taken: int64[1], how many are; who sets it to n stops all. a: addresses, A_*.

    Adds to the sums, (H, W, 4) float32, and atomically to stats, int64[STATS]; writes the light of each path to A_COLOR
    where that is given.
    """
    s = scenery(a)
    work = np.empty(WORK + 16, np.uint8)
    w = scratch((np.uint64(work.ctypes.data) + np.uint64(15)) & ~np.uint64(15))
    w.stats[RAYS] = w.stats[LOOKS] = w.stats[COINCIDENT] = 0
    paths = 0
    counter = np.uint64(taken.ctypes.data)
    k = atomic_add_int64(counter, 1)
    while k < len(tiles):
        paths += _trace_tile(s, w, a, tiles[k, 0], tiles[k, 1], tiles[k, 2], tiles[k, 3])
        k = atomic_add_int64(counter, 1)
    for count in (RAYS, LOOKS, COINCIDENT):
        atomic_add_int64(a[A_STATS] + np.uint64(8 * count), w.stats[count])
    atomic_add_int64(a[A_STATS] + np.uint64(8 * PATHS), paths)
    return work[0]  # keeps the work space alive until here
