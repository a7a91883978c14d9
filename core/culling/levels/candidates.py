"""Meshes of what stays, and what may take their place: simplified versions for a few sizes of error, or coarser ones by
a setting of the program that they come from."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...arrays import F64, I32, I64
from ...progress import Progress
from ...scene.mesh import Mesh
from ...scene.model import Scene
from ...tracing.lights.lights import emissive_instances
from ..loop import Loop
from .stand_ins import Alternative, Coarser, stand_ins

ERRORS = (0.1, 0.2, 0.4, 0.8, 1.6)  # pixels of the picture, of simplified versions
SMALLEST = 64  # triangles of a mesh for which there are levels
SAVING = 0.05  # of a level's triangles, that the next one has less at the least
NEAR = 0.1  # of an instance's size: what is nearer to the camera counts as that far, for the surface may be farther


@dataclass(frozen=True)
class Candidate:
    """A mesh, by its number in the scene as it was given. rows: instances that show it, or parts of it that stay.
    triangles: how many of what stays; chosen: which of the mesh these are, None: all.
    levels: what may take its place, one coarser than the other; errors: of each, in pixels."""

    number: int
    rows: I64
    triangles: int
    chosen: I32 | None
    levels: list[Alternative]
    errors: list[float]


def candidates(loop: Loop, keep: NDArray[np.bool_], progress: Progress) -> Iterator[Candidate]:
    """Meshes of what stays that have levels."""
    scene = loop.scene
    simplifiable, steps = may_be_levelled(scene)
    if not len(simplifiable):
        return
    instances = scene.instances
    emits = np.zeros(len(scene.meshes), bool)
    emits[instances.mesh[emissive_instances(scene)]] = True
    shown = [one for one in _shown(loop, keep, len(simplifiable)) if not emits[one[0]]]
    wanted = [number for number, _, _ in shown if steps[number]]
    coarser = scene.coarser.read(wanted) if wanted and scene.coarser is not None else {}
    for done, (number, rows, chosen) in enumerate(shown):
        progress(0.1 * done / len(shown), "simplifying meshes")
        if number in coarser:
            found = _coarser(loop, number, rows, chosen, coarser)
        elif simplifiable[number]:
            found = _simplified(scene, number, rows, chosen)
        else:
            continue
        if found.levels:
            yield found


def may_be_levelled(scene: Scene) -> tuple[NDArray[np.bool_], I64]:
    """(M,) bool, meshes that may be simplified; (M,) int64, by how many steps they can be coarser. Empty where nothing
    is known of either."""
    simplifiable, coarser = scene.simplifiable, scene.coarser
    count = max(0 if x is None else len(x) for x in (simplifiable, None if coarser is None else coarser.steps))
    return (
        np.zeros(count, bool) if simplifiable is None else simplifiable,
        np.zeros(count, np.int64) if coarser is None else coarser.steps,
    )


def _shown(loop: Loop, keep: NDArray[np.bool_], count: int) -> list[tuple[int, I64, I32 | None]]:
    """The first count meshes as far as they stay: number, rows, and which triangles, None: all."""
    mesh = loop.scene.instances.mesh
    order = np.flatnonzero(keep & (mesh < count))
    order = order[np.argsort(mesh[order], kind="stable")]
    meshes, starts = np.unique(mesh[order], return_index=True)
    pieces: Sequence[tuple[int, I64, I32 | None]] = () if loop.division is None else loop.division.pieces(keep)
    whole = zip(meshes.tolist(), np.split(order, starts[1:]), strict=False)  # of nothing there is one empty piece
    return [*((number, rows, None) for number, rows in whole), *pieces]


def _simplified(scene: Scene, number: int, rows: I64, chosen: I32 | None) -> Candidate:
    """Simplified versions of what stays of a mesh."""
    mesh = scene.meshes[number]
    if chosen is not None:
        mesh = _of_these(mesh, chosen)
    size = len(mesh.triangles)
    found = Candidate(number, rows, size, chosen, [], [])
    if size < SMALLEST:
        return found
    pixel = _pixel(scene, rows)
    for error, level in zip(ERRORS, stand_ins(mesh, [error * pixel for error in ERRORS]), strict=False):
        if 0 < len(level) <= (1 - SAVING) * size:
            found.levels.append(Alternative(level, level.of(mesh)))
            found.errors.append(error)
            size = len(level)
    return found


def _coarser(
    loop: Loop, number: int, rows: I64, chosen: I32 | None, coarser: Mapping[int, Sequence[Mesh]]
) -> Candidate:
    """Coarser versions of a mesh, of which all comes back where only a part has stayed."""
    size = int(loop.blas.table["triangle_count"][number]) if chosen is None else len(chosen)
    found = Candidate(number, rows, size, chosen, [], [])
    pixel = _pixel(loop.scene, rows)
    for k, mesh in enumerate(coarser[number], 1):
        if 0 < len(mesh.triangles) <= (1 - SAVING) * size:
            found.levels.append(Alternative(Coarser(k, len(mesh.triangles)), mesh))
            found.errors.append(_longest_edge(mesh) / 2 / pixel)
            size = len(mesh.triangles)
    return found


def _longest_edge(mesh: Mesh) -> float:
    """A surface through the vertices of a mesh deviates from it by half of that at most, or it turns back within an
    edge."""
    corners = mesh.positions[mesh.triangles].astype(np.float64)
    edges: F64 = np.linalg.norm(corners - corners[:, (1, 2, 0)], axis=2)
    return float(edges.max(initial=0.0))


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
