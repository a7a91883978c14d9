"""Meshes of what stays, and their simplified versions for a few sizes of error."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...arrays import I32, I64
from ...progress import Progress
from ...scene.mesh import Mesh
from ...scene.model import Scene
from ...tracing.lights.lights import emissive_instances
from ..loop import Loop
from .stand_ins import StandIn, stand_ins

ERRORS = (0.1, 0.2, 0.4, 0.8, 1.6)  # pixels of the picture, of the levels
SMALLEST = 64  # triangles of a mesh for which there are levels
SAVING = 0.05  # of a level's triangles, that the next one has less at the least
NEAR = 0.1  # of an instance's size: what is nearer to the camera counts as that far, for the surface may be farther


@dataclass(frozen=True)
class Candidate:
    """A mesh, by its number in the scene as it was given. rows: instances that show it, or parts of it that stay.
    mesh: what stays of it; chosen: which of its triangles these are, None: all. levels: of what stays; errors: of each,
    in pixels."""

    number: int
    rows: I64
    mesh: Mesh
    chosen: I32 | None
    levels: list[StandIn]
    errors: list[float]


def candidates(loop: Loop, keep: NDArray[np.bool_], progress: Progress) -> Iterator[Candidate]:
    """Meshes of what stays that have levels."""
    scene = loop.scene
    simplifiable = scene.simplifiable
    if simplifiable is None:
        return
    instances = scene.instances
    emits = np.zeros(len(scene.meshes), bool)
    emits[instances.mesh[emissive_instances(scene)]] = True
    whole = keep & (instances.mesh < len(simplifiable))
    order = np.flatnonzero(whole)
    order = order[np.argsort(instances.mesh[order], kind="stable")]
    meshes, starts = np.unique(instances.mesh[order], return_index=True)
    shown: list[tuple[int, I64, I32 | None]] = [
        (int(m), rows, None) for m, rows in zip(meshes, np.split(order, starts[1:]), strict=True)
    ]
    if loop.division is not None:
        shown += loop.division.pieces(keep)
    for done, (number, rows, chosen) in enumerate(shown):
        if not simplifiable[number] or emits[number]:
            continue
        mesh = scene.meshes[number]
        if chosen is not None:
            mesh = _of_these(mesh, chosen)
        if len(mesh.triangles) < SMALLEST:
            continue
        progress(0.1 * done / len(shown), "simplifying meshes")
        pixel = _pixel(scene, rows)
        found = Candidate(number, rows, mesh, chosen, [], [])
        size = len(mesh.triangles)
        for error, level in zip(ERRORS, stand_ins(mesh, [error * pixel for error in ERRORS]), strict=False):
            if 0 < len(level) <= (1 - SAVING) * size:
                found.levels.append(level)
                found.errors.append(error)
                size = len(level)
        if found.levels:
            yield found


def _of_these(mesh: Mesh, chosen: I32) -> Mesh:
    """A mesh with some of its triangles."""
    normals, uvs, slots = mesh.normals, mesh.uvs, mesh.slots
    return Mesh(
        mesh.positions,
        mesh.triangles[chosen],
        normals if normals is None or normals.ndim == 2 else normals[chosen],
        None if uvs is None else uvs[:, chosen],
        None if slots is None else slots[chosen],
    )


def _pixel(scene: Scene, rows: I64) -> float:
    """What is as large as a pixel of the picture at the nearest of instances, in their mesh's space."""
    camera, instances = scene.camera, scene.instances
    size = (camera.frame[1] - camera.frame[0]) / scene.film.width
    scale = np.linalg.norm(instances.transform[rows, :, :3], axis=1).max(axis=1).astype(np.float64)
    scale = np.maximum(scale, 1e-30)
    if camera.orthographic:
        return float(size / scale.max())
    bounds, at = instances.bounds[rows].astype(np.float64), camera.to_world[:, 3]
    away = np.linalg.norm(np.maximum(np.maximum(bounds[:, 0] - at, at - bounds[:, 1]), 0.0), axis=1)
    extent = np.linalg.norm(bounds[:, 1] - bounds[:, 0], axis=1)
    return float((size * np.maximum(away, NEAR * extent) / scale).min())
