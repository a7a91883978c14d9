"""First hits that something else than the path tracer has found: a raster of the whole scene, culled instances
included, or rays over everything.

A pass over the picture is a pinhole camera with one hit per pixel centre. Anti-aliasing and depth of field come from
many passes, each with a camera jittered by the pixel filter and over the lens (Haeberli, Akeley, "The Accumulation
Buffer", SIGGRAPH 1990): every path starts at one exact hit, never at a mean of several.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ..accel.embree import HIT_U, HIT_V, PRIM_ID, RAY, intersect, set_ray
from ..accel.tlas import Tlas, hit_instance
from ..arrays import F64
from ..scene.camera import aperture_point, camera_constants, camera_ray, projection
from ..scene.film import filter_offset, filter_offsets
from ..scene.mesh import MeshTable
from ..scene.model import HIT, Camera, Film, FirstHitBuffer, RayType, Scene

BLOCK = 1 << 17  # pixels or instances at a time: temporaries stay small

_CAMERA_MASK = np.uint32(1 << RayType.CAMERA)


def pass_camera(camera: Camera, film: Film, size: tuple[int, int], index: int, count: int) -> Camera:
    """The camera of pass `index` of `count`: moved by a point of the lens, its picture (of size, width and height) by
    an offset of the pixel filter.

    The points are a rank-1 sequence over filter and lens (Roberts's generalised golden ratio): a few passes cover both
    evenly. A single pass is the camera itself. Orthographic cameras are taken without depth of field.
    """
    if count == 1:
        return dataclasses.replace(camera, aperture=0.0)
    u = _sequence(index, 4)
    table = filter_offsets(film)
    constants = camera_constants(camera)
    lens = np.array(aperture_point(constants, np.float32(u[2]), np.float32(u[3])), np.float64) * camera.aperture
    frame = camera.frame.copy()
    for axis in range(2):
        step = (frame[2 * axis + 1] - frame[2 * axis]) / size[axis]
        frame[2 * axis : 2 * axis + 2] += float(filter_offset(table, np.float32(u[axis]))) * step
        if not camera.orthographic:
            # what lies at the distance of focus stays where it is
            frame[2 * axis : 2 * axis + 2] -= lens[axis] / camera.focus
    to_world = camera.to_world.copy()
    if not camera.orthographic:
        to_world[:, 3] += to_world[:, :2] / np.linalg.norm(to_world[:, :2], axis=0) @ lens
    return dataclasses.replace(camera, to_world=to_world, frame=frame, aperture=0.0)


def _sequence(index: int, dimensions: int) -> F64:
    """Point `index` of a sequence that fills [0, 1)^dimensions evenly; the first is its middle."""
    phi = 2.0
    for _ in range(64):
        phi = (1 + phi) ** (1 / (dimensions + 1))
    return np.asarray((0.5 + index * phi ** -np.arange(1.0, dimensions + 1)) % 1.0)


def in_view(scene: Scene, margin: float = 0.05) -> NDArray[np.bool_]:
    """Instances that camera rays may see: (N,) bool. Visible to them, and the box is not wholly beyond one side of the
    view, widened by margin (a share of half the picture) and by the lens: so no pass of `pass_camera` sees another."""
    instances, camera = scene.instances, scene.camera
    # a pass that sees through the edge of the lens has its picture shifted
    if camera.aperture and not camera.orthographic:
        shift = camera.aperture / camera.focus
        camera = dataclasses.replace(camera, frame=camera.frame + np.array([-shift, shift, -shift, shift]))
    matrix, _ = projection(camera)
    planes = np.concatenate(
        [(1 + margin) * matrix[3] + sign * matrix[axis] for axis, sign in ((0, 1), (0, -1), (1, 1), (1, -1))]
        + [matrix[3] + matrix[2]]
    )
    planes = planes.reshape(-1, 4)
    seen = (instances.flags & _CAMERA_MASK) != 0
    for a in range(0, len(instances), BLOCK):
        bounds = instances.bounds[a : a + BLOCK].astype(np.float64)
        low, high = bounds[:, 0] - camera.aperture, bounds[:, 1] + camera.aperture
        for plane in planes:  # the corner that is furthest on its inner side
            corner = np.where(plane[:3] > 0, high, low)
            with np.errstate(invalid="ignore", over="ignore"):
                seen[a : a + BLOCK] &= (low <= high).all(axis=1) & (corner @ plane[:3] + plane[3] >= 0)
    return seen


def trace_primary(
    tlas: Tlas, meshes: MeshTable, camera: Camera, size: tuple[int, int], mesh_of: np.ndarray
) -> FirstHitBuffer:
    """First hits by rays over a TLAS, for machines without a raster. size: width and height. mesh_of: (N,) mesh of
    every instance."""
    hits = np.zeros((size[1], size[0]), HIT)
    flat = hits.view(np.int32).reshape(size[1], size[0], 4)
    _trace_primary(tlas.handle, tlas.ids, tlas.first, camera_constants(camera), flat, flat.view(np.float32))
    found = hits["instance"][hits["instance"] >= 0]
    meshes.need(mesh_of[np.unique(found)])
    return FirstHitBuffer(hits, camera, meshes)


@njit(nogil=True, cache=True, error_model="numpy")
def _trace_primary(tlas, ids, first, camera, hits, values):
    height, width = hits.shape[:2]
    ray = np.zeros(RAY, np.float32)
    for y in range(height):
        for x in range(width):
            u = (np.float32(x) + np.float32(0.5)) / np.float32(width)
            v = (np.float32(y) + np.float32(0.5)) / np.float32(height)
            ox, oy, oz, dx, dy, dz, far = camera_ray(camera, u, v, np.float32(0.0), np.float32(0.0))
            set_ray(ray, ox, oy, oz, dx, dy, dz, np.float32(0.0), far, _CAMERA_MASK)
            hits[y, x, 0] = -1
            if intersect(tlas, ray):
                hits[y, x, 0] = hit_instance(ids, first, ray)
                hits[y, x, 1] = np.int32(ray.view(np.uint32)[PRIM_ID])
                values[y, x, 2] = ray[HIT_U]
                values[y, x, 3] = ray[HIT_V]
