"""The vectorised walk against `depsgraph.object_instances`, instancer by instancer, in render mode."""

from __future__ import annotations

import math
from collections import defaultdict
from typing import Any

import bpy
import numpy as np
import pytest

from lipac.core.scene.model import InstanceFlag, RayType
from lipac.core.scene.placing import usable_transforms
from lipac.lipac_addon.extract import ExtractedWorld, Extraction, extract, extract_world, with_render_depsgraph
from lipac.lipac_addon.extract.graph_items import ray_visibility
from lipac.lipac_addon.extract.scene import VOLUME, VOLUMES
from lipac.lipac_addon.extract.session import extract_frame
from lipac.lipac_addon.keys import Kind, full_name

from .conftest import add, collection, cube, grid, instance_of, nodes, scattered, wedge

Groups = dict[tuple[Any, ...], list[np.ndarray]]


def oracle(depsgraph: Any) -> Groups:
    """Transforms of what Cycles would take, by (object, top-level object, flags, triangles): read one by one, rules as
    in Cycles' `blender/object.cpp`."""
    layer = depsgraph.view_layer_eval
    groups: Groups = defaultdict(list)
    for entry in depsgraph.object_instances:
        data = entry.object.data
        if not entry.show_self or not isinstance(data, bpy.types.Mesh) or not len(data.polygons):
            continue
        parent = entry.parent if entry.is_instance else entry.object
        holdout = parent.holdout_get(view_layer=layer)
        flags = ray_visibility(entry.object) & ray_visibility(parent)
        if not holdout and parent.indirect_only_get(view_layer=layer):
            flags &= ~(1 << RayType.CAMERA)
        m = np.array(entry.matrix_world)[:3]
        if not flags or not usable_transforms(m[None].astype(float))[0]:
            continue
        flags |= (InstanceFlag.HOLDOUT if holdout else 0) | (
            InstanceFlag.SHADOW_CATCHER if entry.object.is_shadow_catcher or parent.is_shadow_catcher else 0
        )
        source = entry.instance_object if entry.is_instance else entry.object
        groups[full_name(source), full_name(parent), int(flags), len(data.loop_triangles)].append(m)
    return groups


def fast(extraction: Extraction) -> Groups:
    """The same of an extraction."""
    scene, keys = extraction.scene, extraction.keys
    counts = [len(mesh.triangles) for mesh in scene.meshes]
    groups: Groups = defaultdict(list)
    flags = scene.instances.flags & ~np.uint8(InstanceFlag.DIVISIBLE)
    for k in range(len(scene.instances)):
        key = keys.records[k]
        m = scene.instances.transform[k].astype(np.float64)
        m[:, 3] += scene.origin
        host = key["host"] if key["host"] >= 0 else key["object"]
        groups[keys.names[key["object"]], keys.names[host], int(flags[k]), counts[scene.instances.mesh[k]]].append(m)
    return groups


def assert_same(a: Groups, b: Groups) -> None:
    """Equal up to order and to float32's rounding along chains of transforms.

    Matrices are compared by random projections, sorted: equal multisets have equal sorted projections. Blender
    multiplies up to 8 matrices in float32, each product sums 4 terms: 32 roundings of half an epsilon, of values up to
    the largest entry; a projection onto a unit vector of 12 entries adds a factor of sqrt(12).
    """
    assert {k: len(v) for k, v in a.items()} == {k: len(v) for k, v in b.items()}
    axes = np.random.default_rng(0).normal(size=(12, 4))
    axes /= np.linalg.norm(axes, axis=0)
    for key, matrices in a.items():
        one, two = (np.reshape(m, (-1, 12)) for m in (matrices, b[key]))
        tolerance = 32 * math.sqrt(12) * np.finfo(np.float32).eps * max(np.abs(one).max(), 1.0)
        difference = np.abs(np.sort(one @ axes, axis=0) - np.sort(two @ axes, axis=0)).max()
        assert difference <= tolerance, key


def check() -> Extraction:
    """Compares both ways on the current scene."""
    world = extract_world(bpy.context.scene)
    extraction, expected = with_render_depsgraph(
        bpy.context.scene, None, lambda graph: (extract(graph, world, allow_no_camera=True), oracle(graph))
    )
    assert_same(expected, fast(extraction))
    return extraction


def kinds(extraction: Extraction) -> dict[Kind, int]:
    values, counts = np.unique(extraction.keys.records["kind"], return_counts=True)
    return {Kind(v): int(c) for v, c in zip(values, counts, strict=True)}


def test_objects_with_render_visibility() -> None:
    """Hidden, excluded, holdout, indirect-only, ray visibility, negative and non-uniform scale: as rendered, not as
    shown in the viewport."""
    mesh = wedge()
    add("plain", mesh, location=(1, 2, 3), rotation=(0.1, 0.2, 0.3), scale=(-1, 2, 0.5))
    add("hidden", mesh).hide_render = True
    add("viewport only hidden", mesh, location=(5, 0, 0)).hide_viewport = True
    for flag in ("camera", "diffuse", "glossy", "transmission", "shadow"):
        setattr(add(f"no {flag}", mesh, location=(0, 1, 0)), f"visible_{flag}", False)
    add("catcher", mesh).is_shadow_catcher = True
    add("own holdout", mesh).is_holdout = True
    layers = bpy.context.view_layer.layer_collection
    for name in ("hide", "exclude", "holdout", "indirect"):
        add(f"in {name}", mesh, collection(name))
    bpy.data.collections["hide"].hide_render = True
    layers.children["exclude"].exclude = True
    layers.children["holdout"].holdout = True
    layers.children["indirect"].indirect_only = True
    extraction = check()
    names = {extraction.keys.names[k] for k in extraction.keys.records["object"]}
    assert {"plain", "viewport only hidden", "own holdout", "in holdout", "in indirect"} <= names
    assert not names & {"hidden", "in hide", "in exclude"}
    assert kinds(extraction) == {Kind.OBJECT: len(extraction.scene.instances)}
    assert len(extraction.scene.meshes) == 1


def test_every_object_type_with_faces() -> None:
    """Curves, text, surfaces and metaballs come as meshes; a family of metaballs once."""
    text = bpy.data.curves.new("text", "FONT")
    text.body, text.extrude = "abc", 0.1
    add("text", text)
    bpy.ops.curve.primitive_bezier_circle_add(location=(4, 0, 0))
    bpy.context.object.data.bevel_depth = 0.1
    bpy.ops.curve.primitive_bezier_curve_add(location=(0, 4, 0))  # no thickness: nothing to see
    bpy.ops.surface.primitive_nurbs_surface_sphere_add(location=(8, 0, 0))
    bpy.ops.object.metaball_add(type="BALL", location=(12, 0, 0))
    bpy.ops.object.metaball_add(type="BALL", location=(13, 0, 0))
    held = collection("held", linked=False)
    ball = bpy.data.metaballs.new("ball")
    ball.elements.new()
    add("lone ball", ball, held)
    balls = collection("balls")
    add("other family", ball, balls, location=(20, 0, 0))
    instance_of("instanced balls", balls, location=(0, 9, 0))
    add("text 2", text, held)
    instance_of("empty", held, location=(0, 0, 5))
    extraction = check()
    assert kinds(extraction) == {Kind.OBJECT: 5, Kind.COLLECTION: 1}


def test_linked_duplicates_share_a_mesh() -> None:
    """One mesh for all; a material linked to an object changes that instance alone; modifiers make a mesh of its
    own."""
    mesh = cube()
    red, green = (bpy.data.materials.new(n) for n in ("red", "green"))
    mesh.materials.append(red)
    for k in range(20):
        add(f"cube {k}", mesh, location=(k, 0, 0))
    other = add("other", mesh)
    other.material_slots[0].link, other.material_slots[0].material = "OBJECT", green
    add("subdivided", mesh).modifiers.new("s", "SUBSURF").render_levels = 2
    extraction = check()
    scene = extraction.scene
    assert len(scene.meshes) == 2
    assert sorted(len(m.triangles) for m in scene.meshes) == [12, 6 * 16 * 2]
    names = [extraction.keys.names[k] for k in extraction.keys.records["object"]]
    of = dict(zip(names, scene.slot_materials[scene.instances.slots], strict=True))
    assert of["cube 3"] == of["cube 7"] == of["subdivided"] != of["other"]


def test_nested_collection_instances() -> None:
    """Offsets, nesting, hidden members, members that instance by geometry nodes, instancers hidden themselves."""
    inner, middle, outer = (collection(n, linked=False) for n in ("inner", "middle", "outer"))
    inner.instance_offset, middle.instance_offset = (1, 2, 3), (0, -1, 0.5)
    add("leaf", wedge(), inner, location=(0, 0, 1), rotation=(0, 0.4, 0))
    add("unseen", wedge(), inner).hide_render = True
    sub = bpy.data.collections.new("sub")
    inner.children.link(sub)
    add("below", cube(), sub, scale=(1, -1, 1))
    hidden = bpy.data.collections.new("hidden sub")
    inner.children.link(hidden)
    hidden.hide_render = True
    add("in hidden sub", cube(), hidden)
    for k in range(5):
        instance_of(f"a {k}", inner, collection=middle, location=(k, 1, 0), rotation=(k, 0, 0), scale=(1, 1 + k, -1))
    host = add("scatter", cube(), middle, location=(0, 3, 0))
    source = add("source", wedge(), collection("sources"))
    nodes(
        host,
        lambda g, new: scattered(
            new, g, new("GeometryNodeObjectInfo", {"Object": source, "As Instance": True}).outputs["Geometry"]
        ),
    )
    for k in range(3):
        instance_of(f"b {k}", middle, collection=outer, location=(0, 0, k))
    instance_of("hidden itself", inner, collection=outer).show_instancer_for_render = False
    for k in range(4):
        instance_of(f"c {k}", outer, location=(20 * k, 0, 0), rotation=(0, 0, k))
    instance_of("hidden at the top", inner, location=(0, -9, 0)).show_instancer_for_render = False
    for name, away in (("excluded", collection("away")), ("hidden", collection("away 2"))):
        instance_of(f"{name} too", inner, collection=away).show_instancer_for_render = False
    bpy.context.view_layer.layer_collection.children["away"].exclude = True
    bpy.data.collections["away 2"].hide_render = True
    extraction = check()
    assert kinds(extraction)[Kind.COLLECTION] > 4 * 3 * 5 * 2
    paths = extraction.keys.records["path"]
    deep = paths[(paths >= 0).sum(axis=1) == 4]
    assert len(deep) and len(np.unique(extraction.keys.records, axis=0)) == len(extraction.keys.records)


def test_geometry_nodes_of_every_reference() -> None:
    """Instances of an object, of a collection (whole and children), of a geometry, of realised ones, nested, picked;
    beside a mesh; hosted by a curve."""
    leaf = add("leaf", wedge(), location=(1, 1, 1), rotation=(0.3, 0, 0), scale=(2, 1, 1))
    pool = collection("pool")
    pool.instance_offset = (0, 0, 2)
    add("p", cube(), pool, location=(0, 4, 0))
    add("q", wedge(), pool, rotation=(0, 0, 1))
    add("r hidden", wedge(), pool).hide_render = True

    def place(k: int) -> dict[str, Any]:
        return {"location": (0, 30 * k, 0), "rotation": (0.1 * k, 0, 0.2), "scale": (1, 1, -1 if k % 2 else 1.5)}

    def info(new: Any, relative: bool = False) -> Any:
        return new(
            "GeometryNodeObjectInfo",
            {"Object": leaf, "As Instance": True},
            transform_space="RELATIVE" if relative else "ORIGINAL",
        ).outputs["Geometry"]

    def members(new: Any, separate: bool) -> Any:
        inputs = {"Collection": pool, "Separate Children": separate}
        return new("GeometryNodeCollectionInfo", inputs, transform_space="RELATIVE").outputs[0]

    hosts = [add(f"host {k}", cube(), **place(k)) for k in range(7)]
    nodes(hosts[0], lambda g, new: scattered(new, grid(new, 5), info(new), 1))
    nodes(hosts[1], lambda g, new: scattered(new, grid(new, 4), members(new, False), 2))
    nodes(hosts[2], lambda g, new: scattered(new, grid(new, 4), members(new, True), 3, pick=True))

    def nested(g: Any, new: Any) -> Any:
        primitive = new("GeometryNodeMeshIcoSphere", {}).outputs[0]
        inner = scattered(
            new, grid(new, 3, 2.0), new("GeometryNodeJoinGeometry", {0: [primitive, info(new, True)]}).outputs[0], 4
        )
        both = new("GeometryNodeJoinGeometry", {0: [inner, members(new, False), primitive]}).outputs[0]
        return new(
            "GeometryNodeJoinGeometry",
            {0: [scattered(new, grid(new, 3), new("GeometryNodeGeometryToInstance", {0: both}).outputs[0], 5), g]},
        ).outputs[0]

    nodes(hosts[3], nested)
    nodes(
        hosts[4],
        lambda g, new: new("GeometryNodeRealizeInstances", {0: scattered(new, grid(new, 4), info(new), 6)}).outputs[0],
    )

    def reuse(g: Any, new: Any) -> Any:
        other = new("GeometryNodeObjectInfo", {"Object": hosts[0], "As Instance": True}).outputs["Geometry"]
        return scattered(new, grid(new, 2), other, 7)

    nodes(hosts[5], reuse)  # instances of an object that scatters itself
    hosts[6].show_instancer_for_render = False
    nodes(
        hosts[6],
        lambda g, new: new("GeometryNodeJoinGeometry", {0: [g, scattered(new, grid(new, 2), info(new), 8)]}).outputs[0],
    )
    curve = bpy.data.curves.new("curve", "CURVE")
    curve.splines.new("POLY").points.add(3)
    hosted = add("curve host", curve, location=(40, 0, 0))
    nodes(hosted, lambda g, new: scattered(new, new("GeometryNodeMeshCube", {}).outputs[0], members(new, True), 9))
    empty = instance_of("empty", pool, location=(-20, 0, 0), rotation=(0, 0, 1))
    last = add("host of empty", cube(), location=(60, 0, 0))
    nodes(
        last,
        lambda g, new: scattered(
            new, g, new("GeometryNodeObjectInfo", {"Object": empty, "As Instance": True}).outputs["Geometry"], 10
        ),
    )
    text = bpy.data.curves.new("text", "FONT")
    text.body, text.extrude = "a", 0.1
    # hide_render does not reach instances of the object itself
    for k, (name, data) in enumerate((("hidden text", text), ("text", text), ("hidden cube", cube()))):
        hidden = add(name, data, location=(0, 0, 9))
        hidden.hide_render = name.startswith("hidden")
        if data is not text:
            nodes(
                hidden,
                lambda g, new: new("GeometryNodeJoinGeometry", {0: [g, scattered(new, g, info(new), 11)]}).outputs[0],
            )

        def instance(g: Any, new: Any, source: Any = hidden) -> Any:
            return scattered(
                new, g, new("GeometryNodeObjectInfo", {"Object": source, "As Instance": True}).outputs["Geometry"], 12
            )

        nodes(add(f"host of {name}", cube(), location=(80, 20 * k, 0)), instance)
    extraction = check()
    keys = extraction.keys.records
    assert kinds(extraction)[Kind.GEOMETRY_NODES] > 100
    first = keys[(keys["host"] == extraction.keys.names.index("host 0")) & (keys["kind"] == Kind.GEOMETRY_NODES)]
    np.testing.assert_array_equal(np.sort(first["path"][:, 0]), np.arange(25))
    assert len(np.unique(keys, axis=0)) == len(keys)


def test_blocks_give_the_same_as_one_piece(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nested instances composed in several blocks."""
    test_geometry_nodes_of_every_reference()
    whole = with_render_depsgraph(bpy.context.scene, None, extract)
    monkeypatch.setattr("lipac.lipac_addon.extract.instances.BLOCK", 7)
    parts = with_render_depsgraph(bpy.context.scene, None, extract)
    a, b = (np.sort(e.keys.records, order=["host", "object", "kind", "path"]) for e in (whole, parts))
    np.testing.assert_array_equal(a, b)
    assert_same(fast(whole), fast(parts))


def hair(emitter: Any, **settings: Any) -> None:
    """A hair system on an object, rendered as instances."""
    modifier = emitter.modifiers.new("p", "PARTICLE_SYSTEM")
    values = {
        "type": "HAIR",
        "count": 30,
        "use_advanced_hair": True,
        "particle_size": 0.3,
        "size_random": 0.5,
        **settings,
    }
    for name, value in values.items():
        setattr(modifier.particle_system.settings, name, value)


def test_particles() -> None:
    """Particle instances of an object and of a collection, at the top and inside a collection instance; of an object
    that scatters by nodes."""
    leaf = add("leaf", wedge(), location=(0, 0, -30))
    pool = collection("pool")
    add("p", cube(), pool, location=(0, 0, -40))
    add("q", wedge(), pool, location=(0, 5, -40))
    hair(add("emitter", cube("emitter", 5.0), rotation=(0, 0, 0.5)), render_type="OBJECT", instance_object=leaf)
    other = add("emitter 2", cube("emitter 2", 5.0), location=(20, 0, 0))
    hair(other, render_type="COLLECTION", instance_collection=pool)
    other.show_instancer_for_render = False
    held = collection("held", linked=False)
    hair(add("emitter 3", cube("emitter 3", 2.0), held), render_type="OBJECT", instance_object=leaf)
    for k in range(2):
        instance_of(f"e {k}", held, location=(0, 20 + 10 * k, 0))
    scatter = add("scatter", cube(), location=(0, 0, -60))
    nodes(scatter, lambda g, new: scattered(new, g, new("GeometryNodeMeshIcoSphere", {}).outputs[0]))
    hair(add("emitter 4", cube("emitter 4", 2.0), location=(40, 0, 0)), render_type="OBJECT", instance_object=scatter)

    def with_sphere(geometry: Any, new: Any) -> Any:
        return new(
            "GeometryNodeJoinGeometry",
            {0: [geometry, scattered(new, geometry, new("GeometryNodeMeshIcoSphere", {}).outputs[0])]},
        ).outputs[0]

    for k, build in enumerate((lambda g, new: g, with_sphere)):  # beside nodes: that only deform, and that instance
        both = add(f"both {k}", cube(f"both {k}", 4.0), location=(60, 20 * k, 0))
        hair(both, render_type="OBJECT", instance_object=leaf)
        nodes(both, build)
    extraction = check()
    assert kinds(extraction)[Kind.PARTICLE] >= 60


def test_vertex_and_face_instancing() -> None:
    """Children on vertices and on faces (scaled), with a child that instances a collection."""
    held = collection("held", linked=False)
    add("held leaf", wedge(), held)
    for k, kind in enumerate(("VERTS", "FACES")):
        parent = add(f"parent {kind}", cube(f"parent {k}", 4.0), location=(20 * k, 0, 0), rotation=(0, 0, 0.4))
        parent.instance_type = kind
        parent.use_instance_vertices_rotation = parent.use_instance_faces_scale = True
        parent.show_instancer_for_render = kind == "FACES"
        add(f"child {kind}", wedge(), location=(1, 0, 0), rotation=(0.2, 0, 0), parent=parent)
        instance_of(f"empty {kind}", held, location=(0, 2, 0), parent=parent)
    extraction = check()
    assert kinds(extraction)[Kind.DUPLI] == 2 * 8 + 2 * 6


def test_render_settings_of_modifiers() -> None:
    """Modifiers that differ between viewport and render are taken as rendered, levels of subdivision too."""
    subdivided = add("subdivided", cube())
    s = subdivided.modifiers.new("s", "SUBSURF")
    s.levels, s.render_levels = 0, 2
    array = add("array", cube(), location=(9, 0, 0)).modifiers.new("a", "ARRAY")
    array.count, array.show_render, array.show_viewport = 3, False, True
    bevel = add("shown in render", cube(), location=(0, 9, 0)).modifiers.new("a", "ARRAY")
    bevel.count, bevel.show_render, bevel.show_viewport = 3, True, False
    extraction = check()
    counts = {
        extraction.keys.names[k["object"]]: len(extraction.scene.meshes[m].triangles)
        for k, m in zip(extraction.keys.records, extraction.scene.instances.mesh, strict=True)
    }
    assert counts == {"subdivided": 6 * 16 * 2, "array": 12, "shown in render": 36}


def test_bad_transforms_are_left_out() -> None:
    """Zero scale, not finite and shears onto a plane: one warning per mesh, keys stay aligned; a tiny scale is fine."""
    good, bad = wedge("good"), cube("bad")
    add("tiny", good, scale=(1e-6, 1e-6, 1e-6))
    add("thin", good, scale=(1, 1, 1e-5))
    add("flat", bad, scale=(1, 0, 1))
    add("nan", bad, location=(float("nan"), 0, 0))
    add("zero", bad, scale=(0, 0, 0))
    extraction = with_render_depsgraph(bpy.context.scene, None, extract)
    assert [extraction.keys.names[k] for k in extraction.keys.records["object"]] == ["tiny", "thin"]
    assert len(extraction.warnings) == 2  # these, and no light
    assert "3 instances" in extraction.warnings[0]


def test_far_from_the_world_origin() -> None:
    """1e6 m out, positions relative to the camera keep the millimetres that Blender's own float32 matrices hold (1/16 m
    steps): nothing is added to that."""
    far = 1e6
    bpy.context.scene.camera.location = (far, far, 0)
    add("a", wedge(), location=(far + 0.5, far, 0))
    extraction = with_render_depsgraph(bpy.context.scene, None, extract)
    np.testing.assert_array_equal(extraction.scene.instances.transform[0, :, 3], [0.5, 0, 0])
    np.testing.assert_array_equal(extraction.scene.camera.to_world[:, 3], [0, 0, 0])


@pytest.mark.parametrize(
    "name",
    [
        "candela_city.blend",
        "rooms1024.blend",
        "kitchen.blend",
        "indoor.blend",
        "small/22_simple_GN.blend",
        "small/gn_nested_instances.blend",
        "small/01_multiple_collection_instances.blend",
        "small/particle_hair.blend",
        "small/animation_instanced.blend",
    ],
)
def test_supplied_scenes(shared: Any, name: str) -> None:
    """As above, on scenes made by others."""
    bpy.ops.wm.open_mainfile(filepath=str(shared / name))
    bpy.context.scene.world = None  # of no interest here
    check()


def test_world_type_is_exported() -> None:
    """What `extract` takes as world is what `extract_world` gives."""
    assert isinstance(extract_world(bpy.context.scene), ExtractedWorld)


def looks_around(why: str) -> bpy.types.Material:
    """A material that shades a face by others of its mesh, one of them in a group."""
    material = bpy.data.materials.new(why)
    material.use_nodes = True
    tree = material.node_tree
    if why == "subsurface":
        tree.nodes["Principled BSDF"].inputs["Subsurface Weight"].default_value = 0.2
    elif why == "volume":
        group = tree.nodes.new("ShaderNodeGroup")
        group.node_tree = bpy.data.node_groups.new("fog", "ShaderNodeTree")
        group.node_tree.nodes.new("ShaderNodeVolumeScatter")
    else:
        geometry = tree.nodes.new("ShaderNodeNewGeometry")
        tree.links.new(geometry.outputs["Random Per Island"], tree.nodes["Principled BSDF"].inputs["Base Color"])
    return material


@pytest.mark.parametrize(
    "why", ["", "small", "instanced", "holdout", "hair", "adaptive", "subsurface", "volume", "islands"]
)
def test_whose_faces_may_be_culled_by_themselves(why: str) -> None:
    """Those of a large mesh of an object of its own; the numbers of its faces are read then."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    side = 10 if why == "small" else 70
    bpy.ops.mesh.primitive_grid_add(x_subdivisions=side, y_subdivisions=side)
    ob = bpy.context.object
    bpy.ops.object.camera_add(location=(0, 0, 5))
    bpy.context.scene.camera = bpy.context.object
    if why == "instanced":
        bpy.context.scene.collection.objects.unlink(ob)
        bpy.data.collections.new("grids").objects.link(ob)
        bpy.ops.object.empty_add()
        bpy.context.object.instance_type, bpy.context.object.instance_collection = (
            "COLLECTION",
            bpy.data.collections["grids"],
        )
    elif why == "holdout":
        ob.is_holdout = True
    elif why == "hair":
        ob.modifiers.new("hair", "PARTICLE_SYSTEM")
    elif why == "adaptive" and bpy.app.version >= (5, 0, 0):
        ob.modifiers.new("fine", "SUBSURF").use_adaptive_subdivision = True
    elif why in ("subsurface", "volume", "islands"):
        ob.data.materials.append(looks_around(why))
    scene = extract_frame(bpy.context.scene, 1).scene
    assert bool(scene.instances.flags[0] & InstanceFlag.DIVISIBLE) == (why == "")
    mesh = scene.meshes[int(scene.instances.mesh[0])]
    assert scene.triangles is not None
    assert scene.triangles[scene.instances.mesh[0]] == len(mesh.triangles)
    assert (mesh.faces is not None) == (why == "")
    if mesh.faces is not None:
        assert np.array_equal(np.bincount(mesh.faces), np.full(70 * 70, 2))


@pytest.mark.parametrize("far", [False, True])
def test_what_simplify_leaves_out_is_not_there(far: bool) -> None:
    """Cycles' own culling, of objects and instances that ask for it: beside the picture or far away, with both only
    where both say so."""
    scene, mesh = bpy.context.scene, cube("shared", 0.5)
    scene.camera.location, scene.camera.rotation_euler = (0, 0, 0), (np.pi / 2, 0, 0)  # along +Y
    places = {"near": (0, 5, 0), "far": (0, 50, 0), "beside": (9, 5, 0), "behind": (0, -5, 0), "both": (90, 50, 0)}
    items = {name: add(name, mesh, location=place) for name, place in places.items()}
    dots = bpy.data.meshes.new("dots")
    dots.from_pydata(list(places.values()), [], [])
    source = add("source", cube("instanced", 0.5), location=(0, 0, -1e4))
    nodes(
        add("host", dots),
        lambda points, new: new(
            "GeometryNodeInstanceOnPoints",
            {"Points": points, "Instance": new("GeometryNodeObjectInfo", {0: source, "As Instance": True}).outputs[4]},
        ).outputs[0],
    )

    def shown() -> list[int]:
        """Instances of the objects that are there, and how many of the scatter."""
        keys = extract_frame(scene).keys
        names = [keys.names[k] for k in keys.records["object"]]
        hosted = keys.records["host"] >= 0
        return [*(names.count(name) for name in places), int(hosted.sum())]

    assert shown() == [1, 1, 1, 1, 1, 5]
    scene.render.use_simplify = True
    scene.cycles.use_camera_cull, scene.cycles.camera_cull_margin = True, 0.1
    scene.cycles.use_distance_cull, scene.cycles.distance_cull_margin = far, 20.0
    assert shown() == [1, 1, 1, 1, 1, 5]
    for item in (*items.values(), source):
        item.cycles.use_camera_cull = True
    assert shown() == [1, 1, 0, 0, 0, 2]
    for item in (*items.values(), source):
        item.cycles.use_distance_cull = True
    assert shown() == ([1, 1, 1, 1, 0, 4] if far else [1, 1, 0, 0, 0, 2])


def test_what_volume_objects_show_is_said_to_be_worth_nothing() -> None:
    """They stay, but not what they alone show or light: one warning, however many there are."""
    add("floor", cube())
    for k in range(2):
        add(f"smoke {k}", bpy.data.volumes.new(f"smoke {k}"))
    extraction = extract_frame(bpy.context.scene)
    assert extraction.warnings.count(VOLUMES) == 1
    assert [line for line in extraction.scene.approximated if line.endswith(VOLUME)] == [
        f"object smoke {k}{VOLUME}" for k in range(2)
    ]
