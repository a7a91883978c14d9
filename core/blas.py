"""Bottom-level structures: one BLAS per mesh, shared by its instances, there only while somebody needs it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from . import embree
from .scene import F32, Mesh, Records

MESH = np.dtype(
    [
        # Addresses of a loaded mesh's arrays (0: absent), for kernels: core.scene.Mesh says their shapes.
        ("positions", "u8"),
        ("triangles", "u8"),
        ("normals", "u8"),
        ("uvs", "u8"),
        ("slots", "u8"),
        ("triangle_count", "i8"),
    ],
    align=True,
)


@dataclass(eq=False)
class _Blas:
    """A loaded mesh with its Embree scene; `mesh` keeps the arrays alive that Embree and the kernels read."""

    mesh: Mesh
    scene: int
    bytes: int


def _padded(positions: F32) -> F32:
    """A copy of (V, 3) positions that may be read 16 bytes at a time up to the last row, as Embree does."""
    flat = np.empty(positions.size + 1, np.float32)
    out = flat[:-1].reshape(positions.shape)
    out[...] = positions
    return out


def _address(array: np.ndarray | None) -> int:
    return 0 if array is None else array.ctypes.data


def loaded(source: Mesh) -> tuple[Mesh, tuple[int, ...]]:
    """A mesh whose arrays Embree and the kernels can read in place, and its record (MESH): valid while the mesh lives."""
    mesh = Mesh(
        _padded(source.positions),
        np.ascontiguousarray(source.triangles, np.uint32),
        None if source.normals is None else np.ascontiguousarray(source.normals, np.float32),
        None if source.uvs is None else np.ascontiguousarray(source.uvs, np.float32),
        None if source.slots is None else np.ascontiguousarray(source.slots, np.uint16),
    )
    return mesh, (*map(_address, (mesh.positions, mesh.triangles, mesh.normals, mesh.uvs, mesh.slots)), len(mesh.triangles))


class BlasCache:
    """The meshes of a scene that are loaded and built.

    table: (M,) of MESH; scenes: (M,) uint64 Embree handles, 0 where there is none; bytes_of: (M,) int64, Embree's memory per BLAS.
    """

    def __init__(self, meshes: Sequence[Mesh], device: embree.Device | None = None) -> None:
        self.device = device or embree.shared_device()
        self._meshes = meshes
        self._built: dict[int, _Blas] = {}
        self.table: Records = np.zeros(len(meshes), MESH)
        self.scenes = np.zeros(len(meshes), np.uint64)
        self.bytes_of = np.zeros(len(meshes), np.int64)
        self.built_total = 0

    @property
    def bytes(self) -> int:
        """Embree's bytes in all BLASes held now."""
        return int(self.bytes_of.sum())

    def __len__(self) -> int:
        return len(self._built)

    def need(self, meshes: np.ndarray, step: Callable[[int, int], None] | None = None) -> int:
        """Load and build what is missing of meshes (indices, repeats allowed). step(done, of) is called after each. Returns how many were built.

        Raises MemoryError where Embree runs out.
        """
        wanted = np.unique(meshes)
        missing = wanted[self.scenes[wanted] == 0]
        for done, index in enumerate(missing.tolist(), 1):
            self._build(index)
            if step:
                step(done, len(missing))
        self.built_total += len(missing)
        return len(missing)

    def keep_only(self, meshes: np.ndarray) -> None:
        """Free every BLAS, and its mesh, that is not among meshes (indices)."""
        kept = set(np.unique(meshes).tolist())
        for index in [i for i in self._built if i not in kept]:
            del self._built[index]
            self.table[index] = np.zeros((), MESH)
            self.scenes[index] = self.bytes_of[index] = 0

    def _build(self, index: int) -> None:
        mesh, record = loaded(self._meshes[index])
        device, lib = self.device, embree.lib
        geometry = lib.rtcNewGeometry(device.handle, embree.GEOMETRY_TRIANGLE)
        if len(mesh.triangles):
            embree.shared_buffer(geometry, embree.BUFFER_VERTEX, embree.FORMAT_FLOAT3, mesh.positions, 12)
            embree.shared_buffer(geometry, embree.BUFFER_INDEX, embree.FORMAT_UINT3, mesh.triangles, 12)
        lib.rtcSetGeometryMask(geometry, 0xFFFFFFFF)  # the ray's mask is tested against the instance's alone
        lib.rtcCommitGeometry(geometry)
        scene = device.new_scene(embree.SCENE_ROBUST | embree.SCENE_COMPACT)
        lib.rtcAttachGeometry(scene, geometry)
        lib.rtcReleaseGeometry(geometry)
        blas = _Blas(mesh, scene, 0)
        blas.bytes = device.commit(scene, blas, f"build the BLAS of mesh {index} with {len(mesh.triangles):,} triangles")
        self._built[index] = blas
        self.scenes[index], self.bytes_of[index] = scene, blas.bytes
        self.table[index] = record
