"""Counts that are large, sums in any order, states that sit on a threshold."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from lipac.core.accel.blas import BlasCache
from lipac.core.accel.hitboxes import Hitboxes
from lipac.core.accel.tlas import Tlas
from lipac.core.culling.analysis import reaches
from lipac.core.feedback.hits import TILES, Feedback, Weights
from lipac.core.tracing import path_state
from lipac.core.tracing.tracer import prepare, trace

from .case import Figure, case
from .places import still_life

GROUP = "Counters"


def counted(
    start: int, threads: int = 2, first: tuple[int, ...] = (0,), samples: int = 4
) -> tuple[Feedback, np.ndarray]:
    """Feedback of the still life, every counter preset to start; the samples are traced in as many calls as `first` has
    numbers."""
    scene = still_life()
    blas = BlasCache(scene.meshes)
    blas.need(scene.instances.mesh)
    tlas = Tlas(scene.instances, blas, np.arange(len(scene.instances)) < 8)
    boxes = Hitboxes(scene.instances.bounds[8:])
    feedback = Feedback.zeros(len(scene.instances), boxes, Weights.zeros(len(tlas), 0.5))
    assert feedback.weights is not None
    for array in (feedback.hits, feedback.boxes, feedback.weights.light, feedback.weights.total):
        np.add(array, start, out=array)
    prepared, rays = prepare(scene, blas), []
    for number in first:
        rays.append(trace(prepared, tlas, samples, first_sample=number, feedback=feedback, threads=threads).rays)
    return feedback, np.array(rays)


def difference(a: Feedback, b: Feedback, offset: int) -> float:
    """Counters of b that are not those of a plus an offset."""
    assert a.weights is not None and b.weights is not None
    pairs = (
        (a.hits, b.hits),
        (a.boxes, b.boxes),
        (a.weights.light, b.weights.light),
        (a.weights.total, b.weights.total),
    )
    return float(sum((y - x != offset).sum() for x, y in pairs))


@case(GROUP)
def large_counts() -> Iterator[Figure]:
    """Counters that stand at 2^33 or 2^62 go on counting."""
    reference, _ = counted(0)
    for exponent in (33, 62):
        feedback, _ = counted(2**exponent)
        what = f"hits, box crossings and weights preset to 2^{exponent}"
        yield Figure(
            what,
            f"counters that are not 2^{exponent} more than from zero",
            difference(reference, feedback, 2**exponent),
            0.0,
        )


@case(GROUP)
def order_and_threads() -> Iterator[Figure]:
    """The same samples in one call, in four, in reverse order, on one thread and on five."""
    reference, _ = counted(0)
    for name, other in (
        ("one thread", counted(0, 1)),
        ("five threads", counted(0, 5)),
        ("one sample at a time", counted(0, 2, (0, 1, 2, 3), 1)),
        ("one sample at a time, the last first", counted(0, 2, (3, 2, 1, 0), 1)),
    ):
        yield Figure(f"counts and weights, {name}", "counters that differ", difference(reference, other[0], 0), 0.0)


@case(GROUP)
def overflowing_weights() -> Figure:
    """A picture a billion times as bright as expected: weights are capped per event, and sum up without overflow."""
    scene = still_life(brightness=1e9)
    blas = BlasCache(scene.meshes)
    blas.need(scene.instances.mesh)
    tlas = Tlas(scene.instances, blas, np.ones(len(scene.instances), bool))
    weights = Weights.zeros(len(tlas), 1e-30)
    feedback = Feedback.zeros(len(scene.instances), None, weights)
    trace(prepare(scene, blas), tlas, 16, feedback=feedback, strategy=path_state.BOTH)
    relative = weights.relative()
    assert relative.shape == (len(tlas), TILES)
    bad = (
        (weights.light < 0).sum()
        + (weights.total < 0).sum()
        + (~np.isfinite(relative)).sum()
        + (weights.total == 0).all()
    )
    return Figure(
        "a picture 10^39 times as bright as expected", "weights that are negative or not finite", float(bad), 0.0
    )


@case(GROUP)
def on_the_threshold() -> Figure:
    """What exactly a share of the paths meets is kept, and one less is not: all shares k / n with k < n <= 200, read
    from 15 decimals as a user writes them."""
    wrong = products = count = 0
    for n in range(1, 201):
        k = np.arange(1, n)
        share = np.array([float(f"{x:.15g}") for x in k / n])
        exact = share == k / n  # others have more decimals than a user would write
        wrong += int((~reaches(k, n, share))[exact].sum() + reaches(k - 1, n, share)[exact].sum())
        products += int((k < share * n)[exact].sum())
        count += int(exact.sum())
    return Figure(
        f"an instance met by exactly --min-share of the paths, {count:,} shares",
        "wrong states",
        float(wrong),
        0.0,
        "before: share x paths",
        products,
    )
