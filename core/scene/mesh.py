"""Meshes: arrays of one, and their addresses as kernels read them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol, overload

import numpy as np
from numpy.typing import NDArray

from ..arrays import F32, I32, U32, Records

# Triangles from which on a mesh is divided into parts: such a share of those of all meshes, but never fewer than the
# least, and always from the most on
DIVIDED_SHARE, DIVIDED_LEAST, DIVIDED_MOST = 0.01, 512, 8192


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


def divided_from(triangles: NDArray[np.int64] | None) -> int:
    """From how many triangles on a mesh is divided into parts where meshes have (M,) triangles; None: nobody knows.

    A mesh with a hundredth of all triangles is: there are a hundred of these at most, and one that is left whole is
    next to nothing.
    """
    if triangles is None:
        return DIVIDED_MOST
    return int(np.clip(np.ceil(DIVIDED_SHARE * int(triangles.sum())), DIVIDED_LEAST, DIVIDED_MOST))
