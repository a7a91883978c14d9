"""Switches of the viewport: what they take out of it, and out of it alone."""

import bpy
import numpy as np
import pytest

from lipac.core.culling.options import State
from lipac.lipac_addon.extract import extract_frame
from lipac.lipac_addon.keys import Kind, full_name
from lipac.lipac_addon.ui.state import scatters
from lipac.lipac_addon.writeback import apply, restore, viewport
from lipac.lipac_addon.writeback.viewport_plan import candidates, viewport_plan
from lipac.tests.lipac_addon.writeback.conftest import collection, empty, link, points, scatter, triangle


@pytest.fixture
def host(boxes):
    """A scatter of eight triangles."""
    made = link(points("host", 8, faces=True))
    scatter(made, link(triangle("source"), at=(0, 0, 3)))
    bpy.context.view_layer.update()
    return made


def cloud(ob):
    """(rows, 3) where the rows of a scatter are in the viewport."""
    bpy.context.view_layer.update()
    geometry = ob.evaluated_get(bpy.context.view_layer.depsgraph).evaluated_geometry()
    found = geometry.instances_pointcloud()
    out = np.empty((len(found.points), 4, 4), np.float32)
    found.attributes["instance_transform"].data.foreach_get("value", out.ravel())
    return out[:, 3, :3]


def shown():
    bpy.context.view_layer.update()
    return {item.name for item in bpy.context.view_layer.depsgraph.objects}


def in_renders():
    """How many instances a render has."""
    return len(extract_frame(bpy.context.scene).keys.records)


def test_rows_go_where_they_were_and_nowhere_else(host):
    places, all_of_it = cloud(host), in_renders()
    gone = np.arange(8) % 2 == 0
    viewport.mask_rows(host, gone, places)
    np.testing.assert_array_equal(cloud(host), places[~gone])
    assert in_renders() == all_of_it
    viewport.mask_rows(host, ~gone, places)  # the same modifier, other rows
    np.testing.assert_array_equal(cloud(host), places[gone])
    assert [m.name for m in host.modifiers][1:] == [viewport.NAME]
    viewport.mask_rows(host, gone, places + 1.0)
    np.testing.assert_array_equal(cloud(host), places)  # nothing is there
    viewport.mask_rows(host, gone[:4], places)  # fewer rows: another mask
    assert len(cloud(host)) == 6
    for _ in range(2):  # none: a mesh without vertices
        viewport.mask_rows(host, gone[:0], places[:0])
        assert len(cloud(host)) == 8
    viewport.mask_rows(host, gone, places)
    viewport.set_masks_shown([host], False)
    assert len(cloud(host)) == 8
    assert viewport.restore()
    assert not viewport.restore()
    assert len(host.modifiers) == 1
    assert not [
        b.name for kind in (bpy.data.objects, bpy.data.meshes, bpy.data.node_groups) for b in kind if "LiPaC" in b.name
    ]


def numbers():
    """By where it is, the number of each row, from which its random colour goes."""
    bpy.context.view_layer.update()
    return {
        tuple(item.matrix_world.translation): item.random_id
        for item in bpy.context.view_layer.depsgraph.object_instances
        if item.is_instance and item.object.name == "source"
    }


@pytest.mark.parametrize("ids", [None, range(8, 0, -1), [0, 0, 1, 1, 2, 2, 3, 3]], ids=["none", "distinct", "equal"])
def test_what_stays_keeps_its_number(host, ids):
    """Also where a mask need not look for equal ids, since there are none."""
    if ids is not None:
        host.data.attributes.new("id", "INT", "POINT").data.foreach_set("value", list(ids))
    places, before = cloud(host), numbers()
    found = scatters.print_of(host, bpy.context.view_layer.depsgraph)
    assert found.distinct == (ids is None or len(set(ids)) == 8)
    gone = np.arange(8) % 2 == 0
    for distinct in {False, found.distinct}:
        viewport.mask_rows(host, gone, places, distinct)
        left = numbers()
        assert len(left) == 4 and left.items() <= before.items()
        viewport.restore()
    viewport.mask_rows(host, gone, places, True)
    assert (numbers().items() <= before.items()) == found.distinct  # it matters what a mask is told
    viewport.restore()


def test_a_copy_of_a_masked_scatter_is_found_and_its_original_stays_masked(host):
    places = cloud(host)
    viewport.mask_rows(host, np.arange(8) < 3, places)
    copy = host.copy()
    bpy.context.scene.collection.objects.link(copy)
    assert set(viewport.masked()) == {host, copy}
    viewport.unmask([copy])
    assert (len(cloud(copy)), len(cloud(host))) == (8, 5)
    viewport.restore()
    assert len(cloud(host)) == 8


def test_the_masks_of_renders_and_of_the_viewport_leave_each_other_alone(host):
    places, all_of_it = cloud(host), in_renders()
    extraction = extract_frame(bpy.context.scene)
    viewport.mask_rows(host, np.arange(8) < 3, places)
    apply(np.arange(all_of_it) >= 0, extraction.keys)
    assert viewport.unmask()
    assert len(cloud(host)) == 8
    viewport.mask_rows(host, np.arange(8) < 3, places)
    restore()
    assert in_renders() == all_of_it
    assert len(cloud(host)) == 5
    viewport.restore()


def test_eyes_are_opened_that_were_closed_and_no_others(boxes):
    layer = bpy.context.view_layer
    near, far, users = (bpy.data.objects[name] for name in ("box0", "box5", "box6"))
    users.hide_set(True)
    viewport.close_eyes(layer, [near, far, users])
    assert {ob.name for ob in viewport.closed_eyes(layer)} == {"box0", "box5"}
    assert not {"box0", "box5", "box6"} & shown()
    near.hide_set(False)  # by the user
    assert viewport.closed_eyes(layer) == [far]
    bpy.data.objects.remove(far)
    assert viewport.closed_eyes(layer) == []
    viewport.close_eyes(layer, [near])
    copied = bpy.context.scene.copy()
    assert viewport.restore()
    assert {ob.name for ob in bpy.data.objects if ob.hide_get(view_layer=layer)} == {"box6"}
    assert {ob.name for ob in copied.objects if ob.hide_get(view_layer=copied.view_layers[0])} == {"box6"}
    assert not any(viewport.KEY in scene.view_layers[0] for scene in bpy.data.scenes)


def plan_of(culled, keys):
    """Objects and masks, and (N,) bool, the culled instances that go by these."""
    objects, masks = viewport_plan(candidates(culled, keys), keys.names, bpy.context.scene)
    records, name = keys.records, {ob: keys.names.index(full_name(ob)) for ob in (*objects, *(ob for ob, _ in masks))}
    own = np.where(records["kind"] == Kind.OBJECT, records["object"], records["host"])
    out = np.isin(own, [name[ob] for ob in objects])
    for ob, rows in masks:
        mine = np.flatnonzero((records["host"] == name[ob]) & (records["kind"] == Kind.GEOMETRY_NODES))
        out[mine] |= rows[records["path"][mine, 0]]
    return objects, masks, out & culled


def plan_of_all():
    """The plan where everything is culled."""
    bpy.context.view_layer.update()
    extraction = extract_frame(bpy.context.scene)
    culled = np.full(len(extraction.keys.records), State.CULLED) == State.CULLED
    objects, masks, out = plan_of(culled, extraction.keys)
    return {ob.name for ob in objects}, {ob.name: rows for ob, rows in masks}, out, extraction.keys


def test_the_plan_closes_eyes_where_all_behind_them_is_culled(host):
    inside = collection("inside", bpy.context.scene.collection)
    link(triangle("part"), inside)
    link(empty("instance", inside), at=(3, 0, 0))
    extraction = extract_frame(bpy.context.scene)
    names, records = extraction.keys.names, extraction.keys.records
    culled = np.ones(len(records), bool)
    own = np.where(records["host"] >= 0, records["host"], records["object"])
    culled[np.flatnonzero(own == names.index("host"))[-1]] = False  # a row of the scatter, or its host's own mesh
    culled[np.flatnonzero(own == names.index("box3"))] = False
    objects, masks, out = plan_of(culled, extraction.keys)
    found = {ob.name for ob in objects}
    assert {"instance", "part", "source", "box0"} <= found  # an eye hides no instance that another makes
    assert not {"host", "box3"} & found
    assert [ob.name for ob, _ in masks] == ["host"]
    assert out.sum() == culled.sum() - (records["object"][culled] == names.index("host")).sum()
    viewport.close_eyes(bpy.context.view_layer, objects)
    assert len(cloud(host)) == 8  # its source has its eye closed
    viewport.restore()


def test_what_stands_against_it(boxes):
    boxes_ = {name: bpy.data.objects[name] for name in ("box0", "box1", "box2")}
    boxes_["box0"].modifiers.new("collision", "COLLISION")
    boxes_["box1"].modifiers.new("cloth", "CLOTH")
    ball = bpy.data.objects.new("ball", bpy.data.metaballs.new("ball"))
    ball.data.elements.new()
    bpy.context.scene.collection.objects.link(ball)
    objects, _, out, keys = plan_of_all()
    assert not {"box0", "box1", "ball"} & objects
    assert {"box2", "box3", "wall"} <= objects
    stay = {keys.names[n] for n in keys.records["object"][~out]}
    assert {"box0", "box1"} <= stay
