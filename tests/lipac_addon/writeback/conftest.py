"""Scenes of each kind of instancing, the instances a render meets (Blender's own list), and a snapshot of a file's
data."""

from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

import bpy
import numpy as np
import pytest

from lipac.lipac_addon.keys import KEY, MAX_DEPTH, Keys, Kind

SURFACES = {"MESH", "CURVE", "SURFACE", "FONT", "META"}


def linked(folder: Path, *names: str) -> list[bpy.types.Object]:
    """Save the open file as a library, and link objects of it, by name, into an empty file; the last is its camera."""
    library = str(folder / "library.blend")
    bpy.ops.wm.save_as_mainfile(filepath=library)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    with bpy.data.libraries.load(library, link=True) as (_found, wanted):
        wanted.objects = list(names)
    for ob in wanted.objects:
        bpy.context.scene.collection.objects.link(ob)
    bpy.context.scene.camera = wanted.objects[-1]
    return list(wanted.objects)


class Census(bpy.types.RenderEngine):
    """A render engine that only notes what it is given: render visibility as Cycles and EEVEE get it."""

    bl_idname = "LIPAC_CENSUS"
    bl_label = "Census"
    met: list = []  # noqa: RUF012

    def render(self, depsgraph: bpy.types.Depsgraph) -> None:
        Census.met.clear()
        for i in depsgraph.object_instances:
            if i.object.type == "LIGHT" or (i.object.type in SURFACES and i.show_self and has_faces(i.object)):
                path = [p for p in i.persistent_id if p < 2**31 - 1][::-1] if i.is_instance else []
                place = tuple(round(v, 4) for row in i.matrix_world for v in row)
                host = i.parent.original if i.parent else None
                Census.met.append(
                    SimpleNamespace(object=i.object.original, host=host, path=path, place=place, random=i.random_id)
                )


def has_faces(ob: bpy.types.Object) -> bool:
    return ob.type != "MESH" or len(ob.data.polygons) > 0


@pytest.fixture(scope="module", autouse=True)
def census() -> Iterator[type]:
    bpy.utils.register_class(Census)
    yield Census
    bpy.utils.unregister_class(Census)


@pytest.fixture
def met() -> Callable[[], list]:
    """Every instance in a render of the open file, in Blender's order."""

    def run() -> list:
        scene = bpy.context.scene
        engine, scene.render.engine = scene.render.engine, Census.bl_idname
        size, scene.render.resolution_percentage = scene.render.resolution_percentage, 25
        bpy.ops.render.render()
        scene.render.engine, scene.render.resolution_percentage = engine, size
        return list(Census.met)

    return run


@pytest.fixture
def shown(met: Callable[[], list]) -> Callable[[], Counter]:
    """The same, as a multiset of who and where."""
    return lambda: Counter(who_and_where(i) for i in met())


def who_and_where(i: SimpleNamespace) -> tuple:
    return i.object.name_full, i.host.name_full if i.host else "", i.place


@pytest.fixture
def census_keys(met: Callable[[], list]) -> Callable[[], tuple[Keys, list[tuple]]]:
    """Keys of the surfaces in the open file, from Blender's own list, and who and where each is."""

    def run() -> tuple[Keys, list[tuple]]:
        found = [i for i in met() if i.object.type != "LIGHT"]
        records = np.zeros(len(found), KEY)
        names: dict[str, int] = {}

        def index(ob: bpy.types.Object | None) -> int:
            full = "" if ob is None else ob.name if ob.library is None else f"{ob.library.filepath}\n{ob.name}"
            return -1 if ob is None else names.setdefault(full, len(names))

        for record, i in zip(records, found, strict=True):
            record["kind"] = kind_of(i)
            record["object"], record["host"] = index(i.object), index(None if kind_of(i) == Kind.OBJECT else i.host)
            record["path"] = (i.path + [-1] * MAX_DEPTH)[:MAX_DEPTH]
        return Keys(records, tuple(names)), [who_and_where(i) for i in found]

    return run


def kind_of(i: SimpleNamespace) -> Kind:
    if i.host in (None, i.object):  # text is its own host
        return Kind.OBJECT
    if i.host.particle_systems:
        return Kind.PARTICLE
    by_type = {"COLLECTION": Kind.COLLECTION, "VERTS": Kind.DUPLI, "FACES": Kind.DUPLI}
    return by_type.get(i.host.instance_type, Kind.GEOMETRY_NODES)


@pytest.fixture
def new_file() -> Iterator[bpy.types.Scene]:
    """An empty file with a camera and a sun."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    camera.location, scene.camera = (2, 2, 20), camera
    sun = bpy.data.objects.new("Sun", bpy.data.lights.new("Sun", "SUN"))
    for ob in (camera, sun):
        scene.collection.objects.link(ob)
    scene.render.resolution_x, scene.render.resolution_y = 64, 48
    yield scene
    bpy.ops.wm.read_factory_settings(use_empty=True)


def link(
    ob: bpy.types.Object, collection: bpy.types.Collection | None = None, at: tuple = (0, 0, 0)
) -> bpy.types.Object:
    ob.location = at
    (collection or bpy.context.scene.collection).objects.link(ob)
    return ob


def triangle(name: str) -> bpy.types.Object:
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata([(0, 0, 0), (0.8, 0, 0), (0, 0.8, 0)], [], [(0, 1, 2)])
    return bpy.data.objects.new(name, mesh)


def points(name: str, count: int, faces: bool = False) -> bpy.types.Object:
    mesh = bpy.data.meshes.new(name)
    spots = [(k % 4, k // 4, 0.0) for k in range(count)]
    mesh.from_pydata(spots, [], [(0, 1, 4), (2, 3, 6)] if faces else [])
    return bpy.data.objects.new(name, mesh)


def empty(name: str, collection: bpy.types.Collection) -> bpy.types.Object:
    ob = bpy.data.objects.new(name, None)
    ob.instance_type, ob.instance_collection = "COLLECTION", collection
    return ob


def collection(name: str, parent: bpy.types.Collection | None = None) -> bpy.types.Collection:
    new = bpy.data.collections.new(name)
    if parent is not None:
        parent.children.link(new)
    return new


def scatter(host: bpy.types.Object, source: bpy.types.ID, separate: bool = False) -> None:
    """A geometry-nodes modifier that puts an object or a collection on every point of the host and keeps the host's own
    faces."""
    tree = bpy.data.node_groups.new("scatter", "GeometryNodeTree")
    tree.interface.new_socket("Geometry", in_out="INPUT", socket_type="NodeSocketGeometry")
    tree.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    inputs, output = tree.nodes.new("NodeGroupInput"), tree.nodes.new("NodeGroupOutput")
    if isinstance(source, bpy.types.Collection):
        info = tree.nodes.new("GeometryNodeCollectionInfo")
        info.inputs["Collection"].default_value, info.inputs["Separate Children"].default_value = source, separate
    else:
        info = tree.nodes.new("GeometryNodeObjectInfo")
        info.inputs["Object"].default_value, info.inputs["As Instance"].default_value = source, True
    put, join = tree.nodes.new("GeometryNodeInstanceOnPoints"), tree.nodes.new("GeometryNodeJoinGeometry")
    put.inputs["Pick Instance"].default_value = separate
    geometry = next(s for s in info.outputs if s.type == "GEOMETRY")
    for a, b in (
        (inputs.outputs[0], put.inputs["Points"]),
        (geometry, put.inputs["Instance"]),
        (inputs.outputs[0], join.inputs[0]),
        (put.outputs[0], join.inputs[0]),
        (join.outputs[0], output.inputs[0]),
    ):
        tree.links.new(a, b)
    host.modifiers.new("scatter", "NODES").node_group = tree


def objects() -> None:
    """Single objects; one collection of its own, one that holds a light, one object in two collections."""
    scene = bpy.context.scene
    a, b, c = (collection(n, scene.collection) for n in ("A", "B", "C"))
    for k, place in enumerate((a, a, b, b, c)):
        link(triangle(f"o{k}"), place, (k, 0, 0))
    link(bpy.data.objects.new("lamp", bpy.data.lights.new("lamp", "POINT")), b)
    c.objects.link(bpy.data.objects["o0"])
    link(bpy.data.objects.new("text", bpy.data.curves.new("text", "FONT")), a).data.body = "text"


def nodes_object() -> None:
    """A scatter of an object, and the source as an object of its own."""
    host = link(points("host", 20, faces=True))
    scatter(host, link(triangle("source"), at=(0, 9, 0)))


def nodes_collection() -> None:
    """A scatter of a whole collection with two objects."""
    inside = collection("inside", bpy.context.scene.collection)
    link(triangle("a"), inside)
    link(triangle("b"), inside, (0.2, 0.3, 0.5))
    scatter(link(points("host", 12)), inside)


def nodes_children() -> None:
    """A scatter that picks from the objects of a collection, pinned to the end of the stack."""
    inside = collection("inside", bpy.context.scene.collection)
    link(triangle("a"), inside)
    link(triangle("b"), inside, (0.2, 0.3, 0.5))
    host = link(points("host", 12))
    scatter(host, inside, separate=True)
    host.modifiers[0].use_pin_to_last = True


def nodes_light() -> None:
    """A scatter of a collection with a lamp in it."""
    inside = collection("inside")
    link(triangle("a"), inside)
    link(bpy.data.objects.new("lamp", bpy.data.lights.new("lamp", "POINT")), inside)
    scatter(link(points("host", 6)), inside)


def nodes_fed() -> None:
    """A host in a collection that is instanced as well."""
    inside = collection("inside", bpy.context.scene.collection)
    host = link(points("host", 5, faces=False), inside)
    scatter(host, link(triangle("source"), at=(0, 9, 0)))
    link(empty("copy", inside), at=(5, 5, 0))


def collections() -> None:
    """Empties that instance a collection with a nested one; a lamp in a second one; a real object inside the first."""
    inside, with_lamp = collection("inside", bpy.context.scene.collection), collection("with lamp")
    nested = collection("nested", inside)
    link(triangle("a"), inside)
    link(triangle("b"), nested, (0.2, 0.3, 0.5))
    link(triangle("c"), with_lamp)
    link(bpy.data.objects.new("lamp", bpy.data.lights.new("lamp", "POINT")), with_lamp)
    for k in range(3):
        link(empty(f"e{k}", inside), at=(k, 1, 0))
    link(empty("lit", with_lamp), at=(0, 4, 0))


def particles() -> None:
    """Hair particles as instances of an object, on a mesh of its own."""
    emitter = link(points("emitter", 8, faces=True))
    emitter.modifiers.new("particles", "PARTICLE_SYSTEM")
    settings = emitter.particle_systems[0].settings
    settings.type, settings.count, settings.render_type = "HAIR", 7, "OBJECT"
    settings.instance_object = link(triangle("source"), at=(0, 9, 0))


def particle_collection() -> None:
    """Hair particles that pick from a collection with real objects."""
    emitter = link(points("emitter", 8, faces=True))
    emitter.modifiers.new("particles", "PARTICLE_SYSTEM")
    inside = collection("inside", bpy.context.scene.collection)
    link(triangle("a"), inside)
    link(triangle("b"), inside, (0.2, 0.3, 0.5))
    settings = emitter.particle_systems[0].settings
    settings.type, settings.count, settings.render_type = "HAIR", 7, "COLLECTION"
    settings.instance_collection = inside


def duplis() -> None:
    """Vertex and face duplicates of two children."""
    for k, kind in enumerate(("VERTS", "FACES")):
        parent = link(points(f"parent{k}", 6, faces=True), at=(0, 5 * k, 0))
        parent.instance_type = kind
        for n in range(2):
            link(triangle(f"child{k}{n}")).parent = parent


def animated() -> None:
    """An object whose render visibility is keyed, one that is driven, one that is free."""
    keyed, driven, _ = (link(triangle(n), at=(k, 0, 0)) for k, n in enumerate(("keyed", "driven", "free")))
    keyed.keyframe_insert("hide_render", frame=1)
    driven.driver_add("hide_render").driver.expression = "0"


def simulation() -> None:
    """A collider and a force field."""
    link(triangle("collider")).modifiers.new("collision", "COLLISION")
    field = link(triangle("field"), at=(1, 0, 0))
    bpy.context.view_layer.objects.active = field
    bpy.ops.object.forcefield_toggle()


def metaballs() -> None:
    for k in range(2):
        ob = link(
            bpy.data.objects.new("ball" if k == 0 else f"ball.{k:03}", bpy.data.metaballs.new("ball")), at=(k, 0, 0)
        )
        ob.data.elements.new()


SCENES = (
    objects, nodes_object, nodes_collection, nodes_children, nodes_light, nodes_fed, collections, particles,
    particle_collection, duplis, animated, simulation, metaballs
)


@pytest.fixture(params=SCENES, ids=[s.__name__ for s in SCENES])
def any_scene(request: pytest.FixtureRequest, new_file: bpy.types.Scene) -> str:
    """Each of the scenes above in turn, opened; its name."""
    request.param()
    return request.param.__name__


@pytest.fixture
def build(new_file: bpy.types.Scene) -> Callable[[str], None]:
    """Build one of the scenes above by its name."""
    return lambda name: globals()[name]()


@pytest.fixture
def snapshot() -> Callable[[], dict]:
    """Every plain property and custom property of every data-block, its modifiers and its users."""

    def run() -> dict:
        blocks = {}
        for name in sorted(
            p.identifier
            for p in bpy.data.bl_rna.properties
            if p.type == "COLLECTION" and p.identifier not in {"all_ids", "images"}
        ):
            for block in getattr(bpy.data, name):
                blocks[name, block.name_full] = plain(block) | {"custom": custom(block)}
        for ob in bpy.data.objects:
            blocks["objects", ob.name_full] |= {
                "modifiers": [plain(m) for m in ob.modifiers],
                "data": None if ob.data is None else ob.data.name_full,
                "slots": [(slot.link, slot.material and slot.material.name_full) for slot in ob.material_slots],
            }
        return blocks

    return run


def custom(block: bpy.types.ID) -> dict:
    return {k: str(block[k]) for k in block.keys()}  # noqa: SIM118


def plain(thing: bpy.types.bpy_struct) -> dict:
    skipped = {"use_nodes", "session_uid", "is_updated", "is_updated_data", "tag", "execution_time", "is_evaluated"}
    values = {}
    for p in thing.bl_rna.properties:
        if p.identifier not in skipped and p.type not in {"POINTER", "COLLECTION"}:
            value = getattr(thing, p.identifier)
            values[p.identifier] = tuple(value) if getattr(p, "is_array", False) and p.type != "STRING" else value
    return {k: str(v) for k, v in values.items()}
