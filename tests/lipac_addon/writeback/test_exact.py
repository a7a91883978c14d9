"""Exact for what stays: where only what nothing meets is culled, every pass of a picture is the full scene's, bit for
bit, for each row of docs/write-back.md.

Materials read all that could depend on numbers, order or count: the random number of an instance, its attributes,
object and particle index, particles' random. Passes: all of vectors, positions, indices and the three Cryptomattes; and
motion blur in a second picture. No two surfaces coincide: which of two at one place a ray meets is chance, and changes
with anything in the scene.
"""

from collections.abc import Callable
from pathlib import Path

import bpy
import numpy as np
import OpenEXR
import pytest
from mathutils import Vector

from lipac.lipac_addon.extract import extract_frame
from lipac.lipac_addon.keys import Keys
from lipac.lipac_addon.writeback import apply, mask, restore
from lipac.tests.lipac_addon.writeback.conftest import collection, empty, link, points, scatter, triangle

AWAY = 1000.0  # metres along x of what the camera does not see
PASSES = (
    "z", "position", "normal", "vector", "uv", "object_index", "material_index", "diffuse_color", "shadow",
    "ambient_occlusion"
)
CRYPTOMATTES = ("object", "material", "asset")


def moving(ob: bpy.types.Object) -> bpy.types.Object:
    """Keyed over frames 1 to 3."""
    place = ob.location.copy()
    for frame in (1, 2, 3):
        ob.location = place + (frame - 2) * Vector((0.3, 0.1, 0.0))
        ob.keyframe_insert("location", frame=frame)
    return ob


def host(every: int = 3, ids: bool = False) -> bpy.types.Object:
    """Points of which every so many are away, each with a tint that its instance inherits."""
    ob = moving(link(points("host", 20)))
    for vertex in ob.data.vertices:
        vertex.co.x += AWAY * (vertex.index % every == 0)
    ob.data.attributes.new("tint", "FLOAT", "POINT").data.foreach_set("value", np.random.default_rng(0).random(20))
    if ids:
        ob.data.attributes.new("id", "INT", "POINT").data.foreach_set("value", [k // 2 for k in range(20)])
    return ob


def source() -> bpy.types.Object:
    return link(triangle("source"), at=(AWAY, 9, 0))


def inside() -> bpy.types.Collection:
    made = collection("inside")
    link(triangle("a"), made)
    link(triangle("b"), made, (0.2, 0.3, 0.5))
    return made


def objects() -> None:
    for k in range(6):
        moving(link(triangle(f"o{k}"), at=(k % 3 + AWAY * (k % 2), k / 3, 0))).pass_index = k


def linked_light() -> None:
    """Lights that light, and are blocked by, some of the objects alone; one of them nothing but what is away."""
    objects()
    for light, receivers, blockers in (("Lamp", (0, 1, 2), (1, 2, 3)), ("Sun", (1,), (1,))):
        linking = bpy.data.objects[light].light_linking
        linking.receiver_collection, linking.blocker_collection = collection("receivers"), collection("blockers")
        for chosen, members in ((linking.receiver_collection, receivers), (linking.blocker_collection, blockers)):
            for k in members:
                chosen.objects.link(bpy.data.objects[f"o{k}"])


def nodes_object() -> None:
    scatter(host(), source())


def nodes_ids() -> None:
    scatter(host(ids=True), source())


def nodes_children() -> None:
    scatter(host(), inside(), separate=True)


def nodes_collection() -> None:
    scatter(host(), inside())


def nodes_moving() -> None:
    """Instances that go their own ways."""
    ob = host()
    scatter(ob, source())
    tree = ob.modifiers[0].node_group
    put, join = (
        next(n for n in tree.nodes if n.bl_idname == kind)
        for kind in ("GeometryNodeInstanceOnPoints", "GeometryNodeJoinGeometry")
    )
    time, index, moved = (
        tree.nodes.new(f"GeometryNode{kind}") for kind in ("InputSceneTime", "InputIndex", "TranslateInstances")
    )
    product, scaled, vector = (tree.nodes.new(f"ShaderNode{kind}") for kind in ("Math", "Math", "CombineXYZ"))
    product.operation = scaled.operation = "MULTIPLY"
    scaled.inputs[1].default_value = 0.01
    for link_ in list(put.outputs[0].links):
        tree.links.remove(link_)
    for a, b in (
        (time.outputs[0], product.inputs[0]),
        (index.outputs[0], product.inputs[1]),
        (product.outputs[0], scaled.inputs[0]),
        (scaled.outputs[0], vector.inputs[2]),
        (vector.outputs[0], moved.inputs["Translation"]),
        (put.outputs[0], moved.inputs[0]),
        (moved.outputs[0], join.inputs[0]),
    ):
        tree.links.new(a, b)


def collections() -> None:
    made = inside()
    for k in range(4):
        moving(link(empty(f"e{k}", made), at=(k + AWAY * (k % 2), 1, 0))).pass_index = k


def collection_parts() -> None:
    """Parts of an instanced collection go, ahead of others in it and between them."""
    made, nested = collection("inside"), collection("nested")
    made.children.link(nested)
    for name, to, x in (
        ("z", nested, AWAY),
        ("y", made, AWAY),
        ("a", nested, 0.0),
        ("b", made, 0.2),
        ("c", nested, 0.5),
    ):
        link(triangle(name), to, (x, 0.2, 0.3))
    for k in range(3):
        moving(link(empty(f"e{k}", made), at=(k, 1, 0)))


def dupli_children() -> None:
    for k, kind in enumerate(("VERTS", "FACES")):
        parent = moving(link(points(f"parent{k}", 8, faces=True), at=(0, 1.5 * k, 0)))
        parent.instance_type = kind
        for n in range(4):
            link(triangle(f"child{k}{n}"), at=(AWAY * (n % 2), 0.2 * n, 0.1)).parent = parent


def dupli_parents() -> None:
    for k in range(4):
        parent = moving(link(points(f"parent{k}", 8, faces=True), at=(AWAY * (k % 2), k / 2, 0)))
        parent.instance_type = ("VERTS", "FACES")[k // 2]
        link(triangle(f"child{k}")).parent = parent


def _emitter(k: int, x: float) -> bpy.types.ParticleSettings:
    ob = moving(link(points(f"emitter{k}", 8, faces=True), at=(x, k / 2, 0)))
    ob.modifiers.new("particles", "PARTICLE_SYSTEM")
    ob.particle_systems[0].seed = k
    settings = ob.particle_systems[0].settings
    settings.type, settings.count, settings.particle_size, settings.size_random = (
        ("HAIR", "EMITTER")[k // 2],
        7,
        0.4,
        0.5,
    )
    if settings.type == "EMITTER":
        settings.frame_start = settings.frame_end = 1
        settings.physics_type, settings.normal_factor = "NO", 0.0
    return settings


def particle_emitters() -> None:
    made = source()
    for k in range(4):
        settings = _emitter(k, AWAY * (k % 2))
        settings.render_type, settings.instance_object = "OBJECT", made


def particles() -> None:
    """All particles of one emitter go, the emitter itself stays."""
    for k in range(2):
        settings = _emitter(k, 0.0)
        settings.render_type, settings.instance_object = (
            "OBJECT",
            link(triangle(("unseen", "seen")[k]), collection("sources")),
        )
    for vertex in bpy.data.meshes["unseen"].vertices:
        vertex.co.x += 10 * AWAY


ROWS = (
    *(objects, linked_light, nodes_object, nodes_ids, nodes_children, nodes_collection, nodes_moving),
    *(collections, collection_parts, dupli_children, dupli_parents, particle_emitters, particles),
)
MASKED = (nodes_object, nodes_ids, nodes_children, nodes_collection, nodes_moving)


@pytest.fixture
def stage(new_file: bpy.types.Scene) -> Callable[[Callable[[], None]], None]:
    """Builds a row, lights it and has its material read all that there is."""

    def run(row: Callable[[], None]) -> None:
        new_file.frame_set(2)
        new_file.camera.location, new_file.camera.rotation_euler = (2, 2, 9), (0.05, 0.03, 0)
        new_file.world = bpy.data.worlds.new("World")
        lamp = link(bpy.data.objects.new("Lamp", bpy.data.lights.new("Lamp", "POINT")), at=(1, 1, 4))
        lamp.data.energy = 300.0
        row()
        rng = np.random.default_rng(5)
        for mesh in bpy.data.meshes:
            mesh.materials.append(bpy.data.materials.get("reads all") or material())
            for vertex in mesh.vertices:
                vertex.co.z += rng.uniform(-0.15, 0.15)
        for ob in bpy.data.objects:
            if ob.type == "MESH":
                ob.rotation_euler = rng.uniform(-0.3, 0.3, 3)
        bpy.context.view_layer.update()

    return run


def material() -> bpy.types.Material:
    made = bpy.data.materials.new("reads all")
    if bpy.app.version < (5, 0, 0):
        made.use_nodes = True
    made.pass_index = 3
    nodes, links = made.node_tree.nodes, made.node_tree.links
    shader = next(n for n in nodes if n.type == "BSDF_PRINCIPLED")
    info, particle, colour = (
        nodes.new("ShaderNodeObjectInfo"),
        nodes.new("ShaderNodeParticleInfo"),
        nodes.new("ShaderNodeCombineColor"),
    )
    tint, index, share = nodes.new("ShaderNodeAttribute"), nodes.new("ShaderNodeMath"), nodes.new("ShaderNodeMath")
    tint.attribute_type, tint.attribute_name = "INSTANCER", "tint"
    share.operation, share.inputs[1].default_value = "MULTIPLY", 0.1
    for a, b in (
        (info.outputs["Random"], colour.inputs[0]),
        (tint.outputs["Fac"], colour.inputs[1]),
        (particle.outputs["Random"], colour.inputs[2]),
        (colour.outputs[0], shader.inputs["Base Color"]),
        (info.outputs["Object Index"], index.inputs[0]),
        (particle.outputs["Index"], index.inputs[1]),
        (index.outputs[0], share.inputs[0]),
        (share.outputs[0], shader.inputs["Roughness"]),
    ):
        links.new(a, b)
    return made


def pictures(folder: Path, engine: str, blurs: tuple[bool, ...] = (False, True)) -> dict[str, np.ndarray]:
    """Every pass of the open file without and with motion blur, by its name: (36, 64) float32."""
    scene, layer = bpy.context.scene, bpy.context.view_layer
    scene.render.engine, scene.render.resolution_x, scene.render.resolution_y = engine, 64, 36
    scene.cycles.samples, scene.cycles.seed, scene.cycles.use_denoising, scene.cycles.use_adaptive_sampling = (
        4, 1, False, False
    )
    scene.eevee.taa_render_samples = 1
    for name in (*PASSES, *(f"cryptomatte_{kind}" for kind in CRYPTOMATTES)):
        setattr(layer, f"use_pass_{name}", True)
    settings = scene.render.image_settings
    if bpy.app.version >= (5, 0, 0):
        settings.media_type = "MULTI_LAYER_IMAGE"
    settings.file_format, settings.color_depth, settings.exr_codec = "OPEN_EXR_MULTILAYER", "32", "NONE"
    scene.render.filepath = str(folder / "picture.exr")
    found: dict[str, np.ndarray] = {}
    for blur in blurs:
        scene.render.use_motion_blur = blur
        bpy.ops.render.render(write_still=True)
        with OpenEXR.File(scene.render.filepath, separate_channels=True) as file:
            channels = [item for part in file.parts for item in part.channels.items()]
            found |= {f"{name}{' blurred' * blur}": np.array(channel.pixels) for name, channel in channels}
    return found


def differing(a: dict[str, np.ndarray], b: dict[str, np.ndarray]) -> list[str]:
    """Names of the passes that are not bit for bit the same."""
    return sorted(
        name
        for name in a.keys() | b.keys()
        if name not in a or name not in b or (a[name].view(np.uint32) != b[name].view(np.uint32)).any()
    )


def extracted() -> tuple[Keys, np.ndarray]:
    """Keys of the open file's instances, and (N,) bool which of them the camera does not see."""
    extraction = extract_frame(bpy.context.scene)
    keys, instances = extraction.keys, extraction.scene.instances
    unseen = np.array([name == "unseen" for name in keys.names])[keys.records["object"]]
    return keys, unseen | (instances.transform[:, 0, 3] + extraction.scene.origin[0] > AWAY / 2)


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.__name__)
@pytest.mark.parametrize("free", [False, True])
def test_cycles(row, free, stage, tmp_path):
    stage(row)
    keys, away = extracted()
    full = pictures(tmp_path, "CYCLES")
    assert any(len(np.unique(channel)) > 20 for name, channel in full.items() if name.endswith("Combined.R"))
    result = apply(away, keys, free=free)
    assert (result.removed == away).all()
    assert result.removed.any()
    assert differing(full, pictures(tmp_path, "CYCLES")) == []
    restore()
    assert differing(full, pictures(tmp_path, "CYCLES")) == []
    apply(np.ones(len(away), bool), keys)  # and what the camera sees is told from nothing
    changed = set(differing(full, pictures(tmp_path, "CYCLES")))
    assert {"ViewLayer.Combined.R", "ViewLayer.Combined.R blurred", "ViewLayer.Vector.X"} <= changed
    assert {f"ViewLayer.Crypto{kind.title()}00.g" for kind in CRYPTOMATTES} <= changed


@pytest.mark.parametrize("row", MASKED, ids=lambda row: row.__name__)
def test_numbers_matter(row, stage, tmp_path, monkeypatch):
    """The check itself: a mask that deletes rows and lets the others be numbered anew is told from the full picture."""
    stage(row)
    keys, away = extracted()
    full = pictures(tmp_path, "CYCLES", (False,))

    def plain(nodes, geometry, goes, *_):
        return nodes.field("GeometryNodeDeleteGeometry", {"Geometry": geometry, "Selection": goes}, domain="INSTANCE")

    monkeypatch.setattr(mask, "_delete", plain)
    apply(away, keys)
    assert "ViewLayer.Combined.R" in differing(full, pictures(tmp_path, "CYCLES", (False,)))


@pytest.mark.parametrize("row", [objects, nodes_ids, collection_parts, particle_emitters], ids=lambda row: row.__name__)
def test_eevee(row, stage, tmp_path):
    """Without a sun: how fine its shadows are goes by how far what casts them reaches."""
    stage(row)
    bpy.data.objects.remove(bpy.data.objects["Sun"])
    keys, away = extracted()
    pictures(tmp_path, "BLENDER_EEVEE", (True,))  # the first one in a process differs from all later ones
    full = pictures(tmp_path, "BLENDER_EEVEE", (True,))
    assert (apply(away, keys, free=True).removed == away).all()
    assert differing(full, pictures(tmp_path, "BLENDER_EEVEE", (True,))) == []
