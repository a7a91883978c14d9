"""The record in the file: whole, safe from what others wrote, and as lasting as what it speaks of."""

from collections import Counter

import bpy
import numpy as np
import pytest

from lipac.lipac_addon.writeback import apply, marks, mask, restore
from lipac.tests.lipac_addon.writeback.conftest import link, linked, particles, points, scatter, triangle


def everything(keys):
    return np.ones(len(keys.records), bool)


@pytest.mark.parametrize("broken", ["add", "mask_object"])
def test_a_failure_leaves_nothing(broken, build, census_keys, snapshot, monkeypatch):
    """Whatever step of the mask fails: hidden objects are shown again."""
    build("nodes_object")
    keys, _places = census_keys()
    culled = np.arange(len(keys.records)) != 5
    bpy.context.scene.collection.objects.link(triangle("plain"))
    keys, _places = census_keys()
    before = snapshot()

    def fail(*_):
        raise RuntimeError("no more")

    monkeypatch.setattr(mask, broken, fail)
    culled = np.ones(len(keys.records), bool)
    culled[np.flatnonzero(keys.records["host"] >= 0)[5]] = False
    with pytest.raises(RuntimeError, match="no more"):
        apply(culled, keys)
    assert snapshot() == before
    assert restore() is False


def test_objects_after_what_cannot_be_edited(new_file, tmp_path):
    """Blender writes values of many objects one after the other, and passes over overrides that it made itself: none of
    the values may go to a neighbour."""
    made = bpy.data.collections.new("made")
    for name in ("b override", "e override"):
        link(triangle(name), made)
    path = str(tmp_path / "library.blend")
    bpy.data.libraries.write(path, {made})
    for ob in list(made.objects):
        bpy.data.objects.remove(ob)
    bpy.data.collections.remove(made)
    with bpy.data.libraries.load(path, link=True) as (_, wanted):
        wanted.collections = ["made"]
    bpy.context.scene.collection.children.link(wanted.collections[0])
    wanted.collections[0].override_hierarchy_create(bpy.context.scene, bpy.context.view_layer)
    local = [link(triangle(name)) for name in ("a", "c", "d", "f", "g")]
    assert [ob.name for ob in bpy.data.objects if ob.is_property_readonly("hide_render") and not ob.library] == [
        "b override",
        "e override",
    ]
    for chosen in ([local[1], local[4]], [local[0], bpy.data.objects["b override"], local[3]]):
        marks.set_hidden(chosen, True)
        assert [ob for ob in bpy.data.objects if ob.hide_render] == chosen
        marks.set_hidden(chosen, False)
        assert not any(ob.hide_render for ob in bpy.data.objects)


def overrides(tmp_path):
    """Library overrides of a host, its source as a real object, a plain object and an emitter, in a file that was saved
    and loaded."""
    scatter(link(points("host", 20)), link(triangle("source"), at=(0, 9, 0)))
    link(triangle("plain"), at=(0, 11, 0))
    emitter = link(points("emitter", 8, faces=True))
    emitter.modifiers.new("particles", "PARTICLE_SYSTEM")
    settings = emitter.particle_systems[0].settings
    settings.type, settings.count, settings.render_type, settings.instance_object = (
        "HAIR",
        7,
        "OBJECT",
        bpy.data.objects["source"],
    )
    for ob in linked(tmp_path, "host", "plain", "emitter", "Camera"):
        ob.override_create(remap_local_usages=True)  # Blender 5.3 overrides only what the file uses
    bpy.context.scene.camera = bpy.data.objects["Camera", None]
    reopen(tmp_path / "shot.blend")


def reopen(path):
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    bpy.ops.wm.open_mainfile(filepath=str(path))


def test_overrides_are_shown_again_after_loading(new_file, census_keys, shown, tmp_path):
    overrides(tmp_path)
    keys, _places = census_keys()
    before, names = (
        shown(),
        {block.name_full for kind in (bpy.data.objects, bpy.data.meshes, bpy.data.node_groups) for block in kind},
    )
    of_emitter = keys.records["host"] == keys.names.index("emitter")
    culled = (
        of_emitter
        | (keys.records["object"] == keys.names.index("plain"))
        | ((keys.records["host"] >= 0) & (np.arange(len(keys.records)) % 2 == 0))
    )
    assert apply(culled, keys, lasting=True).removed.sum() == culled.sum()
    hidden = shown()
    assert hidden != before
    reopen(tmp_path / "shot.blend")
    assert shown() == hidden
    assert {ob.name: [word.split(":")[0] for word in words] for ob, words in marks.all_marks().items()} == {
        "plain": ["hide_render"],
        "host": ["masked"],
        "emitter": ["particles"],
    }
    assert restore()
    assert shown() == before
    reopen(tmp_path / "shot.blend")
    assert shown() == before
    assert {
        block.name_full for kind in (bpy.data.objects, bpy.data.meshes, bpy.data.node_groups) for block in kind
    } == names


def test_a_renamed_particle_modifier(build, census_keys, shown):
    build("particles")
    keys, _places = census_keys()
    before, emitter = shown(), bpy.data.objects["emitter"]
    apply(keys.records["host"] >= 0, keys)
    emitter.modifiers["particles"].name = "renamed"
    assert not emitter.modifiers["renamed"].show_render
    restore()
    assert shown() == before


def test_particles_of_an_earlier_version(new_file, shown):
    """Marked by the modifier's name."""
    particles()
    before, emitter = shown(), bpy.data.objects["emitter"]
    emitter.modifiers["particles"].show_render = False
    emitter[marks.KEY] = "particles:particles"
    restore()
    assert shown() == before


def test_a_collection_of_an_earlier_version(build, shown):
    build("objects")
    before, collection = shown(), bpy.data.collections["A"]
    collection.hide_render, collection[marks.KEY] = True, "hide_render"
    restore()
    assert shown() == before


@pytest.mark.parametrize("word", ["mask", "overrides", "particles:subdivision", "masked", "", "hide_render:x", 7])
def test_marks_that_others_wrote(word, build, census_keys, snapshot):
    """Nothing of the user's is removed or switched, whatever is marked."""
    build("nodes_object")
    host, source = bpy.data.objects["host"], bpy.data.objects["source"]
    hidden = bpy.data.collections.new("hidden")
    hidden.hide_render = True
    subdivision = host.modifiers.new("subdivision", "SUBSURF")
    subdivision.show_render = False
    cloud = link(points("cloud", 3), at=(0, 9, 0))  # its mesh is as a mask's
    cloud.data.attributes.new("culled", "BOOLEAN", "POINT")
    kept = bpy.data.objects.new("kept", None)
    kept.use_fake_user = host.modifiers["scatter"].node_group.use_fake_user = True
    blocks = (host, source, cloud, kept, hidden, *bpy.data.meshes, host.modifiers["scatter"].node_group)
    census_keys()
    before = snapshot()
    for block in blocks:
        block[marks.KEY] = word
    restore()
    keys, _places = census_keys()
    apply(keys.records["host"] >= 0, keys)
    restore()
    for block in blocks:
        block.pop(marks.KEY, None)
    assert snapshot() == before


def test_the_node_group_of_the_mask_may_go(build, census_keys, snapshot):
    build("nodes_object")
    keys, _places = census_keys()
    before = snapshot()
    apply((keys.records["host"] >= 0) & (np.arange(len(keys.records)) % 2 == 0), keys)
    bpy.data.node_groups.remove(bpy.data.node_groups["LiPaC mask"])
    restore()
    assert snapshot() == before


def test_names_with_a_newline(build, census_keys, shown):
    build("objects")
    for ob in bpy.data.objects:
        ob.name = f"{ob.name}\nsecond line"
    keys, _places = census_keys()
    assert not apply(everything(keys), keys).kept
    assert not [name for name, *_ in shown() if not name.startswith("lamp") and not name.startswith("Sun")]
    assert restore()


def test_a_linked_object_stays_where_it_would_not_last(build, census_keys, shown, tmp_path):
    """Blender neither saves nor undoes what is set on it."""
    build("objects")
    linked(tmp_path, "o0", "o1", "Camera")
    keys, _places = census_keys()
    before = shown()
    result = apply(everything(keys), keys, lasting=True)
    assert result.kept == {
        "its object is linked: Blender neither saves nor undoes a change of it (a library override takes it)": 2
    }
    assert not result.removed.any()
    assert shown() == before
    assert apply(everything(keys), keys).removed.all()  # for the renders of this session it can be hidden
    restore()
    assert shown() == before


def test_what_is_appended_from_a_culled_file(build, census_keys, shown, tmp_path):
    """A masked host and a hidden object bring their marks along, and are shown again in full."""
    build("nodes_object")
    link(triangle("plain"), at=(0, 11, 0))
    keys, _places = census_keys()
    culled = ((keys.records["host"] >= 0) & (np.arange(len(keys.records)) % 2 == 0)) | (
        keys.records["object"] == keys.names.index("plain")
    )
    before = Counter({who: n for who, n in shown().items() if who[0] != "Sun"})
    apply(culled, keys)
    library = str(tmp_path / "culled.blend")
    bpy.ops.wm.save_as_mainfile(filepath=library)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    with bpy.data.libraries.load(library, link=False) as (_found, wanted):
        wanted.objects = ["host", "plain", "source", "Camera"]
    for ob in wanted.objects:
        bpy.context.scene.collection.objects.link(ob)
    bpy.context.scene.camera = bpy.data.objects["Camera"]
    assert sum(shown().values()) < sum(before.values())
    assert restore()
    assert shown() == before
    assert not [
        block
        for kind in (bpy.data.objects, bpy.data.meshes, bpy.data.node_groups)
        for block in kind
        if block.name.startswith("LiPaC")
    ]


@pytest.mark.parametrize("free", [False, True], ids=["masked", "emptied"])
@pytest.mark.parametrize("overridden", [False, True], ids=["linked", "overridden"])
def test_what_is_linked_from_a_culled_file(free, overridden, build, census_keys, shown, tmp_path):
    """All of it is shown again, until the file is opened anew; whence it comes is told."""
    build("nodes_object")
    link(triangle("plain"), at=(0, 11, 0))
    keys, _places = census_keys()
    culled = ((keys.records["host"] >= 0) & (free | (np.arange(len(keys.records)) % 2 == 0))) | (
        keys.records["object"] == keys.names.index("plain")
    )
    before = sum(n for (name, *_), n in shown().items() if name != "Sun")
    assert apply(culled, keys, free=free).removed.sum() == culled.sum()
    library = str(tmp_path / "culled.blend")
    bpy.ops.wm.save_as_mainfile(filepath=library)
    assert marks.culled_libraries() == []
    bpy.ops.wm.read_factory_settings(use_empty=True)
    with bpy.data.libraries.load(library, link=True) as (_found, wanted):
        wanted.objects = ["host", "plain", "source", "Camera"]
    for ob in wanted.objects:
        bpy.context.scene.collection.objects.link(ob)
    for ob in wanted.objects if overridden else ():
        ob.override_create(remap_local_usages=True)
    bpy.context.scene.camera = next(ob for ob in bpy.context.scene.objects if ob.type == "CAMERA")
    assert sum(shown().values()) < before
    assert marks.culled_libraries() == [library]
    assert restore()
    assert sum(shown().values()) == before
    assert not restore()
