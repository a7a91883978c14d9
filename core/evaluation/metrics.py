"""How far a picture is from its reference. Pictures are (H, W, 3) arrays, rows in any one order."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from ..arrays import F32, F64
from ..errors import InputError

TILE = 16  # pixels
_EPSILON = 0.01


def _pair(reference: ArrayLike, test: ArrayLike, dtype: type) -> tuple[np.ndarray, np.ndarray]:
    a: np.ndarray = np.asarray(reference, dtype)[..., :3]
    b: np.ndarray = np.asarray(test, dtype)[..., :3]
    if a.shape != b.shape or a.ndim != 3:
        raise InputError(
            f"pictures of {a.shape[1::-1]} and {b.shape[1::-1]} pixels cannot be compared: render both at one "
            "resolution"
        )
    return np.ascontiguousarray(a), np.ascontiguousarray(b)


def flip(reference: ArrayLike, test: ArrayLike) -> tuple[F32, float]:
    """FLIP: the difference that a person alternating between two displayed pictures sees, 0 to 1 (0: none).

    Args: pictures as displayed, sRGB in [0, 1]. Returns the map (H, W) float32 and its mean, at the customary 67 pixels
    per degree.
    (Andersson et al., "FLIP: A Difference Evaluator for Alternating Images", HPG 2020.) Raises InputError where sizes
    differ.
    """
    import flip_evaluator

    a, b = (np.clip(x, 0.0, 1.0) for x in _pair(reference, test, np.float32))
    difference, mean, _ = flip_evaluator.evaluate(a, b, "LDR", applyMagma=False)
    return np.asarray(difference, np.float32).reshape(a.shape[:2]), float(mean)


def relative_mse(reference: ArrayLike, test: ArrayLike) -> float:
    """relMSE of linear pictures: mean of (test - reference)^2 / (reference^2 + 0.01) (Rousselle, Knaus, Zwicker,
    SIGGRAPH Asia 2011)."""
    a, b = _pair(reference, test, np.float64)
    return float(np.mean((b - a) ** 2 / (a * a + _EPSILON)))


def tile_rmse(reference: ArrayLike, test: ArrayLike, tile: int = TILE) -> F64:
    """Root mean square difference of linear pictures within each tile of `tile` x `tile` pixels (smaller at the far
    edges): (rows, columns) float64."""
    a, b = _pair(reference, test, np.float64)
    return np.sqrt(tile_mean(((b - a) ** 2).mean(axis=2), tile))


def flip_hdr(reference: ArrayLike, test: ArrayLike) -> tuple[F32, float]:
    """HDR-FLIP of linear pictures: FLIP at every exposure at which they could be shown, the largest per pixel. Returns
    as `flip` does.

    (Andersson et al., "Visualizing Errors in Rendered High Dynamic Range Images", Eurographics 2021.) Raises InputError
    where sizes differ.
    """
    import flip_evaluator

    a, b = (np.maximum(x, 0.0) for x in _pair(reference, test, np.float32))
    if not a.any():  # HDR-FLIP finds its exposures in the reference
        a, b = b, a
    if not a.any() or np.array_equal(a, b):
        return np.zeros(a.shape[:2], np.float32), 0.0
    difference, mean, _ = flip_evaluator.evaluate(a, b, "HDR", applyMagma=False)
    return np.asarray(difference, np.float32).reshape(a.shape[:2]), float(mean)


def tile_mean(values: ArrayLike, tile: int = TILE) -> F64:
    """Mean of a map (H, W) within each tile of `tile` x `tile` pixels (smaller at the far edges): (rows, columns)
    float64."""
    v = np.asarray(values, np.float64)
    rows, columns = (np.arange(0, n, tile) for n in v.shape)
    total = np.add.reduceat(np.add.reduceat(v, rows, axis=0), columns, axis=1)
    heights, widths = (np.diff(np.append(s, n)) for s, n in zip((rows, columns), v.shape, strict=True))
    return total / np.outer(heights, widths)


def linear_error(reference: ArrayLike, test: ArrayLike) -> dict[str, float]:
    """HDR-FLIP, relMSE and RMSE of linear pictures, each as mean over the picture and as 99th percentile over tiles
    (`_p99`): a lost shadow is local."""
    a, b = _pair(reference, test, np.float64)
    square = (b - a) ** 2
    flip_map, flip_mean = flip_hdr(a, b)
    relative, rmse = (square / (a * a + _EPSILON)).mean(axis=2), tile_rmse(a, b)
    return {
        "flip": flip_mean,
        "flip_p99": float(np.percentile(tile_mean(flip_map), 99)),
        "relmse": float(relative.mean()),
        "relmse_p99": float(np.percentile(tile_mean(relative), 99)),
        "rmse": float(rmse.mean()),
        "rmse_p99": float(np.percentile(rmse, 99)),
    }


def flicker(reference: Sequence[ArrayLike], test: Sequence[ArrayLike]) -> float:
    """How much a sequence of linear pictures flickers beyond its reference: mean over pixels and pairs of successive
    frames of the change of the difference, relative to the reference's mean. A constant difference does not flicker."""
    pairs = [_pair(a, b, np.float64) for a, b in zip(reference, test, strict=True)]
    if len(pairs) < 2:
        return 0.0
    difference = [b - a for a, b in pairs]
    steps = np.mean([np.abs(y - x).mean() for x, y in itertools.pairwise(difference)])
    return float(steps / max(np.mean([a.mean() for a, _ in pairs]), 1e-30))


def error(reference: ArrayLike, test: ArrayLike, reference_shown: ArrayLike, test_shown: ArrayLike) -> dict[str, float]:
    """The named metrics of report.json: `flip` of the displayed pictures, and of the linear ones `relmse`, `rmse` and
    `rmse_p99` over tiles."""
    tiles = tile_rmse(reference, test)
    return {
        "flip": flip(reference_shown, test_shown)[1],
        "relmse": relative_mse(reference, test),
        "rmse": float(tiles.mean()),
        "rmse_p99": float(np.percentile(tiles, 99)),
    }
