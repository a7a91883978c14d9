"""The loop over the frames of a shot: what one frame found out is where the next one begins."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..accel.blas import BlasCache, Work
from ..accel.embree import Device
from ..progress import Progress, silent
from ..scene.change import Change
from ..scene.model import RayType, Scene
from .analysis import decide
from .loop import Loop
from .options import CullOptions
from .policies import LIGHT_PATHS
from .result import CullingResult

How = Callable[[Loop, Progress], CullingResult]


class Shot:
    """Culling over the frames of a shot, one `advance` per frame.

    Each frame starts with what the frame before it needed. Light paths ask for what is missing, and rounds are repeated
    until no more is asked for (at most `CullOptions.max_iterations` of them: with 1, what a frame asks for takes effect
    in the next). So a frame's states are those of a fresh start of that frame, up to hysteresis: an instance that was
    kept stays until it is worth clearly less than what is kept for the first time (`analysis`).

    Frames need not be consecutive; without a `Change` (the first frame, another file, a jump) a frame is a fresh start.
    What is not in the scene any more, and what paths do not ask for, is freed; geometry is read from `Scene.meshes`
    only where it is needed, on the calling thread.

    Independent frames: each decides as a fresh start of it, bit for bit, whatever frames came before, so that a range
    can be split, repeated and completed. What was built for the frame before and did not change is not built again; but
    what deformed is built anew, for refit and rebuild give different trees.

    loop: the loop of the last frame, None before the first.
    """

    def __init__(self, options: CullOptions, device: Device | None = None, independent: bool = False) -> None:
        """device: Embree's, shared by default. independent: frames decide by themselves."""
        self.options = options
        self.independent = independent
        self.device = device
        self.loop: Loop | None = None

    def advance(
        self,
        scene: Scene,
        change: Change | None = None,
        progress: Progress = silent,
        cancelled: Callable[[], bool] | None = None,
        pinned: np.ndarray | None = None,
        how: How = decide,
    ) -> CullingResult:
        """Decide which instances of the next frame stay.

        scene: the frame; where an array did not change it may be the same object as in the last frame, and where
        geometry did not, the same meshes by index. change: how scene differs from the scene of the last call; None for
        a fresh start. pinned: (N,) bool, instances that stay whatever paths meet. how: what is done with the frame's
        loop. The result's stats hold the frame's own figures: seconds, builds, rays of this call alone.

        Raises Cancelled where cancelled() says so (the next call then needs no Change: it starts afresh), MemoryError
        where Embree runs out.
        """
        loop, self.loop = self.loop, None
        if loop is None or change is None:
            loop = Loop(scene, self.options, cancelled, self.device, pinned)
        elif self.independent:
            blas = self._carried(loop.blas, scene, change)
            loop = Loop(scene, self.options, cancelled, self.device, pinned, blas)
        else:
            loop.advance(scene, change, cancelled, pinned)
        result = how(loop, progress)
        seen = result.hits[:, RayType.CAMERA] > 0
        if seen.any() and not result.active.any() and self._judges(scene):
            loop = Loop(scene, self.options, cancelled, self.device, seen)
            result = how(loop, progress)
        self.loop = loop
        return result

    def forget(self) -> None:
        """Let go of the last frame, and what it has built: the next one is a fresh start, whatever its change."""
        self.loop = None

    def _judges(self, scene: Scene) -> bool:
        """Whether a picture without any instance is no picture: things of the brightness of what is behind them, by
        materials that are known approximately, go unseen for nothing. Where a raster shows what is culled, or memory is
        limited, there may be nothing to trace."""
        limited = self.options.blas_budget_bytes or self.options.blas_budget_ms
        return (
            self.options.policy == LIGHT_PATHS and not self.options.by_counts and not scene.first_hits and not limited
        )

    def _carried(self, blas: BlasCache, scene: Scene, change: Change) -> BlasCache:
        """What is built and did not change, for a frame that is to decide by itself. Within a budget nothing: what fits
        depends on what was built before."""
        if self.options.blas_budget_bytes or self.options.blas_budget_ms:
            return BlasCache(scene.meshes, blas.device)
        blas.work = Work()
        blas.advance(scene.meshes, np.zeros(0, np.int32), np.union1d(change.deformed, change.replaced))
        return blas
