"""Verification of a frame as its entry for the report, and what follows where it finds the budget broken."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import bpy
import numpy as np

from ...core.culling.policies import NOTHING
from ...core.error_budget.budget import Budget
from ...core.progress import Progress
from ...core.scene.model import Scene
from .engines.wishes import samples_of
from .job import Cancel, Job

if TYPE_CHECKING:
    from .verify import Verified

# times that a frame is analysed again where a verification finds the budget broken, the last time with everything kept
ENFORCED = 4


def verified(
    job: Job, frame: int, scene: Scene | None, active: np.ndarray | None, progress: Progress, cancelled: Cancel
) -> dict[str, object]:
    """What the frame's entry says of the error that was measured, where the job asks for that. scene, active: for an
    engine of ours."""
    if not job.verify:
        return {}
    from .verify import verified_blender, verified_path

    width = job.options.width
    start, stem = time.perf_counter(), job.folder / "verified" / job.stem(frame).name
    if scene is None or active is None:
        found = verified_blender(
            job.engine, stem, job.samples, job.seed, job.threads, job.verify, progress, job.device, width
        )
    else:
        samples = job.samples or samples_of(bpy.context.scene, "path")
        found = verified_path(scene, active, stem, samples, job.seed, job.threads, job.verify, cancelled, width)
    return {**found.entry(), "verify_s": time.perf_counter() - start}


def measured(entry: dict[str, Any]) -> Verified:
    """The verification that a frame's entry tells of; nothing found where it tells of none."""
    from .verify import Verified

    mean, worst, least_mean, least_worst = (
        float(entry.get(f"verified_{name}", 0.0)) for name in ("mean", "worst", "least_mean", "least_worst")
    )
    return Verified(mean, worst, least_mean, least_worst, ())


def broken(entry: dict[str, Any], budget: Budget) -> bool:
    """Whether a verification found that a frame's change is surely above a bound."""
    return measured(entry).breaks(budget)


def tightened(job: Job, entry: dict[str, Any], attempt: int) -> Job:
    """The job with a budget that is as much smaller as the engine's picture is above it, and by half more; at the last
    attempt without culling."""
    if attempt == ENFORCED - 1:
        return replace(job, options=replace(job.options, policy=NOTHING))
    found, budget = measured(entry), job.options.max_error
    share = min(budget.mean / max(found.mean, 1e-9), budget.worst / max(found.worst, 1e-9), 1.0) / 2 ** (attempt + 1)
    return replace(job, options=replace(job.options, max_error=Budget(share * budget.mean, share * budget.worst)))
