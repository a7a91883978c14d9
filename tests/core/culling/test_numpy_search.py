"""The search against plain NumPy that was written from docs/method.md: the same sets, by the same paths."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lipac.core.culling.analysis import _kept, _search
from lipac.core.culling.loop import Loop
from lipac.core.culling.measurement import Traced
from lipac.core.culling.options import CullOptions
from lipac.core.error_budget.budget import Budget
from lipac.core.feedback.path_log import RECORD, PathLog
from lipac.core.feedback.tiles import marks
from lipac.core.scene import model as s

from . import numpy_search as plain
from .test_certificate import SIZE, meadow, wall
from .test_loop import stage


def paths_of(traced: Traced) -> plain.Paths:
    height, width, samples = traced.log.shape
    path = np.flatnonzero(marks(traced.samples, height, width).ravel())
    records, light = traced.log.records.reshape(-1, RECORD)[path], traced.log.color.reshape(-1, 3)[path]
    return plain.Paths((width, height), path // samples, path % samples, light.copy(), records.copy())


def trials_of(loop: Loop, traced: Traced, tlas: plain.Any) -> plain.Trials:
    shape = traced.log.shape
    path = np.flatnonzero(marks(traced.samples, shape[0], shape[1]).ravel())

    def retrace(cull: np.ndarray, affected: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        only, log, keep = (
            np.zeros(np.prod(shape), np.uint8),
            PathLog.zeros(*shape),
            np.zeros(len(loop.activation), bool),
        )
        only[path[affected]] = 1
        keep[tlas.ids[~cull]] = True
        loop.tracer.trace_without(tlas, traced.first_sample, keep, loop.tracer.build(keep), only.reshape(shape), log)
        return log.color.reshape(-1, 3)[path], log.records.reshape(-1, RECORD)[path]

    return plain.Trials(paths_of(traced), len(tlas), retrace)


SCENES = {"wall": wall, "meadow": lambda: meadow(400), "stage": stage}


@pytest.mark.parametrize("mean", [0.01, 0.05])
@pytest.mark.parametrize("name", SCENES)
def test_the_search_of_the_page_finds_the_same_sets(name: str, mean: float) -> None:
    scene: s.Scene = SCENES[name]()
    loop = Loop(scene, CullOptions(width=SIZE[0], paths=8))
    measured = loop.run()
    ids = measured.tlas.ids
    units, ours = _search(loop, measured, Budget(mean, 5 * mean))
    steps = ours.run()

    (traced,) = measured.traced
    mesh = scene.instances.mesh[ids]
    theirs = plain.Units(
        scene.instances.bounds, ids, measured.paths_met(), measured.worth, mesh, loop.blas.counted_bytes[mesh]
    )
    sets, count = plain.search(theirs, trials_of(loop, traced, measured.tlas), (mean, 5 * mean))
    assert len(sets) == len(steps) > 1
    for (cull, change), step in zip(sets, steps, strict=True):
        np.testing.assert_array_equal(theirs.kept(cull), _kept(loop, units, step.cull, ids))
        np.testing.assert_allclose(change.error, step.estimate.tiles, atol=1e-9)
        np.testing.assert_allclose(change.sigma, step.estimate.deviation, atol=1e-9)
        for confidence in (0.8, 0.99):
            each = 0.5 * (1 + confidence)
            np.testing.assert_allclose(change.upper_mean(each), step.estimate.upper_mean(each), atol=1e-9)
            np.testing.assert_allclose(change.upper_worst(each), step.estimate.upper_worst(each), atol=1e-9)
    assert count == ours.traced


def test_the_plain_version_is_short_and_needs_nothing_of_ours() -> None:
    text = Path(plain.__file__).read_text()
    assert "lipac" not in text.split('"""', 2)[2]
