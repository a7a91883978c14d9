"""Meshes: arrays of one, and their addresses as kernels read them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol, overload

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ..arrays import F32, I32, U32, Records

# triangles of a mesh that is divided into parts: dividing smaller ones costs more time than their memory is worth
DIVIDED_FROM = 8192


@dataclass(frozen=True)
class Mesh:
    """Triangles of one BLAS, in object space.

    positions: (V, 3) float32, C-contiguous; triangles: (T, 3) uint32 into positions.
    normals: float32 shading normals, (V, 3) by vertex or (T, 3, 3) by corner, or None: flat.
    uvs: (K, T, 3, 2) float32 for the K maps of `Scene.uv_maps`, or None: no map is needed.
    slots: (T,) uint16 material slot per triangle, or None: slot 0 throughout.
    faces: (T,) int32 face, of any number of corners, that each triangle is a part of, or None: each is a face.
    """

    positions: F32
    triangles: U32
    normals: F32 | None = None
    uvs: F32 | None = None
    slots: NDArray[np.uint16] | None = None
    faces: I32 | None = None


MESH = np.dtype(
    [
        # Addresses of a loaded mesh's arrays (0: absent), for kernels: `Mesh` says their shapes.
        ("positions", "u8"),
        ("triangles", "u8"),
        ("normals", "u8"),  # by corner
        ("vertex_normals", "u8"),
        ("uvs", "u8"),
        ("slots", "u8"),
        ("triangle_count", "i8"),
    ],
    align=True,
)


def _padded(positions: F32) -> F32:
    """A copy of (V, 3) positions that may be read 16 bytes at a time up to the last row, as Embree does."""
    flat = np.empty(positions.size + 1, np.float32)
    out = flat[:-1].reshape(positions.shape)
    out[...] = positions
    return out


def loaded(source: Mesh, positions: F32 | None = None) -> Mesh:
    """A mesh whose arrays Embree and the kernels can read in place. positions: an earlier copy to bring up to date,
    instead of a new one."""
    if positions is None:
        positions = _padded(source.positions)
    else:
        positions[...] = source.positions
    return Mesh(
        positions,
        np.ascontiguousarray(source.triangles, np.uint32),
        None if source.normals is None else np.ascontiguousarray(source.normals, np.float32),
        None if source.uvs is None else np.ascontiguousarray(source.uvs, np.float32),
        None if source.slots is None else np.ascontiguousarray(source.slots, np.uint16),
    )


def _address(array: np.ndarray | None) -> int:
    return 0 if array is None else array.ctypes.data


def record(mesh: Mesh) -> tuple[int, ...]:
    """The MESH record of a mesh that is `loaded`: valid while the mesh lives."""
    by_corner = mesh.normals is not None and mesh.normals.ndim == 3
    normals = (mesh.normals, None) if by_corner else (None, mesh.normals)
    return (*map(_address, (mesh.positions, mesh.triangles, *normals, mesh.uvs, mesh.slots)), len(mesh.triangles))


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


class MeshSequence(Sequence[Mesh]):
    """Meshes that are made on demand: `mesh(m)` says how, and slices ask for each."""

    def mesh(self, index: int) -> Mesh:
        """Mesh number index, from 0 on."""
        raise NotImplementedError

    @overload
    def __getitem__(self, index: int) -> Mesh: ...
    @overload
    def __getitem__(self, index: slice) -> list[Mesh]: ...
    def __getitem__(self, index: int | slice) -> Mesh | list[Mesh]:
        if isinstance(index, slice):
            return [self.mesh(i) for i in range(*index.indices(len(self)))]
        return self.mesh(range(len(self))[index])  # IndexError beyond the end, where iteration stops


class CoarserMeshes(Protocol):
    """Meshes that the program which they come from can make with fewer triangles, by a setting that has steps.

    steps: (M,) int64, by how many of them each mesh can be coarser, 0: not at all.
    """

    steps: NDArray[np.int64]

    def read(self, meshes: Sequence[int]) -> Mapping[int, Sequence[Mesh]]:
        """Each of meshes, by its number, one step coarser, two, and so on; of some perhaps fewer than `steps` says."""

    def at(self, steps: Mapping[int, int]) -> Mapping[int, Mesh]:
        """Meshes, by their numbers, each so many steps coarser; some may be missing."""


class MeshTable(MeshSequence):
    """Meshes in the form that kernels read, without a BLAS; those that are there need not be read again. table: (M,) of
    MESH."""

    def __init__(self, meshes: Sequence[Mesh]) -> None:
        self._meshes = meshes
        self._loaded: dict[int, Mesh] = {}
        self.table: Records = np.zeros(len(meshes), MESH)

    def need(self, meshes: np.ndarray) -> None:
        """Load what is missing of meshes (indices, repeats allowed)."""
        for index in np.unique(meshes).tolist():
            if index not in self._loaded:
                self._loaded[index] = mesh = loaded(self._meshes[index])
                self.table[index] = record(mesh)

    def __len__(self) -> int:
        return len(self._meshes)

    def mesh(self, index: int) -> Mesh:
        """As it was loaded, or as the source gives it."""
        return self._loaded[index] if index in self._loaded else self._meshes[index]
