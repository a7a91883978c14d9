"""What culling changed in a frame, measured by the engine that renders it: crops of the picture, rendered full and
culled with the same random numbers.

The analysis states the error that its own path tracer measured. This asks the engine whose picture it is, at the price
of rendering crops of the full scene.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import NormalDist

import bpy
import numpy as np
from numpy.typing import NDArray

from ...core.arrays import F32
from ...core.culling.loop import Loop
from ...core.culling.options import CullOptions
from ...core.error_budget.budget import Budget
from ...core.feedback.picture_change import WIDTH, change_of
from ...core.feedback.tiles import BLOCK, COLUMNS, ROWS
from ...core.files.figures import percent
from ...core.progress import Progress, part, silent
from ...core.scene.model import Scene
from .. import writeback
from ..console import muted
from ..depsgraph import changed
from ..pictures import read_picture, save_pixels
from .engines.blender import render_blender
from .engines.choices import AS_SET, DeviceChoice

GRID = (4, 3)  # crops of a picture, across and up: each has 4 x 3 coarse tiles
PATH_SAMPLES = 64  # of the path tracer, at most
PATH_BYTES = 1 << 30  # of what is kept of paths at a time
PATH_SEED = 0x766572  # so that its random numbers are never those of an analysis
_OF_A_PATH = 13  # bytes: its mark, and its light
NORMAL = NormalDist()
NOISE = 3.0  # standard errors: what is above a bound by less may be noise
Crop = tuple[int, int]


@dataclass(frozen=True)
class Verified:
    """Relative change of the coarse tiles of the crops, by luminance, colour and alpha as the budget counts it: their
    mean, and the worst of them. crops: (K,) columns and rows of GRID, rows from the bottom.

    least_mean, least_worst: what is left of both when what noise may make is taken off, by the pixels' differences: of
    each tile the mean size of its noise, and NOISE standard errors of all tiles; of the worst tile as many standard
    errors as are as rare for the worst of so many as NOISE are for one. tiles: (K, T) of each crop's coarse tiles, in
    rows from the bottom. full_s, culled_s: seconds that the crops took.
    """

    mean: float
    worst: float
    least_mean: float
    least_worst: float
    crops: tuple[Crop, ...]
    tiles: tuple[tuple[float, ...], ...] = ()
    full_s: float = 0.0
    culled_s: float = 0.0

    def entry(self) -> dict[str, object]:
        """For a frame of report.json."""
        crops = [list(crop) for crop in self.crops]
        least = {"verified_least_mean": self.least_mean, "verified_least_worst": self.least_worst}
        tiles = {"verified_grid": list(GRID), "verified_tiles": [list(tiles) for tiles in self.tiles]}
        seconds = {"verified_full_s": self.full_s, "verified_culled_s": self.culled_s} if self.full_s else {}
        return {
            "verified_mean": self.mean,
            "verified_worst": self.worst,
            **least,
            "verified_crops": crops,
            **tiles,
            **seconds,
        }

    def breaks(self, budget: Budget) -> bool:
        """Whether the change is surely above a bound, whatever the noise of the crops."""
        return self.least_mean > budget.mean or self.least_worst > budget.worst

    def warning(self, budget: Budget) -> str:
        """What to tell where it is."""
        return (
            f"verified: the picture changes by {percent(self.mean)} in the mean, {percent(self.worst)} in the "
            "worst tile, which is more than the "
            f"{percent(budget.mean)} and {percent(budget.worst)} that --max-error allows; --enforce repeats the "
            "analysis until it is not"
        )


def random_crops(count: int, seed: int) -> tuple[Crop, ...]:
    """So many different crops."""
    cells = np.random.default_rng(seed).permutation(GRID[0] * GRID[1])[:count]
    return tuple((int(cell % GRID[0]), int(cell // GRID[0])) for cell in sorted(cells))


def verified_blender(
    engine: str,
    stem: Path,
    samples: int | None,
    seed: int,
    threads: int,
    count: int,
    progress: Progress = silent,
    device: DeviceChoice = AS_SET,
    width: int = WIDTH,
) -> Verified:
    """The change of so many crops of the open file's current frame, whose culling is applied and is not afterwards;
    options as of `render_blender`, stem as of `save_crops`, width as of `change`."""
    crops, start = random_crops(count, seed), time.perf_counter()
    culled = _blender_crops(engine, samples, seed, threads, device, crops, part(progress, 0.0, 0.3, "culled, "))
    with muted():
        writeback.restore()
    between = time.perf_counter()
    full = _blender_crops(engine, samples, seed, threads, device, crops, part(progress, 0.3, 1.0, "full, "))
    end = time.perf_counter()
    save_crops(full, culled, crops, stem)
    return replace(change(full, culled, crops, width), full_s=end - between, culled_s=between - start)


def verified_path(
    scene: Scene,
    active: NDArray[np.bool_],
    stem: Path,
    samples: int,
    seed: int,
    threads: int,
    count: int,
    cancelled: Callable[[], bool],
    width: int = WIDTH,
) -> Verified:
    """The change of so many crops of a core scene by the path tracer, with only active, (N,) bool, in it; stem as of
    `save_crops`, width as of `change`. Raises Cancelled."""
    crops = random_crops(count, seed)
    full, culled = _path_crops(scene, active, samples, seed, threads, crops, cancelled)
    save_crops(full, culled, crops, stem)
    return change(full, culled, crops, width)


def save_crops(full: list[F32], culled: list[F32], crops: tuple[Crop, ...], stem: Path) -> None:
    """Keep what was compared of the open scene's picture: stem_full and stem_culled, each as .exr and .png, black where
    there is no crop."""
    scene = bpy.context.scene
    width, height = (
        int(n * scene.render.resolution_percentage / 100)
        for n in (scene.render.resolution_x, scene.render.resolution_y)
    )
    stem.parent.mkdir(exist_ok=True)
    for name, pictures in (("full", full), ("culled", culled)):
        whole = np.zeros((height, width, 4), np.float32)
        for (x, y), picture in zip(crops, pictures, strict=True):
            place = whole[y * height // GRID[1] :, x * width // GRID[0] :][: picture.shape[0], : picture.shape[1]]
            place[:] = picture[: place.shape[0], : place.shape[1]]
        with muted():
            save_pixels(whole, scene, stem.with_name(f"{stem.name}_{name}"))


def _blender_crops(
    engine: str,
    samples: int | None,
    seed: int,
    threads: int,
    device: DeviceChoice,
    crops: tuple[Crop, ...],
    progress: Progress = silent,
) -> list[F32]:
    """Each crop of the open file's current frame, as it is now, by one of Blender's engines: (h, w, 4) float32, not
    denoised: what a denoiser makes of noise is as smooth as a change. Options as of `render_blender`."""
    out = []
    noisy = changed(bpy.context.scene.cycles, use_denoising=False)
    with tempfile.TemporaryDirectory(prefix="lipac") as folder, noisy:
        for k, (x, y) in enumerate(crops):
            stem = Path(folder) / f"{x}{y}"
            border = (x / GRID[0], y / GRID[1], (x + 1) / GRID[0], (y + 1) / GRID[1])
            within = part(progress, k / len(crops), (k + 1) / len(crops))
            render_blender(engine, stem, samples, seed, threads, within, border, device)
            out.append(read_picture(stem.with_suffix(".exr")))
    return out


def _path_crops(
    scene: Scene,
    active: NDArray[np.bool_],
    samples: int,
    seed: int,
    threads: int,
    crops: tuple[Crop, ...],
    cancelled: Callable[[], bool],
) -> tuple[list[F32], list[F32]]:
    """Each crop of a core scene by the path tracer, full and with only active, (N,) bool, in it: (h, w, 4) float32.
    Raises Cancelled."""
    height, width = scene.film.height, scene.film.width
    loop = Loop(scene, CullOptions(width=width, seed=seed ^ PATH_SEED, threads=threads), cancelled)
    columns, rows = np.arange(width) * GRID[0] // width, np.arange(height) * GRID[1] // height
    places = [np.ix_(rows == y, columns == x) for x, y in crops]
    samples = min(samples, PATH_SAMPLES)
    at_once = min(samples, max(PATH_BYTES // (height * width * _OF_A_PATH), 1))
    only = np.zeros((height, width, at_once), np.uint8)
    for place in places:
        only[place] = 1

    def traced(keep: NDArray[np.bool_]) -> F32:
        total = np.zeros((height, width, 4), np.float32)
        for first in range(0, samples, at_once):
            marks = only[:, :, : samples - first]
            total += loop.tracer.trace_paths(keep, first, np.ascontiguousarray(marks))[0] * marks.shape[2]
        total /= samples
        return total

    full, culled = traced(loop.activation.exists), traced(active & loop.activation.exists)
    return [full[place] for place in places], [culled[place] for place in places]


def change(full: list[F32], culled: list[F32], crops: tuple[Crop, ...], width: int = WIDTH) -> Verified:
    """The change between crops that were rendered full and culled. width: of the analysis picture, whose blocks
    count."""
    block = full[0].shape[1] * GRID[0] * BLOCK / width
    found = change_of(full, culled, ROWS // GRID[1], COLUMNS // GRID[0], block)
    tiles = found.tiles
    rare = NORMAL.inv_cdf(1 - (1 - NORMAL.cdf(NOISE)) / (2 * len(tiles)))  # the worst of so many, by two measures
    return Verified(
        float(tiles.mean()),
        float(tiles.max()),
        found.least_mean(NOISE),
        found.least_worst(rare),
        crops,
        tuple(map(tuple, tiles.reshape(len(crops), -1).tolist())),
    )
