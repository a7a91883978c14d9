"""Features that came later: drawn from seed SINCE on, so that earlier seeds stay the files that they were."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy

from lipac.lipac_addon import roles

from .choices import Seeded
from .features import FEATURES, Feature, body, group, hosts, put

SINCE = 950
LATER: dict[str, Feature] = {}
OPTIONS = {"levels": ("--levels",)}  # of the command, that go with a feature


def later(function: Feature) -> Feature:
    """Decorator: enter a function into `LATER`."""
    LATER[function.__name__] = function
    return function


def features(seed: int) -> dict[str, Feature]:
    """What a seed draws from."""
    return FEATURES | LATER if seed >= SINCE else FEATURES


def _tree(ob: bpy.types.Object) -> tuple[Any, Any, Any]:
    """Nodes and links of an object's material, and its Principled BSDF."""
    made = ob.data.materials[0].node_tree
    return made.nodes, made.links, made.nodes["Principled BSDF"]


@later
def bumpy_mirrors(choose: Seeded, scene: bpy.types.Scene, folder: Path) -> None:
    """Smooth metal with bumps, or a map of normals, by noise, waves or cells; large or small."""
    for _ in range(2):
        ob = put(choose, body(choose, "cube", "ball", "leaf"), choose.one((0.8, 2.5)))
        nodes, links, shader = _tree(ob)
        shader.inputs["Metallic"].default_value = 1.0
        shader.inputs["Roughness"].default_value = choose.one((0.0, 0.05, 0.3))
        pattern = nodes.new(f"ShaderNodeTex{choose.one(('Noise', 'Wave', 'Voronoi'))}")
        pattern.inputs["Scale"].default_value = choose.one((2.0, 40.0))
        bump = nodes.new(choose.one(("ShaderNodeBump", "ShaderNodeNormalMap")))
        bump.inputs["Strength"].default_value = choose.one((0.1, 1.0))
        color = bump.inputs["Height" if bump.bl_idname == "ShaderNodeBump" else "Color"]
        links.new(pattern.outputs[0], color)
        links.new(bump.outputs[0], shader.inputs["Normal"])


@later
def glowing(choose: Seeded, scene: bpy.types.Scene, folder: Path) -> None:
    """Light by nodes: at random by object, by a pattern, by what looks, by an attribute that may be missing."""
    for _ in range(choose.integer(1, 4)):
        ob = put(choose, body(choose, "cube", "leaf"), choose.one((0.1, 0.8)))
        nodes, links, shader = _tree(ob)
        name, output = choose.one(
            (
                ("ObjectInfo", "Random"),
                ("TexNoise", 0),
                ("TexChecker", 1),
                ("LightPath", "Is Camera Ray"),
                ("Attribute", "Fac"),
                ("LightFalloff", 0),
            )
        )
        source, times = nodes.new(f"ShaderNode{name}"), nodes.new("ShaderNodeMath")
        if name == "Attribute":
            source.attribute_name = "nobody has it"
        times.operation, times.inputs[1].default_value = "MULTIPLY", choose.one((1.0, 30.0))
        links.new(source.outputs[output], times.inputs[0])
        links.new(times.outputs[0], shader.inputs["Emission Strength"])
        shader.inputs["Emission Color"].default_value = (1.0, 0.6, 0.3, 1.0)


@later
def lamps_by_nodes(choose: Seeded, scene: bpy.types.Scene, folder: Path) -> None:
    """A lamp whose strength or colour is a pattern, or falls off otherwise; linked to some things."""
    data = bpy.data.lights.new("gobo", choose.one(("POINT", "SPOT", "AREA", "SUN")))
    data.energy = 3.0 if data.type == "SUN" else 400.0
    data.use_nodes = True
    nodes, links = data.node_tree.nodes, data.node_tree.links
    emission = nodes.get("Emission") or nodes.new("ShaderNodeEmission")
    if choose.integer(0, 1):
        links.new(nodes.new("ShaderNodeTexChecker").outputs["Color"], emission.inputs["Color"])
    else:
        links.new(nodes.new("ShaderNodeLightFalloff").outputs[choose.integer(0, 2)], emission.inputs["Strength"])
    lamp = put(choose, data, 1.0)
    lamp.location.z += 3.0
    if choose.integer(0, 1):
        lamp.light_linking.receiver_collection = group(choose, scene, 2)


@later
def ray_portals(choose: Seeded, scene: bpy.types.Scene, folder: Path) -> None:
    """A surface that shows what is elsewhere."""
    ob = put(choose, body(choose, "leaf", "cube"), 1.5)
    nodes, links, _ = _tree(ob)
    portal = nodes.new("ShaderNodeBsdfRayPortal")
    if choose.integer(0, 1):
        place = nodes.new("ShaderNodeCombineXYZ")
        place.inputs["Y"].default_value = choose.one((-6.0, 6.0))
        links.new(place.outputs[0], portal.inputs["Position"])
    links.new(portal.outputs[0], nodes["Material Output"].inputs[0])


@later
def marked(choose: Seeded, scene: bpy.types.Scene, folder: Path) -> None:
    """Pinned and ignored: objects, what scatters, a collection."""
    roles.make_known()
    for owner in (put(choose, body(choose)), choose.one(hosts(scene)), group(choose, scene)):
        owner.lipac_role = choose.one((roles.PIN, roles.IGNORE))


@later
def levels(choose: Seeded, scene: bpy.types.Scene, folder: Path) -> None:
    """Dense meshes, smooth or flat, with UVs or colours: the command exchanges them for simplified ones."""
    for _ in range(choose.integer(1, 3)):
        ob = put(choose, body(choose, "ball", "cube"), choose.one((0.3, 1.0)))
        modifier = ob.modifiers.new("dense", "SUBSURF")
        modifier.levels, modifier.render_levels = 0, choose.integer(3, 5)
        if choose.integer(0, 1):
            ob.data.color_attributes.new("colour", choose.one(("FLOAT_COLOR", "BYTE_COLOR")), "CORNER")
        if choose.integer(0, 1):
            ob.data.uv_layers.new()
        ob.data.shade_smooth() if choose.integer(0, 1) else ob.data.shade_flat()


@later
def from_gltf(choose: Seeded, scene: bpy.types.Scene, folder: Path) -> None:
    """What came by glTF: empties over parts, materials as its importer makes them."""
    made = group(choose, scene, 3)
    bpy.ops.object.select_all(action="DESELECT")
    for ob in made.objects:
        ob.select_set(True)
    bpy.ops.export_scene.gltf(filepath=str(folder / "part.glb"), use_selection=True)
    bpy.ops.import_scene.gltf(filepath=str(folder / "part.glb"))
