"""From passes of a raster and light paths to one picture.

The raster shows every instance; the light that paths bring to its hits comes from what is built alone. Shadows of lamps
are traced where the blocker is built. Where it is culled, the raster's shadow maps know: they tell which share v of a
lamp's light arrives at all, and paths tell which share meets nothing that is built and crosses no box of what is culled
(clear), which crosses such a box (maybe), and which something built blocks (blocked). Only the light that crosses boxes
is in doubt, so the raster decides over it alone:

    clear + s maybe = v (clear + maybe + blocked),  0 <= s <= 1

With nothing culled there is no doubt, and shadows are exactly the traced ones; with everything culled they are exactly
the raster's.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..accel.region_tree import spatial_order
from ..arrays import F32, F64
from ..culling.loop import Loop
from ..culling.options import CullOptions
from ..culling.result import CullingResult
from ..errors import InputError
from ..scene.bounds import enclosing, existing
from ..scene.film import LUMINANCE, Picture
from ..scene.model import Scene
from ..tracing import path_state
from .modes import MODES

MOST_BOXES = 1 << 17  # before lamps: 14 MB of them, built in a fifth of a second
# limits of the certified error between which the picture fades to the mixture with the raster (linear ramp)
SURE, UNSURE = 0.02, 0.03
CELL = 4  # pixels of an analysis' picture, each way, that are compared as one
# confidence multiplier (sigma): by so many standard errors a share of paths may be too large by chance
DEVIATIONS = 2.0


def with_mode(scene: Scene, mode: str) -> Scene:
    """The scene with the bounces of a mode: all of the scene's own; one bounce of each kind; reflections and
    refractions but no diffuse bounce.

    Light of lamps, emitters and sky at a hit does not count as a bounce. With "none" nothing is traced. Raises
    InputError for an unknown mode.
    """
    limits = scene.limits
    if mode == "diffuse-1":
        limits = dataclasses.replace(
            limits,
            total=min(limits.total, 2),
            diffuse=min(limits.diffuse, 1),
            glossy=min(limits.glossy, 1),
            transmission=2,
        )
    elif mode == "reflections":
        limits = dataclasses.replace(limits, diffuse=0)
    elif mode not in MODES:
        raise InputError(f"unknown global illumination '{mode}': choose one of {', '.join(MODES)}")
    return dataclasses.replace(scene, limits=limits)


def boxes_before_lamps(bounds: F32, culled: NDArray[np.bool_], most: int = MOST_BOXES) -> F32:
    """World boxes (B, 2, 3) float32 that stand for culled, (N,) bool, instances on the way to a lamp; bounds: (N, 2,
    3). What crosses none is in no doubt.

    Each instance has its own; where there are more than `most`, so many neighbours share one that there are not.
    """
    boxes = bounds[culled]
    boxes = boxes[existing(boxes)]
    if len(boxes) <= most:
        return boxes
    return enclosing(boxes[spatial_order(boxes)], -(-len(boxes) // most))


def in_question(result: CullingResult) -> float:
    """How far a raster without any path might be nearer to the truth than a picture without what is culled: 0 where
    that has hardly changed, 1 where it has changed much or nobody measured how much; between SURE and UNSURE in
    proportion, so that frames of a shot do not jump."""
    if not len(result.boxes):
        return 0.0
    return float(np.clip((result.stats.get("certified_mean", np.inf) - SURE) / (UNSURE - SURE), 0.0, 1.0))


def reference(scene: Scene, options: CullOptions, cancelled: Callable[[], bool]) -> F32:
    """Luminance (h, w) float32 of the picture with nothing culled that light paths ask for, of the size of an analysis
    by these options; by other random numbers than theirs, so that its noise is not the picture's. Raises Cancelled."""
    whole = dataclasses.replace(
        options, policy="light-paths", min_share=None, blas_budget_bytes=0, blas_budget_ms=0.0, seed=options.seed ^ 1
    )
    measured = Loop(scene, whole, cancelled).run()
    return (measured.log.luminance.mean(axis=2) * np.float32(scene.film.exposure)).astype(np.float32)


def share_of_paths(truth: F32, picture: F32, raster: F32) -> float:
    """The share w, 0 to 1, by which w picture + (1 - w) raster is nearest to the truth. truth: (h, w) luminance, noisy;
    the others (H, W, 3 or more), at least as large.

    Weighted least squares (weights of relMSE) of means over CELL x CELL pixels of the truth, whose noise is all but
    gone there. The error of such a mixture is a parabola over w: at its bottom at most that of either picture, and up
    to twice as far from 0 as the bottom at most the raster's. The bottom is known to its standard error (White, "A
    Heteroskedasticity-Consistent Covariance Matrix Estimator", Econometrica 1980), and lies DEVIATIONS of them lower in
    the worst case; w is no more than twice that: so the mixture is not worse than the raster by chance.

    A function of the frame alone, and continuous: pictures that change little from frame to frame are shown by shares
    that do.
    """
    rows, columns = (-(-n // CELL) for n in truth.shape)
    true, ours, theirs = (
        _cells(p if p.ndim == 2 else p[..., :3] @ LUMINANCE, rows, columns) for p in (truth, picture, raster)
    )
    weight = 1 / (_around(true) ** 2 + 0.01)  # of cells around: a cell's own noise must not choose its weight
    apart, wanted = ours - theirs, true - theirs
    square = float((weight * apart**2).sum())
    if square == 0:
        return 1.0
    share = float((weight * apart * wanted).sum()) / square
    noise = DEVIATIONS * float(np.sqrt(((weight * apart * (wanted - share * apart)) ** 2).sum())) / square
    return float(np.clip(min(share, 2 * (share - noise)), 0.0, 1.0))


def mixture(picture: F32, raster: F32, share: float) -> F32:
    """share picture + (1 - share) raster, (H, W, C) float32 each."""
    return (np.float32(share) * picture + np.float32(1 - share) * raster).astype(np.float32)


def _around(cells: F64) -> F64:
    """Means of each cell and its neighbours, (rows, columns)."""
    return np.asarray(np.lib.stride_tricks.sliding_window_view(np.pad(cells, 1, mode="edge"), (3, 3)).mean(axis=(2, 3)))


def _cells(luminance: F32, rows: int, columns: int) -> F64:
    """Means over rows x columns equal parts of a picture (H, W): (rows, columns)."""
    y, x = (np.arange(n) * of // n for n, of in zip(luminance.shape, (rows, columns), strict=True))
    cell = (y[:, None] * columns + x[None, :]).ravel()
    means = np.bincount(cell, luminance.ravel(), rows * columns) / np.bincount(cell, minlength=rows * columns)
    return np.asarray(means.reshape(rows, columns))


def added(total: Picture | None, picture: Picture) -> Picture:
    """The sums of two traces with parts; those of total are added to in place. None: of no trace yet."""
    if total is None:
        return picture
    assert total.parts is not None and picture.parts is not None
    np.add(total.sums, picture.sums, out=total.sums)
    np.add(total.parts, picture.parts, out=total.parts)
    counts = {name: getattr(total, name) + getattr(picture, name) for name in ("samples", "paths", "rays")}
    return dataclasses.replace(total, **counts)


@dataclass(frozen=True)
class Light:
    """Mean light, (H, W, 3) float32 each, linear, rows bottom up.

    straight: emission and background seen directly. clear, maybe: of lamps, at the first hit. indirect: all other
    light. alpha: (H, W).
    sampled: (H, W, 3), luminance of lamp samples at the first hit: clear, maybe, blocked.
    """

    straight: F32
    clear: F32
    maybe: F32
    indirect: F32
    alpha: F32
    sampled: F32

    @staticmethod
    def of(picture: Picture) -> Light:
        """From a picture with parts, of one pass or of all (`added`)."""
        assert picture.parts is not None
        total, part = picture.mean, picture.parts / np.float32(picture.samples)
        straight, clear, maybe = (
            part[..., at : at + 3] for at in (path_state.STRAIGHT, path_state.CLEAR, path_state.MAYBE)
        )
        indirect = np.maximum(total[..., :3] - straight - clear - maybe, np.float32(0))
        return Light(
            straight,
            clear,
            maybe,
            indirect,
            total[..., 3],
            part[..., path_state.SAMPLED_CLEAR : path_state.SAMPLED_BLOCKED + 1],
        )

    def doubt(self, visible: F32 | None) -> F32:
        """s (H, W): the share of `maybe` that arrives, where the share `visible` (H, W) of the lamps' light does; all
        of it where no raster says."""
        clear, maybe, blocked = np.moveaxis(self.sampled, 2, 0)
        if visible is None:
            return np.ones_like(maybe)
        wanted = visible * (clear + maybe + blocked) - clear
        return np.where(maybe > 0, np.clip(wanted / np.maximum(maybe, np.float32(1e-20)), 0, 1), np.float32(1)).astype(
            np.float32
        )

    def lamps(self, visible: F32 | None) -> F32:
        """Light of lamps at the first hit, (H, W, 3), shadows of built and of culled instances applied."""
        return self.clear + self.doubt(visible)[..., None] * self.maybe
