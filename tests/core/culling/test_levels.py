"""Levels of detail: fewer triangles within the budget, by paths that chose nothing; what may not be exchanged stays
whole."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
import pytest

from lipac.core.culling.analysis import analyze
from lipac.core.culling.certificate import Certificate
from lipac.core.culling.levels.levelled import CULLING
from lipac.core.culling.levels.stand_ins import Coarser, StandIn
from lipac.core.culling.loop import Loop
from lipac.core.culling.options import CullOptions, State
from lipac.core.culling.result import CullingResult
from lipac.core.error_budget.budget import Budget
from lipac.core.error_budget.error_estimate import ErrorEstimate, Light, Reference
from lipac.core.feedback.path_log import RECORD, PathLog
from lipac.core.feedback.tiles import TILES
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
    found = result.stand_ins
    meshes = [one.of(mesh) if isinstance(one := found.get(m), StandIn) else mesh for m, mesh in enumerate(scene.meshes)]
    return changed(scene, meshes, result)


def changed(scene: s.Scene, meshes: Sequence[Mesh], result: CullingResult) -> tuple[float, float]:
    """The same with these meshes."""
    logs = []
    for one, keep in (
        (scene, None),
        (dataclasses.replace(scene, meshes=list(meshes)), result.state == State.ACTIVE),
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


HOPELESS = ErrorEstimate(*np.full((2, TILES), 9.0), *np.zeros((2, TILES)))


def posts() -> s.Scene:
    """Small cubes around the spheres: the budget says how many of them stay."""
    rng = np.random.default_rng(0)
    spots = rng.uniform((-8, 2), (8, 30), (400, 2)).tolist()
    places = [(2, scenes.placed((x, y, 0.1), 0.2), 0) for x, y in spots]
    first = [(0, scenes.placed((0, 0, 0), 60.0), 0), (1, scenes.placed((0, 4, 0.7), 0.7), 1)]
    surfaces = [material(base_color=0.6), material(base_color=0.3)]
    limits = s.PathLimits(total=1, diffuse=1)
    meshes = [grid(8), scenes.sphere(48), scenes.cube()]
    scene = scenes.build(meshes, [*first, *places], surfaces, CAMERA, sun((1, 0, 1)), (0.4, 0.5, 0.7), SIZE, limits)
    return dataclasses.replace(scene, simplifiable=np.array([False, True, False]))


class Coarse:
    """The spheres, with a quarter of the triangles at each step; notes what is asked of it."""

    def __init__(self, sides: tuple[int, ...] = (24, 12, 6)) -> None:
        self.steps = np.array([0, len(sides)])
        self._sides = sides
        self.asked: list[list[int]] = []

    def read(self, meshes: Sequence[int]) -> dict[int, list[Mesh]]:
        self.asked.append(list(meshes))
        return {number: [scenes.sphere(side) for side in self._sides] for number in meshes}

    def at(self, steps: Mapping[int, int]) -> dict[int, Mesh]:
        return {number: scenes.sphere(self._sides[step - 1]) for number, step in steps.items()}


def test_what_can_be_had_coarser_is() -> None:
    coarser = Coarse()
    scene = dataclasses.replace(spheres(), simplifiable=None, coarser=coarser)
    result, whole = analyze(scene, OPTIONS), analyze(scene, dataclasses.replace(OPTIONS, levels=False))
    chosen = result.stand_ins[1]
    assert isinstance(chosen, Coarser)
    assert coarser.asked == [[1]]
    assert len(chosen) == len(scenes.sphere((24, 12, 6)[chosen.steps - 1]).triangles)
    assert result.stats["triangles"] == whole.stats["triangles"] - len(scene.meshes[1].triangles) + len(chosen)
    assert result.stats["levels_triangles"] == len(scene.meshes[1].triangles) - len(chosen)
    assert result.stats["certified_worst"] <= OPTIONS.max_error.worst
    meshes = [scene.meshes[0], scenes.sphere((24, 12, 6)[chosen.steps - 1])]
    mean, worst = changed(scene, meshes, result)
    assert mean <= OPTIONS.max_error.mean and worst <= OPTIONS.max_error.worst


def test_what_is_nothing_like_it_is_not_taken() -> None:
    """Octahedra in place of spheres, at half of the distance."""
    near = dataclasses.replace(OPTIONS, max_error=Budget(0.0005, 0.002))
    scene = dataclasses.replace(spheres(), simplifiable=None, coarser=Coarse((3,)))
    assert not analyze(scene, near).stand_ins


def smooth(mesh: Mesh) -> Mesh:
    """A `grid` with its normals."""
    x, y, _ = mesh.positions.T
    slope = 0.18 * np.cos(9 * x) * np.cos(7 * y), -0.14 * np.sin(9 * x) * np.sin(7 * y)
    normals = np.stack([-slope[0], -slope[1], np.ones_like(x)], axis=1)
    return dataclasses.replace(mesh, normals=normals / np.linalg.norm(normals, axis=1, keepdims=True))


def test_a_divided_mesh_comes_back_whole_where_that_is_coarser() -> None:
    scene, coarser = spheres(parts=True), Coarse()
    fine, few = smooth(grid(200)), smooth(grid(50))
    coarser.steps = np.array([1, 0])
    coarser.read = lambda meshes: {m: [few] for m in meshes}  # type: ignore[method-assign]
    scene = dataclasses.replace(scene, meshes=[fine, scene.meshes[1]], simplifiable=None, coarser=coarser)
    result = analyze(scene, OPTIONS)
    assert 0 in result.faces
    assert len(result.stand_ins[0]) == len(few.triangles) < 2 * result.faces[0].sum()
    assert result.stats["certified_worst"] <= OPTIONS.max_error.worst


def test_what_levels_do_not_use_is_for_culling(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where no proposal holds, what stays is what stays without levels, or hardly more: they share the doubt. The
    median of five seeds, for one in six has a set that is a fourth larger."""
    monkeypatch.setattr(Certificate, "judge_exchanged", lambda *_: HOPELESS)
    scene, more = posts(), []
    for seed in range(5):
        options = dataclasses.replace(OPTIONS, seed=seed)
        whole = analyze(scene, dataclasses.replace(options, levels=False))
        result = analyze(scene, options)
        assert not result.stand_ins
        more.append(result.stats["active"] / whole.stats["active"])
    assert np.median(more) <= 1.05
    tighter = Budget(CULLING * OPTIONS.max_error.mean, CULLING * OPTIONS.max_error.worst)
    less = analyze(scene, dataclasses.replace(options, levels=False, max_error=tighter))
    assert result.stats["active"] < less.stats["active"]
