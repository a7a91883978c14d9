"""Write-back: what is said to be removed is what a render no longer meets, and restore leaves no trace."""

from collections import Counter

import bpy
import numpy as np
import pytest

from lipac.lipac_addon.keys import Kind
from lipac.lipac_addon.writeback import apply, restore
from lipac.tests.lipac_addon.writeback.conftest import linked, who_and_where

# Share of instances culled, at random; 1 culls everything.
SHARES = (0.3, 0.8, 1.0)


def masks(count, seed=0):
    rng = np.random.default_rng(seed)
    for share in SHARES:
        yield rng.random(count) < share


def check(result, culled, places, before, after):
    """A render meets what it met before, less the removed; every culled instance is accounted for."""
    assert not (result.removed & ~culled).any()
    gone = Counter(p for p, r in zip(places, result.removed, strict=True) if r)
    assert after == before - gone
    assert int(result.removed.sum()) + sum(result.kept.values()) == int(culled.sum())


def test_render_meets_exactly_the_rest(any_scene, census_keys, shown):
    keys, places = census_keys()
    before = shown()
    for culled in masks(len(places)):
        check(apply(culled, keys), culled, places, before, shown())
    restore()
    assert shown() == before


def test_whole_hosts(any_scene, census_keys, shown):
    """Everything of one host, or one object, at a time."""
    keys, places = census_keys()
    before = shown()
    for field in ("host", "object"):
        for n in np.unique(keys.records[field]):
            culled = keys.records[field] == n
            check(apply(culled, keys), culled, places, before, shown())


def test_restore_leaves_no_trace(any_scene, census_keys, snapshot):
    keys, places = census_keys()
    before = snapshot()
    for culled in masks(len(places), seed=1):
        apply(culled, keys)
        apply(culled, keys, free=True)
        restore()
        assert snapshot() == before
    assert restore() is False


def test_apply_twice_is_apply_once(any_scene, census_keys, snapshot):
    keys, places = census_keys()
    culled = next(masks(len(places), seed=2))
    apply(culled, keys, free=True)
    once = snapshot()
    apply(culled, keys, free=True)
    assert snapshot() == once


def test_record_survives_saving(any_scene, census_keys, snapshot, tmp_path):
    keys, places = census_keys()
    file = str(tmp_path / "file.blend")
    bpy.ops.wm.save_as_mainfile(filepath=file)
    bpy.ops.wm.open_mainfile(filepath=file)
    before = snapshot()
    apply(np.ones(len(places), bool), keys, free=True)
    bpy.ops.wm.save_as_mainfile(filepath=file)
    bpy.ops.wm.open_mainfile(filepath=file)
    restore()
    assert snapshot() == before


@pytest.mark.parametrize(
    ("scene", "share", "reason"),
    [
        ("nodes_object", 0.8, "its object also makes instances that stay"),
        ("nodes_collection", 0.7, "other parts of the same nested instance stay"),
        ("nodes_light", 0.5, "its object also shows lights, volumes, hair or metaballs"),
        ("nodes_fed", 1.0, "its host is itself instanced by another object"),
        ("collections", 0.45, "part of a collection instance: the same part stays elsewhere"),
        ("particles", 0.5, "single particles cannot be removed"),
        ("particle_collection", 1.0, "a particle system picks from its collection"),
        ("duplis", 0.5, "single vertex and face duplicates cannot be removed"),
        ("animated", 1.0, "render visibility is animated"),
        ("simulation", 1.0, "its object takes part in a simulation"),
        ("metaballs", 1.0, "metaballs merge: one cannot be hidden alone"),
    ],
)
def test_reasons(scene, share, reason, build, census_keys):
    """What stays says why."""
    build(scene)
    keys, places = census_keys()
    culled = np.arange(len(places)) < share * len(places)
    if reason == "its object also makes instances that stay":
        culled[keys.records["kind"] == Kind.OBJECT] = True
    kept = apply(culled, keys).kept
    assert reason in kept


@pytest.mark.parametrize("scene", ["nodes_object", "nodes_children"])
def test_single_instances_of_nodes_all_go(scene, build, census_keys):
    """Geometry nodes: nothing stays of what is culled, for objects and for picked children."""
    build(scene)
    keys, _places = census_keys()
    for chosen in masks(len(keys.records)):
        culled = chosen & (keys.records["host"] >= 0)
        result = apply(culled, keys)
        assert (result.removed == culled).all()
        assert result.hosts + result.objects == 1


def test_nested_row_goes_only_as_a_whole(build, census_keys):
    build("nodes_collection")
    keys, _places = census_keys()
    culled = (keys.records["path"][:, 0] == 3) | (np.arange(len(keys.records)) == 0)
    result = apply(culled & (keys.records["host"] >= 0), keys)
    assert result.removed.sum() == 2  # both parts of row 3
    assert sum(result.kept.values()) <= 1


def test_a_lamp_stays(build, census_keys):
    build("objects")
    keys, _places = census_keys()
    result = apply(np.ones(len(keys.records), bool), keys)
    assert {ob.name for ob in bpy.data.objects if ob.hide_render} == {"o0", "o1", "o2", "o3", "o4", "text"}
    assert result.objects == 6


def test_user_edits_stay(build, census_keys):
    build("objects")
    keys, _places = census_keys()
    apply(keys.records["object"] != keys.names.index("o4"), keys)
    bpy.data.objects["o2"].hide_render = False
    bpy.data.objects["o4"].hide_render = True
    bpy.data.objects["o3"].name = "renamed"
    restore()
    assert {ob.name for ob in bpy.data.objects if ob.hide_render} == {"o4"}


def test_user_may_remove_the_modifier(build, census_keys, snapshot):
    build("nodes_object")
    keys, _places = census_keys()
    before = snapshot()
    apply(next(masks(len(keys.records))), keys)
    host = bpy.data.objects["host"]
    host.modifiers.remove(host.modifiers["LiPaC mask"])
    restore()
    assert snapshot() == before


def test_linked_host_is_reported(build, census_keys, shown, tmp_path, new_file):
    build("nodes_object")
    linked(tmp_path, "host", "source", "Camera")
    keys, places = census_keys()
    before = shown()
    culled = (keys.records["host"] >= 0) & (np.arange(len(places)) % 2 == 0)
    result = apply(culled, keys)
    check(result, culled, places, before, shown())
    assert result.kept == {
        "its host takes no modifier: linked from a library, or of a type without modifiers": int(culled.sum())
    }
    everything = np.ones(len(places), bool)  # hiding works on linked objects
    check(apply(everything, keys), everything, places, before, shown())
    assert not result.kept or not shown()
    restore()
    assert shown() == before


def test_override_takes_the_mask(build, census_keys, shown, snapshot, tmp_path):
    build("nodes_object")
    host, _camera = linked(tmp_path, "host", "Camera")
    host.override_create(remap_local_usages=True)  # Blender 5.3 overrides only what the file uses
    keys, places = census_keys()
    before, data = shown(), snapshot()
    culled = (keys.records["host"] >= 0) & (np.arange(len(places)) % 2 == 0)
    result = apply(culled, keys)
    assert (result.removed == culled).all()
    check(result, culled, places, before, shown())
    restore()
    assert snapshot() == data


def test_lengths_must_agree(build, census_keys):
    build("objects")
    keys, _places = census_keys()
    with pytest.raises(ValueError, match="states for"):
        apply(np.zeros(1, bool), keys)


IDS = {
    "none": None,
    "own": [7 * k + 3 for k in range(20)],
    "all equal": [5] * 20,
    "pairs": [k // 2 for k in range(20)],
    "two scatters": [*range(10), *range(10)],
}


def with_ids(ids):
    if ids is not None:
        bpy.data.objects["host"].data.attributes.new("id", "INT", "POINT").data.foreach_set("value", ids)


@pytest.mark.parametrize("ids", IDS.values(), ids=IDS)
@pytest.mark.parametrize("scene", ["nodes_object", "nodes_collection", "nodes_children"])
def test_survivors_keep_their_random_numbers(scene, ids, build, census_keys, met):
    """Object Info > Random, and what motion blur finds an instance by, whatever ids a scatter has."""
    build(scene)
    keys, _places = census_keys()  # before there are ids: Blender lists instances by these
    with_ids(ids if ids is None else ids[: len(bpy.data.objects["host"].data.vertices)])
    before = {who_and_where(i): i.random for i in met()}
    for rows in masks(len(bpy.data.objects["host"].data.vertices), seed=3):
        assert apply(rows[keys.records["path"][:, 0]] & (keys.records["host"] >= 0), keys).removed.any()
        assert all(before[who_and_where(i)] == i.random for i in met())


def random_colours():
    """Every surface of the open file in the colour of its random number."""
    material = bpy.data.materials.new("random")
    if bpy.app.version < (5, 0, 0):
        material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    info, shader = nodes.new("ShaderNodeObjectInfo"), nodes.new("ShaderNodeEmission")
    links.new(info.outputs["Random"], shader.inputs["Strength"])
    links.new(shader.outputs[0], next(n for n in nodes if n.type == "OUTPUT_MATERIAL").inputs["Surface"])
    for mesh in bpy.data.meshes:
        mesh.materials.append(material)


@pytest.mark.parametrize(("engine", "ids"), [("CYCLES", "none"), ("CYCLES", "pairs"), ("BLENDER_EEVEE", "pairs")])
def test_what_is_unseen_changes_no_pixel(engine, ids, build, new_file, census_keys, tmp_path):
    """Culling what lies outside the picture leaves it bit for bit, colours by number included."""
    build("nodes_object")
    keys, _places = census_keys()
    with_ids(IDS[ids])
    for vertex in bpy.data.objects["host"].data.vertices:
        vertex.co.x += 1000.0 * (vertex.index % 3 == 0)
    random_colours()
    picture(tmp_path / "first.exr", engine)  # EEVEE's first one in a process differs from all later ones
    full = picture(tmp_path / "full.exr", engine)
    culled = (keys.records["host"] >= 0) & (keys.records["path"][:, 0] % 3 == 0)
    assert apply(culled, keys).removed.sum() == 7
    culled_picture = picture(tmp_path / "culled.exr", engine)
    assert len(np.unique(full)) > 10
    assert (culled_picture == full).all()


def picture(path, engine="CYCLES"):
    """A small picture of the open file: (H W 4,) float32."""
    scene = bpy.context.scene
    scene.render.engine = engine
    scene.cycles.samples, scene.cycles.seed, scene.cycles.use_denoising, scene.cycles.use_adaptive_sampling = (
        4, 1, False, False
    )
    scene.eevee.taa_render_samples = 1
    scene.render.image_settings.file_format, scene.render.image_settings.color_depth = "OPEN_EXR", "32"
    scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True)
    image = bpy.data.images.load(str(path))
    pixels = np.empty(len(image.pixels), np.float32)
    image.pixels.foreach_get(pixels)
    bpy.data.images.remove(image)
    return pixels


def test_cycles_renders_what_deleting_would(build, new_file, census_keys, tmp_path):
    """Pixel for pixel: the mask against a host whose points were never there, hide_render against deletion."""
    build("nodes_object")
    new_file.world = bpy.data.worlds.new("World")
    host, source = bpy.data.objects["host"], bpy.data.objects["source"]
    keys, _places = census_keys()
    rows = keys.records["path"][:, 0]
    nodes = keys.records["host"] >= 0
    culled = (nodes & (rows % 3 != 0)) | (~nodes & (keys.records["object"] == keys.names.index("source")))
    full = picture(tmp_path / "full.exr")
    assert apply(culled, keys).removed.sum() == culled.sum()
    masked = picture(tmp_path / "masked.exr")
    restore()
    assert (picture(tmp_path / "restored.exr") == full).all()
    # Points that are not a multiple of three move out of the scatter: a second host without them
    stay = [v.co.copy() for v in host.data.vertices if v.index % 3 == 0]
    fewer = bpy.data.meshes.new("fewer")
    fewer.from_pydata(stay, [], [])
    second = bpy.data.objects.new("second", fewer)
    new_file.collection.objects.link(second)
    second.modifiers.new("scatter", "NODES").node_group = host.modifiers[0].node_group
    host.modifiers.clear()
    for collection in list(source.users_collection):
        collection.objects.unlink(source)
    deleted = picture(tmp_path / "deleted.exr")
    assert (masked == deleted).all()
    assert not (masked == full).all()
