"""Instanced geometry answers as flat geometry does, over exactly the active set; BLASes come and go with need."""

from __future__ import annotations

import gc

import numpy as np
from numba import njit

from lipac.core.accel import embree
from lipac.core.accel.blas import BlasCache
from lipac.core.accel.tlas import Tlas, hit_instance
from lipac.core.scene import model as s

from .. import scenes


@njit(nogil=True)
def closest(tlas, ids, first, origin, direction, mask, instance, prim, distance):
    ray = np.zeros(embree.RAY, np.float32)
    for i in range(len(origin)):
        embree.set_ray(
            ray, origin[i, 0], origin[i, 1], origin[i, 2], direction[i, 0], direction[i, 1], direction[i, 2], 0.0,
            np.inf, mask
        )
        instance[i], prim[i], distance[i] = -1, -1, np.inf
        if embree.intersect(tlas, ray):
            instance[i] = hit_instance(ids, first, ray)
            prim[i] = ray.view(np.uint32)[embree.PRIM_ID]
            distance[i] = ray[embree.TFAR]


def shoot(
    tlas: Tlas, origin: np.ndarray, direction: np.ndarray, mask: int = s.ALL_RAYS
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    n = len(origin)
    out = np.zeros(n, np.int64), np.zeros(n, np.int64), np.zeros(n)
    closest(tlas.handle, tlas.ids, tlas.first, origin, direction, mask, *out)
    return out


def cloud(count: int = 60) -> s.Scene:
    """Cubes and spheres with rotations, shear, negative and very uneven scale, apart from each other."""
    rng = np.random.default_rng(5)
    placement = []
    for i in range(count):
        transform = np.zeros((3, 4), np.float32)
        rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        transform[:, :3] = rotation @ np.diag(10 ** rng.uniform(-1.3, 0.2, 3)) * (-1) ** i
        transform[:, 3] = rng.uniform(-8, 8, 3)
        placement.append((i % 2, transform, 0))
    return scenes.build([scenes.cube(), scenes.sphere(8)], placement)


def rays(count: int = 20000) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(6)
    origin = rng.normal(size=(count, 3))
    origin *= 20 / np.linalg.norm(origin, axis=1, keepdims=True)
    target = rng.uniform(-8, 8, (count, 3))
    return origin.astype(np.float32), (target - origin).astype(np.float32)


def flat(scene: s.Scene) -> tuple[s.Scene, np.ndarray, np.ndarray]:
    """All instances baked into one mesh: the scene, and instance and primitive of each of its triangles."""
    positions, triangles, owner, prim, offset = [], [], [], [], 0
    for i, m in enumerate(scene.instances.mesh):
        mesh, t = scene.meshes[m], scene.instances.transform[i].astype(float)
        positions.append(mesh.positions @ t[:, :3].T + t[:, 3])
        triangles.append(mesh.triangles + offset)
        offset += len(mesh.positions)
        owner.append(np.full(len(mesh.triangles), i))
        prim.append(np.arange(len(mesh.triangles)))
    baked = s.Mesh(np.concatenate(positions).astype(np.float32), np.concatenate(triangles).astype(np.uint32))
    return scenes.build([baked], [(0, scenes.placed((0, 0, 0)), 0)]), np.concatenate(owner), np.concatenate(prim)


def test_instanced_equals_flat() -> None:
    scene = cloud()
    baked, owner, prim = flat(scene)
    everything = np.ones(len(scene.instances), bool)
    blas, flat_blas = BlasCache(scene.meshes), BlasCache(baked.meshes)
    blas.need(scene.instances.mesh)
    flat_blas.need(np.zeros(1, np.int32))
    instance, triangle, distance = shoot(Tlas(scene.instances, blas, everything), *rays())
    _, flat_prim, flat_distance = shoot(Tlas(baked.instances, flat_blas, np.ones(1, bool)), *rays())
    # float32 rounds an edge one way or the other: rays that graze one may differ, a handful in twenty thousand.
    hit = (instance >= 0) & (flat_prim >= 0)
    same = hit & (owner[flat_prim] == instance) & (prim[flat_prim] == triangle)
    assert hit.sum() > 1000
    assert ((instance >= 0) != (flat_prim >= 0)).sum() <= 3
    assert (hit & ~same).sum() <= 10
    # Distances are lengths of directions of about 20: float32 rounding of positions of size 20, over that, is some
    # 1e-6.
    np.testing.assert_allclose(distance[same], flat_distance[same], rtol=2e-5, atol=2e-6)


def test_only_the_active_are_met() -> None:
    scene = cloud()
    blas = BlasCache(scene.meshes)
    blas.need(scene.instances.mesh)
    everything = shoot(Tlas(scene.instances, blas, np.ones(60, bool)), *rays())[0]
    active = np.arange(60) % 3 == 0
    met = shoot(Tlas(scene.instances, blas, active), *rays())[0]
    assert set(met[met >= 0]) <= set(np.flatnonzero(active))
    was_active = (everything >= 0) & active[everything]
    np.testing.assert_array_equal(met[was_active], everything[was_active])
    assert (shoot(Tlas(scene.instances, blas, np.zeros(60, bool)), *rays())[0] == -1).all()


def test_rays_see_what_is_visible_to_their_type() -> None:
    flags = np.array([1 << s.RayType.CAMERA, 1 << s.RayType.SHADOW, s.ALL_RAYS], np.uint8)
    scene = scenes.build([scenes.cube()], [(0, scenes.placed((0, y, 0)), 0) for y in (0.0, 2.0, 4.0)], flags=flags)
    blas = BlasCache(scene.meshes)
    blas.need(np.zeros(1, np.int32))
    tlas = Tlas(scene.instances, blas, np.ones(3, bool))
    origin, direction = np.array([[0, -5, 0]], np.float32), np.array([[0, 1, 0]], np.float32)
    met = [int(shoot(tlas, origin, direction, 1 << t)[0][0]) for t in s.RayType]
    assert met == [0, 2, 2, 2, 1]


def test_groups_of_one_keep_their_meshes() -> None:
    """Embree ignores an index buffer of one item: an instance with visibility of its own must still be of its own
    mesh."""
    sizes = (1.0, 2.0, 4.0)
    meshes = [s.Mesh(scenes.quad().positions * np.float32(size), scenes.quad().triangles) for size in sizes]
    flags = np.array([s.ALL_RAYS, s.ALL_RAYS & ~1, s.ALL_RAYS & ~2], np.uint8)
    scene = scenes.build(meshes, [(k, scenes.placed((10.0 * k, 0, 0)), 0) for k in (0, 1, 2)], flags=flags)
    blas = BlasCache(scene.meshes)
    blas.need(scene.instances.mesh)
    tlas = Tlas(scene.instances, blas, np.ones(3, bool))
    inside = np.array([[10.0 * k + 0.49 * size, 0.1, 1.0] for k, size in enumerate(sizes)], np.float32)
    outside = inside + np.array([[0.02 * size, 0, 0] for size in sizes], np.float32)
    down = np.tile(np.array([0, 0, -1], np.float32), (3, 1))
    assert shoot(tlas, inside, down)[0].tolist() == [0, 1, 2]
    assert shoot(tlas, outside, down)[0].tolist() == [-1, -1, -1]


def test_a_blas_is_shared_counted_and_freed() -> None:
    class Counting(list):
        loads = 0

        def __getitem__(self, index):
            self.loads += 1
            return super().__getitem__(index)

    meshes = Counting([scenes.sphere(64), scenes.cube(), scenes.sphere(32)])
    device = embree.Device()
    blas = BlasCache(meshes, device)
    empty = device.bytes
    assert blas.need(np.array([0, 0, 1, 0])) == 2
    assert blas.need(np.array([1, 0])) == 0
    assert meshes.loads == 2  # the third is never asked for
    assert blas.bytes_of[0] > 64 * 128 * 2 * 20  # Embree keeps some tens of bytes per triangle
    assert abs(device.bytes - empty - blas.bytes) < 4096
    small = int(blas.bytes_of[1])
    blas.keep_only(np.array([1]))
    gc.collect()
    assert blas.bytes == small
    assert device.bytes - empty <= small + 4096
    assert blas.scenes[0] == 0
    assert blas.table["positions"][0] == 0


def test_meshes_without_triangles_are_passed_over() -> None:
    nothing = s.Mesh(np.zeros((2, 3), np.float32), np.zeros((0, 3), np.uint32))
    scene = scenes.build([nothing, scenes.cube()], [(0, scenes.placed((0, 0, 0)), 0), (1, scenes.placed((0, 0, 0)), 0)])
    blas = BlasCache(scene.meshes)
    blas.need(scene.instances.mesh)
    tlas = Tlas(scene.instances, blas, np.ones(2, bool))
    assert tlas.ids.tolist() == [1]


def test_a_tlas_outlives_what_the_cache_lets_go_of() -> None:
    """Its hits are the same after everything was freed, and other memory was asked for."""
    scene = scenes.build(
        [scenes.sphere(24), scenes.cube()], [(0, scenes.placed((0, 0, 0)), 0), (1, scenes.placed((2, 0, 0)), 0)]
    )
    blas = BlasCache(scene.meshes)
    blas.need(np.array([0, 1]))
    tlas = Tlas(scene.instances, blas, np.ones(2, bool))
    rng = np.random.default_rng(0)
    org = (rng.normal(size=(3000, 3)) * 3).astype(np.float32)
    direction = (rng.uniform(-1, 2, (3000, 3)) - org).astype(np.float32)
    before = shoot(tlas, org, direction)
    blas.keep_only(np.zeros(0, np.int64))
    gc.collect()
    trash = [np.full(n, np.nan, np.float32) for n in (400, 3000, 4000, 8000) for _ in range(50)]
    after = shoot(tlas, org, direction)
    assert trash
    assert np.isfinite(before[2]).sum() > 1000
    for a, b in zip(before, after, strict=True):
        np.testing.assert_array_equal(a, b)
