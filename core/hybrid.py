"""From passes of a raster and light paths to one picture.

The raster shows every instance; the light that paths bring to its hits comes from what is built alone. Shadows of lamps are traced where the blocker is built.
Where it is culled, the raster's shadow maps know: they tell which share v of a lamp's light arrives at all, and paths tell which share meets nothing that is
built and crosses no box of what is culled (clear), which crosses such a box (maybe), and which something built blocks (blocked). Only the light that crosses
boxes is in doubt, so the raster decides over it alone:

    clear + s maybe = v (clear + maybe + blocked),  0 <= s <= 1

With nothing culled there is no doubt, and shadows are exactly the traced ones; with everything culled they are exactly the raster's.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from . import path_state
from .culling import CullOptions
from .errors import InputError
from .film import LUMINANCE, Picture
from .loop import CullingResult, Loop
from .placing import LARGEST
from .regions import spatial_order
from .scene import F32, F64, Scene

MOST_BOXES = 1 << 17  # before lamps: 14 MB of them, built in a fifth of a second
SURE = 0.03  # mean change of a picture up to which it is taken to be nearer to the truth than a raster without paths
CELL = 4  # pixels of an analysis' picture, each way, that are compared as one
CLEARLY = 0.9  # of the raster's error: what is not less than that is shown by the raster
MODES = ("path", "diffuse-1", "reflections", "none")


def with_mode(scene: Scene, mode: str) -> Scene:
    """The scene with the bounces of a mode: all of the scene's own; one bounce of each kind; reflections and refractions but no diffuse bounce.

    Light of lamps, emitters and sky at a hit does not count as a bounce. With "none" nothing is traced. Raises InputError for an unknown mode.
    """
    limits = scene.limits
    if mode == "diffuse-1":
        limits = dataclasses.replace(limits, total=min(limits.total, 2), diffuse=min(limits.diffuse, 1), glossy=min(limits.glossy, 1), transmission=2)
    elif mode == "reflections":
        limits = dataclasses.replace(limits, diffuse=0)
    elif mode not in MODES:
        raise InputError(f"unknown global illumination '{mode}': choose one of {', '.join(MODES)}")
    return dataclasses.replace(scene, limits=limits)


def boxes_before_lamps(bounds: F32, culled: NDArray[np.bool_], most: int = MOST_BOXES) -> F32:
    """World boxes (B, 2, 3) float32 that stand for culled, (N,) bool, instances on the way to a lamp; bounds: (N, 2, 3). What crosses none is in no doubt.

    Each instance has its own; where there are more than `most`, so many neighbours share one that there are not.
    """
    there = culled & (bounds[:, 0] <= bounds[:, 1]).all(axis=1) & (np.abs(bounds) <= LARGEST).all(axis=(1, 2))
    boxes = bounds[there]
    if len(boxes) <= most:
        return boxes
    boxes = boxes[spatial_order(boxes)]
    starts = np.arange(0, len(boxes), -(-len(boxes) // most))
    return np.stack([np.minimum.reduceat(boxes[:, 0], starts), np.maximum.reduceat(boxes[:, 1], starts)], axis=1)


def in_question(result: CullingResult) -> bool:
    """Whether a raster without any path might be nearer to the truth than a picture without what is culled: much has changed, or nobody measured how much."""
    return len(result.boxes) > 0 and not result.stats.get("calibrated_mean", np.inf) <= SURE


def reference(scene: Scene, options: CullOptions, cancelled: Callable[[], bool]) -> F32:
    """Luminance (h, w) float32 of the picture with nothing culled that light paths ask for, of the size of an analysis by these options. Raises Cancelled."""
    loop = Loop(scene, dataclasses.replace(options, policy="light-paths", min_share=None, blas_budget_bytes=0, blas_budget_ms=0.0), cancelled)
    loop.run()
    assert loop.measured is not None
    return (loop.measured.log.luminance.mean(axis=2) * np.float32(scene.film.exposure)).astype(np.float32)


def is_nearer(truth: F32, picture: F32, raster: F32) -> bool:
    """Whether a picture is clearly nearer to the truth than a raster. truth: (h, w) luminance, noisy; the others (H, W, 3 or more), at least as large.

    By relMSE of means over CELL x CELL pixels of the truth, whose noise is all but gone there.
    """
    rows, columns = (-(-n // CELL) for n in truth.shape)
    true, *errors = (_cells(p if p.ndim == 2 else p[..., :3] @ LUMINANCE, rows, columns) for p in (truth, picture, raster))
    ours, theirs = (float(((e - true) ** 2 / (true**2 + 0.01)).mean()) for e in errors)
    return ours < CLEARLY * theirs


def _cells(luminance: F32, rows: int, columns: int) -> F64:
    """Means over rows x columns equal parts of a picture (H, W)."""
    y, x = (np.arange(n) * of // n for n, of in zip(luminance.shape, (rows, columns), strict=True))
    cell = (y[:, None] * columns + x[None, :]).ravel()
    return np.bincount(cell, luminance.ravel(), rows * columns) / np.bincount(cell, minlength=rows * columns)


@dataclass(frozen=True)
class Light:
    """Mean light of all passes, (H, W, 3) float32 each, linear, rows bottom up.

    straight: emission and background seen directly. clear, maybe: of lamps, at the first hit. indirect: all other light. alpha: (H, W).
    sampled: (H, W, 3), luminance of lamp samples at the first hit: clear, maybe, blocked.
    """

    straight: F32
    clear: F32
    maybe: F32
    indirect: F32
    alpha: F32
    sampled: F32

    @staticmethod
    def of(pictures: list[Picture]) -> Light:
        """From the passes' pictures, each with parts."""
        samples = np.float32(sum(p.samples for p in pictures))
        total = sum((p.sums for p in pictures[1:]), pictures[0].sums.copy()) / samples
        parts = [p.parts for p in pictures if p.parts is not None]
        part = sum(parts[1:], parts[0].copy()) / samples
        straight, clear, maybe = (part[..., at : at + 3] for at in (path_state.STRAIGHT, path_state.CLEAR, path_state.MAYBE))
        indirect = np.maximum(total[..., :3] - straight - clear - maybe, np.float32(0))
        return Light(straight, clear, maybe, indirect, total[..., 3], part[..., path_state.SAMPLED_CLEAR : path_state.SAMPLED_BLOCKED + 1])

    def doubt(self, visible: F32 | None) -> F32:
        """s (H, W): the share of `maybe` that arrives, where the share `visible` (H, W) of the lamps' light does; all of it where no raster says."""
        clear, maybe, blocked = np.moveaxis(self.sampled, 2, 0)
        if visible is None:
            return np.ones_like(maybe)
        wanted = visible * (clear + maybe + blocked) - clear
        return np.where(maybe > 0, np.clip(wanted / np.maximum(maybe, np.float32(1e-20)), 0, 1), np.float32(1)).astype(np.float32)

    def lamps(self, visible: F32 | None) -> F32:
        """Light of lamps at the first hit, (H, W, 3), shadows of built and of culled instances applied."""
        return self.clear + self.doubt(visible)[..., None] * self.maybe
