"""How far a picture is from its reference. Pictures are (H, W, 3) arrays, rows in any one order."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from .errors import InputError
from .scene import F32, F64

TILE = 16  # pixels
_EPSILON = 0.01


def _pair(reference: ArrayLike, test: ArrayLike, dtype: type) -> tuple[np.ndarray, np.ndarray]:
    a: np.ndarray = np.asarray(reference, dtype)[..., :3]
    b: np.ndarray = np.asarray(test, dtype)[..., :3]
    if a.shape != b.shape or a.ndim != 3:
        raise InputError(f"pictures of {a.shape[1::-1]} and {b.shape[1::-1]} pixels cannot be compared: render both at one resolution")
    return np.ascontiguousarray(a), np.ascontiguousarray(b)


def flip(reference: ArrayLike, test: ArrayLike) -> tuple[F32, float]:
    """FLIP: the difference that a person alternating between two displayed pictures sees, 0 to 1 (0: none).

    Args: pictures as displayed, sRGB in [0, 1]. Returns the map (H, W) float32 and its mean, at the customary 67 pixels per degree.
    (Andersson et al., "FLIP: A Difference Evaluator for Alternating Images", HPG 2020.) Raises InputError where sizes differ.
    """
    import flip_evaluator

    a, b = (np.clip(x, 0.0, 1.0) for x in _pair(reference, test, np.float32))
    difference, mean, _ = flip_evaluator.evaluate(a, b, "LDR", applyMagma=False)
    return np.asarray(difference, np.float32).reshape(a.shape[:2]), float(mean)


def relative_mse(reference: ArrayLike, test: ArrayLike) -> float:
    """relMSE of linear pictures: mean of (test - reference)^2 / (reference^2 + 0.01) (Rousselle, Knaus, Zwicker, SIGGRAPH Asia 2011)."""
    a, b = _pair(reference, test, np.float64)
    return float(np.mean((b - a) ** 2 / (a * a + _EPSILON)))


def tile_rmse(reference: ArrayLike, test: ArrayLike, tile: int = TILE) -> F64:
    """Root mean square difference of linear pictures within each tile of `tile` x `tile` pixels (smaller at the far edges): (rows, columns) float64."""
    a, b = _pair(reference, test, np.float64)
    square = ((b - a) ** 2).mean(axis=2)
    rows, columns = (np.arange(0, n, tile) for n in square.shape)
    total = np.add.reduceat(np.add.reduceat(square, rows, axis=0), columns, axis=1)
    heights, widths = (np.diff(np.append(s, n)) for s, n in zip((rows, columns), square.shape, strict=True))
    return np.sqrt(total / np.outer(heights, widths))


def error(reference: ArrayLike, test: ArrayLike, reference_shown: ArrayLike, test_shown: ArrayLike) -> dict[str, float]:
    """The named metrics of report.json: `flip` of the displayed pictures, and of the linear ones `relmse`, `rmse` and `rmse_p99` over tiles."""
    tiles = tile_rmse(reference, test)
    return {
        "flip": flip(reference_shown, test_shown)[1],
        "relmse": relative_mse(reference, test),
        "rmse": float(tiles.mean()),
        "rmse_p99": float(np.percentile(tiles, 99)),
    }
