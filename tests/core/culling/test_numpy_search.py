"""The search against plain NumPy that was written from docs/method.md: the same sets, by the same paths."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lipac.core.culling.analysis import _search, kept_of
from lipac.core.culling.certificate import Certificate
from lipac.core.culling.loop import Loop, trace_witness
from lipac.core.culling.measurement import Traced
from lipac.core.culling.options import CullOptions
from lipac.core.error_budget.budget import Budget
from lipac.core.error_budget.error_estimate import Light, Reference
from lipac.core.feedback.path_log import RECORD, PathLog
from lipac.core.feedback.tiles import marks
from lipac.core.scene import model as s

from . import numpy_certificate
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


@pytest.mark.parametrize("samples", [1, 4])
@pytest.mark.parametrize(("share", "backdrop"), [(0.02, 0.0), (0.5, 0.0), (0.5, 0.7)])
def test_the_estimate_of_the_page(samples: int, share: float, backdrop: float) -> None:
    """Of changes at random, some of which move light between neighbouring pixels: blocks say more than whole tiles; and
    of a transparent film, of which paths lack the backdrop."""
    rng = np.random.default_rng(3)
    log = PathLog.zeros(50, 90, samples, backdrop=backdrop)
    log.color[:] = rng.gamma(1.0, 1.0, log.color.shape)
    log.color[rng.random(log.shape) < 0.3] -= backdrop
    after = log.color.copy()
    after[:, ::4] *= np.where(rng.random(after[:, ::4].shape[:3]) < share, 0.2, 1.0)[..., None]
    after[:, 1::4] += log.color[:, ::4][:, : after[:, 1::4].shape[1]] - after[:, ::4][:, : after[:, 1::4].shape[1]]
    reference = Reference(log)
    only = np.ones(log.shape, np.uint8)
    ours = Light.of(reference).estimate(reference.compare(only, after, log, reference.nothing))
    path = np.arange(only.size)
    light, record = log.color.reshape(-1, 3), log.records.reshape(-1, RECORD)
    paths = plain.Paths((90, 50), path // samples, path % samples, light, record)
    theirs = paths.change((after.reshape(-1, 3) - light).astype(float), np.zeros(plain.T))
    np.testing.assert_allclose(theirs.error, ours.error, atol=1e-9)
    np.testing.assert_allclose(theirs.average, ours.average, atol=1e-6)  # roots of what nearly cancels
    np.testing.assert_allclose(theirs.sigma, ours.deviation, atol=1e-6)


@pytest.mark.parametrize("mean", [0.01, 0.05])
@pytest.mark.parametrize("name", SCENES)
def test_the_search_of_the_page_finds_the_same_sets(name: str, mean: float) -> None:
    scene: s.Scene = SCENES[name]()
    loop = Loop(scene, CullOptions(width=SIZE[0], paths=8))
    measured = loop.run()
    ids = measured.tlas.ids
    ours = _search(loop, measured, Budget(mean, 5 * mean))
    units = ours.units
    steps = ours.run()

    (traced,) = measured.traced
    mesh = scene.instances.mesh[ids]
    theirs = plain.Units(
        scene.instances.bounds, ids, measured.paths_met(), measured.worth, mesh, loop.blas.counted_bytes[mesh]
    )
    sets, count = plain.search(theirs, trials_of(loop, traced, measured.tlas), (mean, 5 * mean))
    assert len(sets) == len(steps) > 1
    for (cull, change), step in zip(sets, steps, strict=True):
        np.testing.assert_array_equal(theirs.kept(cull), kept_of(loop, units, step.cull, ids))
        np.testing.assert_allclose(change.error, step.estimate.tiles, atol=1e-9)
        np.testing.assert_allclose(change.sigma, step.estimate.deviation, atol=1e-9)
        for confidence in (0.8, 0.99):
            each = 0.5 * (1 + confidence)
            np.testing.assert_allclose(change.upper_mean(each), step.estimate.upper_mean(each), atol=1e-9)
            np.testing.assert_allclose(change.upper_worst(each), step.estimate.upper_worst(each), atol=1e-9)
    assert count == ours.traced


@pytest.mark.parametrize("mean", [0.01, 0.05])
@pytest.mark.parametrize("name", SCENES)
def test_the_certificate_of_the_page_accepts_the_same_set(name: str, mean: float) -> None:
    """By as many paths, with the same bounds."""
    scene: s.Scene = SCENES[name]()
    options, budget = CullOptions(width=SIZE[0], paths=8), Budget(mean, 5 * mean)
    loop = Loop(scene, options)
    measured = loop.run()
    found = _search(loop, measured, budget)
    units = found.units
    sets = [step.cull for step in found.run() if step.cull.any()]
    ids = measured.tlas.ids
    walked = Certificate(loop, measured.next_sample, measured.samples, budget)
    verdict = walked.walk(sets, units, lambda cull: kept_of(loop, units, cull, ids))

    other = Loop(scene, options)  # in the state before the certificate
    again = other.run()
    mesh = scene.instances.mesh[ids]
    met, bytes_of = again.paths_met(), other.blas.counted_bytes[mesh]
    theirs = plain.Units(scene.instances.bounds, ids, met, again.worth, mesh, bytes_of)
    next_sample = again.next_sample

    def look(samples: np.ndarray) -> numpy_certificate.Look:
        nonlocal next_sample
        only = marks(samples, SIZE[1], SIZE[0])
        witness = trace_witness(other, next_sample, only, Budget(0.05 * mean, 0.05 * 5 * mean))
        traced = Traced(witness.log, next_sample, samples)
        next_sample += only.shape[2]
        return numpy_certificate.Look(trials_of(other, traced, witness.tlas), witness.tlas.ids, witness.unknown)

    walk = numpy_certificate.Walk(theirs, (mean, 5 * mean), again.samples, look, other.include)
    plain_sets, _ = plain.search(theirs, trials_of(other, again.traced[0], again.tlas), (mean, 5 * mean))
    cull, change = walk.run(cull for cull, _ in plain_sets if cull.any())
    assert verdict.cull is not None
    np.testing.assert_array_equal(theirs.kept(cull), verdict.keep)
    assert walk.paths == verdict.paths
    if change is not None:
        each = 0.5 * (1 + numpy_certificate.GAMMA)
        np.testing.assert_allclose(change.upper_mean(each), verdict.estimate.upper_mean(each), atol=1e-9)
        np.testing.assert_allclose(change.upper_worst(each), verdict.estimate.upper_worst(each), atol=1e-9)


def test_the_plain_version_is_short_and_needs_nothing_of_ours() -> None:
    text = Path(plain.__file__).read_text()
    assert "lipac" not in text.split('"""', 2)[2]
