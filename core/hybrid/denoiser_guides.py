"""What guides a denoiser: base colours and normals of first hits, without noise."""

from __future__ import annotations

import numpy as np
from numba import njit

from ..arrays import F32
from ..jit.pointers import address, f32_pointer
from ..scene.camera import camera_constants, camera_ray
from ..scene.model import FirstHitBuffer
from ..tracing.bsdf.lobes import F_N, FRAME, P_BASE, PARAMS
from ..tracing.materials import material_inputs, material_of
from ..tracing.surface import SURF, T_TRANSFORM, SceneTable, face, interpolate, mesh_record

GUIDES = 6  # base colour (1 where nothing is), normal towards the camera (0 where nothing is)
_INSTANCE_BYTES = np.uint64(48)
_HALF, _ONE, _ZERO = np.float32(0.5), np.float32(1.0), np.float32(0.0)


def guides(table: SceneTable, primary: FirstHitBuffer) -> F32:
    """(H, W, GUIDES) float32 of one pass of first hits; the mean of all passes is filtered as the picture is. table: of
    the scene that they lie in."""
    hits = primary.hits.view(np.int32).reshape(*primary.hits.shape, 4)
    out = np.zeros((*primary.hits.shape, GUIDES), np.float32)
    _fill(
        hits,
        hits.view(np.float32),
        camera_constants(primary.camera),
        table.table,
        np.uint64(address(primary.meshes.table)),
        out,
    )
    return out


@njit(nogil=True, cache=True, error_model="numpy")
def _fill(hits, values, camera, table, meshes, out):
    height, width = hits.shape[:2]
    work = np.empty(SURF + FRAME + PARAMS, np.float32)
    surf = f32_pointer(np.uint64(work.ctypes.data))
    frame = f32_pointer(np.uint64(work.ctypes.data + 4 * SURF))
    params = f32_pointer(np.uint64(work.ctypes.data + 4 * (SURF + FRAME)))
    for y in range(height):
        for x in range(width):
            instance = np.int64(hits[y, x, 0])
            if instance < 0:
                for k in range(3):
                    out[y, x, k] = _ONE
                continue
            triangle, b1, b2 = np.int64(hits[y, x, 1]), values[y, x, 2], values[y, x, 3]
            mesh = mesh_record(meshes, table, instance)
            interpolate(mesh, table[T_TRANSFORM] + _INSTANCE_BYTES * np.uint64(instance), triangle, b1, b2, surf, frame)
            _, _, _, dx, dy, dz, _ = camera_ray(
                camera,
                (np.float32(x) + _HALF) / np.float32(width),
                (np.float32(y) + _HALF) / np.float32(height),
                _ZERO,
                _ZERO,
            )
            face(frame, dx, dy, dz)
            material_inputs(table, mesh, material_of(table, mesh, instance, triangle), triangle, b1, b2, params)
            for k in range(3):
                out[y, x, k] = params[P_BASE + k]
                out[y, x, 3 + k] = frame[F_N + k]
    return work[0]  # keeps the work space alive until here
