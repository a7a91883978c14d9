"""What culling changed in a frame, measured by the engine that renders it: crops of the picture, rendered full and culled with the same random numbers.

The analysis states the error that its own path tracer measured. This asks the engine whose picture it is, at the price of rendering crops of the full scene.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..core.culling import CullOptions
from ..core.film import LUMINANCE
from ..core.loop import Loop
from ..core.progress import Progress, part, silent
from ..core.scene import F32, F64, Scene
from ..core.tiles import COLUMNS, DARK, ROWS
from . import writeback
from .console import muted
from .engines import render_blender
from .pictures import read_picture

GRID = (4, 3)  # crops of a picture, across and up: each has 4 x 3 coarse tiles
PATH_SAMPLES = 64  # of the path tracer, at most
Crop = tuple[int, int]


@dataclass(frozen=True)
class Verified:
    """Relative change of the coarse tiles of the crops: their mean, and the worst of them. crops: (K,) columns and rows of GRID, rows from the bottom."""

    mean: float
    worst: float
    crops: tuple[Crop, ...]

    def entry(self) -> dict[str, object]:
        """For a frame of report.json."""
        return {"verified_mean": self.mean, "verified_worst": self.worst, "verified_crops": [list(crop) for crop in self.crops]}


def random_crops(count: int, seed: int) -> tuple[Crop, ...]:
    """So many different crops."""
    cells = np.random.default_rng(seed).permutation(GRID[0] * GRID[1])[:count]
    return tuple((int(cell % GRID[0]), int(cell // GRID[0])) for cell in sorted(cells))


def verified_blender(engine: str, samples: int | None, seed: int, threads: int, count: int, progress: Progress = silent) -> Verified:
    """The change of so many crops of the open file's current frame, whose culling is applied and is not afterwards; options as of `render_blender`."""
    crops = random_crops(count, seed)
    culled = _blender_crops(engine, samples, seed, threads, crops, part(progress, 0.0, 0.3, "culled, "))
    with muted():
        writeback.restore()
    return change(_blender_crops(engine, samples, seed, threads, crops, part(progress, 0.3, 1.0, "full, ")), culled, crops)


def verified_path(
    scene: Scene, active: NDArray[np.bool_], samples: int, seed: int, threads: int, count: int, cancelled: Callable[[], bool]
) -> Verified:
    """The change of so many crops of a core scene by the path tracer, with only active, (N,) bool, in it. Raises Cancelled."""
    crops = random_crops(count, seed)
    return change(*_path_crops(scene, active, samples, seed, threads, crops, cancelled), crops)


def _blender_crops(
    engine: str, samples: int | None, seed: int, threads: int, crops: tuple[Crop, ...], progress: Progress = silent
) -> list[F32]:
    """Each crop of the open file's current frame, as it is now, by one of Blender's engines: (h, w, 4) float32. Options as of `render_blender`."""
    out = []
    with tempfile.TemporaryDirectory(prefix="lipac") as folder:
        for k, (x, y) in enumerate(crops):
            stem = Path(folder) / f"{x}{y}"
            border = (x / GRID[0], y / GRID[1], (x + 1) / GRID[0], (y + 1) / GRID[1])
            within = part(progress, k / len(crops), (k + 1) / len(crops))
            render_blender(engine, stem, samples, seed, threads, within, border)
            out.append(read_picture(stem.with_suffix(".exr")))
    return out


def _path_crops(
    scene: Scene, active: NDArray[np.bool_], samples: int, seed: int, threads: int, crops: tuple[Crop, ...], cancelled: Callable[[], bool]
) -> tuple[list[F32], list[F32]]:
    """Each crop of a core scene by the path tracer, full and with only active, (N,) bool, in it: (h, w, 4) float32. Raises Cancelled."""
    height, width = scene.film.height, scene.film.width
    loop = Loop(scene, CullOptions(width=width, seed=seed, threads=threads), cancelled)
    columns, rows = np.arange(width) * GRID[0] // width, np.arange(height) * GRID[1] // height
    places = [np.ix_(rows == y, columns == x) for x, y in crops]
    only = np.zeros((height, width, min(samples, PATH_SAMPLES)), np.uint8)
    for place in places:
        only[place] = 1
    full, culled = (loop.trace_paths(keep, 0, only)[0] for keep in (loop.exists, active & loop.exists))
    return [full[place] for place in places], [culled[place] for place in places]


def change(full: list[F32], culled: list[F32], crops: tuple[Crop, ...]) -> Verified:
    """The change between crops that were rendered full and culled."""
    a, b = np.concatenate([_tiles(p) for p in full]), np.concatenate([_tiles(p) for p in culled])
    size = np.abs(b - a) / np.maximum(a, max(DARK * float(a.mean()), 1e-30))
    return Verified(float(size.mean()), float(size.max()), crops)


def _tiles(crop: F32) -> F64:
    """Mean luminance of a crop's coarse tiles."""
    luminance = crop[..., :3].astype(np.float64) @ LUMINANCE
    columns, rows = COLUMNS // GRID[0], ROWS // GRID[1]
    y, x = (np.arange(n) * of // n for n, of in zip(luminance.shape, (rows, columns), strict=True))
    tile = (y[:, None] * columns + x[None, :]).ravel()
    return np.bincount(tile, luminance.ravel(), rows * columns) / np.maximum(np.bincount(tile, minlength=rows * columns), 1)
