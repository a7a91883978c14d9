"""What people's files have in them, beside meshes: a function of each feature adds it to a scene in view of a camera
that looks along +Y from (0, 0, 2)."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from lipac.lipac_addon.demo import builders
from lipac.lipac_addon.demo.family_stage import SHAPES
from lipac.lipac_addon.demo.solids import Solid

from .choices import Seeded

Feature = Callable[[Seeded, bpy.types.Scene, Path], None]  # takes where the file will be saved: libraries lie beside it
FEATURES: dict[str, Feature] = {}


def feature(function: Feature) -> Feature:
    """Decorator: enter a function into `FEATURES`."""
    FEATURES[function.__name__] = function
    return function


def material(choose: Seeded, name: str = "feature") -> bpy.types.Material:
    """A material of its own, of some colour."""
    red, green, blue = choose.numbers().uniform(0.1, 0.9, 3).tolist()
    return builders.material(f"{name} {len(bpy.data.materials)}", (red, green, blue), choose.one((0.2, 0.8)))


def body(choose: Seeded, *shapes: str) -> bpy.types.Mesh:
    """A mesh, of one of these shapes of a family, by default any."""
    name, solid = choose.one(shapes or ("cube", "ball", "leaf", "rod")), Solid()
    SHAPES[name](solid)
    return builders.mesh(name, solid, [material(choose)])


def put(choose: Seeded, data: Any, size: float = 0.7, collection: Any = None) -> bpy.types.Object:
    """A new object in view, in a collection, by default that of the scene."""
    ob = bpy.data.objects.new(data.name if data else "empty", data)
    (collection or bpy.context.scene.collection).objects.link(ob)
    rng = choose.numbers()
    ob.location, ob.rotation_euler, ob.scale = (
        (rng.uniform(-2, 2), rng.uniform(4, 9), rng.uniform(0.3, 2)),
        rng.uniform(-3, 3, 3),
        (size,) * 3,
    )
    return ob


def group(choose: Seeded, scene: bpy.types.Scene, count: int = 3, linked: bool = True) -> bpy.types.Collection:
    """A collection of new objects, in the scene or in none."""
    made = bpy.data.collections.new(f"group {len(bpy.data.collections)}")
    if linked:
        scene.collection.children.link(made)
    for _ in range(count):
        put(choose, body(choose), 0.4, made)
    return made


def tree(ob: bpy.types.Object, *names: str) -> tuple[Any, list[Any]]:
    """Geometry nodes on an object: its geometry, through a chain of nodes whose first sockets are geometry. Returns the
    tree and the nodes."""
    made = bpy.data.node_groups.new("nodes", "GeometryNodeTree")
    for side in ("INPUT", "OUTPUT"):
        made.interface.new_socket("Geometry", in_out=side, socket_type="NodeSocketGeometry")
    nodes = [made.nodes.new(name) for name in ("NodeGroupInput", *names, "NodeGroupOutput")]
    for before, after in pairwise(nodes):
        made.links.new(before.outputs[0], after.inputs[0])
    ob.modifiers.new("nodes", "NODES").node_group = made
    return made, nodes[1:-1]


def hosts(scene: bpy.types.Scene) -> list[bpy.types.Object]:
    """Meshes in the scene."""
    return [ob for ob in scene.objects if ob.type == "MESH"]


def select(ob: bpy.types.Object, mode: str) -> None:
    """Into a mode, as a user does."""
    bpy.context.view_layer.update()
    bpy.context.view_layer.objects.active = ob
    ob.select_set(True)
    bpy.ops.object.mode_set(mode=mode)


# Modes


@feature
def edit_mode(choose: Seeded, scene: bpy.types.Scene, folder: Path) -> None:
    """Saved while something was being edited, of any kind, with modifiers."""
    kind = choose.one(("mesh", "mesh", "host", "CURVE", "SURFACE", "FONT", "META", "ARMATURE"))
    if kind == "host":
        ob = choose.one(hosts(scene))
    elif kind == "mesh":
        ob = put(choose, body(choose))
        ob.modifiers.new("m", choose.one(("MIRROR", "ARRAY", "SUBSURF", "SOLIDIFY")))
    elif kind == "META":
        ob = put(choose, bpy.data.metaballs.new("meta"))
        ob.data.elements.new()
    elif kind == "ARMATURE":
        ob = put(choose, bpy.data.armatures.new("bones"))
    else:
        ob = put(choose, curve(choose, kind))
    select(ob, "EDIT")
    if ob.type == "MESH" and choose.rarely():
        bpy.ops.mesh.select_all(action="SELECT")
        bpy.ops.mesh.hide()


@feature
def painted(choose: Seeded, scene: bpy.types.Scene, folder: Path) -> None:
    """Saved while something was being sculpted or painted."""
    ob = put(choose, body(choose, "ball"))
    if choose.integer(0, 1):
        ob.modifiers.new("m", "MULTIRES")
    select(ob, choose.one(("SCULPT", "VERTEX_PAINT", "WEIGHT_PAINT", "TEXTURE_PAINT")))


@feature
def posed(choose: Seeded, scene: bpy.types.Scene, folder: Path) -> None:
    """Bones that bend a mesh, in Pose Mode."""
    rig = put(choose, bpy.data.armatures.new("bones"))
    select(rig, "EDIT")
    bone = rig.data.edit_bones.new("bone")
    bone.tail = (0, 0, 1)
    bpy.ops.object.mode_set(mode="OBJECT")
    ob = put(choose, body(choose, "ball"))
    ob.vertex_groups.new(name="bone").add(list(range(len(ob.data.vertices))), 1.0, "REPLACE")
    ob.modifiers.new("rig", "ARMATURE").object = rig
    ob.parent = rig
    rig.pose.bones["bone"].location = choose.numbers().uniform(-0.5, 0.5, 3)
    if choose.integer(0, 1):
        bpy.ops.object.mode_set(mode="POSE")


# What is made of something other than meshes


def curve(choose: Seeded, kind: str) -> Any:
    """A curve, a surface, or a text."""
    data = bpy.data.curves.new(kind.lower(), kind)
    if kind == "FONT":
        data.body, data.extrude = choose.one(("LiPaC", "ä\nß", "")), choose.one((0.0, 0.1))
        return data
    if kind == "SURFACE":
        spline = data.splines.new("NURBS")
        spline.points.add(3)
        for k, point in enumerate(spline.points):
            point.co = (k % 2, k // 2, 0, 1)
        return data
    data.dimensions, data.bevel_depth = "3D", choose.one((0.0, 0.08))
    data.splines.new("BEZIER").bezier_points.add(2)
    for point in data.splines[0].bezier_points:
        point.co, point.handle_left_type, point.handle_right_type = choose.numbers().uniform(-1, 1, 3), "AUTO", "AUTO"
    return data


@feature
def curves(choose: Seeded, scene: bpy.types.Scene, folder: Path) -> None:
    """Curves and texts; one that others are instanced from, or bent along."""
    data = curve(choose, choose.one(("CURVE", "FONT", "SURFACE")))
    data.materials.append(material(choose))
    ob = put(choose, data)
    if ob.type == "CURVE" and choose.integer(0, 1):
        other = put(choose, body(choose))
        other.modifiers.new("bend", "CURVE").object = ob
    for _ in range(choose.integer(0, 3)):
        put(choose, data)


@feature
def metaballs(choose: Seeded, scene: bpy.types.Scene, folder: Path) -> None:
    """Metaballs of one family, and another one."""
    for name in ("meta", "meta.001", "other")[: choose.integer(1, 3)]:
        data = bpy.data.metaballs.new(name)
        data.elements.new().radius = 1.0
        data.materials.append(material(choose))
        put(choose, data, 0.5).name = name


@feature
def hair(choose: Seeded, scene: bpy.types.Scene, folder: Path) -> None:
    """Hair as an object of its own."""
    data = bpy.data.hair_curves.new("hair")
    count = choose.integer(1, 40)
    data.add_curves([3] * count)
    data.position_data.foreach_set("vector", choose.numbers().uniform(-1, 1, 9 * count))
    data.materials.append(material(choose))
    put(choose, data)


@feature
def points(choose: Seeded, scene: bpy.types.Scene, folder: Path) -> None:
    """A point cloud: as an object, or by nodes."""
    if choose.integer(0, 1) or not hasattr(bpy.types.PointCloud, "resize"):  # since 5.1
        ob = put(choose, body(choose, "ball"))
        tree(ob, choose.one(("GeometryNodeMeshToPoints", "GeometryNodeDistributePointsOnFaces")))
        return
    data = bpy.data.pointclouds.new("points")
    count = choose.integer(1, 50)
    data.resize(count)
    data.attributes["position"].data.foreach_set("vector", choose.numbers().uniform(-1, 1, 3 * count))
    data.materials.append(material(choose))
    put(choose, data)


@feature
def drawn(choose: Seeded, scene: bpy.types.Scene, folder: Path) -> None:
    """Grease Pencil, lattices, empties with pictures, speakers, probes: what no path meets."""
    bpy.ops.object.select_all(action="DESELECT")
    kind = choose.integer(0, 4)
    if kind == 0:
        bpy.ops.object.grease_pencil_add(type="MONKEY", location=(0, 6, 1))
    elif kind == 1:
        bpy.ops.object.add(type="LATTICE", location=(0, 6, 1))
        put(choose, body(choose, "ball")).modifiers.new("lattice", "LATTICE").object = bpy.context.object
    elif kind == 2:
        bpy.ops.object.empty_add(type="IMAGE", location=(0, 6, 1))
    elif kind == 3:
        bpy.ops.object.speaker_add(location=(0, 6, 1))
    else:
        bpy.ops.object.lightprobe_add(type=choose.one(("SPHERE", "PLANE", "VOLUME")), location=(0, 6, 1))


@feature
def volume(choose: Seeded, scene: bpy.types.Scene, folder: Path) -> None:
    """A box of smoke, a world of it, or a volume by nodes or without its file."""
    kind = choose.one(("box", "box", "world", "nodes", "lost"))
    if kind == "lost":
        data = bpy.data.volumes.new("smoke")
        data.filepath = "//nowhere.vdb"
        put(choose, data)
        return
    if kind == "nodes":
        ob = put(choose, body(choose))
        _, (cube,) = tree(ob, "GeometryNodeSetPosition")
        made = ob.modifiers["nodes"].node_group
        smoke = made.nodes.new("GeometryNodeVolumeCube")
        for name in ("Resolution X", "Resolution Y", "Resolution Z"):
            smoke.inputs[name].default_value = 8
        made.links.new(smoke.outputs[0], next(n for n in made.nodes if n.type == "GROUP_OUTPUT").inputs[0])
        made.nodes.remove(cube)
        return
    if kind == "world":
        nodes, links = scene.world.node_tree.nodes, scene.world.node_tree.links
        output = next(n for n in nodes if n.type == "OUTPUT_WORLD")
        density = 0.02
    else:
        ob = put(choose, body(choose, "cube", "ball"), 2.0)
        nodes, links = ob.data.materials[0].node_tree.nodes, ob.data.materials[0].node_tree.links
        output = nodes["Material Output"]
        density = choose.one((0.05, 1.0))
        if choose.integer(0, 1):
            nodes.remove(nodes["Principled BSDF"])
    fog = nodes.new(choose.one(("ShaderNodeVolumePrincipled", "ShaderNodeVolumeScatter", "ShaderNodeVolumeAbsorption")))
    fog.inputs["Density"].default_value = density
    links.new(fog.outputs[0], output.inputs["Volume"])


# Particles and scatters


@feature
def particles(choose: Seeded, scene: bpy.types.Scene, folder: Path) -> None:
    """Hair or particles that show an object, a collection, a metaball, or themselves; nothing is baked."""
    host = put(choose, body(choose, "ball", "cube"), 1.0)
    settings = host.modifiers.new("particles", "PARTICLE_SYSTEM").particle_system.settings
    settings.type, settings.count = choose.one(("HAIR", "EMITTER")), choose.integer(1, 80)
    settings.render_type = choose.one(("OBJECT", "OBJECT", "COLLECTION", "PATH" if settings.type == "HAIR" else "HALO"))
    settings.particle_size, settings.use_advanced_hair = 0.1, True
    if settings.render_type == "OBJECT":
        source = bpy.data.metaballs.new("drop") if choose.rarely() else body(choose)
        if isinstance(source, bpy.types.MetaBall):
            source.elements.new()
        settings.instance_object = put(choose, source)
    elif settings.render_type == "COLLECTION":
        settings.instance_collection = group(choose, scene, linked=bool(choose.integer(0, 1)))
        settings.use_whole_collection = bool(choose.integer(0, 1))
    host.show_instancer_for_render = bool(choose.integer(0, 2))
    if settings.type == "EMITTER":
        settings.frame_start, settings.frame_end, settings.lifetime = -20, 1, 100
        scene.frame_set(choose.integer(1, 8))


@feature
def scatter(choose: Seeded, scene: bpy.types.Scene, folder: Path) -> None:
    """Geometry nodes that scatter, with ids or without, coloured at random by them, nested or realized."""
    host = put(choose, body(choose, "ball", "cube"), 1.5)
    names = [choose.one(("GeometryNodeMeshToPoints", "GeometryNodeDistributePointsOnFaces"))]
    names += (
        ["GeometryNodeSetID"] * choose.integer(0, 1)
        + ["GeometryNodeInstanceOnPoints"]
        + ["GeometryNodeRealizeInstances"] * choose.rarely()
    )
    made, nodes = tree(host, *names)
    if names[0].endswith("Faces"):
        nodes[0].inputs["Density"].default_value = choose.one((5.0, 30.0))
    place = next(n for n in nodes if n.bl_idname == "GeometryNodeInstanceOnPoints")
    info = made.nodes.new(choose.one(("GeometryNodeObjectInfo", "GeometryNodeCollectionInfo")))
    if info.bl_idname == "GeometryNodeObjectInfo":
        source = put(choose, body(choose), 0.1)
        info.inputs["Object"].default_value = source
        info.inputs["As Instance"].default_value = bool(choose.integer(0, 1))
        random_colour(source.data.materials[0])
        made.links.new(info.outputs["Geometry"], place.inputs["Instance"])
    else:
        info.inputs["Collection"].default_value = group(choose, scene, linked=bool(choose.integer(0, 1)))
        info.inputs["Separate Children"].default_value = bool(choose.integer(0, 1))
        place.inputs["Pick Instance"].default_value = bool(choose.integer(0, 1))
        made.links.new(info.outputs[0], place.inputs["Instance"])
    place.inputs["Scale"].default_value = choose.one(((0.1, 0.1, 0.1), (0.2, 0.2, -0.1)))


def random_colour(made: bpy.types.Material) -> None:
    """Colour by Object Info > Random."""
    nodes, links = made.node_tree.nodes, made.node_tree.links
    ramp, info = nodes.new("ShaderNodeValToRGB"), nodes.new("ShaderNodeObjectInfo")
    ramp.color_ramp.elements[1].color = (1, 0, 0, 1)
    links.new(info.outputs["Random"], ramp.inputs[0])
    links.new(ramp.outputs[0], nodes["Principled BSDF"].inputs["Base Color"])


@feature
def simulated(choose: Seeded, scene: bpy.types.Scene, folder: Path) -> None:
    """Cloth, rigid bodies, softness, waves, a simulation zone: unbaked."""
    kind = choose.one(("CLOTH", "SOFT_BODY", "OCEAN", "WAVE", "DYNAMIC_PAINT", "RIGID", "ZONE", "BUILD", "EXPLODE"))
    ob = put(choose, body(choose, "ball"))
    if kind == "ZONE":
        made, _ = tree(ob)
        start, end = made.nodes.new("GeometryNodeSimulationInput"), made.nodes.new("GeometryNodeSimulationOutput")
        start.pair_with_output(end)
        nodes = {n.type: n for n in made.nodes}
        made.links.new(nodes["GROUP_INPUT"].outputs[0], start.inputs[0])
        made.links.new(start.outputs[1], end.inputs[1])
        made.links.new(end.outputs[1], nodes["GROUP_OUTPUT"].inputs[0])
    elif kind == "RIGID":
        bpy.ops.object.select_all(action="DESELECT")
        bpy.context.view_layer.objects.active = ob
        bpy.ops.rigidbody.object_add()
    else:
        ob.modifiers.new("simulated", kind)
    scene.frame_set(choose.integer(1, 5))


@feature
def instancers(choose: Seeded, scene: bpy.types.Scene, folder: Path) -> None:
    """Collections on empties, one in the other; children on vertices or faces."""
    if choose.integer(0, 1):
        inner = group(choose, scene, linked=bool(choose.integer(0, 1)))
        outer = bpy.data.collections.new("outer")
        for collection in (outer, scene.collection):
            ob = put(choose, None, 1.0, collection)
            ob.instance_type, ob.instance_collection = "COLLECTION", inner if collection is outer else outer
            ob.location = choose.numbers().uniform(-1, 1, 3) if collection is outer else (0, 6, 1)
        return
    parent = put(choose, body(choose, "ball"), 1.5)
    parent.instance_type = choose.one(("VERTS", "FACES"))
    parent.show_instancer_for_render = bool(choose.integer(0, 1))
    child = put(choose, body(choose), 0.1)
    child.parent, child.location = parent, (0, 0, 0)


# Layers, visibility, light


@feature
def view_layers(choose: Seeded, scene: bpy.types.Scene, folder: Path) -> None:
    """More of them, with what is excluded, held out, lights only, or overridden; one may be off."""
    groups = [group(choose, scene) for _ in range(2)]
    for k in range(choose.integer(1, 2)):
        layer = scene.view_layers.new(f"layer {k}")
        layer.use = bool(choose.integer(0, 3))
        for made in groups:
            child = layer.layer_collection.children[made.name]
            setattr(child, choose.one(("exclude", "holdout", "indirect_only", "hide_viewport")), True)
        if choose.rarely():
            layer.material_override = material(choose)
        if choose.rarely():
            layer.samples = 2
    first = scene.view_layers[0].layer_collection.children[groups[0].name]
    setattr(first, choose.one(("exclude", "holdout", "indirect_only", "hide_viewport")), True)
    if choose.rarely():
        scene.view_layers[0].use = False


@feature
def overridden(choose: Seeded, scene: bpy.types.Scene, folder: Path) -> None:
    """One material or world for all, by the view layer."""
    if choose.integer(0, 1):
        scene.view_layers[0].material_override = material(choose)
    else:
        world = bpy.data.worlds.new("other")
        world.color = (0.2, 0.3, 0.1)
        scene.view_layers[0].world_override = world


@feature
def visibility(choose: Seeded, scene: bpy.types.Scene, folder: Path) -> None:
    """Seen by some kinds of rays alone; held out, shadow catchers, hidden ones; also what was there before."""
    for ob in [*(put(choose, body(choose)) for _ in range(4)), choose.one(hosts(scene))]:
        name = choose.one(
            (
                "visible_camera", "visible_diffuse", "visible_glossy", "visible_transmission", "visible_shadow",
                "is_holdout", "is_shadow_catcher", "hide_render"
            )
        )
        setattr(ob, name, not getattr(ob, name))
    scene.render.film_transparent = bool(choose.integer(0, 1))


@feature
def light_linking(choose: Seeded, scene: bpy.types.Scene, folder: Path) -> None:
    """Lamps that light, or are blocked by, some things alone; a mesh that glows does too."""
    lamps = [ob for ob in scene.objects if ob.type == "LIGHT"]
    glowing = put(choose, body(choose, "leaf"))
    glowing.data.materials[0].node_tree.nodes["Principled BSDF"].inputs["Emission Strength"].default_value = 20.0
    for ob in (*lamps, glowing):
        linking = ob.light_linking
        setattr(linking, choose.one(("receiver_collection", "blocker_collection")), group(choose, scene, 2))


@feature
def lamps(choose: Seeded, scene: bpy.types.Scene, folder: Path) -> None:
    """Lamps of every kind; with nodes, portals, groups, no strength, an odd size."""
    for _ in range(choose.integer(1, 4)):
        data = bpy.data.lights.new("lamp", choose.one(("POINT", "SUN", "SPOT", "AREA")))
        data.energy = choose.one((0.0, 5.0, 200.0, -10.0)) if data.type != "SUN" else choose.one((0.0, 2.0))
        if data.type == "AREA":
            data.shape, data.cycles.is_portal = choose.one(("SQUARE", "RECTANGLE", "DISK", "ELLIPSE")), choose.rarely()
        ob = put(choose, data, choose.one((1.0, 1.0, 0.0, -2.0)))
        ob.location.z += 3
        if choose.rarely():
            scene.view_layers[0].lightgroups.add(name="lights")
            ob.lightgroup = "lights"


@feature
def world(choose: Seeded, scene: bpy.types.Scene, folder: Path) -> None:
    """None, a sky, a picture with one pixel that is infinite."""
    kind = choose.integer(0, 2)
    if kind == 0:
        scene.world = None
        return
    nodes, links = scene.world.node_tree.nodes, scene.world.node_tree.links
    if kind == 1:
        texture = nodes.new("ShaderNodeTexSky")
    else:
        texture = nodes.new("ShaderNodeTexEnvironment")
        texture.image = bpy.data.images.new("sky", 32, 16, float_buffer=True)
        pixels = choose.numbers().uniform(0, 1, 32 * 16 * 4).astype(np.float32)
        pixels[choose.integer(0, 500) * 4] = choose.one((1.0, 1000.0, float("inf")))
        texture.image.pixels.foreach_set(pixels)
        texture.image.pack()
    links.new(texture.outputs[0], next(n for n in nodes if n.type == "BACKGROUND").inputs["Color"])


# Materials


@feature
def displacement(choose: Seeded, scene: bpy.types.Scene, folder: Path) -> None:
    """Up, down, of a few faces or many, true or as bumps; adaptive subdivision."""
    bpy.ops.object.select_all(action="DESELECT")
    bpy.ops.mesh.primitive_grid_add(x_subdivisions=choose.one((1, 20)), y_subdivisions=20, size=4, location=(0, 6, 0.1))
    ob, made = bpy.context.object, material(choose)
    ob.data.materials.append(made)
    made.displacement_method = choose.one(("DISPLACEMENT", "BOTH", "BUMP"))
    nodes, links = made.node_tree.nodes, made.node_tree.links
    move, height = (
        nodes.new("ShaderNodeDisplacement"),
        nodes.new(choose.one(("ShaderNodeTexNoise", "ShaderNodeTexWave", "ShaderNodeTexVoronoi"))),
    )
    move.inputs["Scale"].default_value = choose.one((0.3, -1.5, 2.0))
    links.new(height.outputs[0], move.inputs["Height"])
    links.new(move.outputs[0], nodes["Material Output"].inputs["Displacement"])
    if choose.integer(0, 1):
        modifier = ob.modifiers.new("subdivision", "SUBSURF")
        modifier.use_adaptive_subdivision = bool(choose.integer(0, 1))


@feature
def materials(choose: Seeded, scene: bpy.types.Scene, folder: Path) -> None:
    """Mixes by what looks, or by where; alpha; hair, skin, toon shaders; groups; without a node that leads anywhere."""
    for _ in range(3):
        ob = put(choose, body(choose, "cube", "ball", "leaf"), 1.2)
        nodes, links = ob.data.materials[0].node_tree.nodes, ob.data.materials[0].node_tree.links
        output, first = nodes["Material Output"], nodes["Principled BSDF"]
        kind = choose.one(("mix", "mix", "alpha", "other", "nothing"))
        if kind == "alpha":
            checker = nodes.new("ShaderNodeTexChecker")
            links.new(checker.outputs["Fac"], first.inputs["Alpha"])
        elif kind == "nothing":
            nodes.clear()
        elif kind == "other":
            names = (
                "ShaderNodeBsdfHairPrincipled", "ShaderNodeBsdfToon", "ShaderNodeBsdfSheen",
                "ShaderNodeSubsurfaceScattering", "ShaderNodeBsdfGlass"
            )
            links.new(nodes.new(choose.one(names)).outputs[0], output.inputs[0])
        else:
            mix, by = (
                nodes.new("ShaderNodeMixShader"),
                choose.one(("LightPath", "NewGeometry", "LayerWeight", "TexNoise")),
            )
            source = nodes.new(f"ShaderNode{by}")
            links.new(source.outputs[choose.integer(0, len(source.outputs) - 1)], mix.inputs[0])
            links.new(first.outputs[0], mix.inputs[1])
            links.new(nodes.new("ShaderNodeBsdfTransparent").outputs[0], mix.inputs[2])
            links.new(mix.outputs[0], output.inputs[0])


@feature
def pictures(choose: Seeded, scene: bpy.types.Scene, folder: Path) -> None:
    """Image textures: packed, generated, without their file, as alpha."""
    ob = put(choose, body(choose, "leaf"), 2.0)
    ob.data.uv_layers.new()
    image = bpy.data.images.new("picture", 16, 16, alpha=True)
    kind = choose.integer(0, 2)
    if kind == 0:
        image.pixels.foreach_set(choose.numbers().uniform(0, 1, 16 * 16 * 4).astype(np.float32))
        image.pack()
    elif kind == 1:
        image.source, image.filepath = choose.one(("FILE", "SEQUENCE", "MOVIE", "TILED")), "//nowhere.png"
    nodes, links = ob.data.materials[0].node_tree.nodes, ob.data.materials[0].node_tree.links
    texture = nodes.new("ShaderNodeTexImage")
    texture.image = image
    for name in ("Base Color", "Alpha")[: choose.integer(1, 2)]:
        links.new(texture.outputs["Alpha" if name == "Alpha" else "Color"], nodes["Principled BSDF"].inputs[name])


# Time


@feature
def drivers(choose: Seeded, scene: bpy.types.Scene, folder: Path) -> None:
    """Of visibility by visibility, of places by frames, of modifiers, by expressions, of what is scattered."""
    leader = choose.one([put(choose, body(choose)), *hosts(scene)])
    for _ in range(choose.integer(1, 3)):
        ob = put(choose, body(choose))
        path, index = choose.one((("hide_render", -1), ("location", 2), ("scale", 0), ("visible_shadow", -1)))
        driver = ob.driver_add(path, index).driver
        variable = driver.variables.new()
        variable.name = "x"
        if choose.rarely():
            variable.targets[0].id_type = "SCENE"
            variable.targets[0].id, variable.targets[0].data_path = scene, "frame_current"
        else:
            variable.targets[0].id, variable.targets[0].data_path = (
                leader,
                choose.one(("hide_render", "location.z", "scale.x")),
            )
        driver.expression = choose.one(("x", "1 - x", "x + frame * 0.01", "__import__('os').getpid() and x"))


@feature
def markers(choose: Seeded, scene: bpy.types.Scene, folder: Path) -> None:
    """Cameras bound to markers; frames before the first, and between frames."""
    for frame in (-5, 3, 8)[: choose.integer(1, 3)]:
        camera = bpy.data.objects.new("camera", scene.camera.data.copy())
        scene.collection.objects.link(camera)
        camera.location, camera.rotation_euler = scene.camera.location, scene.camera.rotation_euler
        camera.location.x += 0.2 * frame
        scene.timeline_markers.new("shot", frame=frame).camera = camera
    scene.frame_set(choose.integer(-10, 12), subframe=choose.one((0.0, 0.0, 0.5)))


@feature
def motion(choose: Seeded, scene: bpy.types.Scene, folder: Path) -> None:
    """Motion blur of the camera, of what moves, deforms, and appears."""
    scene.render.use_motion_blur = True
    scene.render.motion_blur_shutter = choose.one((0.5, 1.0, 4.0))
    scene.render.motion_blur_position = choose.one(("START", "CENTER", "END"))
    moving = [put(choose, body(choose)) for _ in range(2)] + [scene.camera] * choose.integer(0, 1)
    for ob in moving:
        for frame, change in ((0, 0.0), (2, 0.3)):
            ob.location.x += change
            ob.rotation_euler.z += 0.3 * change
            ob.keyframe_insert("location", frame=frame)
            ob.keyframe_insert("rotation_euler", frame=frame)
    moving[0].hide_render = True
    moving[0].keyframe_insert("hide_render", frame=choose.integer(0, 2))
    keyed = put(choose, body(choose, "ball"))
    keyed.shape_key_add(name="Basis")
    key = keyed.shape_key_add(name="big")
    for point in key.data:
        point.co *= 2
    for frame in (0, 2):
        key.value = frame / 2
        key.keyframe_insert("value", frame=frame)
    keyed.cycles.use_deform_motion = bool(choose.integer(0, 1))
    scene.frame_set(1)


# Other files


@feature
def libraries(choose: Seeded, scene: bpy.types.Scene, folder: Path) -> None:
    """What another file has: instanced, in the scene, overridden, or lost."""
    made = group(choose, scene, 3)
    name, path = made.name, folder / "library.blend"
    bpy.data.libraries.write(str(path), {made})
    for ob in list(made.objects):
        bpy.data.objects.remove(ob)
    bpy.data.collections.remove(made)
    with bpy.data.libraries.load(str(path), link=True, relative=False) as (_, wanted):
        wanted.collections = [name]
    (linked,) = wanted.collections
    how = choose.one(("instance", "scene", "override", "lost", "object"))
    if how in ("instance", "lost"):
        ob = put(choose, None, 1.0)
        ob.location, ob.rotation_euler, ob.instance_type, ob.instance_collection = (
            (0, 0, 0),
            (0, 0, 0),
            "COLLECTION",
            linked,
        )
    elif how == "object":
        scene.collection.objects.link(linked.objects[0])
    else:
        scene.collection.children.link(linked)
        if how == "override":
            linked.override_hierarchy_create(scene, bpy.context.view_layer)
    if how == "lost":
        path.unlink()


@feature
def other_scene(choose: Seeded, scene: bpy.types.Scene, folder: Path) -> None:
    """A second scene: as the background set, or with the same objects."""
    other = bpy.data.scenes.new("other")
    for ob in (put(choose, body(choose)), put(choose, body(choose))):
        other.collection.objects.link(ob)
        if choose.integer(0, 1):
            scene.collection.objects.unlink(ob)
    if choose.integer(0, 1):
        scene.background_set = other


@feature
def scripts(choose: Seeded, scene: bpy.types.Scene, folder: Path) -> None:
    """A script that would run when the file is opened."""
    text = bpy.data.texts.new("run.py")
    text.write("import bpy\nfor ob in bpy.data.objects:\n    ob.hide_render = True\n")
    text.use_module = True


# What is done with the picture


@feature
def compositor(choose: Seeded, scene: bpy.types.Scene, folder: Path) -> None:
    """Nodes after the render: effects, files, a second scene."""
    made = bpy.data.node_groups.new("compositing", "CompositorNodeTree")
    made.interface.new_socket("Image", in_out="OUTPUT", socket_type="NodeSocketColor")
    scene.compositing_node_group = made
    layers, out = made.nodes.new("CompositorNodeRLayers"), made.nodes.new("NodeGroupOutput")
    effect = made.nodes.new(f"CompositorNode{choose.one(('Blur', 'Glare', 'Invert', 'Denoise', 'Exposure'))}")
    made.links.new(layers.outputs[0], next(s for s in effect.inputs if s.type == "RGBA"))
    made.links.new(effect.outputs[0], out.inputs[0])
    if choose.integer(0, 1):
        made.nodes.new("CompositorNodeOutputFile")
    if choose.rarely():
        other = bpy.data.scenes.new("second")
        other.camera = scene.camera
        other.collection.objects.link(put(choose, body(choose)))
        other.render.engine = "CYCLES"
        other.cycles.samples = 1
        second, mix = made.nodes.new("CompositorNodeRLayers"), made.nodes.new("CompositorNodeAlphaOver")
        second.scene = other
        colours = [s for s in mix.inputs if s.type == "RGBA"]
        made.links.new(effect.outputs[0], colours[0])
        made.links.new(second.outputs[0], colours[1])
        made.links.new(mix.outputs[0], out.inputs[0])


@feature
def formats(choose: Seeded, scene: bpy.types.Scene, folder: Path) -> None:
    """Any format of pictures and films, with any of its colour modes and depths."""
    settings = scene.render.image_settings
    settings.media_type = choose.one(("IMAGE", "MULTI_LAYER_IMAGE", "VIDEO"))
    items = [item.identifier for item in settings.bl_rna.properties["file_format"].enum_items]
    for _ in range(20):
        try:
            settings.file_format = choose.one(items)
            break
        except TypeError:
            continue
    for name in ("color_mode", "color_depth"):
        try:
            setattr(
                settings, name, choose.one([item.identifier for item in settings.bl_rna.properties[name].enum_items])
            )
        except TypeError:
            continue
    scene.render.filepath = choose.one(("", "//", "/nowhere/at/all/#", "//../x"))
    scene.view_settings.view_transform = choose.one(("Standard", "AgX", "Raw"))


@feature
def stereo(choose: Seeded, scene: bpy.types.Scene, folder: Path) -> None:
    """Two views, of one camera or of several."""
    scene.render.use_multiview = True
    scene.render.views_format = choose.one(("STEREO_3D", "MULTIVIEW"))
    scene.camera.data.stereo.convergence_mode = choose.one(("OFFAXIS", "PARALLEL", "TOE"))


@feature
def freestyle(choose: Seeded, scene: bpy.types.Scene, folder: Path) -> None:
    """Lines over the picture."""
    scene.render.use_freestyle = True
    layer = scene.view_layers[0]
    layer.use_freestyle = True
    if not len(layer.freestyle_settings.linesets):
        layer.freestyle_settings.linesets.new("lines").linestyle = bpy.data.linestyles.new("line")


@feature
def passes(choose: Seeded, scene: bpy.types.Scene, folder: Path) -> None:
    """Passes, cryptomattes, outputs of materials; denoising and adaptive sampling."""
    layer = scene.view_layers[0]
    for name in (
        "use_pass_z", "use_pass_mist", "use_pass_normal", "use_pass_vector", "use_pass_cryptomatte_object",
        "use_pass_object_index"
    ):
        setattr(layer, name, bool(choose.integer(0, 1)))
    layer.aovs.add().name = "own"
    scene.cycles.use_denoising, scene.cycles.use_adaptive_sampling = choose.rarely(), bool(choose.integer(0, 1))


@feature
def cameras(choose: Seeded, scene: bpy.types.Scene, folder: Path) -> None:
    """Depth of field, orthographic, clipped, shifted, scaled, upside down, of odd pixels, with a region."""
    data, render = scene.camera.data, scene.render
    kind = choose.one(("dof", "ortho", "clip", "shift", "scale", "pixels", "region", "sensor"))
    if kind == "dof":
        data.dof.use_dof, data.dof.aperture_fstop, data.dof.focus_distance = (
            True,
            choose.one((0.1, 2.8)),
            choose.one((0.3, 6.0)),
        )
    elif kind == "ortho":
        data.type, data.ortho_scale = "ORTHO", 6.0
    elif kind == "clip":
        data.clip_start, data.clip_end = choose.one((0.01, 5.0)), choose.one((6.0, 1000.0))
    elif kind == "shift":
        data.shift_x, data.shift_y = choose.numbers().uniform(-0.5, 0.5, 2)
    elif kind == "scale":
        scene.camera.scale = choose.one(((3.0, 3.0, 3.0), (1.0, 1.0, -1.0), (-1.0, 1.0, 1.0)))
    elif kind == "pixels":
        render.pixel_aspect_x, render.resolution_percentage = choose.one((0.5, 2.0)), choose.one((50, 100))
    elif kind == "region":
        render.use_border, render.border_min_x, render.border_max_x, render.use_crop_to_border = (
            True,
            0.3,
            0.6,
            bool(choose.integer(0, 1)),
        )
    else:
        data.sensor_fit, data.sensor_height = choose.one(("VERTICAL", "HORIZONTAL", "AUTO")), choose.one((10.0, 40.0))


@feature
def settings(choose: Seeded, scene: bpy.types.Scene, folder: Path) -> None:
    """Simplified, cut by the camera, with data that persists, a sequencer, other units and seeds."""
    render = scene.render
    render.use_simplify, render.simplify_subdivision_render = bool(choose.integer(0, 1)), choose.integer(0, 2)
    scene.cycles.use_camera_cull = scene.cycles.use_distance_cull = choose.rarely()
    render.use_persistent_data, render.use_file_extension = bool(choose.integer(0, 1)), False
    scene.unit_settings.scale_length = choose.one((1.0, 0.001))
    scene.cycles.light_sampling_threshold = choose.one((0.0, 0.01))
    scene.cycles.film_exposure, scene.cycles.sample_clamp_direct = choose.one((1.0, 3.0)), choose.one((0.0, 1.0))
    if choose.rarely():
        strips = (scene.sequence_editor or scene.sequence_editor_create()).strips
        strips.new_effect(name="white", type="COLOR", channel=1, frame_start=-20, length=100)


@feature
def names(choose: Seeded, scene: bpy.types.Scene, folder: Path) -> None:
    """In any script, with line breaks, empty of letters; data of many users."""
    data = body(choose)
    for name in ("木", "two\nlines", " ", "a" * 200, "../..", "Render Result", "%s{0}"):
        put(choose, data, 0.4).name = name
    scene.camera.name = choose.one(("caméra", "cam\nera", "Camera"))


@feature
def places(choose: Seeded, scene: bpy.types.Scene, folder: Path) -> None:
    """No size, turned inside out, far away, nowhere; no faces; one on the other."""
    for _ in range(3):
        ob = put(choose, choose.one((body(choose), bpy.data.meshes.new("nothing"))))
        kind = choose.integer(0, 4)
        if kind == 0:
            ob.scale[choose.integer(0, 2)] = choose.one((0.0, -1.0, 1e-20, 1e20))
        elif kind == 1:
            ob.location[choose.integer(0, 2)] = choose.one((1e7, float("nan"), float("inf")))
        elif kind == 2:
            twin = put(choose, ob.data)
            twin.location, twin.rotation_euler = ob.location, ob.rotation_euler
        elif kind == 3:
            ob.parent = choose.one(hosts(scene)[:1])
        else:
            ob.modifiers.new("m", choose.one(("BOOLEAN", "ARRAY", "MIRROR", "WIREFRAME", "SKIN", "REMESH", "DECIMATE")))
