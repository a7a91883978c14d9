"""A shot's frames are what each would be alone, up to the stated hysteresis; what is settled stays; memory is flat;
pending ones come."""

from __future__ import annotations

import dataclasses
import gc
import itertools
import time
from collections.abc import Iterator

import numpy as np
import pytest

from lipac.core.accel.embree import Device
from lipac.core.culling.activation import COLD_HITS
from lipac.core.culling.analysis import analyze
from lipac.core.culling.options import CullOptions, State
from lipac.core.culling.result import CullingResult
from lipac.core.culling.shot import Shot
from lipac.core.error_budget.budget import Budget
from lipac.core.scene import model as s
from lipac.core.scene.bounds import world_bounds
from lipac.core.scene.change import Change

from .. import scenes

NONE = np.zeros(0, np.int32)
CAMERA = Change(None, None, NONE, NONE, False, True)
STILL = Change(None, None, NONE, NONE, False, False)
OPTIONS = CullOptions(width=96, paths=4, min_share=4 * COLD_HITS / (96 * 54 * 4), settled=0.0)


def pole(phase: float) -> s.Mesh:
    """A thick pole that sways: the same triangles at every phase."""
    ring = np.linspace(0, 2 * np.pi, 8, endpoint=False)
    z = np.linspace(0, 2, 9)
    x = 0.3 * np.cos(ring)[None, :] + 0.4 * np.sin(z + phase)[:, None] * z[:, None] / 2
    y = np.broadcast_to(0.3 * np.sin(ring), x.shape)
    positions = np.stack([x, y, np.broadcast_to(z[:, None], x.shape)], -1).reshape(-1, 3).astype(np.float32)
    i, j = np.meshgrid(np.arange(8), np.arange(8), indexing="ij")
    a, b = i * 8 + j, i * 8 + (j + 1) % 8
    quads = np.stack([a, b, b + 8, a, b + 8, a + 8], -1).reshape(-1, 3)
    return s.Mesh(positions, quads.astype(np.uint32))


WALLS, POLES = 12, 60


def frame_of(frame: int, poles: int = POLES) -> s.Scene:
    """Poles that sway and drift, each a mesh of its own, among walls; a camera that moves along. Rows: floor, walls,
    poles."""
    rng = np.random.default_rng(1)
    placement = [(1, scenes.placed((0, 0, 0), 80.0), 0)]
    for _ in range(WALLS):
        placement.append((0, scenes.placed((*rng.uniform(-14, 14, 2), 1.5), (6.0, 0.3, 3.0)), 0))
    meshes = [scenes.cube(), scenes.quad()]
    for k in range(poles):
        x, y = rng.uniform(-14, 14, 2)
        placement.append((2 + k, scenes.placed((x + 0.1 * frame, y, 0)), 0))
        meshes.append(pole(0.3 * frame + k))
    camera = scenes.look_at((-6 + 0.4 * frame, -16, 2.0), (-6 + 0.4 * frame, 0, 1.0))
    return scenes.build(
        meshes,
        placement,
        camera=camera,
        size=(96, 54),
        limits=s.PathLimits(total=2, diffuse=1, glossy=1, transmission=0),
    )


def all_deform(poles: int = POLES) -> Change:
    moved = np.zeros(1 + WALLS + poles, bool)
    moved[1 + WALLS :] = True
    return Change(None, moved, np.arange(2, 2 + poles, dtype=np.int32), NONE, False, True)


def assert_as_alone(shot: Shot, result: CullingResult, scene: s.Scene, options: CullOptions = OPTIONS) -> None:
    """States and hits of a shot's last frame are those of a fresh start of it, repeated until it is at rest.

    Hits: what is built in one of the two alone, a few paths meet: fewer than COLD_HITS of a round's cross its box, so
    some times that of a measurement's, twice as many, may meet it. All other paths take the same course, to the last
    hit; but where other emitters are built, other shadow rays are traced, and blocked. Where two surfaces coincide the
    structure decides which is met: then as many hits of each kind are there, and every path is as bright, to the last
    bit. States: by counts, what clearly passes the bound is active, what clearly fails both bounds, that of hysteresis
    too, is culled. Clearly: by COLD_HITS hits, and as many for paths that took another course.
    """
    fresh = Shot(options)
    before, alone = None, fresh.advance(scene)
    while before is None or (alone.hits != before.hits).any():
        before, alone = alone, fresh.advance(scene, STILL)
    assert (
        shot.loop is not None
        and shot.loop.measured is not None
        and fresh.loop is not None
        and fresh.loop.measured is not None
    )
    met, mine, theirs = alone.hits.sum(axis=1), shot.loop.measured.tlas.ids, fresh.loop.measured.tlas.ids
    lacking = np.concatenate(
        [result.hits[np.setdiff1d(mine, theirs)].sum(axis=1), alone.hits[np.setdiff1d(theirs, mine)].sum(axis=1)]
    )
    assert lacking.max(initial=0) < 6 * COLD_HITS
    same_emitters = not np.isin(np.setxor1d(mine, theirs), fresh.loop.tracer.prepared.emissive).any()
    kinds = slice(None) if same_emitters else slice(s.RayType.SHADOW)
    of_a_path = 2 * (scene.limits.total + 1)  # a hit and a shadow ray at every bounce
    other, a, b = (
        (result.hits - alone.hits)[:, kinds],
        shot.loop.measured.log.luminance,
        fresh.loop.measured.log.luminance,
    )
    tied = not other.sum(axis=0).any() and np.array_equal(a, b)
    assert tied or np.abs(other).sum() <= 2 * of_a_path * lacking.sum()
    assert options.min_share is not None
    bound, slack = options.min_share * options.paths * scene.film.width * scene.film.height, 2 * COLD_HITS
    assert result.active[met >= bound + slack].all()
    assert not result.active[met < bound / options.hysteresis - slack].any()
    assert met.any()


def test_each_frame_is_what_it_is_alone() -> None:
    shot = Shot(OPTIONS)
    counts = []
    for frame in range(6):
        scene = frame_of(frame)
        result = shot.advance(scene, all_deform() if frame else None)
        assert_as_alone(shot, result, scene)
        counts.append(result.stats["active"])
        if frame:
            assert result.stats["blas_refitted"] > 0 or frame == 1  # the first time they are built for refitting
            assert result.stats["refit_s"] > 0 or frame == 1
    assert min(counts) < len(scene.instances)  # some were culled


def test_instances_come_go_and_change_places() -> None:
    shot = Shot(OPTIONS)
    full = frame_of(0)
    shot.advance(full)
    rng = np.random.default_rng(2)
    rows = np.arange(len(full.instances))
    for _ in range(4):
        kept = np.sort(rng.permutation(len(full.instances))[:50])
        kept = kept[rng.permutation(len(kept))]  # another order too
        kept = np.append(0, kept[kept != 0])
        previous = np.full(len(kept), -1, np.int32)
        common, at, was = np.intersect1d(kept, rows, return_indices=True)
        previous[at] = was
        assert len(common) < len(kept) or len(rows) == len(full.instances)
        scene = dataclasses.replace(
            full,
            instances=s.Instances(*(getattr(full.instances, f.name)[kept] for f in dataclasses.fields(s.Instances))),
        )
        result = shot.advance(scene, Change(previous, previous < 0, NONE, NONE, False, False))
        assert_as_alone(shot, result, scene)
        rows = kept


def test_other_triangles_in_a_mesh_are_seen() -> None:
    shot = Shot(OPTIONS)
    first = frame_of(0)
    shot.advance(first)
    cubes = [*first.meshes[:2], *[scenes.cube()] * POLES]
    bounds = np.stack([np.stack([m.positions.min(axis=0), m.positions.max(axis=0)]) for m in cubes]).astype(np.float32)
    instances = dataclasses.replace(
        first.instances, bounds=world_bounds(first.instances.transform, bounds, first.instances.mesh)
    )
    second = dataclasses.replace(first, meshes=cubes, mesh_bounds=bounds, instances=instances)
    change = all_deform()
    result = shot.advance(second, dataclasses.replace(change, deformed=NONE, replaced=change.deformed, camera=False))
    assert_as_alone(shot, result, second)
    assert result.stats["blas_built"] > 10


def test_what_is_settled_stays_over_two_hundred_frames() -> None:
    scene = frame_of(0)
    options = dataclasses.replace(OPTIONS, width=64, paths=2)
    shot = Shot(options)
    shot.advance(scene)
    # also where every frame says that something changed
    seen = [shot.advance(scene, STILL if k % 2 else CAMERA) for k in range(200)]
    for late in seen[20:]:
        np.testing.assert_array_equal(late.state, seen[20].state)
        np.testing.assert_array_equal(late.hits, seen[20].hits)
        assert late.stats["blas_built"] == 0
    rounds = [r.stats["iterations"] for r in seen[20:]]
    assert sum(rounds) <= 1.1 * len(rounds)  # here and there a region is tried again, less and less often


@pytest.mark.parametrize(
    "options", [OPTIONS, CullOptions(width=96, paths=4, max_error=Budget(0.02, 0.2))], ids=["counts", "budget"]
)
def test_hysteresis_lets_fewer_states_change_again(options: CullOptions) -> None:
    """What flickers: an instance that has changed once before. What comes and stays is counted for neither."""
    changes = []
    for hysteresis in (1.0, 4.0):
        shot = Shot(dataclasses.replace(options, hysteresis=hysteresis))
        states = []
        for frame in range(10):
            result = shot.advance(frame_of(frame), all_deform() if frame else None)
            states.append(result.active)
            if options.min_share is None:
                assert result.stats["certified_mean"] <= options.max_error.mean
        times = sum((a != b).astype(np.int64) for a, b in itertools.pairwise(states))
        changes.append(int(np.maximum(times - 1, 0).sum()))
    assert changes[1] < changes[0]


def test_memory_is_flat() -> None:
    device = Device(2)
    options = dataclasses.replace(OPTIONS, width=48, paths=1)
    shot = Shot(options, device)
    held = []
    for frame in range(120):
        shot.advance(frame_of(frame % 10, 12), all_deform(12) if frame else None)
        held.append(device.bytes)
    assert max(held[60:]) <= 1.05 * max(held[20:60])
    del shot
    gc.collect()
    assert device.bytes == 0


@pytest.mark.parametrize("budget_bytes", [0, 200_000])
def test_within_a_time_budget_states_are_pending_and_resolve(budget_bytes: int) -> None:
    scene = frame_of(0)
    shot = Shot(dataclasses.replace(OPTIONS, blas_budget_ms=0.05, blas_budget_bytes=budget_bytes))
    results = [shot.advance(scene)]
    for _ in range(400):
        time.sleep(0.001)
        results.append(shot.advance(scene, CAMERA))
        assert not budget_bytes or results[-1].stats["blas_held_bytes"] <= budget_bytes
        if results[-1].stats["pending"] == 0 and results[-2].stats["pending"] == 0 and len(results) > 10:
            break
    pending = [int((r.state == State.PENDING).sum()) for r in results]
    assert [r.stats["pending"] for r in results] == pending
    assert max(pending) > 0
    assert pending[-1] == 0
    if not budget_bytes:
        assert_as_alone(shot, results[-1], scene)


def test_the_most_valuable_stay_where_bytes_are_short() -> None:
    scene = frame_of(0)
    free = Shot(OPTIONS).advance(scene)
    limit = int(0.5 * free.stats["blas_bytes"])
    shot = Shot(dataclasses.replace(OPTIONS, blas_budget_bytes=limit))
    for k in range(6):
        result = shot.advance(scene, CAMERA if k else None)
        assert result.stats["blas_held_bytes"] <= limit
    lost = free.active & ~result.active
    assert lost.any()
    assert free.score[result.active & free.active].mean() > 2 * free.score[lost].mean()


def turn(frame: int) -> s.Scene:
    """A camera that turns by a quarter in frame 2, to a cube that it did not see before."""
    scene = frame_of(0)
    target = (6.0, -16.0, 2.0) if frame >= 2 else (-6.0, 0.0, 1.0)
    placement = scene.instances
    instances = s.Instances(
        *(
            np.concatenate([getattr(placement, f.name), getattr(placement, f.name)[1:2]])
            for f in dataclasses.fields(s.Instances)
        )
    )
    instances.transform[-1] = scenes.placed((4.0, -16.0, 2.0), 2.0)
    instances.bounds[-1] = [[3, -17, 1], [5, -15, 3]]
    return dataclasses.replace(scene, instances=instances, camera=scenes.look_at((-6, -16, 2.0), target))


@pytest.mark.parametrize("mitigation", [True, False])
def test_what_comes_into_view_is_active_at_once_with_mitigation(mitigation: bool) -> None:
    shot = Shot(dataclasses.replace(OPTIONS, mitigation=mitigation, max_iterations=1))
    states = [shot.advance(turn(frame), CAMERA if frame else None).active[-1] for frame in range(10)]
    assert not any(states[:2])
    latency = states[2:].index(True)
    assert latency == 0 if mitigation else latency > 0


def test_without_rounds_to_rest_frames_catch_up() -> None:
    scene = frame_of(0)
    shot = Shot(dataclasses.replace(OPTIONS, max_iterations=1))
    for k in range(20):
        result = shot.advance(scene, CAMERA if k else None)
        assert result.stats["iterations"] == 1
    assert_as_alone(shot, result, scene)


def test_threads_change_nothing() -> None:
    def run(threads: int) -> Iterator[tuple[np.ndarray, ...]]:
        shot = Shot(dataclasses.replace(OPTIONS, threads=threads))
        for frame in range(4):
            result = shot.advance(frame_of(frame), all_deform() if frame else None)
            yield result.state, result.hits, result.score, result.boxes

    for one, two, four in zip(run(1), run(2), run(4), strict=True):
        for a, b, c in zip(one, two, four, strict=True):
            np.testing.assert_array_equal(a, b)
            np.testing.assert_array_equal(a, c)


@pytest.mark.parametrize(
    "options",
    [CullOptions(width=96, paths=4), CullOptions(policy="distance", setting=12.0), CullOptions(policy="none")],
)
def test_other_policies_follow_too(options: CullOptions) -> None:
    shot = Shot(options)
    for frame in range(3):
        scene = frame_of(frame)
        result = shot.advance(scene, all_deform() if frame else None)
        alone = analyze(scene, options)
        if options.policy == "light-paths":
            assert result.stats["certified_mean"] <= options.max_error.mean
            assert result.stats["certified_worst"] <= options.max_error.worst
        else:
            np.testing.assert_array_equal(result.state, alone.state)
            assert result.stats["meshes"] == alone.stats["meshes"]


def test_a_picture_of_nothing_is_none() -> None:
    """A white cube under a white sky, which is all there is, is as bright as what is behind it. That no path tells them
    apart says little, for materials are known approximately: it stays, but not where memory is limited. Beside other
    things it goes."""
    white = scenes.material(base_color=(1.0, 1.0, 1.0))
    grey = scenes.material(base_color=(0.1, 0.1, 0.1))
    alone = scenes.build([scenes.cube()], [(0, scenes.placed((0, 0, 0)), 0)], [white])
    assert Shot(CullOptions(width=48)).advance(alone).active.all()
    assert not Shot(CullOptions(width=48, blas_budget_bytes=1)).advance(alone).active.any()
    beside = scenes.build([scenes.cube()], [(0, scenes.placed((x, 0, 0)), int(x > 0)) for x in (-2, 2)], [white, grey])
    assert Shot(CullOptions(width=48)).advance(beside).active.tolist() == [False, True]
