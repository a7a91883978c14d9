"""Stand-ins: simplified versions of meshes, made of corners that the meshes themselves have.

Edges are contracted to one of their ends, the least change of shape first (quadric error metric: Garland and Heckbert,
"Surface Simplification Using Quadric Error Metrics", SIGGRAPH 1997). So each corner of a stand-in is one of the mesh,
with its position, normal, UVs and whatever else it has, each triangle has the material of one of the mesh, and no value
is made up.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...arrays import F32, F64, I32, I64
from ...scene.mesh import Mesh

FLIP = 60.0  # degrees that the normal of a triangle may turn at most
ALIKE = 3  # decimals in which normals of corners agree that are one


@dataclass(frozen=True)
class StandIn:
    """What is left of a mesh. corners: (S, 3) int32 corners of it, 3 t + k for corner k of its triangle t; triangles:
    (S,) int32, those whose materials the S have."""

    corners: I32
    triangles: I32

    def __len__(self) -> int:
        return len(self.triangles)

    def within(self, chosen: NDArray[np.integer]) -> StandIn:
        """The same where the mesh is (T,) chosen triangles of another."""
        corners = 3 * chosen[self.corners // 3] + self.corners % 3
        return StandIn(corners.astype(np.int32), chosen[self.triangles].astype(np.int32))

    def of(self, mesh: Mesh) -> Mesh:
        """As a mesh with vertices of its own."""
        flat, count = self.corners.reshape(-1), len(self)
        vertices, corners = np.unique(mesh.triangles.reshape(-1)[flat], return_inverse=True)
        uvs, normals = mesh.uvs, mesh.normals
        if normals is not None and normals.ndim == 2:
            normals = normals[vertices]
        elif normals is not None:
            normals = normals.reshape(-1, 3)[flat].reshape(count, 3, 3)
        return Mesh(
            mesh.positions[vertices],
            corners.reshape(-1, 3).astype(np.uint32),
            normals,
            None if uvs is None else uvs.reshape(len(uvs), -1, 2)[:, flat].reshape(len(uvs), count, 3, 2),
            None if mesh.slots is None else mesh.slots[self.triangles],
        )


@dataclass(frozen=True)
class Coarser:
    """A mesh as its program makes it, so many steps coarser; triangles: that it has then."""

    steps: int
    triangles: int

    def __len__(self) -> int:
        return self.triangles


@dataclass(frozen=True)
class Alternative:
    """What may take the place of a mesh, and the mesh that it is then."""

    what: StandIn | Coarser
    mesh: Mesh

    def __len__(self) -> int:
        return len(self.what)


def stand_ins(mesh: Mesh, errors: Sequence[float]) -> list[StandIn]:
    """A stand-in of a mesh for each of these errors, lengths in its space: by how much it deviates at most, as the
    quadrics estimate it. Edges of open surfaces, of UV islands and of normals stay edges, borders between materials
    stay where they are. Empty where the mesh cannot be simplified."""
    from opengl_decimate import SimplifyOptions, collapse_sequence
    from opengl_decimate.types import DecimateError

    points = mesh.positions[mesh.triangles]
    solid = np.flatnonzero((points != points[:, (1, 2, 0)]).any(axis=2).all(axis=1))  # the others have no area
    first, wedge = _wedges(mesh)
    attributes: dict[str, np.ndarray] = {"POSITION": points.reshape(-1, 3)[first].astype(np.float64)}
    normals = _corner_normals(mesh)
    if normals is not None:
        attributes["NORMAL"] = normals[first]
    for k, uvs in enumerate(() if mesh.uvs is None else mesh.uvs):
        attributes[f"TEXCOORD_{k}"] = uvs.reshape(-1, 2)[first]
    options = SimplifyOptions(
        target_ratio=1.0,
        placement="endpoint",
        max_normal_flip=FLIP,
        locked=_between_materials(mesh)[first].nonzero()[0].tolist(),
    )
    try:
        sequence = collapse_sequence(attributes, wedge.reshape(-1, 3)[solid].reshape(-1).astype(np.uint32), options)
    except DecimateError:
        return []
    if len(sequence.faces) != len(solid):  # which of them are left is not said
        return []
    out = []
    for error in errors:
        steps = sequence.steps_for(target_error=error)
        left = solid[(sequence.removed_at < 0) | (sequence.removed_at >= steps)]
        out.append(StandIn(first[sequence.state(steps)[3]].astype(np.int32), left.astype(np.int32)))
    return out


def _corner_normals(mesh: Mesh) -> F32 | None:
    """(3 T, 3) shading normals of corners, None: flat."""
    if mesh.normals is None or mesh.normals.ndim == 3:
        return None if mesh.normals is None else mesh.normals.reshape(-1, 3)
    return np.asarray(mesh.normals[mesh.triangles.reshape(-1)])


def _between_materials(mesh: Mesh) -> NDArray[np.bool_]:
    """(3 T,) corners at places where triangles of several materials meet, by vertices of their own or shared ones."""
    if mesh.slots is None:
        return np.zeros(mesh.triangles.size, bool)
    _, place = np.unique(mesh.positions + np.float32(0), axis=0, return_inverse=True)  # -0 is 0
    corners, slots = place.reshape(-1)[mesh.triangles.reshape(-1)], np.repeat(mesh.slots, 3)
    low, high = np.full(len(mesh.positions), 1 << 16), np.full(len(mesh.positions), -1)
    np.minimum.at(low, corners, slots)
    np.maximum.at(high, corners, slots)
    return np.asarray((low != high)[corners])


def _wedges(mesh: Mesh) -> tuple[I64, I64]:
    """The first corner of each wedge, (W,), and the wedge of each corner, (3 T,): those with the same vertex, normal,
    UVs and material."""
    columns: list[F64] = [mesh.triangles.reshape(-1, 1).astype(np.float64)]
    normals = _corner_normals(mesh)
    if normals is not None:
        columns.append(np.round(normals.astype(np.float64), ALIKE))
    columns += [uvs.reshape(-1, 2).astype(np.float64) for uvs in (() if mesh.uvs is None else mesh.uvs)]
    if mesh.slots is not None:
        columns.append(np.repeat(mesh.slots, 3)[:, None].astype(np.float64))
    rows = np.concatenate(columns, axis=1)
    _, first, wedge = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    return first, wedge.reshape(-1)
