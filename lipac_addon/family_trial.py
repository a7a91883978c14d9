"""Does a budget hold? One scene of `family`: analysed, culled, and judged by Cycles, whose pictures and random numbers
the analysis knows nothing of."""

from __future__ import annotations

import dataclasses
import gc
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from ..core.arrays import F32
from ..core.culling.analysis import analyze
from ..core.culling.options import CullOptions, State
from ..core.error_budget.budget import Budget
from ..core.evaluation.paired import MEASURES, Change, Pairs, Range
from . import writeback
from .batch.engines.blender import render_blender
from .batch.engines.choices import CPU, DeviceChoice
from .console import muted
from .demo import family
from .extract import extract_frame
from .pictures import read_picture

SAMPLES = 64  # of the first pairs
# at most, each by pairs of twice the samples of the one before: the last ones where the budget may hold and may not
LOOKS = 3
PAIRS = 2  # of a look
JUDGED = ("luminance", "colour")  # by which a budget counts as held; detail is told beside it
SEED = 900_000_000  # of the judge's random numbers, from here on
FEW = 20  # instances that are enough to need every kernel
FIGURES = ("certified_", "unknown_", "predicted_", "calibrated_", "confidence")


def verdict(times: Range) -> str:
    """In a word, of how many times the budget a change surely is: "held", "broken", "twice" (beyond twice the budget),
    or "open", where noise leaves that."""
    if times.low > 2:
        return "twice"
    if times.low > 1:
        return "broken"
    return "held" if times.high <= 1 else "open"


def run(
    seed: int,
    size: tuple[int, int] = family.SIZE,
    samples: int = SAMPLES,
    threads: int = 0,
    instances: int | None = None,
    device: str = CPU,
) -> dict[str, Any]:
    """Build, analyse and judge the scene of a seed; what the record of it holds. The open file is replaced.

    size: of the pictures; samples: per pixel, of the first pairs; instances: rows of the scatter, None as the seed
    draws; device: of Cycles. Raises InputError.
    """
    drawn = family.draw(seed)
    with muted():
        family.build(instances, seed)
    scene = bpy.context.scene
    scene.render.resolution_x, scene.render.resolution_y = size
    record: dict[str, Any] = {"seed": seed, "draw": dataclasses.asdict(drawn)}
    start = time.perf_counter()
    with muted():
        extraction = extract_frame(scene, scene.frame_current)
    synced = time.perf_counter()
    result = analyze(
        extraction.scene, CullOptions(max_error=Budget(drawn.mean, drawn.worst), seed=seed, threads=threads)
    )
    record |= {"sync_s": synced - start, "analysis_s": time.perf_counter() - start}
    culled = np.asarray(result.state == State.CULLED)
    record |= {
        "instances": len(culled),
        "active": int((~culled).sum()),
        "figures": {k: v for k, v in result.stats.items() if k.startswith(FIGURES)},
    }
    record |= {
        "approximated": list(extraction.scene.approximated),
        "warnings": [*extraction.warnings, *result.warnings],
    }
    keys = extraction.keys
    del extraction, result
    gc.collect()

    def apply() -> None:
        with muted():
            record["stays"] = dict(writeback.apply(culled, keys).kept)

    return record | judged(apply, drawn.mean, drawn.worst, samples, threads, SEED + 16 * seed, device)


def warm(threads: int = 0) -> None:
    """Load all kernels, or compile them, by an analysis of a small scene. The open file is replaced."""
    with muted():
        family.build(FEW, 0)
        bpy.context.scene.render.resolution_x, bpy.context.scene.render.resolution_y = 32, 18
        scene = extract_frame(bpy.context.scene).scene
    analyze(scene, CullOptions(threads=threads))


def judged(
    apply: Callable[[], None], mean: float, worst: float, samples: int, threads: int, seed: int, device: str = CPU
) -> dict[str, Any]:
    """The verdict on the open file: rendered by Cycles as it is, and with what `apply` takes out of it, which is put
    back.

    mean, worst: the budget. Where noise does not let it be told there are more looks, LOOKS in all.
    """
    pairs, seconds = Pairs(), []
    for look in range(LOOKS):
        each = samples << look
        pictures: dict[str, list[F32]] = {"full": [], "culled": []}
        for name, shown in pictures.items():
            if name == "culled":
                apply()
            for k in range(PAIRS):
                picture, took = _render(each, seed + PAIRS * look + k, threads, device)
                shown.append(picture)
                seconds += [took] if name == "full" and look == 0 else []
        with muted():
            writeback.restore()
        for full, other in zip(*pictures.values(), strict=True):
            pairs.add(full, other, each)
        changes = pairs.changes()
        times = {name: changes[name].times(mean, worst) for name in MEASURES}
        if all(verdict(times[name]) in ("held", "twice") for name in JUDGED) or any(
            verdict(times[name]) == "twice" for name in JUDGED
        ):
            break
        if look > 0 and any(verdict(times[name]) == "broken" for name in JUDGED):
            break
    return {
        "judge_samples": pairs.samples,
        "cycles_64_s": float(np.median(seconds)) * SAMPLES / samples,
        "changes": {name: dataclasses.asdict(change) for name, change in changes.items()},
        "verdict": worst_of(verdict(times[name]) for name in JUDGED),
        "verdict_mean": worst_of(verdict(_within(changes[name], mean, None)) for name in JUDGED),
        "verdict_worst": worst_of(verdict(_within(changes[name], None, worst)) for name in JUDGED),
        "verdict_detail": verdict(times["detail"]),
        "times": max((times[name] for name in JUDGED), key=lambda r: r.low).low,
    }


def worst_of(verdicts: Any) -> str:
    """The worst of some verdicts."""
    return max(verdicts, key=("held", "open", "broken", "twice").index)


def _within(change: Change, mean: float | None, worst: float | None) -> Range:
    """How many times one of the two bounds."""
    return change.times(np.inf if mean is None else mean, np.inf if worst is None else worst)


def _render(samples: int, seed: int, threads: int, device: str = CPU) -> tuple[F32, float]:
    """A picture of the open file by Cycles, (H, W, 4) float32, and the seconds that it took."""
    with tempfile.TemporaryDirectory(prefix="lipac") as folder:
        stem = Path(folder) / "picture"
        took = render_blender("cycles", stem, samples, seed, threads, device=DeviceChoice.parse(device)).seconds
        with muted():
            return read_picture(stem.with_suffix(".exr")), took
