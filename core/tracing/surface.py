"""From a hit to a point on a surface: position with its error, normals, UV.

Kernels reach the scene through a table of addresses, uint64[9], slots T_*: `SceneTable` makes it and keeps the arrays
alive.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from ..jit.pointers import address, load_f32, load_i32, load_u32, load_u64, offset
from ..jit.sampling import INNER, mix
from ..scene.mesh import MESH
from ..scene.model import RAY_TYPES, Scene
from .bsdf.lobes import F_N, F_NG, F_NS, F_WI

T_TRANSFORM, T_MESH, T_SLOTS, T_FLAGS, T_SLOT_MATERIALS, T_MATERIALS, T_TEXTURES, T_BYTES, T_FLOATS = range(9)
# surf, float32[SURF]: a shading point, world space.
S_P = 0  # position
S_ERROR = 3  # bound of its error, and of Embree's, per axis
S_BARY = 6  # barycentrics of vertices 1 and 2
SURF = 8
_MESH_SIZE = np.uint64(MESH.itemsize)
_POSITIONS, _TRIANGLES, _NORMALS = offset(MESH, "positions"), offset(MESH, "triangles"), offset(MESH, "normals")
_VERTEX_NORMALS = offset(MESH, "vertex_normals")
_UVS, MESH_SLOTS, _COUNT = offset(MESH, "uvs"), offset(MESH, "slots"), offset(MESH, "triangle_count")
_ZERO, _ONE, _HALF, _TWO, _THIRD = map(np.float32, (0.0, 1.0, 0.5, 2.0, 1.0 / 3.0))
# Error bounds of `interpolate`, in units of float32's rounding
_TRANSFORM, _TRIANGLE, _POSITION, _SLIVER = 12 * 2.0**-24, 4 * 2.0**-24, 2 * 2.0**-24, 2.0**10
_BITS = np.float32(2.0**31)
LIGHT_VIEW = RAY_TYPES  # for `part_of`: what light sampling sees
_GEOMETRY_OFFSET = np.float32(0.1)  # Blender's default "Shadow Terminator Geometry Offset"


class SceneTable:
    """Addresses of a scene's arrays for the kernels; `table` is uint64[9]."""

    def __init__(self, scene: Scene) -> None:
        i = scene.instances
        self.arrays: tuple[np.ndarray[Any, Any], ...] = (
            np.ascontiguousarray(i.transform, np.float32),
            np.ascontiguousarray(i.mesh, np.int32),
            np.ascontiguousarray(i.slots, np.int32),
            np.ascontiguousarray(i.flags, np.uint8),
            np.ascontiguousarray(scene.slot_materials, np.int32),
            np.ascontiguousarray(scene.materials),
            np.ascontiguousarray(scene.textures.records),
            np.ascontiguousarray(scene.textures.bytes, np.uint8),
            np.ascontiguousarray(scene.textures.floats, np.float32),
        )
        self.table = np.array([address(a) for a in self.arrays], np.uint64)


@njit(**INNER)
def mesh_record(meshes, table, instance):
    """Address of the mesh record (blas.MESH) of an instance; meshes: address of the records."""
    return meshes + np.uint64(load_i32(table[T_MESH], instance)) * _MESH_SIZE


@njit(**INNER)
def corners(mesh, triangle):
    """The corners of a triangle in object space: 9 float32."""
    rows, p = load_u64(mesh + _TRIANGLES, 0), load_u64(mesh + _POSITIONS, 0)
    a = 3 * np.int64(load_u32(rows, 3 * triangle))
    b = 3 * np.int64(load_u32(rows, 3 * triangle + 1))
    c = 3 * np.int64(load_u32(rows, 3 * triangle + 2))
    return (
        *(load_f32(p, a), load_f32(p, a + 1), load_f32(p, a + 2)),
        *(load_f32(p, b), load_f32(p, b + 1), load_f32(p, b + 2)),
        *(load_f32(p, c), load_f32(p, c + 1), load_f32(p, c + 2)),
    )


@njit(**INNER)
def smooth(mesh):
    """Whether a mesh has shading normals."""
    return load_u64(mesh + _NORMALS, 0) != np.uint64(0) or load_u64(mesh + _VERTEX_NORMALS, 0) != np.uint64(0)


@njit(**INNER)
def corner_normals(mesh, triangle):
    """Shading normals at the corners of a triangle of a smooth mesh, in object space: 9 float32."""
    n, rows = load_u64(mesh + _NORMALS, 0), load_u64(mesh + _TRIANGLES, 0)
    i, j, k = 9 * triangle, 9 * triangle + 3, 9 * triangle + 6
    if n == np.uint64(0):
        n = load_u64(mesh + _VERTEX_NORMALS, 0)
        i = 3 * np.int64(load_u32(rows, 3 * triangle))
        j = 3 * np.int64(load_u32(rows, 3 * triangle + 1))
        k = 3 * np.int64(load_u32(rows, 3 * triangle + 2))
    return (
        *(load_f32(n, i), load_f32(n, i + 1), load_f32(n, i + 2)),
        *(load_f32(n, j), load_f32(n, j + 1), load_f32(n, j + 2)),
        *(load_f32(n, k), load_f32(n, k + 1), load_f32(n, k + 2)),
    )


@njit(**INNER)
def corner_normal(mesh, triangle, b1, b2):
    """Interpolated shading normal in object space, not normalised; zeros where the mesh is flat shaded."""
    if not smooth(mesh):
        return _ZERO, _ZERO, _ZERO
    nx0, ny0, nz0, nx1, ny1, nz1, nx2, ny2, nz2 = corner_normals(mesh, triangle)
    b0 = _ONE - b1 - b2
    return b0 * nx0 + b1 * nx1 + b2 * nx2, b0 * ny0 + b1 * ny1 + b2 * ny2, b0 * nz0 + b1 * nz1 + b2 * nz2


@njit(**INNER)
def _unit64(x, y, z):
    """(unit vector, length) in float64; a zero vector gives zeros."""
    length = math.sqrt(x * x + y * y + z * z)
    f = 1.0 / max(length, 1e-300)
    return x * f, y * f, z * f, length


@njit(**INNER)
def interpolate(mesh, m, triangle, b1, b2, surf, frame):
    """Position, its error bound and both normals of a point of a triangle.

    mesh: address of the mesh record; m: address of the instance's transform. Fills surf, frame[F_NG], frame[F_NS] and
    frame[F_N], outward as the mesh says.

    Computed in float64, so that neither a triangle of 1e-9 m loses its normal nor one of 1e4 m its millimetres; what is
    left of our error is the rounding of the position. The bound is of that and of what Embree, in float32, makes of a
    ray from there (first-order bounds, as in pbrt-v4 section 6.8, u = 2^-24):
    - Taking the origin to object space, M^-1 p - M^-1 t: three multiply-adds, two roundings of a cofactor, one of the
      division, and the determinant's four: 10 u of sums of |products|, not of results, which may cancel. Two more for
      what the result loses when it comes back by |M|.
    - Vertices minus origin: u of the distances. The normal's direction, from edges of these differences: two roundings
      of each difference and two of each product in the best conditioned cross product of two edges, relative to the
      area: 4 u times (1 + 1 / sine of the angle), capped at slivers of 2^-10.
    """
    ax, ay, az, bx, by, bz, cx, cy, cz = corners(mesh, triangle)
    ax, ay, az = np.float64(ax), np.float64(ay), np.float64(az)
    b0 = 1.0 - np.float64(b1) - np.float64(b2)
    x = b0 * ax + b1 * np.float64(bx) + b2 * np.float64(cx)
    y = b0 * ay + b1 * np.float64(by) + b2 * np.float64(cy)
    z = b0 * az + b1 * np.float64(bz) + b2 * np.float64(cz)
    m00, m01, m02, tx = (
        np.float64(load_f32(m, 0)),
        np.float64(load_f32(m, 1)),
        np.float64(load_f32(m, 2)),
        np.float64(load_f32(m, 3)),
    )
    m10, m11, m12, ty = (
        np.float64(load_f32(m, 4)),
        np.float64(load_f32(m, 5)),
        np.float64(load_f32(m, 6)),
        np.float64(load_f32(m, 7)),
    )
    m20, m21, m22, tz = (
        np.float64(load_f32(m, 8)),
        np.float64(load_f32(m, 9)),
        np.float64(load_f32(m, 10)),
        np.float64(load_f32(m, 11)),
    )
    px = m00 * x + m01 * y + m02 * z + tx
    py = m10 * x + m11 * y + m12 * z + ty
    pz = m20 * x + m21 * y + m22 * z + tz
    # Cofactors: rows of the inverse transpose times the determinant. Each is a difference whose terms bound its
    # rounding: s..
    c00, c01, c02 = m11 * m22 - m12 * m21, m12 * m20 - m10 * m22, m10 * m21 - m11 * m20
    c10, c11, c12 = m02 * m21 - m01 * m22, m00 * m22 - m02 * m20, m01 * m20 - m00 * m21
    c20, c21, c22 = m01 * m12 - m02 * m11, m02 * m10 - m00 * m12, m00 * m11 - m01 * m10
    det = m00 * c00 + m01 * c01 + m02 * c02
    inv = 1.0 / max(abs(det), 1e-300)
    wx, wy, wz = abs(px) + abs(tx), abs(py) + abs(ty), abs(pz) + abs(tz)
    n00, n01, n02, n10, n11, n12, n20, n21, n22 = (
        abs(m00),
        abs(m01),
        abs(m02),
        abs(m10),
        abs(m11),
        abs(m12),
        abs(m20),
        abs(m21),
        abs(m22),
    )
    ox = inv * ((n11 * n22 + n12 * n21) * wx + (n02 * n21 + n01 * n22) * wy + (n01 * n12 + n02 * n11) * wz)
    oy = inv * ((n12 * n20 + n10 * n22) * wx + (n00 * n22 + n02 * n20) * wy + (n02 * n10 + n00 * n12) * wz)
    oz = inv * ((n10 * n21 + n11 * n20) * wx + (n01 * n20 + n00 * n21) * wy + (n00 * n11 + n01 * n10) * wz)
    # The triangle: edges, area, distances of the vertices.
    ux, uy, uz = bx - ax, by - ay, bz - az
    vx, vy, vz = cx - ax, cy - ay, cz - az
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    length = math.sqrt(nx * nx + ny * ny + nz * nz)
    uu, vv = ux * ux + uy * uy + uz * uz, vx * vx + vy * vy + vz * vz
    ww = (vx - ux) * (vx - ux) + (vy - uy) * (vy - uy) + (vz - uz) * (vz - uz)
    shape = _TRIANGLE * (1.0 + min(math.sqrt(min(uu * vv, min(uu * ww, vv * ww))) / max(length, 1e-300), _SLIVER))
    ox = _TRANSFORM * ox + shape * max(abs(ax - x), max(abs(bx - x), abs(cx - x)))
    oy = _TRANSFORM * oy + shape * max(abs(ay - y), max(abs(by - y), abs(cy - y)))
    oz = _TRANSFORM * oz + shape * max(abs(az - z), max(abs(bz - z), abs(cz - z)))
    surf[S_P] = px
    surf[S_P + 1] = py
    surf[S_P + 2] = pz
    surf[S_ERROR] = n00 * ox + n01 * oy + n02 * oz + _POSITION * abs(px)
    surf[S_ERROR + 1] = n10 * ox + n11 * oy + n12 * oz + _POSITION * abs(py)
    surf[S_ERROR + 2] = n20 * ox + n21 * oy + n22 * oz + _POSITION * abs(pz)
    surf[S_BARY] = b1
    surf[S_BARY + 1] = b2
    s = 1.0 if det >= 0.0 else -1.0
    gx, gy, gz, length = _unit64(
        s * (c00 * nx + c01 * ny + c02 * nz), s * (c10 * nx + c11 * ny + c12 * nz), s * (c20 * nx + c21 * ny + c22 * nz)
    )
    kx, ky, kz = corner_normal(mesh, triangle, b1, b2)
    sx, sy, sz, length = _unit64(
        s * (c00 * kx + c01 * ky + c02 * kz), s * (c10 * kx + c11 * ky + c12 * kz), s * (c20 * kx + c21 * ky + c22 * kz)
    )
    if not length > 0.0:
        sx, sy, sz = gx, gy, gz
    frame[F_NG] = gx
    frame[F_NG + 1] = gy
    frame[F_NG + 2] = gz
    frame[F_NS] = frame[F_N] = sx
    frame[F_NS + 1] = frame[F_N + 1] = sy
    frame[F_NS + 2] = frame[F_N + 2] = sz


@njit(**INNER)
def face(frame, dx, dy, dz):
    """Turn the normals to the side that a ray of direction d came from and set F_WI. True where the surface is seen
    from its back."""
    frame[F_WI] = -dx
    frame[F_WI + 1] = -dy
    frame[F_WI + 2] = -dz
    back = frame[F_NG] * dx + frame[F_NG + 1] * dy + frame[F_NG + 2] * dz > _ZERO
    if back:
        for k in range(3, 12):
            frame[k] = -frame[k]
    return back


@njit(**INNER)
def offset_origin(surf, frame, dx, dy, dz):
    """Where a ray of direction d starts that must not meet its own surface: moved along the geometric normal, to d's
    side, by the error bound (pbrt-v4 section 6.8.6)."""
    nx, ny, nz = frame[F_NG], frame[F_NG + 1], frame[F_NG + 2]
    d = abs(nx) * surf[S_ERROR] + abs(ny) * surf[S_ERROR + 1] + abs(nz) * surf[S_ERROR + 2]
    if nx * dx + ny * dy + nz * dz < _ZERO:
        d = -d
    return surf[S_P] + d * nx, surf[S_P + 1] + d * ny, surf[S_P + 2] + d * nz


@njit(**INNER)
def uv_at(mesh, uv_map, triangle, b1, b2):
    """UV coordinates of a point of a triangle in map uv_map; zeros without maps."""
    uvs = load_u64(mesh + _UVS, 0)
    if uvs == np.uint64(0):
        return _ZERO, _ZERO
    i = 6 * (np.int64(uv_map) * np.int64(load_u64(mesh + _COUNT, 0)) + triangle)
    b0 = _ONE - b1 - b2
    u = b0 * load_f32(uvs, i) + b1 * load_f32(uvs, i + 2) + b2 * load_f32(uvs, i + 4)
    v = b0 * load_f32(uvs, i + 1) + b1 * load_f32(uvs, i + 3) + b2 * load_f32(uvs, i + 5)
    return u, v


@njit(**INNER)
def hit_number(triangle, b1, b2):
    """A uniform number that belongs to a point of a triangle: where a path has none of its own to pick a part by."""
    x = np.uint64(np.int64(b1 * _BITS)) | np.uint64(np.int64(b2 * _BITS)) << np.uint64(32)
    return np.float32(mix(mix(x) + np.uint64(triangle)) >> np.uint64(40)) * np.float32(2.0**-24)


@njit(**INNER)
def shadow_origin(mesh, m, triangle, surf, frame, lx, ly, lz):
    """Where a shadow ray towards l starts: `offset_origin`, and near the terminator of a smooth-shaded mesh lifted off
    the flat triangle.

    The lift follows the curved surface that the normals suggest (Cycles' "geometry offset", after Hanika, "Hacking the
    shadow terminator", Ray Tracing Gems II, 2021): each corner's tangent plane is raised to the point, the smallest
    lift wins.
    """
    if not smooth(mesh):
        return offset_origin(surf, frame, lx, ly, lz)
    cos_n = frame[F_NS] * lx + frame[F_NS + 1] * ly + frame[F_NS + 2] * lz
    flip = -_ONE if cos_n < _ZERO else _ONE
    cos_n = abs(cos_n)
    cos_g = flip * (frame[F_NG] * lx + frame[F_NG + 1] * ly + frame[F_NG + 2] * lz)
    if cos_n < _GEOMETRY_OFFSET:
        amount = _TWO - (cos_g + cos_n) / _GEOMETRY_OFFSET
    else:
        amount = _ONE - cos_g / _GEOMETRY_OFFSET
    amount = min(max(amount, _ZERO), _ONE)
    if amount == _ZERO:
        return offset_origin(surf, frame, lx, ly, lz)
    b1, b2 = surf[S_BARY], surf[S_BARY + 1]
    b0 = _ONE - b1 - b2
    nx0, ny0, nz0, nx1, ny1, nz1, nx2, ny2, nz2 = corner_normals(mesh, triangle)
    ax, ay, az, bx, by, bz, cx, cy, cz = corners(mesh, triangle)
    px, py, pz = b0 * ax + b1 * bx + b2 * cx, b0 * ay + b1 * by + b2 * cy, b0 * az + b1 * bz + b2 * cz
    nx, ny, nz = b0 * nx0 + b1 * nx1 + b2 * nx2, b0 * ny0 + b1 * ny1 + b2 * ny2, b0 * nz0 + b1 * nz1 + b2 * nz2
    wx = load_f32(m, 0) * nx + load_f32(m, 1) * ny + load_f32(m, 2) * nz
    wy = load_f32(m, 4) * nx + load_f32(m, 5) * ny + load_f32(m, 6) * nz
    wz = load_f32(m, 8) * nx + load_f32(m, 9) * ny + load_f32(m, 10) * nz
    # Second-order height of the curved surface above the flat triangle.
    a = (nx2 - nx0) * (ax - cx) + (ny2 - ny0) * (ay - cy) + (nz2 - nz0) * (az - cz)
    b = (nx2 - nx1) * (bx - cx) + (ny2 - ny1) * (by - cy) + (nz2 - nz1) * (bz - cz)
    c = (nx1 - nx0) * (bx - ax) + (ny1 - ny0) * (by - ay) + (nz1 - nz0) * (bz - az)
    height = a * b0 * (b0 - _ONE) + (a + b + c) * b0 * b1 + b * b1 * (b1 - _ONE)
    side = flip * (wx * frame[F_NG] + wy * frame[F_NG + 1] + wz * frame[F_NG + 2])
    s = _ONE if side > _ZERO else -_ONE
    # Heights of the corners and of the point over each corner's tangent plane, on the light's side.
    d01 = (bx - ax) * nx0 + (by - ay) * ny0 + (bz - az) * nz0
    d02 = (cx - ax) * nx0 + (cy - ay) * ny0 + (cz - az) * nz0
    d10 = (ax - bx) * nx1 + (ay - by) * ny1 + (az - bz) * nz1
    d12 = (cx - bx) * nx1 + (cy - by) * ny1 + (cz - bz) * nz1
    d20 = (ax - cx) * nx2 + (ay - cy) * ny2 + (az - cz) * nz2
    d21 = (bx - cx) * nx2 + (by - cy) * ny2 + (bz - cz) * nz2
    h0 = max(max(s * d01, s * d02), _ZERO) + s * ((ax - px) * nx0 + (ay - py) * ny0 + (az - pz) * nz0)
    h1 = max(max(s * d10, s * d12), _ZERO) + s * ((bx - px) * nx1 + (by - py) * ny1 + (bz - pz) * nz1)
    h2 = max(max(s * d20, s * d21), _ZERO) + s * ((cx - px) * nx2 + (cy - py) * ny2 + (cz - pz) * nz2)
    lift = s * max(min(max(h0, _ZERO), min(max(h1, _ZERO), max(h2, _ZERO))), s * height * _HALF)
    lift = lift * amount if math.isfinite(lift) else _ZERO
    # A light below the flat triangle is meant to be blocked by it: start on the triangle's lit side all the same.
    if cos_g <= _ZERO:
        ox, oy, oz = offset_origin(surf, frame, flip * frame[F_NG], flip * frame[F_NG + 1], flip * frame[F_NG + 2])
    else:
        ox, oy, oz = offset_origin(surf, frame, lx, ly, lz)
    return ox + wx * lift, oy + wy * lift, oz + wz * lift
