"""mirror-city: as many instances as asked, the same street for every count, nothing in it that the engine does not
support."""

from __future__ import annotations

import bpy
import numpy as np
import pytest

from lipac.core.errors import InputError
from lipac.lipac_addon.demo import build, mirror_city
from lipac.lipac_addon.demo.city_parts import DEPTH, WIDTH


def _cloud() -> tuple[np.ndarray, np.ndarray]:
    """Transforms (N, 16) and reference index (N,) of the city's instances, as Blender evaluates them."""
    host = bpy.data.objects["City"].evaluated_get(bpy.context.evaluated_depsgraph_get())
    geometry = host.evaluated_geometry()  # freed memory otherwise
    cloud = geometry.instances_pointcloud()
    transform, index = np.empty(16 * len(cloud.points), np.float32), np.empty(len(cloud.points), np.int32)
    cloud.attributes["instance_transform"].data.foreach_get("value", transform)
    cloud.attributes[".reference_index"].data.foreach_get("value", index)
    return transform.reshape(-1, 16), index


@pytest.mark.smoke
def test_blender_makes_the_instances_that_layout_places() -> None:
    build("mirror-city", 1_500, 3)
    points, kind, turn, size = mirror_city.layout(1_500, np.random.default_rng(3))
    transform, index = _cloud()
    assert len(transform) == 1_500
    np.testing.assert_allclose(transform[:, 12:15], points, atol=1e-4)
    names = [o.name for o in bpy.data.collections["City parts"].objects]
    assert names == sorted(names)  # Collection Info's order is the order of the kinds
    np.testing.assert_array_equal(index, kind)
    np.testing.assert_allclose(transform[:, 0], np.cos(turn) * size, atol=1e-5)  # float32 sine and cosine
    np.testing.assert_allclose(transform[:, 1], np.sin(turn) * size, atol=1e-5)


def test_the_street_is_the_same_at_every_count_and_the_rest_is_outside_of_it() -> None:
    small, large = (mirror_city.layout(n, np.random.default_rng(0)) for n in (1_000, 30_000))
    suburb_house = (small[1] >= mirror_city.TOWN_HOUSES) & (
        small[1] < mirror_city.TOWN_HOUSES + mirror_city.SUBURB_HOUSES
    )
    street = int(np.argmax(suburb_house))  # a block starts with its houses
    assert 100 < street < 1_000
    for a, b in zip(small, large, strict=True):
        np.testing.assert_array_equal(a[:street], b[:street])
    points, kind = large[0][street:], large[1][street:]
    inside = (
        (np.abs(points[:, 0]) < mirror_city.HALF_STREET + DEPTH)
        & (points[:, 1] > mirror_city.SOUTH - DEPTH)
        & (points[:, 1] < mirror_city.NORTH + DEPTH)
    )
    assert not inside.any()
    assert (kind >= mirror_city.TOWN_HOUSES).all()


def test_houses_of_the_suburbs_do_not_overlap() -> None:
    points, kind, _, _ = mirror_city.layout(20_000, np.random.default_rng(0))
    house = points[(kind >= mirror_city.TOWN_HOUSES) & (kind < mirror_city.TOWN_HOUSES + mirror_city.SUBURB_HOUSES)]
    assert len(np.unique(np.round(house, 3), axis=0)) == len(house)
    order = np.lexsort((house[:, 0], house[:, 1]))
    step = np.diff(house[order], axis=0)
    neighbours = step[:, 1] == 0
    assert (step[neighbours, 0] >= WIDTH - 1e-9).all()


def test_no_house_of_the_suburbs_rises_above_the_street() -> None:
    """Else the city would look over the roofs and the picture would change with the number of instances."""
    build("mirror-city", 1_000)
    height = np.array([o.bound_box[6][2] for o in bpy.data.collections["City parts"].objects])
    town, suburb = (
        height[: mirror_city.TOWN_HOUSES],
        height[mirror_city.TOWN_HOUSES : mirror_city.TOWN_HOUSES + mirror_city.SUBURB_HOUSES],
    )
    assert suburb.max() < town.min()


def test_all_materials_are_plain_principled() -> None:
    build("mirror-city", 1_000)
    for mat in bpy.data.materials:
        assert sorted(n.type for n in mat.node_tree.nodes) == ["BSDF_PRINCIPLED", "OUTPUT_MATERIAL"], mat.name
    mirror = bpy.data.materials["Mirror"].node_tree.nodes["Principled BSDF"].inputs
    assert mirror["Metallic"].default_value == 1.0
    assert mirror["Roughness"].default_value == 0.0


@pytest.mark.parametrize(
    ("name", "count", "says"),
    [("no-such", 1_000, "mirror-city"), ("mirror-city", 999, "--instances"), ("mirror-city", 1_000_001, "--instances")],
)
def test_unusable_requests_say_what_to_do(name: str, count: int, says: str) -> None:
    with pytest.raises(InputError, match=says):
        build(name, count)
