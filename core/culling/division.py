"""Large meshes divided into parts, as light paths ask for them: a level of the region tree below the instance.

An instance whose mesh may be divided is a box like any other until paths ask for it. Then its mesh is read, and its
parts, runs of neighbouring triangles, take its place: each an instance with a hitbox, a state and a BLAS of its own,
which paths ask for in turn. So whole meshes are never built where parts do, and what nobody asks for is never read.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..accel.halving import halved
from ..accel.triangulation import own_vertices
from ..arrays import F32, I32, I64
from ..files.scratch import Rows, Scratch
from ..scene.bounds import world_bounds
from ..scene.mesh import Mesh, MeshSequence, divided_from
from ..scene.model import InstanceFlag, Instances, Scene
from ..scene.render_costs import RenderCosts
from ..tracing.lights.lights import emissive_instances
from .options import CullOptions, State
from .policies import LIGHT_PATHS
from .result import CullingResult

PART = 256  # triangles of a part: with fewer more is culled, with more the parts' own structures are smaller


@dataclass(frozen=True)
class Parts:
    """A mesh in parts, which waits on disk: part by part, with vertices of their own.

    boxes: (P, 2, 3) float32, object space; ends, upto: (P,) int64 where each ends in what is stored of T triangles and
    of vertices. order: (T,) int32 triangles of the mesh; face: (T,) int32 their faces, of which there are `faces_of`.
    positions, triangles, normals, uvs, slots: as of `Mesh`, uvs (T, K, 3, 2); triangles by the part's own vertices.
    """

    boxes: F32
    ends: I64
    upto: I64
    order: Rows
    face: Rows
    faces_of: int
    positions: Rows
    triangles: Rows
    normals: Rows | None
    uvs: Rows | None
    slots: Rows | None

    @staticmethod
    def of(mesh: Mesh, scratch: Scratch) -> Parts:
        """Divide a mesh into runs of up to PART neighbouring triangles."""
        order, ends = halved(mesh.positions, mesh.triangles, PART)
        return Parts._stored(mesh, order, ends, scratch)

    @staticmethod
    def by(mesh: Mesh, faces: NDArray[np.bool_], scratch: Scratch) -> Parts:
        """Divide a mesh into two: the triangles of faces, (F,) bool, of which there are some, and the others, likewise.
        Raises ValueError where the mesh has another number of faces."""
        if len(faces) != _faces_of(mesh):
            raise ValueError("a mesh with other faces")
        first = faces if mesh.faces is None else faces[mesh.faces]
        order = np.argsort(~first, kind="stable").astype(np.int32)
        ends = np.array([np.count_nonzero(first), len(first)])
        return Parts._stored(mesh, order, ends, scratch)

    @staticmethod
    def _stored(mesh: Mesh, order: I32, ends: I64, scratch: Scratch) -> Parts:
        vertices, triangles, upto = own_vertices(mesh.triangles, order, ends, len(mesh.positions))
        normals, uvs, slots = mesh.normals, mesh.uvs, mesh.slots
        positions, places = mesh.positions[vertices], scratch.put(order)
        starts = np.append(0, upto[:-1])
        return Parts(
            np.stack((np.minimum.reduceat(positions, starts), np.maximum.reduceat(positions, starts)), axis=1),
            ends,
            upto,
            places,
            places if mesh.faces is None else scratch.put(mesh.faces[order]),
            _faces_of(mesh),
            scratch.put(positions),
            scratch.put(triangles),
            None if normals is None else scratch.put(normals[vertices if normals.ndim == 2 else order]),
            None if uvs is None else scratch.put(uvs.transpose(1, 0, 2, 3)[order]),
            None if slots is None else scratch.put(slots[order]),
        )

    @property
    def sizes(self) -> I64:
        """(P,) triangles of each part."""
        return np.diff(self.ends, prepend=0)

    def part(self, number: int) -> Mesh:
        """One of them, with vertices of its own."""
        rows, vertices = _run(self.ends, number), _run(self.upto, number)
        positions, normals = self.positions[vertices], self.normals
        by_corner = normals is not None and normals.like.ndim == 3
        return Mesh(
            positions,
            self.triangles[rows],
            None if normals is None else normals[rows if by_corner else vertices],
            None if self.uvs is None else self.uvs[rows].transpose(1, 0, 2, 3),
            None if self.slots is None else self.slots[rows],
        )

    def triangles_of(self, parts: Sequence[int]) -> I32:
        """Triangles of the mesh that are in parts, of which there are some."""
        return np.concatenate([self.order[_run(self.ends, number)] for number in parts])

    def faces(self, parts: np.ndarray) -> NDArray[np.bool_]:
        """(F,) bool, faces of the mesh of which a triangle is in one of parts, (P,) bool."""
        out = np.zeros(self.faces_of, bool)
        out[self.face[:][np.repeat(parts, self.sizes)]] = True
        return out


def _run(ends: I64, number: int) -> slice:
    """What is between the end before and that of a number."""
    return slice(int(ends[number - 1]) if number else 0, int(ends[number]))


def _faces_of(mesh: Mesh) -> int:
    return len(mesh.triangles) if mesh.faces is None else int(mesh.faces.max(initial=-1)) + 1


class _Meshes(MeshSequence):
    """Meshes of a scene, and behind them the parts of some."""

    def __init__(self, whole: Sequence[Mesh], divided: Sequence[Parts]) -> None:
        self._whole, self._divided = whole, divided
        self._first = np.cumsum([len(whole), *(len(parts.boxes) for parts in divided)])

    def __len__(self) -> int:
        return int(self._first[-1])

    def mesh(self, index: int) -> Mesh:
        """Of the scene, or a part."""
        if index < len(self._whole):
            return self._whole[index]
        k = int(np.searchsorted(self._first, index, side="right")) - 1
        return self._divided[k].part(index - int(self._first[k]))


class Division:
    """A scene of which more and more meshes are divided.

    scene: its instances as they were, N of them, of which those that are divided exist no more, and behind them the
    parts.
    """

    @staticmethod
    def of(scene: Scene, options: CullOptions, limited: bool) -> Division | None:
        """What is to be divided where light paths decide, in as many rounds as they need; not where builds are limited,
        nor where a raster's first hits lie on whole meshes."""
        wanted = (
            options.parts
            and options.policy == LIGHT_PATHS
            and options.max_iterations > 1
            and not limited
            and not scene.first_hits
        )
        return Division(scene) if wanted and (scene.instances.flags & InstanceFlag.DIVISIBLE).any() else None

    def __init__(self, scene: Scene) -> None:
        """Those are divided whose flags let them (`InstanceFlag.DIVISIBLE`), and whose mesh is nobody else's."""
        instances = scene.instances
        users = np.bincount(instances.mesh, minlength=len(scene.meshes))
        self._from = divided_from(scene.triangles)
        self._whole = self.scene = scene
        self._scratch = Scratch()
        self._may = ((instances.flags & InstanceFlag.DIVISIBLE) != 0) & (users[instances.mesh] == 1)
        self._may[emissive_instances(scene)] = False  # light sampling picks triangles of these
        if scene.triangles is not None:  # so what is too small is not even read
            self._may &= scene.triangles[instances.mesh] >= self._from
        self._rows: list[int] = []
        self._parts: list[Parts] = []

    @staticmethod
    def by(scene: Scene, faces: Mapping[int, NDArray[np.bool_]]) -> Division:
        """What is divided already: of rows of the scene those faces, (F,) bool, that stay, and behind them the others.
        Raises ValueError as `Parts.by`."""
        out = Division(scene)
        out._may[:] = False
        out._rows = list(faces)
        out._parts = [Parts.by(out._read(row), mask, out._scratch) for row, mask in faces.items()]
        out._renew()
        return out

    def divide(self, active: np.ndarray) -> bool:
        """Divide what is active, (N,) bool and perhaps more. Returns whether there was any."""
        count = len(self._rows)
        for row in np.flatnonzero(active[: len(self._may)] & self._may).tolist():
            self._may[row] = False
            mesh = self._read(row)
            if len(mesh.triangles) >= self._from:
                self._rows.append(row)
                self._parts.append(Parts.of(mesh, self._scratch))
        if count == len(self._rows):
            return False
        self._renew()
        return True

    def _read(self, row: int) -> Mesh:
        """The mesh of an instance."""
        return self._whole.meshes[int(self._whole.instances.mesh[row])]

    def _renew(self) -> None:
        whole, rows, boxes = self._whole.instances, np.array(self._rows), [parts.boxes for parts in self._parts]
        owner, mesh = self.owner, len(self._whole.meshes) + np.arange(sum(map(len, boxes)), dtype=np.int32)
        mesh_bounds = np.concatenate([self._whole.mesh_bounds, *boxes])
        bounds = whole.bounds.copy()
        bounds[rows] = np.array([np.inf, -np.inf], np.float32)[:, None]  # what does not exist
        self.scene = dataclasses.replace(
            self._whole,
            instances=Instances(
                np.concatenate([whole.transform, whole.transform[owner]]),
                np.concatenate([whole.mesh, mesh]),
                np.concatenate([whole.slots, whole.slots[owner]]),
                np.concatenate([whole.flags, whole.flags[owner]]),
                np.concatenate([bounds, world_bounds(whole.transform[owner], mesh_bounds, mesh)]),
            ),
            meshes=_Meshes(self._whole.meshes, list(self._parts)),
            mesh_bounds=mesh_bounds,
            render_costs=self._costs(),
        )

    def _costs(self) -> RenderCosts | None:
        """Of a render, by parts."""
        costs = self._whole.render_costs
        if costs is None:
            return None
        meshes = self._whole.instances.mesh[self._rows].tolist()
        return costs.divided(self.owner, list(zip(meshes, [parts.sizes for parts in self._parts], strict=True)))

    def pieces(self, keep: np.ndarray) -> list[tuple[int, I64, I32]]:
        """What stays of each divided mesh: its number, the rows of the parts of it that stay with keep, (N,) bool, and
        their triangles."""
        out = []
        first = self.first
        for row, parts in zip(self._rows, self._parts, strict=True):
            kept = np.flatnonzero(keep[first : first + len(parts.boxes)])
            if len(kept):
                chosen = parts.triangles_of(kept.tolist())
                out.append((int(self._whole.instances.mesh[row]), first + kept, chosen))
            first += len(parts.boxes)
        return out

    @property
    def first(self) -> int:
        """Row of the first part."""
        return len(self._whole.instances)

    @property
    def owner(self) -> I64:
        """(P,) row of the divided instance that each part belongs to."""
        return np.repeat(np.array(self._rows, np.int64), [len(parts.boxes) for parts in self._parts])

    def joined(self, result: CullingResult) -> CullingResult:
        """Of a result for the divided scene, one for the instances as they were: what is divided is active where a part
        is.

        What paths carry through parts adds up; a path that meets several counts several times.
        """
        if not self._rows:
            return result
        n, owner = self.first, self.owner
        state, score, hits, stats = (
            result.state[:n].copy(),
            result.score[:n].copy(),
            result.hits[:n].copy(),
            dict(result.stats),
        )
        active = result.state[n:] == State.ACTIVE
        state[owner[active]] = State.ACTIVE
        np.add.at(score, owner, result.score[n:])
        np.add.at(hits, owner, result.hits[n:])
        ends = np.cumsum([len(parts.boxes) for parts in self._parts])[:-1]
        kept = {
            row: parts.faces(a)
            for row, parts, a in zip(self._rows, self._parts, np.split(active, ends), strict=True)
            if a.any()
        }
        counts = np.bincount(state, minlength=len(State))
        stats |= {
            "instances": n,
            "active": int(counts[State.ACTIVE]),
            "pending": int(counts[State.PENDING]),
            "culled": int(counts[State.CULLED]),
        }
        stats |= {"parts": len(owner), "parts_active": int(active.sum())}
        return dataclasses.replace(result, state=state, score=score, hits=hits, stats=stats, faces=kept)
