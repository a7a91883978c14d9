"""What a culled scene costs and how wrong it is, measured against the full one.

The judge traces both with the same random numbers, which are not the analysis's: noise that both share cancels, and
what is left is the bias of the culling. It knows what each path of the full picture met (`path_log`), so the culled one
costs only the paths that met something culled, and every path's own difference tells how sure a figure is.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ..arrays import F32, F64, I32
from ..culling.loop import Loop
from ..culling.options import CullOptions
from ..error_budget.error_estimate import ErrorEstimate, Light, Reference
from ..feedback.hits import Weights
from ..feedback.path_log import PathLog
from ..feedback.picture_change import tile_changes
from ..feedback.tiles import tile_means
from ..progress import Progress, part, silent
from ..scene.model import Scene
from .metrics import linear_error

SEED = 0x6A7564  # of the judge; an analysis has another one
TIMED = 4  # paths per pixel that a set is timed with
TWO_SIDED_95 = 1.96  # standard deviations of a normal distribution


def picture_change(full: F32, other: F32) -> tuple[float, float]:
    """Relative change between two pictures, (H, W, 3 or 4) float32, by luminance and colour as the budget counts it:
    mean over the coarse tiles and of the worst one. The noise of tiles is included, that of single blocks is not."""
    size = tile_changes(full, other)
    return float(size.mean()), float(size.max())


class Judge:
    """The full scene, converged as far as its samples go, to measure others against."""

    def __init__(
        self,
        scene: Scene,
        samples: int,
        threads: int = 0,
        progress: Progress = silent,
        cancelled: Callable[[], bool] | None = None,
    ) -> None:
        """samples: paths per pixel of the scene's film."""
        self.scene = scene
        self.loop = Loop(scene, CullOptions(width=scene.film.width, seed=SEED, threads=threads), cancelled)
        self.samples = samples
        self.mesh_seconds = np.zeros(len(scene.meshes))
        for mesh in np.unique(scene.instances.mesh[self.loop.activation.exists]):
            start = time.perf_counter()
            self.loop.blas.need(np.array([mesh]))
            self.mesh_seconds[mesh] = time.perf_counter() - start
        self.tlas = self.loop.tracer.build(self.loop.activation.exists)
        self.first_sample = self.loop.tracer.next_sample
        self.log = PathLog.zeros(scene.film.height, scene.film.width, samples)
        self.full = self.loop.tracer.trace(
            self.tlas, samples, progress=part(progress, 0.0, 0.5, "full picture, "), log=self.log
        )[1]
        self.second_seed = self.loop.tracer.trace(
            self.tlas, samples, progress=part(progress, 0.5, 1.0, "with another seed, ")
        )[1]
        self.reference = Reference(self.log)
        self.light = Light.of(self.reference)

    def _affected(self, keep: np.ndarray) -> NDArray[np.uint8]:
        """Which paths of the full picture what keep (N,) bool leaves out matters to."""
        return self.log.affected(~keep[self.tlas.ids])

    def change(self, keep: np.ndarray) -> ErrorEstimate:
        """Change by culling to keep (N,) bool."""
        only = self._affected(keep)
        _, color = self.loop.tracer.trace_paths(keep, self.first_sample, only)
        return self.light.estimate(self.reference.compare(only, color, self.log, self.reference.nothing))

    def picture(self, keep: np.ndarray) -> F32:
        """The picture with only keep (N,) bool in the scene, (H, W, 4) float32: the full one, with what has changed in
        it exchanged."""
        only = self._affected(keep)
        before, after = (
            self.loop.tracer.trace_paths(which, self.first_sample, only)[0]
            for which in (self.loop.activation.exists, keep)
        )
        return np.asarray(self.full + (after - before), np.float32)

    def measure(self, keep: np.ndarray) -> tuple[dict[str, float], F32]:
        """Error and cost of keep (N,) bool by name, and the picture (H, W, 4) float32. trace_s: of TIMED paths per
        pixel."""
        change, culled = self.change(keep), self.picture(keep)
        cost = self.cost(keep)
        start = time.perf_counter()
        self.loop.tracer.trace_again(keep, self.first_sample, TIMED)
        cost["trace_s"] = time.perf_counter() - start
        half = TWO_SIDED_95 * change.mean_deviation, TWO_SIDED_95 * change.worst_deviation
        error = {"mean": change.mean, "mean_ci": half[0], "worst": change.worst, "worst_ci": half[1]}
        return cost | error | linear_error(self.full, culled), culled

    def noise_floor(self) -> dict[str, float]:
        """Error of the full picture with other random numbers: no culling can be seen below it."""
        a, b = self.full, self.second_seed
        mean, worst = picture_change(a, b)
        return {"mean": mean, "worst": worst} | linear_error(a, b)

    def cost(self, keep: np.ndarray) -> dict[str, float]:
        """What keep (N,) bool takes: counts, Embree's bytes, seconds to build BLASes and TLAS."""
        meshes = np.unique(self.scene.instances.mesh[keep & self.loop.activation.exists])
        start = time.perf_counter()
        tlas = self.loop.tracer.build(keep)
        return {
            "active": int(keep.sum()),
            "meshes": len(meshes),
            "blas_bytes": int(self.loop.blas.bytes_of[meshes].sum()),
            "tlas_bytes": int(tlas.bytes),
            "build_s": float(self.mesh_seconds[meshes].sum()),
            "tlas_s": time.perf_counter() - start,
        }

    def exhaustive_weights(self, samples: int, progress: Progress = silent) -> tuple[F64, I32]:
        """What each instance is worth with the whole scene active, from paths that the judge does not use: (A, T)
        float64, and ids (A,) int32."""
        weights = Weights.zeros(len(self.tlas), float(tile_means(self.full).mean()))
        self.loop.tracer.trace(self.tlas, samples, weights=weights, progress=progress)
        return weights.relative(), self.tlas.ids
