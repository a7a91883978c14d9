"""The top-level structure: an Embree instance array over the active instances."""

from __future__ import annotations

import numpy as np
from numba import njit

from ..arrays import I32, I64
from ..scene.model import ALL_RAYS, Instances
from . import embree
from .blas import BlasCache
from .embree import INST_ID, INST_PRIM_ID


class Tlas:
    """Active instances over their BLASes, ready for `embree.intersect(tlas.handle, ray)`.

    Instances are grouped by their visibility bits, which become Embree's geometry masks: a ray of type t, traced with
    mask 1 << t, meets what is visible to it. ids: (A,) int32 instance of every TLAS entry; first: (G + 1,) int64
    offsets of the groups in ids. bytes: Embree's memory plus the arrays it reads in place.
    """

    def __init__(self, instances: Instances, blas: BlasCache, active: np.ndarray) -> None:
        """Build over the instances where active (N,) bool holds; their meshes must be in blas. Meshes without triangles
        are left out."""
        device, lib = blas.device, embree.lib
        self._blas = blas  # keeps the device
        chosen = np.flatnonzero(active).astype(np.int32)
        chosen = chosen[blas.table["triangle_count"][instances.mesh[chosen]] > 0]
        visibility = instances.flags[chosen] & ALL_RAYS
        order = np.argsort(visibility, kind="stable")
        self.ids: I32 = np.ascontiguousarray(chosen[order])
        groups, starts = np.unique(visibility[order], return_index=True)
        self.first: I64 = np.append(starts, len(chosen)).astype(np.int64)
        meshes, entry_mesh = np.unique(instances.mesh[self.ids], return_inverse=True)
        # keeps the vertices that Embree reads in place, also when the cache lets go of them
        self._built = blas.built(meshes)
        self._scenes = np.ascontiguousarray(blas.scenes[meshes])
        self._index = np.ascontiguousarray(entry_mesh, np.uint32)
        # column-major, as Embree reads them
        self._transform = np.ascontiguousarray(instances.transform[self.ids].transpose(0, 2, 1))
        self._only, self._entry_of = np.zeros(1, np.uint32), np.zeros(0, np.int32)
        scene, unreported = device.new_scene(embree.SCENE_ROBUST), 0
        for mask, a, b in zip(groups.tolist(), self.first[:-1].tolist(), self.first[1:].tolist(), strict=True):
            geometry = lib.rtcNewGeometry(device.handle, embree.GEOMETRY_INSTANCE_ARRAY)
            scenes, index = self._scenes, self._index[a:b]
            if b - a == 1:  # Embree (4.4) reads no index buffer of one item: it takes the first scene
                scenes, index = self._scenes[index[0] :][:1], self._only
            lib.rtcSetGeometryInstancedScenes(geometry, scenes.ctypes.data, len(scenes))
            unreported += scenes.nbytes  # Embree (4.4) counts its copy of the handles, but not that it is freed
            embree.shared_buffer(
                geometry, embree.BUFFER_TRANSFORM, embree.FORMAT_FLOAT3X4_COLUMN_MAJOR, self._transform[a:b], 48
            )
            embree.shared_buffer(geometry, embree.BUFFER_INDEX, embree.FORMAT_UINT, index, 4)
            lib.rtcSetGeometryMask(geometry, mask)
            lib.rtcCommitGeometry(geometry)
            lib.rtcAttachGeometry(scene, geometry)
            lib.rtcReleaseGeometry(geometry)
        device.own(scene, self, unreported)
        built = device.commit(scene, f"build the TLAS over {len(self.ids):,} instances")
        self.handle = np.uint64(scene)
        self.bytes = built + self._transform.nbytes + self._index.nbytes + self._scenes.nbytes

    def entry_of(self, instances: int) -> I32:
        """(instances,) int32: the entry of each instance, -1 where it is not in here. Made once: tracing asks often."""
        if len(self._entry_of) != instances:
            self._entry_of = np.full(instances, -1, np.int32)
            self._entry_of[self.ids] = np.arange(len(self.ids), dtype=np.int32)
        return self._entry_of

    def __len__(self) -> int:
        return len(self.ids)


@njit(nogil=True, cache=True, error_model="numpy")
def hit_instance(ids, first, ray):
    """Instance that a ray (after a hit in a TLAS) met; ids and first are the TLAS's."""
    words = ray.view(np.uint32)
    return ids[first[words[INST_ID]] + words[INST_PRIM_ID]]
