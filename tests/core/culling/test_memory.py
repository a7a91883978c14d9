"""The least change of the picture that fits a render into so many bytes."""

import dataclasses

import numpy as np
import pytest

from lipac.core.culling.analysis import analyze
from lipac.core.culling.options import CullOptions
from lipac.core.error_budget.budget import Budget
from lipac.core.errors import InputError
from lipac.core.scene.render_costs import RenderCosts

from .test_division import SIZE, terrain

MEGABYTE = 1_000_000
PROCESS = 50 * MEGABYTE


def priced(scene, per_mesh=30 * MEGABYTE):
    """A scene with what its render takes: each mesh so much."""
    n, m = len(scene.instances), len(scene.meshes)
    size, nothing = np.full(m, per_mesh), np.zeros(m, np.int64)
    costs = RenderCosts(
        size, nothing, nothing, np.full(n, 100, np.int32), np.zeros(0, np.int64), np.zeros((0, 2), np.int32), 0, PROCESS
    )
    return dataclasses.replace(scene, render_costs=costs)


def options(memory, error=0.0005, parts=True):
    return CullOptions(width=SIZE[0], max_error=Budget(error, 5 * error), parts=parts, memory=memory)


@pytest.fixture(scope="module")
def by_limit():
    """Results of the terrain by megabytes that its render may take."""
    scene = priced(terrain())
    return {limit: analyze(scene, options(limit * MEGABYTE)) for limit in (500, 120, 90, 65)}


def total(result, scene):
    share = np.ones(len(scene.meshes))
    for row, faces in result.faces.items():
        share[scene.instances.mesh[row]] = faces.mean()
    costs = scene.render_costs
    return costs.at_most(costs.total(scene.instances.mesh, scene.instances.slots, result.active, share))


def test_where_all_fits_nothing_changes(by_limit):
    scene = priced(terrain())
    free = analyze(dataclasses.replace(scene, render_costs=None), options(0))
    roomy = by_limit[500]
    assert roomy.stats["memory_limit_bytes"] == 500 * MEGABYTE
    assert roomy.stats["certified_mean"] <= 0.0005
    assert free.stats["certified_mean"] <= 0.0005


def test_it_fits_and_the_less_there_is_the_more_changes(by_limit):
    scene = priced(terrain())
    for limit, result in by_limit.items():
        assert total(result, scene) <= limit * MEGABYTE, limit
    changes = [by_limit[limit].stats["certified_mean"] for limit in (500, 120, 90, 65)]
    assert changes == sorted(changes)
    assert changes[-1] > 0.0005  # and says so
    assert changes[0] == changes[1] <= 0.0005  # what the budget lets go is enough
    assert by_limit[65].stats["parts_active"] < by_limit[120].stats["parts_active"]


def test_no_more_goes_than_it_takes(by_limit):
    """A part of the terrain takes less than half a megabyte."""
    scene = priced(terrain())
    assert total(by_limit[65], scene) > 64 * MEGABYTE


def test_too_little_is_refused_with_what_is_needed():
    scene = priced(terrain())
    with pytest.raises(InputError, match=r"60 MB is too little: .* at least 63 MB: 63 MB for Blender") as error:
        analyze(scene, options(60 * MEGABYTE))
    assert "0 MB for what cannot be culled" in str(error.value)


def test_what_is_pinned_is_needed():
    scene = priced(terrain())
    with pytest.raises(InputError, match=r"at least \d+ MB: 62 MB for Blender.*, [3-9]\d MB for what cannot be"):
        analyze(scene, options(70 * MEGABYTE, parts=False), pinned=np.array([True, False]))


def test_levels_make_room_for_what_would_have_to_go():
    """The terrain, which may be simplified, in so little that what stays of it would not fit as it is."""
    scene = dataclasses.replace(priced(terrain()), simplifiable=np.array([True, False]))
    costs, error = scene.render_costs, 0.01
    free = analyze(scene, dataclasses.replace(options(0, error), levels=True))
    left = len(free.stand_ins[0]) / len(scene.meshes[0].triangles)
    taken = costs.process + int(left * costs.mesh[0]) + int(free.active[1]) * int(costs.mesh[1])
    limit = costs.at_most(taken) + MEGABYTE // 10
    result = analyze(scene, dataclasses.replace(options(limit, error), levels=True))
    assert len(result.stand_ins[0]) == len(free.stand_ins[0])
    assert result.stats["certified_mean"] == free.stats["certified_mean"] <= error
    assert np.array_equal(result.faces[0], free.faces[0]) and total(result, scene) > limit


def test_what_levels_do_not_make_fit_goes():
    """Part by part, as without levels."""
    scene = dataclasses.replace(priced(terrain()), simplifiable=np.array([True, False]))
    limit = 63 * MEGABYTE
    result = analyze(scene, dataclasses.replace(options(limit, 0.003), levels=True))
    assert result.stats["certified_mean"] > 0.003
    assert not result.stand_ins and total(result, scene) <= limit
