"""What a frame's culling decided, and what it built for that."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np

from ..accel.blas import BlasCache
from ..accel.residency import Residency
from ..accel.tlas import Tlas
from ..arrays import F32, I32, I64, U8
from ..tracing.tracer import Prepared
from .levels.stand_ins import Coarser, StandIn
from .options import State


@dataclass(frozen=True)
class Built:
    """Structures of a decided frame: they hold until its loop goes on to the next frame.

    tlas: over the active instances. prepared: lights, tables and camera of the scene with nothing culled.
    """

    blas: BlasCache
    tlas: Tlas
    prepared: Prepared


@dataclass(frozen=True)
class CullingResult:
    """What a frame's culling decided.

    state: (N,) uint8 of `State`; score: (N,) float32 share of paths that met the instance; hits: (N, RAY_TYPES) int64
    paths that met it, by type. boxes: (H, 2, 3) float32 world boxes that stand in for what is culled. faces: by row of
    an active instance whose mesh was divided, (F,) bool, those of its faces that stay. stats: the frame's figures,
    named as in report.json.
    stand_ins: by mesh, what takes its place.
    tiles: (TILES,) float32, by how much each tile of the picture changes at most, where that is certified.
    warnings: what could not be kept to. built: for a renderer of this frame; None where nothing was.
    """

    state: U8
    score: F32
    hits: I64
    boxes: F32
    stats: dict[str, float | int]
    warnings: tuple[str, ...] = ()
    faces: Mapping[int, np.ndarray] = field(default_factory=dict)
    tiles: F32 | None = None
    stand_ins: Mapping[int, StandIn | Coarser] = field(default_factory=dict)
    built: Built | None = field(default=None, repr=False, compare=False)

    @property
    def active(self) -> np.ndarray:
        """(N,) bool."""
        return self.state == State.ACTIVE


def states(keep: np.ndarray, residency: Residency, mesh: I32, active: np.ndarray) -> U8:
    """(N,) `State` of each instance where keep, (N,) bool, stay as far as they have a BLAS. mesh: (N,) of each; active:
    (N,) bool, those that want one."""
    state = np.where(keep, np.uint8(State.ACTIVE), np.uint8(State.CULLED))
    if residency.limited:
        waiting = residency.waiting(mesh, active)
        comes = residency.deferred & ~np.isin(mesh[waiting], residency.blas.refused)
        state[waiting] = np.where(comes, np.uint8(State.PENDING), np.uint8(State.CULLED))
    return state


def structure_figures(state: U8, mesh: I32, blas: BlasCache, tlas_bytes: int) -> dict[str, float | int]:
    """Figures of a frame's states and structures, by their names in report.json. state: (N,); mesh: of each built
    instance."""
    counts, meshes = np.bincount(state, minlength=len(State)), np.unique(mesh)
    return {
        "instances": len(state),
        "active": int(counts[State.ACTIVE]),
        "pending": int(counts[State.PENDING]),
        "culled": int(counts[State.CULLED]),
        "meshes": len(meshes),
        "blas_built": blas.work.built,
        "blas_refitted": blas.work.refitted,
        "triangles": int(blas.table["triangle_count"][meshes].sum()),
        "blas_bytes": int(blas.bytes_of[meshes].sum()),
        "blas_held_bytes": blas.bytes,
        "tlas_bytes": tlas_bytes,
        "blas_s": blas.work.build_s,
        "refit_s": blas.work.refit_s,
    }


@dataclass
class Timer:
    """Seconds per step of the loop."""

    seconds: dict[str, float] = field(default_factory=lambda: {"build_s": 0.0, "trace_s": 0.0, "feedback_s": 0.0})

    @contextmanager
    def step(self, name: str) -> Iterator[None]:
        """Count what a block takes as `build_s`, `trace_s` or `feedback_s`."""
        start = time.perf_counter()
        yield
        self.seconds[name] += time.perf_counter() - start
