"""Heuristic policies against their definitions, worked out independently."""

from __future__ import annotations

import itertools
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from lipac.core.culling import policies
from lipac.core.culling.options import CullOptions
from lipac.core.culling.policies import NOTHING, POLICIES, RULES, Policy
from lipac.core.culling.policies.distance import keep_distance
from lipac.core.culling.policies.frustum import keep_frustum
from lipac.core.culling.policies.solid_angle import keep_solid_angle
from lipac.core.errors import InputError
from lipac.core.scene import model as s

from .. import scenes


def scattered(camera: s.Camera, count: int = 3000) -> s.Scene:
    rng = np.random.default_rng(2)
    placement = []
    for _ in range(count):
        rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        transform = np.zeros((3, 4), np.float32)
        transform[:, :3] = rotation * 10 ** rng.uniform(-2, 0.5)
        transform[:, 3] = rng.uniform(-30, 30, 3)
        placement.append((0, transform, 0))
    return scenes.build([scenes.cube()], placement, camera=camera)


def corners(scene: s.Scene) -> np.ndarray:
    t = scene.instances.transform.astype(float)
    return np.einsum("nij,kj->nki", t[:, :, :3], scenes.CUBE_POSITIONS.astype(float)) + t[:, None, :, 3]


def test_frustum_keeps_what_touches_the_picture_and_margin() -> None:
    camera = scenes.look_at((3, -20, 5), (0, 0, 0), half_width=0.4)
    scene = scattered(camera)
    keep = keep_frustum(scene, 0.1)
    axes = camera.to_world[:, :3]
    local = (corners(scene) - camera.to_world[:, 3]) @ axes
    depth = -local[..., 2]
    ahead = (depth > 0).all(axis=1)  # wholly in front: the definition is plain projection
    with np.errstate(divide="ignore"):
        x, y = local[..., 0] / depth / 0.8 + 0.5, local[..., 1] / depth / 0.45 + 0.5
    off = (x >= 1.1).all(axis=1) | (x <= -0.1).all(axis=1) | (y >= 1.1).all(axis=1) | (y <= -0.1).all(axis=1)
    assert (ahead & off).sum() > 300
    assert (ahead & ~off).sum() > 100
    np.testing.assert_array_equal(keep[ahead], ~off[ahead])
    assert not keep[(depth < -1).all(axis=1)].any()  # behind the camera
    # what the camera can see is never culled, a wider margin keeps more
    inside = ((x > 0) & (x < 1) & (y > 0) & (y < 1) & (depth > 0)).any(axis=1)
    assert keep[inside].all()
    assert (keep_frustum(scene, 0.5) >= keep).all()
    assert keep_frustum(scene, 0.5).sum() > keep.sum()


def test_frustum_of_an_orthographic_camera_is_a_box() -> None:
    perspective = scenes.look_at((0, -40, 0), (0, 0, 0))
    camera = s.Camera(perspective.to_world, np.array([-4.0, 4.0, -2.0, 2.0]), orthographic=True, clip_end=100)
    scene = scattered(camera)
    local = (corners(scene) - camera.to_world[:, 3]) @ camera.to_world[:, :3]
    x, y = local[..., 0], local[..., 1]
    off = (x >= 4.8).all(axis=1) | (x <= -4.8).all(axis=1) | (y >= 2.4).all(axis=1) | (y <= -2.4).all(axis=1)
    np.testing.assert_array_equal(keep_frustum(scene, 0.1), ~off)


def test_distance_is_to_the_nearest_point_of_the_box() -> None:
    camera = scenes.look_at((0, 0, 0), (0, 1, 0))
    scene = scenes.build(
        [scenes.cube()], [(0, scenes.placed((10, 0, 0), 2.0), 0), (0, scenes.placed((10, 0, 0), 1.0), 0)], camera=camera
    )
    assert keep_distance(scene, 9.25).tolist() == [True, False]
    assert keep_distance(scene, 9.75).tolist() == [True, True]


def test_solid_angle_is_size_over_distance() -> None:
    camera = scenes.look_at((0, 0, 0), (0, 1, 0))
    scene = scenes.build(
        [scenes.cube()], [(0, scenes.placed((0, 100, 0), scale), 0) for scale in (1.0, 2.0, 400.0)], camera=camera
    )
    radius = np.sqrt(3) / 2
    angle = 2 * np.degrees(np.arcsin(radius / 100))
    assert keep_solid_angle(scene, angle * 1.01).tolist() == [False, True, True]
    assert keep_solid_angle(scene, angle * 0.99).tolist() == [True, True, True]
    assert keep_solid_angle(scene, 180).tolist() == [False, False, True]  # the camera is inside the last


def test_an_unknown_policy_is_one_clear_line() -> None:
    with pytest.raises(InputError, match=r"^unknown culling policy 'best': choose one of none, light-paths, frustum"):
        CullOptions(policy="best")


@pytest.mark.parametrize("policy", RULES.values(), ids=list(RULES))
def test_rules_keep_more_and_more_along_their_ladder(policy: Policy) -> None:
    """`lipac evaluate` looks between two settings for the one that holds a budget."""
    assert policy.keep is not None and policy.setting is not None
    scene = scattered(scenes.look_at((3, -20, 5), (0, 0, 0), half_width=0.4))
    sets = [policy.keep(scene, x) for x in policy.setting.ladder(scene)]
    assert all((~a | b).all() for a, b in itertools.pairwise(sets))
    assert sets[0].sum() < sets[-1].sum()
    assert CullOptions(policy=policy.name).rule(scene).tolist() == policy.keep(scene, policy.setting.default).tolist()
    assert (
        CullOptions(policy=policy.name, setting=policy.setting.default / 3).rule(scene).tolist()
        == policy.keep(scene, policy.setting.default / 3).tolist()
    )


def test_the_registry_finds_every_policy_and_numbers_them() -> None:
    names = [
        path.stem for path in Path(policies.__file__).parent.glob("*.py") if path.stem not in ("__init__", "policy")
    ]
    assert len(POLICIES) == len(names)
    assert len({policy.rank for policy in POLICIES.values()}) == len(POLICIES)
    # what saved files hold
    assert [POLICIES[name].rank for name in ("light-paths", "frustum", "distance", "solid-angle")] == [0, 1, 2, 3]
    assert CullOptions(policy=NOTHING).rule(scattered(scenes.look_at((3, -20, 5), (0, 0, 0)))).all()


def test_listing_policies_loads_no_kernels() -> None:
    code = "import sys, lipac.core.culling.policies; sys.exit('numba' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
