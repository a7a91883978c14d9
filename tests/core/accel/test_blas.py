"""BLASes follow deforming meshes, within budgets, and leave nothing behind."""

from __future__ import annotations

import gc
import time

import numpy as np
import pytest

from lipac.core.accel import embree
from lipac.core.accel.blas import CHECK_INTERVAL, BlasCache
from lipac.core.accel.embree import Device
from lipac.core.accel.tlas import Tlas
from lipac.core.culling.analysis import analyze
from lipac.core.culling.options import CullOptions
from lipac.core.culling.policies import RULES, Policy
from lipac.core.culling.shot import Shot
from lipac.core.errors import InputError
from lipac.core.scene import model as s
from lipac.core.scene.change import Change

from .. import scenes
from .test_tlas import shoot

NONE = np.zeros(0, np.int32)


def wave(phase: float, rings: int = 24) -> s.Mesh:
    """A sphere with a wave on it: the same triangles at every phase."""
    mesh = scenes.sphere(rings)
    p = mesh.positions
    return s.Mesh((p * (1 + 0.3 * np.sin(4 * p[:, 2:] + phase))).astype(np.float32), mesh.triangles)


def one(mesh: s.Mesh) -> s.Instances:
    return scenes.build([mesh], [(0, scenes.placed((0, 0, 0)), 0)]).instances


def rays(count: int = 4000) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(3)
    org = rng.normal(size=(count, 3))
    org *= 3 / np.linalg.norm(org, axis=1, keepdims=True)
    return org.astype(np.float32), (rng.uniform(-1, 1, (count, 3)) - org).astype(np.float32)


def test_refit_equals_rebuild_hit_for_hit() -> None:
    cache = BlasCache([wave(0)])
    cache.need(np.array([0]))
    for phase in (1.0, 2.0, 5.0):
        mesh = wave(phase)
        cache.advance([mesh], np.array([0], np.int32), NONE)
        cache.need(np.array([0]))
        fresh = BlasCache([mesh])
        fresh.need(np.array([0]))
        refitted, rebuilt = (shoot(Tlas(one(mesh), c, np.ones(1, bool)), *rays()) for c in (cache, fresh))
        assert (rebuilt[0] == 0).sum() > 1000
        for a, b in zip(refitted, rebuilt, strict=True):
            np.testing.assert_array_equal(a, b)
    # the first time it is built once more, in the form that can be refitted
    assert (cache.work.built, cache.work.refitted) == (2, 2)


def test_what_is_torn_is_built_anew() -> None:
    """Triangles that fly apart: refits cannot keep their tree, so after a while it is another one. What only sways,
    grows or turns is refitted on."""
    mesh = wave(0)
    loose = mesh.positions[mesh.triangles].reshape(-1, 3)
    triangles = np.arange(len(loose), dtype=np.uint32).reshape(-1, 3)
    away = np.repeat(np.random.default_rng(5).normal(size=(len(triangles), 3)), 3, axis=0)
    for shape, torn in ((lambda k: loose * (1 + 0.1 * k), 0), (lambda k: loose + 0.1 * k * away, 1)):
        cache = BlasCache([s.Mesh(loose, triangles)])
        cache.need(np.array([0]))
        for k in range(1, CHECK_INTERVAL + 3):
            now = s.Mesh(shape(k).astype(np.float32), triangles)
            cache.advance([now], np.array([0], np.int32), NONE)
            cache.need(np.array([0]))
        assert (cache.work.built, cache.work.refitted) == (2 + torn, CHECK_INTERVAL + 1 - torn)
        fresh = BlasCache([now])
        fresh.need(np.array([0]))
        for a, b in zip(*(shoot(Tlas(one(now), c, np.ones(1, bool)), *rays()) for c in (cache, fresh)), strict=True):
            np.testing.assert_array_equal(a, b)


def test_other_triangles_are_built_anew() -> None:
    cache = BlasCache([wave(0)])
    cache.need(np.array([0]))
    # the last two were not announced as replaced
    for k, mesh in enumerate((wave(1), wave(1, 12), s.Mesh(wave(1).positions, wave(1).triangles[::-1].copy()))):
        cache.advance([mesh], np.array([0], np.int32), NONE)
        cache.need(np.array([0]))
        fresh = BlasCache([mesh])
        fresh.need(np.array([0]))
        for a, b in zip(*(shoot(Tlas(one(mesh), c, np.ones(1, bool)), *rays()) for c in (cache, fresh)), strict=True):
            np.testing.assert_array_equal(a, b)
        assert (cache.work.built, cache.work.refitted) == (2 + k, 0)


class Counted(list):
    """Meshes that know how often each was read."""

    def __init__(self, meshes: list[s.Mesh]) -> None:
        super().__init__(meshes)
        self.reads = np.zeros(len(meshes), int)

    def __getitem__(self, index):
        self.reads[index] += 1
        return super().__getitem__(index)


def test_only_what_is_needed_is_read() -> None:
    meshes = Counted([wave(k) for k in range(4)])
    cache = BlasCache(meshes)
    cache.need(np.array([0, 1]))
    cache.advance(meshes, np.array([1, 2], np.int32), np.array([0, 3], np.int32))
    assert cache.scenes.astype(bool).tolist() == [False, True, False, False]  # what was replaced is gone at once
    cache.need(np.array([1]))
    assert meshes.reads.tolist() == [1, 2, 0, 0]
    cache.keep_only(np.array([], int))
    cache.advance(meshes, np.array([1], np.int32), NONE)
    cache.need(np.array([], int))
    assert meshes.reads.tolist() == [1, 2, 0, 0]
    assert cache.bytes == 0


def test_memory_is_flat_over_hundreds_of_frames() -> None:
    device = Device(1)
    cache = BlasCache([wave(0, 12), wave(0, 12)], device)
    gc.collect()
    held = []
    for frame in range(300):
        cache.advance([wave(frame, 12), wave(0, 12)], np.array([0], np.int32), np.array([1], np.int32))
        cache.need(np.array([0, 1]))
        if frame % 10 == 0:
            cache.keep_only(np.array([1]))
        tlas = Tlas(one(wave(0, 12)), cache, np.ones(1, bool))
        del tlas
        held.append(device.bytes)
    assert cache.work.refitted > 250
    assert max(held[50:]) <= max(held[:50])
    del cache
    gc.collect()
    assert device.bytes == 0


def test_builds_within_a_time_budget_come_frames_later_and_all_come() -> None:
    meshes = Counted([wave(k, 48) for k in range(12)])
    cache = BlasCache(meshes)
    wanted = np.arange(12)[::-1].copy()
    built = []
    for _ in range(10000):
        cache.provide(wanted, seconds=1e-6, limit=0)
        time.sleep(0.001)
        built.append(len(cache))
        if len(cache) == 12:
            break
    assert built[0] == 0  # nothing is there at once
    assert built[-1] == 12
    assert (np.diff(built) <= 1).all()  # the smallest budget: one at a time
    assert (meshes.reads == 1).all()
    sync = BlasCache(list(meshes))
    sync.need(wanted)
    # Embree takes memory by blocks, how many depends on its threads
    np.testing.assert_allclose(cache.bytes_of, sync.bytes_of, rtol=0.2)


def test_what_is_being_built_may_be_replaced_deformed_or_freed() -> None:
    meshes = [wave(k, 96) for k in range(3)]
    cache = BlasCache(meshes)
    for index in range(3):
        cache.provide(np.array([index]), seconds=1e9, limit=0)  # all three under way
    meshes = [wave(7), wave(8, 96), meshes[2]]
    cache.advance(meshes, np.array([1], np.int32), np.array([0], np.int32))
    cache.keep_only(np.array([0, 1]))
    while len(cache) < 2 or cache._stale:
        cache.provide(np.array([0, 1]), seconds=1e-6, limit=0)
    assert cache.work.built >= 2
    fresh = BlasCache(meshes)
    fresh.need(np.array([0, 1]))
    both = scenes.build(meshes, [(0, scenes.placed((0, 0, 0)), 0), (1, scenes.placed((1, 0, 0)), 0)]).instances
    for a, b in zip(*(shoot(Tlas(both, c, np.ones(2, bool)), *rays()) for c in (cache, fresh)), strict=True):
        np.testing.assert_array_equal(a, b)
    assert cache.scenes[2] == 0


def test_the_least_valuable_go_first_where_bytes_are_short() -> None:
    meshes = Counted([wave(k) for k in range(8)])
    cache = BlasCache(meshes)
    cache.need(np.array([0]))
    limit = int(3.5 * cache.bytes)
    for order in (np.array([4, 5, 6, 7, 0]), np.array([7, 0, 5, 4])):
        for _ in range(3):
            cache.provide(order, seconds=0, limit=limit)
            assert cache.bytes <= limit
        assert np.flatnonzero(cache.scenes).tolist() == sorted(order[:3].tolist())
    assert meshes.reads.max() <= 2  # what does not fit is not built again and again


def test_what_embree_measures_decides_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Embree's bytes vary where threads share a build: with bytes that are twice as many or half as many at random, the
    same instances stay."""
    rng = np.random.default_rng(1)
    meshes = [scenes.quad(), *(scenes.sphere(rings) for rings in range(4, 16))]
    places = [(int(rng.integers(1, 13)), scenes.placed((*rng.uniform(-3, 3, 2), 0.1), 0.1), 0) for _ in range(300)]
    scene = scenes.build(meshes, [(0, scenes.placed((0, 0, 0), 20.0), 0), *places], size=(96, 54))
    options = CullOptions(width=96, paths=4)
    states = [analyze(scene, options).state]
    commit = Device.commit
    for seed in range(3):
        noise = np.random.default_rng(seed)
        monkeypatch.setattr(Device, "commit", lambda *args, noise=noise: int(commit(*args) * noise.uniform(0.5, 2.0)))
        states.append(analyze(scene, options).state)
    assert 0 < np.count_nonzero(states[0]) < len(states[0])
    assert all((state == states[0]).all() for state in states)


def test_bytes_by_count_are_near_those_that_are_measured() -> None:
    cache = BlasCache([scenes.sphere(rings) for rings in (4, 12, 40, 120)])
    cache.need(np.array([1, 2, 3]))
    assert cache.counted_bytes[0] == 0
    np.testing.assert_allclose(cache.counted_bytes[1:], cache.bytes_of[1:], rtol=0.34)


@pytest.mark.parametrize("policy", RULES.values(), ids=list(RULES))
def test_heuristics_hold_no_more_than_they_keep(policy: Policy) -> None:
    """A camera that passes a row of different things: what is culled is freed."""
    assert policy.keep is not None and policy.setting is not None
    meshes = [scenes.sphere(rings) for rings in range(4, 24)]
    placement = [(k, scenes.placed((0, 6.0 * k, 0)), 0) for k in range(len(meshes))]
    row = [
        scenes.build(meshes, placement, camera=scenes.look_at((0, y, 1), (0, y + 5, 0))) for y in range(-5, 110, 12)
    ]
    ladder = policy.setting.ladder(row[-1])
    shares = np.array([policy.keep(row[-1], x).mean() for x in ladder])
    setting = float(ladder[np.abs(shares - 0.5).argmin()])  # which keeps nearest to half of them
    shot = Shot(CullOptions(policy=policy.name, setting=setting))
    for scene in row:
        stats = shot.advance(scene, Change(None, None, NONE, NONE, False, True)).stats
        assert stats["blas_held_bytes"] == stats["blas_bytes"]
    assert stats["culled"] > 5


def test_another_embree_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whose structs may differ from those that are written here."""
    monkeypatch.setattr(embree, "VERSIONS", range(40300, 40400))
    with pytest.raises(InputError, match=r"Embree 4\.4 was loaded"):
        Device()
