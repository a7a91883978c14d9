"""What a culled scene costs and how wrong it is, measured against the full one.

The judge traces both with the same random numbers, which are not the analysis's: noise that both share cancels, and what is left is the bias of the culling. It
traces in batches, so that every figure comes with a confidence interval.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from .budget import Budget
from .culling import CullOptions
from .feedback import Weights
from .loop import Loop
from .metrics import linear_error
from .progress import Progress, part, silent
from .scene import F32, F64, I32, Scene
from .tiles import DARK, tile_means

SEED = 0x6A7564  # of the judge; an analysis has another one
BATCHES = 4
_TWO_SIDED_95 = 3.182  # Student's t at 3 degrees of freedom


@dataclass(frozen=True)
class Change:
    """Relative change of a picture, as `budget` defines it: mean over the coarse tiles and of the worst one, each with half a 95 % confidence interval.

    tiles: (T,) float64 signed relative change of every coarse tile.
    """

    mean: float
    worst: float
    mean_ci: float
    worst_ci: float
    tiles: F64

    def holds(self, budget: Budget) -> bool:
        """Whether both bounds are kept."""
        return self.mean <= budget.mean and self.worst <= budget.worst


def paired_change(full: F32, culled: F32) -> Change:
    """Change between two stacks of batches, (B, H, W, 3 or 4) float32 each, batch b of both traced with the same random numbers."""
    a = np.stack([tile_means(p) for p in full])
    b = np.stack([tile_means(p) for p in culled])
    base = np.maximum(a.mean(axis=0), max(DARK * a.mean(), 1e-30))
    relative = (b - a) / base
    tiles = relative.mean(axis=0)
    half = _TWO_SIDED_95 * relative.std(axis=0, ddof=1) / np.sqrt(len(full)) if len(full) > 1 else np.full(len(tiles), np.inf)
    size = np.abs(tiles)
    worst = int(size.argmax())
    return Change(float(size.mean()), float(size[worst]), float(np.sqrt((half**2).sum()) / len(half)), float(half[worst]), tiles)


class Judge:
    """The full scene, converged as far as its samples go, to measure others against."""

    def __init__(
        self, scene: Scene, samples: int, threads: int = 0, progress: Progress = silent, cancelled: Callable[[], bool] | None = None
    ) -> None:
        """samples: paths per pixel of the scene's film, a multiple of BATCHES (rounded up)."""
        self.scene = scene
        self.loop = Loop(scene, CullOptions(width=scene.film.width, seed=SEED, threads=threads), cancelled)
        self.per_batch = -(-samples // BATCHES)
        self.samples = self.per_batch * BATCHES
        self.mesh_seconds = np.zeros(len(scene.meshes))
        for mesh in np.unique(scene.instances.mesh[self.loop.exists]):
            start = time.perf_counter()
            self.loop.blas.need(np.array([mesh]))
            self.mesh_seconds[mesh] = time.perf_counter() - start
        tlas = self.loop.build(self.loop.exists)
        self.first_sample = self.loop.next_sample
        self.full = self._batches(lambda k: self.loop.trace(tlas, self.per_batch)[1], part(progress, 0.0, 0.5))
        self.second_seed = self._batches(lambda k: self.loop.trace(tlas, self.per_batch)[1], part(progress, 0.5, 1.0))

    def _batches(self, trace: Callable[[int], F32], progress: Progress, count: int = BATCHES) -> F32:
        out = []
        for k in range(count):
            progress(k / count, f"full picture, {self.samples} paths per pixel")
            out.append(trace(k))
        return np.stack(out)

    def picture(self, keep: np.ndarray, batches: int = BATCHES) -> F32:
        """Batches of the picture with only keep (N,) bool in the scene: (batches, H, W, 4) float32."""
        return np.stack([self.loop.trace_again(keep, self.first_sample + k * self.per_batch, self.per_batch) for k in range(batches)])

    def change(self, keep: np.ndarray, batches: int = BATCHES) -> Change:
        """Change by culling to keep (N,) bool; fewer batches are cheaper and noisier."""
        return paired_change(self.full[:batches], self.picture(keep, batches))

    def measure(self, keep: np.ndarray) -> tuple[dict[str, float], F32]:
        """Error and cost of keep (N,) bool by name, and the mean picture (H, W, 4) float32."""
        start = time.perf_counter()
        culled = self.picture(keep)
        seconds = time.perf_counter() - start
        change, mean = paired_change(self.full, culled), culled.mean(axis=0)
        error = {"mean": change.mean, "mean_ci": change.mean_ci, "worst": change.worst, "worst_ci": change.worst_ci}
        return self.cost(keep) | {"trace_s": seconds} | error | linear_error(self.full.mean(axis=0), mean), mean

    def noise_floor(self) -> dict[str, float]:
        """Error of the full picture with other random numbers: no culling can be seen below it."""
        a, b = self.full, self.second_seed
        change = paired_change(a, b)
        return {"mean": change.mean, "worst": change.worst} | linear_error(a.mean(axis=0), b.mean(axis=0))

    def cost(self, keep: np.ndarray) -> dict[str, float]:
        """What keep (N,) bool takes: counts, Embree's bytes, seconds to build BLASes and TLAS."""
        meshes = np.unique(self.scene.instances.mesh[keep & self.loop.exists])
        start = time.perf_counter()
        tlas = self.loop.build(keep)
        return {
            "active": int(keep.sum()),
            "meshes": len(meshes),
            "blas_bytes": int(self.loop.blas.bytes_of[meshes].sum()),
            "tlas_bytes": int(tlas.bytes),
            "build_s": float(self.mesh_seconds[meshes].sum()),
            "tlas_s": time.perf_counter() - start,
        }

    def exhaustive_weights(self, samples: int, progress: Progress = silent) -> tuple[F64, I32]:
        """What each instance is worth with the whole scene active, from paths that the judge does not use: (A, T) float64, and ids (A,) int32."""
        loop = self.loop
        tlas = loop.build(loop.exists)
        ambient = float(tile_means(self.full.mean(axis=0)).mean())
        weights = Weights.zeros(len(self.scene.instances), tlas.ids, ambient)
        loop.trace(tlas, samples, None, weights, progress)
        return weights.relative(), tlas.ids
