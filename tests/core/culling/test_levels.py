"""Levels of detail: fewer triangles within the budget, by paths that chose nothing; what may not be exchanged stays
whole."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from lipac.core.culling.analysis import analyze
from lipac.core.culling.levels.stand_ins import StandIn
from lipac.core.culling.loop import Loop
from lipac.core.culling.options import CullOptions, State
from lipac.core.culling.result import CullingResult
from lipac.core.error_budget.budget import Budget
from lipac.core.error_budget.error_estimate import Light, Reference
from lipac.core.feedback.path_log import RECORD, PathLog
from lipac.core.scene import model as s
from lipac.core.scene.mesh import Mesh

from .. import scenes
from .test_budget_cases import CAMERA, material, sun
from .test_division import FLAGS, grid

SIZE = (96, 54)
OPTIONS = CullOptions(width=SIZE[0], max_error=Budget(0.02, 0.1), parts=True, levels=True)


def spheres(simplifiable: bool = True, emission: float = 0.0, parts: bool = False) -> s.Scene:
    """Finely divided spheres far and near on a plate, one of them seen twice; or on a terrain that is divided."""
    ground = grid(100) if parts else grid(8)
    scene = scenes.build(
        [ground, scenes.sphere(48)],
        [
            (0, scenes.placed((0, 0, 0), 60.0), 0),
            (1, scenes.placed((0, 4, 0.7), 0.7), 1),
            (1, scenes.placed((3, 12, 0.7), 0.7), 1),
        ],
        [material(base_color=0.6), material(base_color=0.3, emission=emission)],
        CAMERA,
        sun((1, 0, 1)),
        (0.4, 0.5, 0.7),
        SIZE,
        s.PathLimits(total=1, diffuse=1),
        np.full(3, FLAGS if parts else s.ALL_RAYS, np.uint8),
    )
    return dataclasses.replace(scene, simplifiable=np.full(2, simplifiable))


def change(scene: s.Scene, result: CullingResult) -> tuple[float, float]:
    """What a result changes, in the mean and the worst tile, by many paths of its own."""
    meshes = [result.stand_ins[m].of(mesh) if m in result.stand_ins else mesh for m, mesh in enumerate(scene.meshes)]
    logs = []
    for one, keep in (
        (scene, None),
        (dataclasses.replace(scene, meshes=meshes), result.state == State.ACTIVE),
    ):
        loop = Loop(one, CullOptions(width=SIZE[0], seed=99))
        only = np.ones((SIZE[1], SIZE[0], 32), np.uint8)
        color = loop.tracer.trace_paths(loop.activation.exists if keep is None else keep, 0, only)[1]
        logs.append(PathLog(np.zeros((0, RECORD), np.int32), color))
    reference = Reference(logs[0])
    difference = reference.compare(only, logs[1].color, logs[0], reference.nothing)
    estimate = Light.of(reference).estimate(difference)
    return estimate.mean - estimate.mean_deviation, estimate.worst - 3 * estimate.worst_deviation


def test_less_is_left_within_the_budget() -> None:
    scene = spheres()
    result, whole = analyze(scene, OPTIONS), analyze(scene, dataclasses.replace(OPTIONS, levels=False))
    assert list(result.stand_ins) == [1]
    assert len(result.stand_ins[1]) < 0.67 * len(scene.meshes[1].triangles)
    assert result.stats["triangles"] < 0.67 * whole.stats["triangles"]
    assert result.stats["levels"] == 1
    assert result.stats["levels_triangles"] == len(scene.meshes[1].triangles) - len(result.stand_ins[1])
    assert result.stats["certified_mean"] <= OPTIONS.max_error.mean
    assert result.stats["certified_worst"] <= OPTIONS.max_error.worst
    mean, worst = change(scene, result)
    assert mean <= OPTIONS.max_error.mean and worst <= OPTIONS.max_error.worst
    assert not whole.stand_ins


def test_what_is_met_where_nothing_was_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    """A stand-in that is larger than its mesh changes paths that never met that."""
    of = StandIn.of

    def larger(self: StandIn, mesh: Mesh) -> Mesh:
        return dataclasses.replace(of(self, mesh), positions=2 * of(self, mesh).positions)

    monkeypatch.setattr(StandIn, "of", larger)
    assert not analyze(spheres(), OPTIONS).stand_ins


@pytest.mark.parametrize(
    "scene", [spheres(False), dataclasses.replace(spheres(), simplifiable=None), spheres(emission=1.0)]
)
def test_what_must_stay_whole_does(scene: s.Scene) -> None:
    result = analyze(scene, OPTIONS)
    assert 1 not in result.stand_ins


def test_same_for_any_number_of_threads() -> None:
    results = [analyze(spheres(), dataclasses.replace(OPTIONS, threads=n)) for n in (1, 2)]
    for x, y in zip(*(result.stand_ins.items() for result in results), strict=True):
        assert x[0] == y[0]
        assert np.array_equal(x[1].corners, y[1].corners)
    assert results[0].stats["certified_mean"] == results[1].stats["certified_mean"]


def test_of_a_divided_mesh_what_stays_is_simplified() -> None:
    scene = spheres(parts=True)
    result = analyze(scene, OPTIONS)
    assert 0 in result.stand_ins and 0 in result.faces
    kept = np.flatnonzero(result.faces[0])
    faces = scene.meshes[0].faces
    assert faces is not None
    assert np.isin(faces[result.stand_ins[0].triangles], kept).all()
    assert len(result.stand_ins[0]) < 0.9 * np.isin(faces, kept).sum()
    assert result.stats["certified_worst"] <= OPTIONS.max_error.worst
