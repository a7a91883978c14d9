"""The judge separates bias from noise, the oracle keeps its budget and no more than others, an evaluation goes on where
it was stopped."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from lipac.core.culling.options import CullOptions
from lipac.core.culling.policies import RULES
from lipac.core.error_budget.budget import Budget
from lipac.core.evaluation import judge as judge_module
from lipac.core.evaluation.evaluate import BUDGETS, OURS, Evaluation, Settings, Store, at_equal_error, holds
from lipac.core.evaluation.judge import PASSES, Judge, picture_change
from lipac.core.evaluation.oracle import retained, search
from lipac.core.scene import model as s

from .. import scenes

FLOOR, SEEN, HIDDEN, FAR_AWAY = range(4)


def stage() -> s.Scene:
    """A floor, a cube on it, one under it, one so far that it covers a part of a pixel."""
    placement = [
        (1, scenes.placed((0, 0, 0), 40.0), 0),
        (0, scenes.placed((0, 1, 0.5)), 0),
        (0, scenes.placed((0, 1, -3)), 0),
        (2, scenes.placed((3, 400, 60), 0.3), 0),
    ]
    return scenes.build(
        [scenes.cube(), scenes.quad(), scenes.sphere()],
        placement,
        size=(64, 36),
        limits=s.PathLimits(total=1, diffuse=1),
    )


@pytest.fixture(scope="module")
def judge() -> Judge:
    return Judge(stage(), 16)


def test_something_black_before_a_transparent_film_counts() -> None:
    placement = [(0, scenes.placed((x, 0, 0)), k) for k, x in enumerate((-1.5, 1.5))]
    materials = [scenes.material(), scenes.material(base_color=(0, 0, 0))]
    scene = scenes.build([scenes.cube()], placement, materials, size=(64, 36))
    film = dataclasses.replace(scene.film, transparent=True)
    judge = Judge(dataclasses.replace(scene, film=film), 16)
    change = judge.change(np.array([True, False]))
    alpha = judge.full[..., 3] - judge.picture(np.array([True, False]))[..., 3]
    assert 0 < alpha.mean() < change.mean
    assert change.worst > 1.0


def without(*culled: int) -> np.ndarray:
    keep = np.ones(4, bool)
    keep[list(culled)] = False
    return keep


def test_what_changes_nothing_measures_as_nothing_and_what_is_seen_as_much(judge: Judge) -> None:
    assert judge.change(without(HIDDEN)).mean == 0.0
    seen, all_but_sky = judge.change(without(SEEN)), judge.change(without(FLOOR, SEEN))
    assert 0.001 < seen.mean < all_but_sky.mean
    assert seen.worst > 0.05
    assert 2 * seen.worst_deviation < seen.worst


def test_pairing_removes_noise(judge: Judge) -> None:
    assert judge.noise_floor()["mean"] > 5 * judge.change(without(FAR_AWAY)).mean


def test_the_culled_picture_is_that_of_a_whole_trace(judge: Judge) -> None:
    """Only paths that met something culled are traced again; the rest of the picture is the full one's. Tolerance:
    float32 sums in another order."""
    keep = without(SEEN)
    whole = judge.loop.tracer.trace_again(keep, judge.passes[0].first_sample, judge.samples)
    np.testing.assert_allclose(judge.picture(keep), whole, rtol=1e-4, atol=1e-5)
    mean, worst = picture_change(judge.full, whole)  # by tiles' luminance, noise included
    change = judge.change(keep)
    assert 0 < change.mean < mean + 3 * change.mean_deviation
    assert change.worst == pytest.approx(worst, rel=1e-3)  # a cube: one-signed, and by far more than noise


def test_confidence_interval_covers_the_truth(monkeypatch: pytest.MonkeyPatch) -> None:
    """20 judges of 16 paths per pixel against one of 2,048: 95 % of intervals cover it; fewer than 15 do once in 3,000
    times."""
    keep = without(SEEN)
    truth = Judge(stage(), 2048).change(keep).tiles
    covered = 0
    for seed in range(20):
        monkeypatch.setattr(judge_module, "SEED", seed)
        change = Judge(stage(), 16).change(keep)
        assert change.worst > 0
        covered += abs(change.worst - truth[change.tiles.argmax()]) <= 1.96 * change.worst_deviation
    assert covered >= 15


def test_a_verdict_takes_as_many_paths_as_it_needs() -> None:
    """Passes add up to one judge of as many paths, to the rounding of sums; what is far from the budget is told by
    one."""
    keep, few = without(SEEN), Judge(stage(), 4)
    many = Judge(stage(), 4 * PASSES).change(keep)
    near = few.verdict(keep, Budget(many.mean, many.worst))
    assert near.samples == 4 * PASSES
    np.testing.assert_allclose(near.change.tiles, many.tiles, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(near.change.deviation, many.deviation, rtol=1e-6)
    assert not near.surely and not near.broken
    far = few.verdict(keep, Budget(0.1 * many.mean, 0.1 * many.worst))
    assert far.broken and not far.surely and far.samples < near.samples
    wide = few.verdict(keep, Budget(10 * many.mean, 10 * many.worst))
    assert wide.surely and not wide.broken and wide.samples == 4


def test_cost_counts_a_shared_mesh_once(judge: Judge) -> None:
    both, one, none = (judge.cost(keep) for keep in (without(), without(HIDDEN), without(SEEN, HIDDEN)))
    assert both["blas_bytes"] == one["blas_bytes"] > none["blas_bytes"]
    assert (both["active"], one["active"]) == (4, 3)
    assert (both["meshes"], none["meshes"]) == (3, 2)


def test_oracle_keeps_the_budget_and_no_more_than_a_proposal(judge: Judge) -> None:
    worth, ids = judge.exhaustive_weights(16)
    proposal = without(HIDDEN)
    for budget in (Budget(0.0, 0.0), Budget(0.005, 0.025), Budget(0.0002, 1.0), Budget(0.005, 1.0), Budget(0.5, 1.0)):
        keep = search(judge, worth, ids, budget, [proposal])
        assert judge.change(keep).surely_holds(budget)
        assert retained(judge, keep) <= retained(judge, proposal)
    assert not keep[HIDDEN]


def test_an_evaluation_is_complete_and_goes_on_where_it_was(tmp_path: Path) -> None:
    settings = Settings(samples=4, options=CullOptions(width=64, paths=2))
    first = Evaluation(stage(), settings, tmp_path)
    first.run()
    assert {row["policy"] for row in first.rows} == {"none", *RULES, OURS, "light-paths counts", "random", "oracle"}
    assert [e["error"] for e in at_equal_error(first.rows)] == list(BUDGETS)
    for row in first.rows:
        if row["policy"] == "oracle":
            assert holds(row, Budget(row["setting"], 5 * row["setting"]))
    again = Evaluation(stage(), settings, tmp_path)
    rays = again.judge.loop.tracer.rays
    again.run()
    assert again.rows == first.rows
    assert again.judge.loop.tracer.rays == rays  # nothing is traced a second time
    other = Evaluation(stage(), Settings(samples=8, options=settings.options), tmp_path)
    rays = other.judge.loop.tracer.rays
    other.measure("none", 0.0, without())
    assert other.judge.loop.tracer.rays > rays


def test_pieces_are_kept_apart_by_all_that_they_depend_on(tmp_path: Path) -> None:
    """Each variant changes one thing that a picture depends on."""

    def variant(**changes: object) -> s.Scene:
        return dataclasses.replace(stage(), **changes)  # type: ignore[arg-type]

    def camera(**changes: object) -> s.Scene:
        return variant(camera=dataclasses.replace(stage().camera, **changes))  # type: ignore[arg-type]

    mesh = scenes.cube()
    moved = s.Mesh(mesh.positions * np.float32(0.9), mesh.triangles)
    sky = np.zeros((4, 8, 3), np.float32)
    lit = sky.copy()
    lit[2, 3] = 5
    scenes_ = [
        stage(),
        variant(meshes=[moved, *stage().meshes[1:]]),
        variant(world=s.World(np.zeros(3, np.float32), sky)),
        variant(world=s.World(np.zeros(3, np.float32), lit)),
        camera(aperture=0.1),
        camera(aperture=0.1, focus=2.0),
        camera(orthographic=True),
        variant(slot_materials=np.zeros(2, np.int32)),
        variant(limits=s.PathLimits(total=2)),
        variant(uv_maps=("", "other")),
    ]
    digests = [Store(tmp_path, scene, 4).digest for scene in scenes_]
    assert len(set(digests)) == len(digests)
    assert Store(tmp_path, stage(), 4).digest == digests[0] != Store(tmp_path, stage(), 8).digest


@pytest.mark.parametrize("records", [s.MATERIAL, s.TEXTURE, s.LIGHT], ids=["material", "texture", "light"])
def test_equal_records_have_equal_bytes(records: np.dtype) -> None:
    """Pieces are found by the bytes of what they depend on; NumPy 1 leaves anything in padding."""
    assert sum(field[0].itemsize for field in (records.fields or {}).values()) == records.itemsize
