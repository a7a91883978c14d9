"""A frame of which meshes are exchanged for others."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...accel.tlas import Tlas
from ...arrays import I32, I64
from ...scene.mesh import Mesh, MeshSequence
from ...tracing.lights.lights import emissive_instances
from ..frame_tracer import FrameTracer, exchanged
from ..loop import Loop
from .stand_ins import Alternative


@dataclass(frozen=True)
class Exchanged:
    """What traces the frame; the instances that there are, (N,) bool; the TLAS over these."""

    tracer: FrameTracer
    rows: NDArray[np.bool_]
    tlas: Tlas

    @property
    def figures(self) -> dict[str, float | int]:
        """Of the meshes that there are, as in `CullingResult.stats`."""
        meshes, blas = np.unique(self.tracer.scene.instances.mesh[self.tlas.ids]), self.tracer.blas
        return {
            "meshes": len(meshes),
            "triangles": int(blas.table["triangle_count"][meshes].sum()),
            "blas_bytes": int(blas.bytes_of[meshes].sum()),
        }


class _Meshes(MeshSequence):
    """Meshes of a scene, and more behind them."""

    def __init__(self, meshes: Sequence[Mesh], more: Sequence[Mesh]) -> None:
        self._meshes, self._more = meshes, more

    def __len__(self) -> int:
        return len(self._meshes) + len(self._more)

    def mesh(self, index: int) -> Mesh:
        """Of the scene, or of what is behind."""
        return self._meshes[index] if index < len(self._meshes) else self._more[index - len(self._meshes)]


class Exchange:
    """A loop's scene with more meshes behind its own, which its cache of BLASes knows. first: the number of the first
    of these."""

    def __init__(self, loop: Loop, meshes: Sequence[Mesh]) -> None:
        self._loop, self.first = loop, len(loop.scene.meshes)
        boxes = [np.stack((mesh.positions.min(axis=0), mesh.positions.max(axis=0))) for mesh in meshes]
        self._scene = dataclasses.replace(
            loop.scene,
            meshes=_Meshes(loop.scene.meshes, meshes),
            mesh_bounds=np.concatenate([loop.scene.mesh_bounds, *(box[None] for box in boxes)]).astype(np.float32),
        )
        loop.blas.advance(self._scene.meshes, *np.zeros((2, 0), np.int32))

    def forget(self) -> None:
        """Free what was built of them."""
        self._loop.blas.advance(self._loop.scene.meshes, *np.zeros((2, 0), np.int32))

    def with_meshes(self, mesh: I32, rows: NDArray[np.bool_]) -> Exchanged:
        """With other meshes of the instances, (N,), of which those of rows, (N,) bool, are there."""
        instances = dataclasses.replace(self._scene.instances, mesh=mesh)
        tracer = exchanged(self._loop.tracer, dataclasses.replace(self._scene, instances=instances))
        return Exchanged(tracer, rows, tracer.build(rows))


def with_levels(loop: Loop, keep: NDArray[np.bool_], levels: Sequence[tuple[I64, Alternative]]) -> Exchanged:
    """A loop's frame where keep, (N,) bool, stays, with what takes the place of the meshes of rows of it. Raises
    ValueError where one of these emits."""
    exchange, mesh = Exchange(loop, [level.mesh for _, level in levels]), loop.scene.instances.mesh.copy()
    for k, (rows, _) in enumerate(levels):
        mesh[rows] = exchange.first + k
    emissive = emissive_instances(loop.scene)
    if (mesh[emissive] != loop.scene.instances.mesh[emissive]).any():
        raise ValueError("a mesh that emits is to be exchanged")
    return exchange.with_meshes(mesh, keep)
