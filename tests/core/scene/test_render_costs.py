"""What a render takes, in bytes and seconds, by what is in it."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from lipac.core.scene.render_costs import (
    BVH_TRIANGLE,
    DELETING_TRIANGLE,
    MESH,
    TRIANGLE,
    UV_CORNER,
    VERTEX,
    RenderCosts,
    Stakes,
)


def instances(mesh, slots):
    return np.array(mesh, np.int32), np.array(slots, np.int32)


@pytest.fixture
def costs():
    """Three meshes of 100, 200 and no triangles; two images: the first of what begins at slot 0, both of what begins at
    1."""
    sizes = np.array([100, 200, 0], np.int64)
    per_mesh = RenderCosts.of_meshes(sizes, sizes // 2, np.array([False, True, False]))
    uses = np.array([[0, 0], [1, 0], [1, 1]], np.int32)
    return RenderCosts(*per_mesh, np.array([10, 20, 30, 40], np.int32), np.array([1000, 5000], np.int64), uses, 7)


def test_a_mesh_of_so_many_triangles():
    n = np.array([1_000_000], np.int64)
    geometry, bvh, cutting = RenderCosts.of_meshes(n, n // 2, np.array([False]))
    assert geometry == 1_000_000 * TRIANGLE + 500_000 * VERTEX + MESH
    assert bvh == 1_000_000 * BVH_TRIANGLE
    assert cutting == 1_000_000 * DELETING_TRIANGLE
    with_uvs, *_ = RenderCosts.of_meshes(n, n // 2, np.array([True]))
    assert with_uvs - geometry == 3_000_000 * UV_CORNER
    assert not any(x.any() for x in RenderCosts.of_meshes(0 * n, 0 * n, np.array([True])))


def test_the_whole_and_what_goes_with_what_is_culled(costs):
    placed = instances([0, 0, 1, 2], [0, 0, 1, 1])
    everything = np.ones(4, bool)
    assert costs.total(*placed, everything) == 7 + costs.mesh.sum() + 100 + 6000
    assert costs.total(*placed, ~everything) == 7
    assert (
        costs.total(*placed, np.array([True, False, True, True])) == costs.total(*placed, everything) - 20
    )  # its mesh stays
    one = np.array([False, False, True, False])
    assert costs.total(*placed, one) == 7 + costs.mesh[1] + 30 + 6000
    assert (
        costs.total(*placed, np.array([True, False, False, False])) == 7 + costs.mesh[0] + 10 + 1000
    )  # one image's last user


def test_a_mesh_of_which_faces_are_deleted(costs):
    placed = instances([0, 1, 1, 2], [0, 0, 0, 0])
    share = np.array([0.25, 1.0, 1.0])
    first = np.array([True, False, False, False])
    assert costs.total(*placed, first, share) == 7 + int(costs.mesh[0] / 4 + costs.cutting[0]) + 10 + 1000
    assert costs.total(*placed, ~first, share) == 7 + costs.mesh[1] + 90 + 1000


def test_images_that_stay_are_paid_for_whatever_is_culled(costs):
    placed = instances([0, 0, 1, 2], [0, 0, 1, 1])
    stay = costs.with_images_that_stay(np.array([False, True]))
    assert stay.total(*placed, np.ones(4, bool)) == costs.total(*placed, np.ones(4, bool))
    assert stay.total(*placed, np.zeros(4, bool)) == 7 + 5000


def test_parts_take_together_what_their_mesh_takes(costs):
    parts = costs.divided(np.array([0, 0, 0]), [(0, np.array([60, 30, 10]))])
    assert len(parts.geometry) == len(parts.cutting) == 6
    assert costs.mesh[0] <= parts.mesh[3:].sum() <= costs.mesh[0] + 6
    assert parts.mesh[3] == pytest.approx(0.6 * costs.mesh[0], abs=2)
    assert parts.fixed == 7 + costs.cutting[0] + costs.instance[0]  # the object is there while a part of it is
    whole = instances([0, 1, 1, 2, 3, 4, 5], [0] * 7)
    assert parts.total(*whole, np.array([0, 0, 0, 0, 1, 0, 0], bool)) == parts.fixed + parts.mesh[3] + 1000


def stakes(costs: RenderCosts, **more: Any) -> Stakes:
    """Of one frame of such costs on two processors, a picture of 64 x 36 with 2 samples."""
    given: dict[str, Any] = {"objects": 0, "evaluated_s": 0.0, "paths": 64 * 36 * 2, "analysed": 300_000, "frames": 1}
    return Stakes.of(costs, **given | {"processors": 2} | more)


def test_a_scene_of_little_has_nothing_to_win(costs: RenderCosts) -> None:
    assert stakes(costs).nothing_to_win
    assert stakes(costs, objects=4).seconds > stakes(costs).seconds  # an object takes more than what nodes place


@pytest.mark.parametrize(
    "much",
    [
        {"evaluated_s": 5.0},  # heavy modifiers
        {"paths": 1920 * 1080 * 8},  # a share of these is more than an analysis takes
        {"frames": 1_000_000, "analysed": 1000},  # a shot that loads once
    ],
)
def test_any_one_thing_may_be_worth_an_analysis(costs: RenderCosts, much: dict[str, float]) -> None:
    assert not stakes(costs, **much).nothing_to_win


@pytest.mark.parametrize(
    "heavy",
    [
        {"instance": np.zeros(200_000, np.int32)},  # seconds alone
        {"bvh": np.array([3_000_000 * BVH_TRIANGLE, 0, 0])},
        {"geometry": np.array([0, 80_000_000, 0])},  # bytes alone: a mesh of vertices
        {"image": np.array([80_000_000, 0])},
    ],
)
def test_any_heavy_thing_may_be_worth_an_analysis(costs: RenderCosts, heavy: dict[str, Any]) -> None:
    assert not stakes(replace(costs, **heavy)).nothing_to_win


def test_levels_take_their_share(costs: RenderCosts) -> None:
    less = costs.with_levels([(np.array([1], np.int32), 0.25)])
    assert less.mesh.tolist() == [costs.mesh[0], -(-costs.geometry[1] // 4) - (-costs.bvh[1] // 4), costs.mesh[2]]
    assert less.fixed == costs.fixed


def test_a_level_of_parts_is_there_whatever_is_culled(costs: RenderCosts) -> None:
    parts = costs.divided(np.array([0, 0, 0]), [(0, np.array([60, 30, 10]))])
    less = parts.with_levels([(np.array([3, 4], np.int32), 0.5)])
    assert less.mesh[3:].tolist() == [0, 0, parts.mesh[5]]
    assert less.fixed == parts.fixed + -(-int(parts.mesh[3] + parts.mesh[4]) // 2)
