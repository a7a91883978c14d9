"""What must not be hidden, for more hangs on it than its own instances."""

import subprocess
import sys
from pathlib import Path

import bpy
import numpy as np
import pytest

import lipac
from lipac.lipac_addon.extract import extract_frame
from lipac.lipac_addon.writeback import apply, restore
from lipac.lipac_addon.writeback.references import scenes_in_picture
from lipac.tests.lipac_addon.writeback.conftest import link, points, scatter, triangle

FIELD = Path(lipac.__file__).parent.parent / "shared" / "cases" / "field"
UNBAKED = "its simulation is not baked: hiding it would empty the cache"
DRIVES = "a driver reads whether its object renders"
ELSEWHERE = "another scene that is part of the picture shows it, too"


def emitter():
    """Particles that move, played to frame 10."""
    ob = link(points("emitter", 8, faces=True))
    ob.modifiers.new("particles", "PARTICLE_SYSTEM")
    settings = ob.particle_systems[0].settings
    settings.count, settings.frame_start, settings.frame_end, settings.render_type = 30, 1, 5, "OBJECT"
    settings.instance_object = link(triangle("source"), at=(0, 9, 0))
    return ob, ob.particle_systems[0].point_cache


def cloth():
    ob = link(points("emitter", 8, faces=True))
    return ob, ob.modifiers.new("cloth", "CLOTH").point_cache


def played():
    for frame in range(1, 11):
        bpy.context.scene.frame_set(frame)


@pytest.mark.parametrize(("kind", "itself"), [(emitter, True), (emitter, False), (cloth, True)])
def test_an_unbaked_cache_is_left_alone(kind, itself, new_file, census_keys, shown):
    ob, cache = kind()
    played()
    keys, _places = census_keys()
    before, info = shown(), cache.info
    name = keys.names.index("emitter")
    chosen = (keys.records["host"] == name) | ((keys.records["object"] == name) & itself)
    result = apply(chosen, keys)
    assert result.kept == {UNBAKED: int(chosen.sum())}
    restore()
    bpy.context.view_layer.update()
    assert cache.info == info
    assert shown() == before
    with bpy.context.temp_override(point_cache=cache, active_object=ob, object=ob):
        bpy.ops.ptcache.bake(bake=True)
    assert apply(chosen, keys).removed.sum() == chosen.sum()
    restore()
    assert shown() == before


@pytest.mark.parametrize("kind", [emitter, cloth])
def test_the_parent_of_an_unbaked_simulation_is_left_alone(kind, new_file, census_keys):
    """Blender passes on that it changed."""
    ob, cache = kind()
    ob.parent = link(triangle("parent"), at=(1, 1, 1))
    played()
    keys, _places = census_keys()
    info = cache.info
    assert apply(keys.records["object"] == keys.names.index("parent"), keys).kept == {UNBAKED: 1}
    bpy.context.view_layer.update()
    assert cache.info == info
    restore()
    bpy.context.view_layer.update()
    assert cache.info == info


def follow(ob, source):
    ob.constraints.new("COPY_ROTATION").target = source


def turn_by_driver(ob, source):
    driver = ob.driver_add("rotation_euler", 0).driver
    variable = driver.variables.new()
    variable.type = "TRANSFORMS"
    variable.targets[0].id, driver.expression = source, "var"


def instance_a_child(_ob, source):
    source.parent = link(triangle("other"), at=(0, 3, 0))


@pytest.mark.parametrize("how", [None, follow, turn_by_driver, instance_a_child])
def test_what_an_unbaked_simulation_reads_is_left_alone(how, new_file, census_keys, shown):
    """Blender begins it anew at the next render after that has changed."""
    ob, _cache = emitter()
    source = bpy.data.objects["source"]
    if how in (follow, turn_by_driver):
        ob.particle_systems[0].settings.instance_object = link(triangle("instanced"), at=(0, 5, 0))
    if how is not None:
        how(ob, source)
    played()
    keys, _places = census_keys()
    before = shown()
    name = keys.names.index("other" if how is instance_a_child else "source")
    culled = (keys.records["object"] == name) & (keys.records["host"] < 0)
    assert apply(culled, keys).kept == {UNBAKED: 1}
    shown()
    restore()
    assert shown() == before


def test_a_simulation_zone_is_left_alone(new_file, census_keys):
    host = link(points("host", 8, faces=True))
    scatter(host, link(triangle("source"), at=(0, 9, 0)))
    tree = host.modifiers[0].node_group
    zone = tree.nodes.new("GeometryNodeSimulationInput")
    zone.pair_with_output(tree.nodes.new("GeometryNodeSimulationOutput"))
    outer = bpy.data.node_groups.new("outer", "GeometryNodeTree")
    for way in ("INPUT", "OUTPUT"):
        outer.interface.new_socket("Geometry", in_out=way, socket_type="NodeSocketGeometry")
    ends = outer.nodes.new("NodeGroupInput"), outer.nodes.new("GeometryNodeGroup"), outer.nodes.new("NodeGroupOutput")
    ends[1].node_tree = tree
    outer.links.new(ends[0].outputs[0], ends[1].inputs[0])
    outer.links.new(ends[1].outputs[0], ends[2].inputs[0])
    host.modifiers[0].node_group = outer
    keys, _places = census_keys()
    culled = keys.records["host"] >= 0
    assert apply(culled, keys).kept == {UNBAKED: int(culled.sum())}


def driven(ob, id_type, target, path, expression="var"):
    driver = ob.driver_add("hide_render").driver
    driver.expression = expression
    variable = driver.variables.new()
    variable.name = "var"
    if id_type:
        variable.targets[0].id_type = id_type
    variable.targets[0].id, variable.targets[0].data_path = target, path


@pytest.mark.parametrize("by", ["object", "scene", "python"])
def test_what_a_driver_reads_is_left_alone(by, new_file, census_keys, shown):
    controller, part, _ = (link(triangle(name), at=(k, 0, 0)) for k, name in enumerate(("controller", "part", "free")))
    if by == "object":
        driven(part, "", controller, "hide_render")
    elif by == "scene":
        driven(part, "SCENE", new_file, 'collection.objects["controller"].hide_render')
    else:
        driven(part, "", controller, "location.x", "var + bpy.data.objects['controller'].hide_render")
    keys, _places = census_keys()
    culled = keys.records["object"] != keys.names.index("part")
    result = apply(culled, keys)
    assert result.kept == {DRIVES: 1}
    assert {name for name, *_ in shown()} >= {"controller", "part"}


def test_a_driver_that_reads_a_modifier(build, census_keys):
    build("particles")
    driven(link(triangle("part")), "", bpy.data.objects["emitter"], 'modifiers["particles"].show_render')
    keys, _places = census_keys()
    culled = keys.records["host"] >= 0
    assert apply(culled, keys).kept == {DRIVES: int(culled.sum())}


@pytest.mark.parametrize(
    ("file", "kept"),
    [("h_driver_parent", DRIVES), ("h_metaparticles", "its object also shows lights, volumes, hair or metaballs")],
)
def test_cases_from_the_field(file, kept, shown):
    """Where all that can go goes, what a driver hides, or a metaball instanced by particles adds, is as before."""
    if not FIELD.is_dir():
        pytest.skip("no shared cases")
    bpy.ops.wm.open_mainfile(filepath=str(FIELD / f"{file}.blend"), use_scripts=False)
    before = shown()
    extraction = extract_frame(bpy.context.scene)
    result = apply(np.ones(len(extraction.keys.records), bool), extraction.keys)
    assert kept in result.kept
    gone = set(before) - set(shown())
    names = {ob.name for ob in bpy.data.objects if ob.hide_render}
    assert {name for name, *_ in gone} <= names  # nothing but what was hidden itself
    restore()
    assert shown() == before


def test_another_scene_of_the_picture(new_file, census_keys):
    """The compositor reads it: what both show stays, be it shown as an instance."""
    for k in range(3):
        link(triangle(f"o{k}"), at=(k, 0, 0))
    scatter(link(points("host", 5)), bpy.data.objects["o1"])
    other = bpy.data.scenes.new("other")
    other.collection.objects.link(bpy.data.objects["host"])
    keys, _places = census_keys()
    culled = np.ones(len(keys.records), bool)
    assert not apply(culled, keys).kept  # nothing of it is read
    compose(new_file, other)
    assert apply(culled, keys).kept == {ELSEWHERE: 6}  # the five, and o1
    assert {ob.name for ob in bpy.data.objects if ob.hide_render} == {"o0", "o2"}
    new_file.render.use_compositing = False
    assert not apply(culled, keys).kept


def test_scenes_behind_another_scene(new_file):
    """What the compositor of a strip's scene reads is part of the picture, and the set behind that; the set behind the
    scene itself is analysed with it."""
    strip, read, backdrop, own = (bpy.data.scenes.new(name) for name in ("strip", "read", "set", "own"))
    new_file.sequence_editor_create().strips.new_scene("strip", strip, 1, 1)
    compose(strip, read)
    read.background_set, new_file.background_set = backdrop, own
    assert scenes_in_picture(new_file) == {strip, read, backdrop}
    backdrop.background_set = new_file
    assert scenes_in_picture(new_file) == {strip, read, backdrop}
    strip.render.use_compositing = False
    assert scenes_in_picture(new_file) == {strip}


def compose(scene, other):
    """A compositor that shows two scenes."""
    tree = scene.compositing_node_group = bpy.data.node_groups.new("both", "CompositorNodeTree")
    tree.interface.new_socket("Image", in_out="OUTPUT", socket_type="NodeSocketColor")
    over, output = tree.nodes.new("CompositorNodeAlphaOver"), tree.nodes.new("NodeGroupOutput")
    for k, read in enumerate((scene, other)):
        layers = tree.nodes.new("CompositorNodeRLayers")
        layers.scene = read
        tree.links.new(layers.outputs["Image"], over.inputs[k])
    tree.links.new(over.outputs[0], output.inputs[0])


CHILD = """
import bpy, numpy as np
import lipac
from lipac.lipac_addon.extract import extract_frame
from lipac.lipac_addon.writeback import apply, restore
from lipac.lipac_addon.writeback.references import scenes_in_picture
from lipac.tests.lipac_addon.writeback.conftest import collection, link, points, scatter, triangle
from lipac.tests.lipac_addon.writeback.test_references import compose

bpy.ops.wm.read_factory_settings(use_empty=True)
scene = bpy.context.scene
scene.camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
link(scene.camera, at=(2, 2, 20))
shared = collection("shared", scene.collection)
for k in range(40):
    link(triangle(f"o{k}"), shared, (k, 0, 0))
    link(triangle(f"own{k}"), at=(k, 2, 0))
scatter(link(points("host", 20)), bpy.data.objects["own0"])
other = bpy.data.scenes.new("other")
other.camera = scene.camera
other.collection.children.link(shared)
compose(scene, other)
for each in (scene, other):
    each.render.engine, each.cycles.samples = "CYCLES", 1
    each.render.resolution_x = each.render.resolution_y = 32
keys = extract_frame(scene).keys
culled = np.arange(len(keys.records)) % 2 == 0
def before(*_):
    print("removed", apply(culled, keys, scene=scene, in_render=True).removed.sum(), flush=True)
def after(*_):
    restore(in_render=True)
bpy.app.handlers.render_pre.append(before)
bpy.app.handlers.render_complete.append(after)
bpy.ops.render.render()
print("hidden", sum(ob.hide_render for ob in bpy.data.objects), flush=True)
"""


def test_a_render_whose_compositor_reads_a_second_scene(tmp_path):
    """Assigning visibility in its handlers crashes Blender; so in a process of its own."""
    script = tmp_path / "child.py"
    script.write_text(CHILD)
    child = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, encoding="utf-8", check=False)
    assert child.returncode == 0, child.stderr[-2000:]
    assert "hidden 0" in child.stdout
    assert "removed 30" in child.stdout  # half of what the other scene does not show: 40, and 20 of the scatter
