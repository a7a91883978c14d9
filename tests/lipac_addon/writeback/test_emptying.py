"""What goes is free: nothing of what only culled instances show is evaluated, loaded or built, and all of it comes
back."""

import subprocess
import sys

import bpy
import numpy as np
import pytest

from lipac.lipac_addon.farm.stripping import strip
from lipac.lipac_addon.writeback import apply, emptying, restore
from lipac.tests.lipac_addon.writeback.conftest import collection, empty, link, points, scatter, triangle


class Ids(bpy.types.RenderEngine):
    """A render engine that notes what data there is for a render, and how many vertices each mesh object has."""

    bl_idname = "LIPAC_IDS"
    bl_label = "Ids"
    names: set = set()  # noqa: RUF012
    vertices: dict = {}  # noqa: RUF012

    def render(self, depsgraph: bpy.types.Depsgraph) -> None:
        Ids.names = {
            f"{block.id_type} {block.name}" for block in depsgraph.ids if block.id_type in {"MATERIAL", "IMAGE"}
        }
        Ids.vertices = {
            block.name: len(block.data.vertices)
            for block in depsgraph.ids
            if isinstance(block, bpy.types.Object) and block.type == "MESH"
        }


@pytest.fixture(scope="module", autouse=True)
def ids():
    bpy.utils.register_class(Ids)
    yield
    bpy.utils.unregister_class(Ids)


def in_render():
    """What a render of the open file has: names of materials and images, and vertices by object."""
    scene = bpy.context.scene
    engine, scene.render.engine = scene.render.engine, Ids.bl_idname
    bpy.ops.render.render()
    scene.render.engine = engine
    return Ids.names, Ids.vertices


def dear(name):
    """A triangle with a picture of its own, subdivided."""
    ob = triangle(name)
    material = bpy.data.materials.new(name)
    if bpy.app.version < (5, 0, 0):
        material.use_nodes = True
    node = material.node_tree.nodes.new("ShaderNodeTexImage")
    node.image = bpy.data.images.new(name, 8, 8)
    shader = next(n for n in material.node_tree.nodes if n.type == "BSDF_PRINCIPLED")
    material.node_tree.links.new(node.outputs["Color"], shader.inputs["Base Color"])
    ob.data.materials.append(material)
    ob.modifiers.new("subdivision", "SUBSURF").render_levels = 3
    ob.modifiers.new("displacement", "DISPLACE").strength = 0.01
    return ob


def two():
    """A collection with two of them."""
    made = collection("inside")
    for name in ("seen", "unseen"):
        link(dear(name), made)
    return made


def picked():
    scatter(link(points("host", 6)), two(), separate=True)


def grouped():
    """By an input of the modifier, in a group within the group, with more modifiers behind."""
    host = link(points("host", 6))
    scatter(host, two(), separate=True)
    inner = host.modifiers[0].node_group
    outer = bpy.data.node_groups.new("outer", "GeometryNodeTree")
    outer.interface.new_socket("Geometry", in_out="INPUT", socket_type="NodeSocketGeometry")
    outer.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    start, group, turn, end = (
        outer.nodes.new(kind)
        for kind in ("NodeGroupInput", "GeometryNodeGroup", "GeometryNodeScaleInstances", "NodeGroupOutput")
    )
    group.node_tree = inner
    for a, b in ((start, group), (group, turn), (turn, end)):
        outer.links.new(a.outputs[0], b.inputs[0])
    host.modifiers[0].node_group = outer


def collection_instance():
    """One of its parts is culled everywhere, and hidden; Blender evaluates it all the same."""
    link(empty("e", two()))


def particle_instances():
    """The emitter stays, its particles go, and what they show is in no scene."""
    for name in ("seen", "unseen"):
        emitter = link(points(f"emitter {name}", 8, faces=True))
        emitter.modifiers.new("particles", "PARTICLE_SYSTEM")
        settings = emitter.particle_systems[0].settings
        settings.type, settings.count, settings.render_type = "HAIR", 5, "OBJECT"
        settings.instance_object = link(dear(name), collection(name))


def two_hosts():
    for name in ("seen", "unseen"):
        scatter(link(points(f"host {name}", 5, faces=True)), link(dear(name), collection(name)))


def plain():
    for name in ("seen", "unseen"):
        link(dear(name))


def vertex_children():
    parent = link(points("parent", 6, faces=True))
    parent.instance_type = "VERTS"
    for name in ("seen", "unseen"):
        link(dear(name)).parent = parent


ROWS = (plain, picked, grouped, two_hosts, collection_instance, particle_instances, vertex_children)


@pytest.fixture
def stored(snapshot):
    """A snapshot without what comes of the last evaluation, whenever that was."""
    derived = {"dimensions", "bound_box"}
    return lambda: {
        block: {k: v for k, v in values.items() if k not in derived} for block, values in snapshot().items()
    }


def of_unseen(keys):
    return keys.records["object"] == keys.names.index("unseen")


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.__name__)
def test_nothing_of_it_is_in_the_render(row, new_file, census_keys, shown, stored):
    if row is two_hosts and bpy.app.version < (5, 2):
        pytest.skip("Blender 5.0 and 5.1 crash on this scene as it is")
    row()
    keys, _ = census_keys()
    names, vertices = in_render()
    assert {"MATERIAL unseen", "IMAGE unseen", "MATERIAL seen", "IMAGE seen"} <= names
    before, met = stored(), shown()
    result = apply(of_unseen(keys), keys, free=True)
    assert (result.removed == of_unseen(keys)).all()
    names, vertices = in_render()
    assert {"MATERIAL seen", "IMAGE seen"} <= names
    assert not names & {"MATERIAL unseen", "IMAGE unseen"}
    assert not vertices.get("unseen")
    assert sum(n for who, n in shown().items() if who[0] == "seen") == sum(
        n for who, n in met.items() if who[0] == "seen"
    )
    restore()
    assert stored() == before


@pytest.mark.parametrize(
    "row", [picked, grouped, collection_instance, particle_instances], ids=lambda row: row.__name__
)
def test_it_would_be(row, new_file, census_keys):
    """The check itself: without emptying, it is all there."""
    row()
    keys, _ = census_keys()
    apply(of_unseen(keys), keys)
    assert {"MATERIAL unseen", "IMAGE unseen"} <= in_render()[0]


def test_a_baked_file(new_file, census_keys, stored, shown, tmp_path):
    """Saved and loaded, it costs nothing; and Restore puts all back, text and slots included; what has materials of its
    own keeps them."""
    made = two()
    unseen, own = made.objects["unseen"], link(dear("own"), made)
    unseen.data.materials.append(None)
    unseen.material_slots[1].link = own.material_slots[0].link = "OBJECT"
    own.material_slots[0].material = bpy.data.materials.new("paint")
    text = link(bpy.data.objects.new("text", bpy.data.curves.new("text", "FONT")), made)
    text.data.body = "text"
    text.data.materials.append(bpy.data.materials.new("ink"))
    scatter(link(points("host", 9)), made, separate=True)
    keys, _ = census_keys()
    reopen(tmp_path / "full.blend")
    before, met = stored(), shown()
    culled = keys.records["object"] != keys.names.index("seen")
    assert apply(culled, keys, lasting=True, free=True).sources == 3
    reopen(tmp_path / "baked.blend")
    names, _ = in_render()
    assert not names & {"MATERIAL unseen", "IMAGE unseen", "MATERIAL ink"}
    assert "MATERIAL paint" in names
    assert restore()
    assert (stored(), shown()) == (before, met)
    assert restore() is False


def reopen(path):
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    bpy.ops.wm.open_mainfile(filepath=str(path))


def realised():
    tree = bpy.data.objects["host"].modifiers[0].node_group
    join, out = (
        next(n for n in tree.nodes if n.bl_idname == kind) for kind in ("GeometryNodeJoinGeometry", "NodeGroupOutput")
    )
    put, bounds = (
        next(n for n in tree.nodes if n.bl_idname == "GeometryNodeInstanceOnPoints"),
        tree.nodes.new("GeometryNodeBoundBox"),
    )
    tree.links.new(put.outputs[0], bounds.inputs[0])
    tree.links.new(join.outputs[0], out.inputs[0])


def later_realised():
    """A modifier behind the scatter looks at what it gets."""
    host = bpy.data.objects["host"]
    scatter(host, bpy.data.objects["seen"])
    tree = host.modifiers[1].node_group
    start, out = (next(n for n in tree.nodes if n.bl_idname == kind) for kind in ("NodeGroupInput", "NodeGroupOutput"))
    hull = tree.nodes.new("GeometryNodeConvexHull")
    tree.links.new(start.outputs[0], hull.inputs[0])
    tree.nodes.active = hull
    assert out


def cut():
    link(triangle("cut")).modifiers.new("cut", "BOOLEAN").object = bpy.data.objects["unseen"]


def cut_by_collection():
    modifier = link(triangle("cut")).modifiers.new("cut", "BOOLEAN")
    modifier.operand_type, modifier.collection = "COLLECTION", bpy.data.collections["inside"]


def driven():
    variable = link(triangle("driven")).driver_add("location", 0).driver.variables.new()
    variable.targets[0].id, variable.targets[0].data_path = bpy.data.objects["unseen"], "dimensions.x"


def clamped():
    link(triangle("clamped")).constraints.new("SHRINKWRAP").target = bpy.data.objects["unseen"]


def on_a_vertex():
    child = link(triangle("child"))
    child.parent, child.parent_type = bpy.data.objects["unseen"], "VERTEX"


def shown_elsewhere():
    """What it instances itself stays."""
    unseen = bpy.data.objects["unseen"]
    unseen.instance_type, unseen.instance_faces_scale = "FACES", 1.0
    bpy.data.objects["seen"].parent = unseen


@pytest.mark.parametrize(
    "reader",
    [realised, later_realised, cut, cut_by_collection, driven, clamped, on_a_vertex, shown_elsewhere],
    ids=lambda f: f.__name__,
)
def test_what_is_looked_at_is_left(reader, new_file, census_keys):
    picked()
    keys, _ = census_keys()
    reader()
    result = apply(of_unseen(keys), keys, free=True)
    assert result.removed.sum() == 3
    assert result.sources == 0
    assert bpy.data.objects["unseen"].data.name == "unseen"


def test_half_way(new_file, census_keys, snapshot, monkeypatch):
    """All or nothing: a second object that fails leaves the first as it was."""
    picked()
    keys, _ = census_keys()
    before, exchange, done = snapshot(), emptying.exchange, []

    def fail(ob, stand_in):
        exchange(ob, stand_in)
        done.append(ob)
        raise MemoryError

    monkeypatch.setattr(emptying, "exchange", fail)
    with pytest.raises(MemoryError):
        apply(of_unseen(keys), keys, free=True)
    assert done
    assert snapshot() == before


def test_what_a_user_changes_since_stays(new_file, census_keys):
    picked()
    keys, _ = census_keys()
    apply(of_unseen(keys), keys, free=True)
    unseen, other = bpy.data.objects["unseen"], bpy.data.meshes.new("other")
    copy = unseen.copy()
    unseen.data = other
    restore()
    assert unseen.data == other
    assert copy.data.name == "unseen"
    assert not [mesh for mesh in bpy.data.meshes if mesh.name.startswith("LiPaC")]


@pytest.mark.parametrize("kept", [7, "text", {"data": 3, "own": [{}]}, {"own": 5}])
def test_a_record_that_others_wrote(kept, new_file):
    ob = link(triangle("a"))
    ob["lipac_kept"] = kept
    restore()
    assert ob.data.name == "a"
    assert "lipac_kept" not in ob


STATISTICS = """
import bpy, numpy as np, _cycles
from lipac.lipac_addon.extract import extract_frame
from lipac.lipac_addon.writeback import apply
from lipac.tests.lipac_addon.writeback import test_emptying as scenes
bpy.ops.wm.read_factory_settings(use_empty=True)
scene = bpy.context.scene
scene.camera = scenes.link(bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera")), at=(2, 2, 9))
scenes.picked()
for image in bpy.data.images:
    image.scale(512, 512)
scene.render.engine, scene.cycles.samples, scene.render.resolution_x, scene.render.resolution_y = "CYCLES", 1, 16, 16
keys = extract_frame(scene).keys
apply(scenes.of_unseen(keys), keys, free=FREE)
_cycles.enable_print_stats()
bpy.ops.render.render()
"""


@pytest.mark.parametrize("free", [False, True])
def test_cycles_statistics(free):
    """Cycles' own count of its images: of two, one."""
    done = subprocess.run(
        [sys.executable, "-c", STATISTICS.replace("FREE", str(free))], capture_output=True, text=True, check=True
    )
    images = done.stdout.partition("Image statistics")[2].partition("Kernel statistics")[0]
    assert "  seen " in images
    assert (" unseen " in images) != free


def test_a_culled_file_for_a_farm(new_file, census_keys):
    """It does not carry what emptied objects had."""
    picked()
    keys, _ = census_keys()
    apply(of_unseen(keys), keys, lasting=True, free=True)
    strip()
    assert {"seen", "unseen"} & {mesh.name for mesh in bpy.data.meshes} == {"seen"}
    assert "unseen" not in bpy.data.images
    restore()
    assert not bpy.data.objects["unseen"].data.vertices


def test_nothing_where_places_decide(new_file, census_keys):
    """What may come back after an edit keeps what it looks like."""
    picked()
    keys, _ = census_keys()
    assert apply(of_unseen(keys), keys, {"host": np.zeros((6, 3), np.float32)}, free=True).sources == 0
