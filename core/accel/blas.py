"""Bottom-level structures: one BLAS per mesh, shared by its instances, there only while somebody needs it."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from ..arrays import I32, I64, Records
from ..scene.mesh import MESH, Mesh, loaded, record
from . import embree
from .region_tree import spatial_order

RUN, RUNS = 8, 64  # triangles that were neighbours when a BLAS was built, and how many such runs are looked at
# growth of the boxes of such runs (surface area) at which a BLAS is built anew instead of refitted: there rays take 1.4
# times as long
REBUILD_SAH_RATIO = 4.0
CHECK_INTERVAL = 8  # refits from one check to the next: checking takes as long as refitting a small mesh
# bytes of Embree 4.4's compact structure, per BLAS and per triangle: within a third of what is measured, over meshes
# of 12 to 500,000 triangles
BLAS_BYTES, TRIANGLE_BYTES = 1152, 36


@dataclass(eq=False)
class _Blas:
    """A loaded mesh with its Embree scene; `mesh` keeps the arrays alive that Embree and the kernels read. geometry: 0
    where it is never to be refitted.

    runs: (R, RUN) triangles that were neighbours when it was built; spread: of these runs, then (`_spread`); refits:
    how many since then.
    """

    mesh: Mesh
    scene: int
    geometry: int
    runs: I32
    spread: float
    refits: int = 0
    bytes: int = 0
    seconds: float = 0.0


def _runs(mesh: Mesh) -> I32:
    """Up to RUNS runs of RUN neighbouring triangles of a mesh: (R, RUN) int32."""
    corners = mesh.positions[mesh.triangles]
    order = spatial_order(np.stack((corners.min(axis=1), corners.max(axis=1)), axis=1))
    runs = order[: len(order) // RUN * RUN].reshape(-1, RUN)
    return runs[:: -(-len(runs) // RUNS) or 1]


def _spread(mesh: Mesh, runs: I32) -> float:
    """How far runs of triangles spread: the surface of their boxes, relative to that of the box around all of them."""
    if not len(runs):
        return 0.0
    corners = mesh.positions[mesh.triangles[runs].reshape(len(runs), -1)]
    low, high = corners.min(axis=1), corners.max(axis=1)
    extents, whole = (high - low).astype(np.float64), (high.max(axis=0) - low.min(axis=0)).astype(np.float64)
    return float((extents * extents[:, (1, 2, 0)]).sum() / max((whole * whole[[1, 2, 0]]).sum(), 1e-300))


@dataclass
class Work:
    """BLAS work done: how many were built and refitted, and the seconds of either, reading the meshes included, on
    whatever thread."""

    built: int = 0
    refitted: int = 0
    build_s: float = 0.0
    refit_s: float = 0.0


class BlasCache:
    """The meshes of a scene that are loaded and built.

    table: (M,) of MESH; scenes: (M,) uint64 Embree handles, 0 where there is none; bytes_of: (M,) int64, Embree's
    memory per BLAS, as measured: it varies a little with the number of builder threads, and from run to run.
    work: what was done since somebody last put a new `Work` there. refused: meshes that did not fit into the limit when
    one was last given.
    """

    def __init__(self, meshes: Sequence[Mesh], device: embree.Device | None = None) -> None:
        self.device = device or embree.shared_device()
        self._meshes = meshes
        self._built: dict[int, _Blas] = {}
        # builds on another thread, each with its number of triangles
        self._coming: dict[int, tuple[Future[_Blas], int]] = {}
        self._stale: set[int] = set()  # built, or coming, from vertices of an earlier frame
        self._worker: ThreadPoolExecutor | None = None
        self._rate = 1e-6  # seconds per triangle of the latest builds
        self.table: Records = np.zeros(len(meshes), MESH)
        self.scenes = np.zeros(len(meshes), np.uint64)
        self.bytes_of = np.zeros(len(meshes), np.int64)
        self._known = np.zeros(len(meshes), np.int64)  # bytes_of when it was last built
        self._deforms = np.zeros(len(meshes), bool)
        self.refused = np.zeros(0, np.int64)
        self.work = Work()

    @property
    def bytes(self) -> int:
        """Embree's bytes in all BLASes held now."""
        return int(self.bytes_of.sum())

    @property
    def counted_bytes(self) -> I64:
        """(M,) int64 bytes of each BLAS by its number of triangles, 0 where there is none. For decisions: these must
        not depend on threads."""
        return np.where(self.scenes != 0, BLAS_BYTES + TRIANGLE_BYTES * self.table["triangle_count"], 0)

    def __len__(self) -> int:
        return len(self._built)

    def advance(self, meshes: Sequence[Mesh], deformed: I32, replaced: I32) -> None:
        """Go on to the next frame's meshes: `core.scene.change.Change` says what deformed and replaced are. Nothing is
        read or built; BLASes with an index beyond these meshes, which were parts of others, are freed."""
        self._meshes = meshes
        for index in [i for i in (*self._built, *self._coming) if i >= len(meshes)]:
            self._free(index)
        for name in ("table", "scenes", "bytes_of", "_known", "_deforms"):
            old = getattr(self, name)[: len(meshes)]
            setattr(self, name, np.concatenate([old, np.zeros(len(meshes) - len(old), old.dtype)]))
        for index in replaced.tolist():
            self._free(index)
        self._known[replaced] = 0
        self._deforms[replaced] = False
        self._deforms[deformed] = True
        self._stale.update(i for i in deformed.tolist() if i in self._built or i in self._coming)

    def need(self, meshes: np.ndarray, step: Callable[[int, int], None] | None = None) -> int:
        """Load and build what is missing of meshes (indices, repeats allowed), and refit what has deformed. step(done,
        of) is called after each.

        Returns how many were built or refitted. Raises MemoryError where Embree runs out.
        """
        wanted = np.unique(meshes)
        missing = wanted[self.scenes[wanted] == 0].tolist()
        stale = sorted(self._stale.intersection(wanted.tolist())) if self._stale else []
        for done, index in enumerate([*stale, *missing], 1):
            if index in self._built:
                self._refit(index)
            else:
                self._install(index, self._build(index, self._load(index)))
            if step:
                step(done, len(stale) + len(missing))
        return len(stale) + len(missing)

    def provide(
        self, meshes: np.ndarray, seconds: float, limit: int, step: Callable[[int, int], None] | None = None
    ) -> None:
        """`need` within bounds. meshes: distinct indices, the most valuable first.

        limit: bytes of all BLASes together, 0 for any: what is not among meshes is freed, and of meshes the least
        valuable, or they are not built. seconds: of work to start in this frame, 0 for any: what has deformed is
        refitted first, then what is missing is read here and built by another thread, to be there in one of the next
        frames; at least one of each, so that all come in the end.
        """
        if limit:
            meshes = self._affordable(meshes, limit)
        if not seconds:
            self.need(meshes, step)
            return
        self._collect()
        spent = 0.0
        for index in meshes.tolist() if self._stale else ():
            if index in self._stale and index in self._built:
                spent += self._refit(index)
                if spent > seconds:
                    break
        for index in meshes[self.scenes[meshes] == 0].tolist():
            if self._coming and spent + self._rate * self._ahead() >= seconds:
                break
            if index not in self._coming:
                mesh = self._load(index)
                self._worker = self._worker or ThreadPoolExecutor(1, "blas")
                self._coming[index] = (self._worker.submit(self._build, index, mesh), len(mesh.triangles))

    def built(self, meshes: np.ndarray) -> tuple[object, ...]:
        """What keeps the BLASes of meshes (indices), and the arrays that they read, for as long as it is held, whatever
        is freed here."""
        return tuple(self._built[index] for index in meshes.tolist())

    def keep_only(self, meshes: np.ndarray) -> None:
        """Let go of every BLAS, and its mesh, that is not among meshes (indices): it is freed once no TLAS holds it."""
        kept = set(np.unique(meshes).tolist())
        for index in [i for i in (*self._built, *self._coming) if i not in kept]:
            self._free(index)

    def _affordable(self, meshes: np.ndarray, limit: int) -> np.ndarray:
        """As many of the first of meshes as fit into limit bytes, by what they took when they were last built; all
        others are freed."""
        known = self._known[meshes]
        guess = int(known[known > 0].mean()) if (known > 0).any() else 0
        fits = np.cumsum(np.where(known > 0, known, guess)) <= limit
        self.keep_only(meshes[fits])
        self.refused = meshes[~fits]
        return meshes[fits]

    def _load(self, index: int) -> Mesh:
        """Read a mesh, here: what produces `Scene.meshes` need not be safe on other threads."""
        start = time.perf_counter()
        mesh = loaded(self._meshes[index])
        self._stale.discard(index)
        self.work.build_s += time.perf_counter() - start
        return mesh

    def _build(self, index: int, mesh: Mesh) -> _Blas:
        """Build the BLAS of a loaded mesh, on any thread; what has deformed once, for refitting."""
        return _built(self.device, mesh, bool(self._deforms[index]), f"the BLAS of mesh {index}")

    def _refit(self, index: int) -> float:
        """Bring a built BLAS to the mesh's present vertices; build it anew where it was not built for refitting, has
        other triangles, or its tree has degraded (REBUILD_SAH_RATIO). Returns seconds."""
        start = time.perf_counter()
        blas, source = self._built[index], self._meshes[index]
        same = source.positions.shape == blas.mesh.positions.shape and np.array_equal(
            source.triangles, blas.mesh.triangles
        )
        blas.refits += 1
        degraded = (
            same
            and blas.refits % CHECK_INTERVAL == 0
            and _spread(source, blas.runs) > REBUILD_SAH_RATIO * blas.spread > 0
        )
        if degraded or not (same and blas.geometry):
            self._free(index)
            self._install(index, self._build(index, loaded(source)))
        else:
            mesh = loaded(source, blas.mesh.positions)
            blas.mesh = dataclasses.replace(mesh, triangles=blas.mesh.triangles)  # Embree reads those
            lib = embree.lib
            lib.rtcUpdateGeometryBuffer(blas.geometry, embree.BUFFER_VERTEX, 0)
            lib.rtcCommitGeometry(blas.geometry)
            self.bytes_of[index] += self.device.commit(
                blas.scene, f"refit the BLAS of mesh {index} with {len(blas.mesh.triangles):,} triangles"
            )
            self.table[index] = record(blas.mesh)
            self.work.refitted += 1
            self.work.refit_s += time.perf_counter() - start
        self._stale.discard(index)
        return time.perf_counter() - start

    def _install(self, index: int, blas: _Blas) -> None:
        """Enter a built BLAS into the tables."""
        self._built[index] = blas
        self.scenes[index], self.bytes_of[index], self._known[index] = blas.scene, blas.bytes, blas.bytes
        self.table[index] = record(blas.mesh)
        self.work.built += 1
        self.work.build_s += blas.seconds
        if len(blas.mesh.triangles) > 100:
            self._rate = blas.seconds / len(blas.mesh.triangles)

    def _collect(self) -> None:
        """Enter what the other thread has finished."""
        for index in [i for i, (future, _) in self._coming.items() if future.done()]:
            self._install(index, self._coming.pop(index)[0].result())

    def _ahead(self) -> int:
        """Triangles that the other thread has still to build."""
        return sum(triangles for future, triangles in self._coming.values() if not future.done())

    def _free(self, index: int) -> None:
        """Forget a mesh and its BLAS, also one that is still being built."""
        if index in self._coming:
            self._coming.pop(index)[0].cancel()
        if self._built.pop(index, None) is not None:
            self.table[index] = np.zeros((), MESH)
            self.scenes[index] = self.bytes_of[index] = 0
        self._stale.discard(index)


def _built(device: embree.Device, mesh: Mesh, refits: bool, name: str) -> _Blas:
    """Build the BLAS of a loaded mesh. refits: as a two-level structure, which Embree can refit."""
    start = time.perf_counter()
    lib = embree.lib
    geometry = lib.rtcNewGeometry(device.handle, embree.GEOMETRY_TRIANGLE)
    if len(mesh.triangles):
        embree.shared_buffer(geometry, embree.BUFFER_VERTEX, embree.FORMAT_FLOAT3, mesh.positions, 12)
        embree.shared_buffer(geometry, embree.BUFFER_INDEX, embree.FORMAT_UINT3, mesh.triangles, 12)
    lib.rtcSetGeometryMask(geometry, 0xFFFFFFFF)  # the ray's mask is tested against the instance's alone
    if refits:
        lib.rtcSetGeometryBuildQuality(geometry, embree.QUALITY_REFIT)
    lib.rtcCommitGeometry(geometry)
    if refits:
        scene = device.new_scene(embree.SCENE_ROBUST | embree.SCENE_COMPACT | embree.SCENE_DYNAMIC, embree.QUALITY_LOW)
    else:
        scene = device.new_scene(embree.SCENE_ROBUST | embree.SCENE_COMPACT)
    lib.rtcAttachGeometry(scene, geometry)
    lib.rtcReleaseGeometry(geometry)  # the scene holds it
    runs = _runs(mesh) if refits else np.zeros((0, RUN), np.int32)
    blas = _Blas(mesh, scene, geometry if refits else 0, runs, _spread(mesh, runs))
    device.own(scene, blas)
    blas.bytes = device.commit(scene, f"build {name} with {len(mesh.triangles):,} triangles")
    blas.seconds = time.perf_counter() - start
    return blas
