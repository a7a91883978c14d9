"""What a culled scene costs and how wrong it is, measured against the full one.

The judge traces both with the same random numbers, which are not the analysis's: noise that both share cancels, and
what is left is the bias of the culling. It knows what each path of the full picture met (`path_log`), so the culled one
costs only the paths that met something culled, and every path's own difference tells how sure a figure is.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..arrays import F32, F64, I32
from ..culling.loop import Loop, brightness
from ..culling.options import CullOptions
from ..error_budget.budget import Budget
from ..error_budget.error_estimate import Difference, ErrorEstimate, Light, Reference
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
PASSES = 16  # at most, of the judge's paths each, where a verdict hangs on noise
SURE = 3.0  # deviations by which a bound is exceeded where it surely is


def picture_change(full: F32, other: F32) -> tuple[float, float]:
    """Relative change between two pictures, (H, W, 3 or 4) float32, by luminance, colour and alpha as the budget counts
    it: mean over the coarse tiles and of the worst one. The noise of tiles is included, that of single blocks is not.
    """
    size = tile_changes(full, other)
    return float(size.mean()), float(size.max())


@dataclass(frozen=True)
class Pass:
    """Paths of the full picture, from a sample number on, and what each met."""

    first_sample: int
    log: PathLog
    reference: Reference


@dataclass(frozen=True)
class Verdict:
    """The change of a set, by as many paths per pixel as it took to tell whether a budget holds. surely: it does, with
    95 % confidence; broken: a bound is exceeded by more than SURE deviations."""

    change: ErrorEstimate
    samples: int
    surely: bool
    broken: bool


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
        self.passes: list[Pass] = []
        self._backdrop = 0.0
        if scene.film.transparent:
            self._backdrop = brightness(self.loop.tracer.trace(self.tlas, 1)[1], scene.film)[2]
        self.full = self._trace(part(progress, 0.0, 0.5, "full picture, "))
        self.second_seed = self._trace(part(progress, 0.5, 1.0, "with another seed, "))

    def _trace(self, progress: Progress = silent) -> F32:
        """One more pass; its picture, (H, W, 4)."""
        log = PathLog.zeros(self.loop.size[1], self.loop.size[0], self.samples, backdrop=self._backdrop)
        first = self.loop.tracer.next_sample
        picture = self.loop.tracer.trace(self.tlas, self.samples, progress=progress, log=log)[1]
        self.passes.append(Pass(first, log, Reference(log)))
        return picture

    def _affected(self, keep: np.ndarray, log: PathLog) -> NDArray[np.uint8]:
        """Which paths of a log of the full picture what keep (N,) bool leaves out matters to."""
        return log.affected(~keep[self.tlas.ids])

    def _difference(self, keep: np.ndarray, k: int) -> Difference:
        """What the paths of the k-th pass differ by with keep (N,) bool."""
        while k >= len(self.passes):
            self._trace()
        one = self.passes[k]
        only = self._affected(keep, one.log)
        _, color = self.loop.tracer.trace_paths(keep, one.first_sample, only, backdrop=self._backdrop)
        return one.reference.compare(only, color, one.log, one.reference.nothing)

    def _estimate(self, difference: Difference, passes: int) -> ErrorEstimate:
        return Light.of(*(one.reference for one in self.passes[:passes])).estimate(difference)

    def change(self, keep: np.ndarray) -> ErrorEstimate:
        """Change by culling to keep (N,) bool, by the first pass."""
        return self._estimate(self._difference(keep, 0), 1)

    def verdict(self, keep: np.ndarray, budget: Budget) -> Verdict:
        """Whether keep (N,) bool holds a budget, by twice as many passes each time until noise does not decide that, or
        by PASSES."""
        difference, passes = self._difference(keep, 0), 1
        while True:
            change = self._estimate(difference, passes)
            surely, broken = change.surely_holds(budget), _broken(change, budget)
            if surely or broken or passes == PASSES:
                return Verdict(change, passes * self.samples, surely, broken)
            for k in range(passes, 2 * passes):
                difference = difference + self._difference(keep, k)
            passes *= 2

    def picture(self, keep: np.ndarray) -> F32:
        """The picture with only keep (N,) bool in the scene, (H, W, 4) float32: the full one, with what has changed in
        it exchanged."""
        one = self.passes[0]
        only = self._affected(keep, one.log)
        before, after = (
            self.loop.tracer.trace_paths(which, one.first_sample, only)[0]
            for which in (self.loop.activation.exists, keep)
        )
        return np.asarray(self.full + (after - before), np.float32)

    def measure(self, keep: np.ndarray) -> tuple[dict[str, float], F32]:
        """Error and cost of keep (N,) bool by name, and the picture (H, W, 4) float32. trace_s: of TIMED paths per
        pixel."""
        change, culled = self.change(keep), self.picture(keep)
        cost = self.cost(keep)
        start = time.perf_counter()
        self.loop.tracer.trace_again(keep, self.passes[0].first_sample, TIMED)
        cost["trace_s"] = time.perf_counter() - start
        return cost | error_of(change) | linear_error(self.full, culled), culled

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


def error_of(change: ErrorEstimate) -> dict[str, float]:
    """Mean and worst tile by name, each with half of its confidence interval of 95 %."""
    half = TWO_SIDED_95 * change.mean_deviation, TWO_SIDED_95 * change.worst_deviation
    return {"mean": change.mean, "mean_ci": half[0], "worst": change.worst, "worst_ci": half[1]}


def _broken(change: ErrorEstimate, budget: Budget) -> bool:
    """Whether a change is surely beyond a budget."""
    worst = change.tiles - SURE * change.deviation
    return bool(change.mean - SURE * change.mean_deviation > budget.mean or worst.max() > budget.worst)
