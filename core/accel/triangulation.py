"""Faces of meshes as triangles, and normals of their vertices, as Blender makes them; vertices of parts of meshes."""

from __future__ import annotations

import math

import numpy as np
from numba import njit


@njit(nogil=True, cache=True, error_model="numpy")
def corners_of_faces(positions, vertices, sizes):
    """Triangles of faces of three or four corners each, as Blender makes them: (T, 3) int32 corners; face by face.

    positions: (V, 3) float32; vertices: (C,) int32 of the corners, face after face; sizes: (F,) int32. A quadrilateral
    is cut from its first corner to its third, but where that is outside of it.
    """
    count = 0
    for f in range(len(sizes)):
        count += sizes[f] - 2
    out = np.empty((count, 3), np.int32)
    c = t = 0
    for f in range(len(sizes)):
        out[t, 0], out[t, 1], out[t, 2] = c, c + 1, c + 2
        if sizes[f] == 4:
            t += 1
            out[t, 0], out[t, 1], out[t, 2] = c, c + 2, c + 3
            a, across = vertices[c], _from_to(positions, vertices[c], vertices[c + 2])
            one = _cross(_from_to(positions, a, vertices[c + 1]), across)
            other = _cross(_from_to(positions, a, vertices[c + 3]), across)
            if _dot(one, other) > 0:
                out[t - 1, 2], out[t, 0] = c + 3, c + 1
        t += 1
        c += sizes[f]
    return out


@njit(nogil=True, cache=True, error_model="numpy")
def vertex_normals(positions, vertices, sizes):
    """Normals of vertices, (V, 3) float32: of faces of three or four corners each, weighted by their angles (Thürmer
    and Wüthrich, "Computing Vertex Normals from Polygonal Facets", 1998); at vertices without faces, where they are
    seen from the origin. As of `corners_of_faces`."""
    sums = np.zeros(positions.shape, np.float32)
    c = 0
    for f in range(len(sizes)):
        n = sizes[f]
        if n == 4:
            a = _from_to(positions, vertices[c], vertices[c + 2])
            b = _from_to(positions, vertices[c + 1], vertices[c + 3])
        else:
            a = _from_to(positions, vertices[c], vertices[c + 1])
            b = _from_to(positions, vertices[c + 1], vertices[c + 2])
        normal = _unit(_cross(a, b))
        for k in range(n):
            v = vertices[c + k]
            before = _unit(_from_to(positions, v, vertices[c + (k + n - 1) % n]))
            after = _unit(_from_to(positions, v, vertices[c + (k + 1) % n]))
            angle = _angle(_dot(before, after))
            for axis in range(3):
                sums[v, axis] += angle * normal[axis]
        c += n
    for v in range(len(sums)):
        x, y, z = sums[v]
        if x == 0 and y == 0 and z == 0:
            x, y, z = positions[v]
        sums[v, 0], sums[v, 1], sums[v, 2] = _unit((x, y, z))
    return sums


@njit(nogil=True, cache=True, error_model="numpy")
def own_vertices(triangles, order, ends, count):
    """Vertices of each part, one part after the other, each vertex once in a part: (W,) int32 into count of them; the
    triangles by numbers among their part's own, (T, 3) uint32; and (P,) int64 where each part ends in W.

    triangles: (T, 3) uint32; order: (T,) int32 part by part; ends: (P,) int64.
    """
    part_of, number = np.full(count, -1, np.int32), np.empty(count, np.uint32)
    vertices, out, upto = np.empty(3 * len(order), np.int32), np.empty((len(order), 3), np.uint32), np.empty_like(ends)
    t = w = 0
    for p in range(len(ends)):
        first = w
        while t < ends[p]:
            for corner in range(3):
                vertex = triangles[order[t], corner]
                if part_of[vertex] != p:
                    part_of[vertex], number[vertex], vertices[w] = p, w - first, vertex
                    w += 1
                out[t, corner] = number[vertex]
            t += 1
        upto[p] = w
    return vertices[:w].copy(), out, upto


@njit(nogil=True, cache=True, error_model="numpy", inline="always")
def _from_to(positions, a, b):
    return (
        positions[b, 0] - positions[a, 0],
        positions[b, 1] - positions[a, 1],
        positions[b, 2] - positions[a, 2],
    )


@njit(nogil=True, cache=True, error_model="numpy", inline="always")
def _cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@njit(nogil=True, cache=True, error_model="numpy", inline="always")
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(nogil=True, cache=True, error_model="numpy", inline="always")
def _angle(cosine):
    """Arc cosine, within 7e-5: as Blender has it (`safe_acos_approx`)."""
    m = min(abs(cosine), np.float32(1))
    a = np.float32(math.sqrt(np.float32(1) - m))
    a *= np.float32(1.5707963267) + m * (
        np.float32(-0.213300989) + m * (np.float32(0.077980478) + m * np.float32(-0.02164095))
    )
    return np.float32(math.pi) - a if cosine < 0 else a


@njit(nogil=True, cache=True, error_model="numpy", inline="always")
def _unit(a):
    length = np.float32(math.sqrt(_dot(a, a)))
    if length == 0:
        return np.float32(0), np.float32(0), np.float32(0)
    return a[0] / length, a[1] / length, a[2] / length
