"""Random scenes built in Blender, and what must hold for all of them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import bpy
import numpy as np

from lipac.core.errors import InputError
from lipac.core.files.level import AnyLevel, Level, Steps
from lipac.core.scene.model import Scene
from lipac.lipac_addon import writeback
from lipac.lipac_addon.console import muted
from lipac.lipac_addon.extract import Extraction, extract_frame
from lipac.lipac_addon.extract.geometry.meshes import corners_of, faces_of
from lipac.lipac_addon.keys import Kind

from . import fuzz_core
from .choices import Seeded

SHADERS = ("Principled", "Diffuse", "Glossy", "Glass", "Emission", "Transparent", "Holdout", "Translucent")
NONSENSE = (0.0, 1e-20, 1e30, float("nan"), float("inf"))


def build(choose: Seeded) -> None:
    """A new file: up to ten objects with modifiers, instancing, odd transforms, materials and animation; lamps, a
    world, a camera."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene, rng = bpy.context.scene, choose.numbers()
    scale = 10.0 ** choose.integer(-2, 3)
    materials = [_material(choose, k) for k in range(choose.integer(0, 4))]
    made: list[Any] = []
    for k in range(choose.integer(1, 10)):
        data = _data(choose, k, scale)
        if data is not None and hasattr(data, "materials"):
            for _ in range(choose.integer(0, 2) if materials else 0):
                data.materials.append(choose.one(materials))
        item = bpy.data.objects.new(f"object {k}", data)
        (
            choose.one(list(bpy.data.collections))
            if len(bpy.data.collections) and choose.integer(0, 1)
            else scene.collection
        ).objects.link(item)
        item.location, item.rotation_euler = rng.uniform(-3, 3, 3) * scale, rng.uniform(-3, 3, 3)
        item.scale = 10 ** rng.uniform(-0.5, 0.5, 3) * rng.choice([1, 1, 1, -1], 3)
        if choose.rarely():
            item.scale[choose.integer(0, 2)] = choose.one(NONSENSE)
        if choose.rarely():
            item.location[choose.integer(0, 2)] = choose.one(NONSENSE)
        if made and choose.rarely():
            item.parent = choose.one(made)
        if choose.rarely():
            item.keyframe_insert("location", frame=1)
            item.location = rng.uniform(-3, 3, 3) * scale
            item.keyframe_insert("location", frame=5)
        if item.type == "MESH":
            _modify(choose, item)
        elif data is None and len(bpy.data.collections):
            item.instance_type, item.instance_collection = "COLLECTION", choose.one(list(bpy.data.collections))
        item.hide_render, item.visible_camera, item.visible_shadow = (
            choose.rarely(),
            not choose.rarely(),
            not choose.rarely(),
        )
        made.append(item)
        if choose.integer(0, 3) == 3:
            group = bpy.data.collections.new(f"collection {k}")
            if choose.integer(0, 1):
                scene.collection.children.link(group)
    hosts = [item for item in made if item.type == "MESH"]
    if len(hosts) > 1 and choose.integer(0, 1):
        _scatter(choose, hosts[0], hosts[1])
    for k in range(choose.integer(0, 3)):
        light = bpy.data.lights.new(f"lamp {k}", choose.one(("POINT", "SUN", "SPOT", "AREA")))
        light.energy = 10.0 ** choose.integer(-12, 12)
        item = bpy.data.objects.new(f"lamp {k}", light)
        scene.collection.objects.link(item)
        item.location, item.rotation_euler = rng.uniform(-4, 4, 3) * scale, rng.uniform(-3, 3, 3)
    camera = bpy.data.cameras.new("camera")
    camera.type = "ORTHO" if choose.rarely() else "PERSP"
    camera.lens, camera.ortho_scale, camera.clip_start = choose.one((1.0, 35.0, 5000.0)), 8 * scale, 1e-3 * scale
    camera.dof.use_dof = choose.rarely()
    item = bpy.data.objects.new("camera", camera)
    scene.collection.objects.link(item)
    item.location, item.rotation_euler = (0, -8 * scale, 2 * scale), (1.3, 0, 0)
    scene.camera = item
    scene.world = bpy.data.worlds.new("world") if not choose.rarely() else None
    render = scene.render
    render.engine, render.resolution_x, render.resolution_y, render.resolution_percentage = "CYCLES", 16, 9, 100
    render.use_border, render.border_min_x, render.film_transparent = choose.rarely(), 0.5, choose.rarely()
    scene.frame_set(choose.integer(1, 5))


def _data(choose: Seeded, k: int, scale: float) -> Any:
    kind = choose.integer(0, 6)
    if kind == 0 and len(bpy.data.meshes):
        return choose.one(list(bpy.data.meshes))
    if kind == 1:
        return None
    if kind == 2:
        curve = bpy.data.curves.new(f"curve {k}", "CURVE")
        curve.dimensions, curve.bevel_depth = "3D", choose.one((0.0, 0.1 * scale))
        curve.splines.new("POLY").points.add(3)
        for point in curve.splines[0].points:
            point.co = (*choose.numbers().normal(size=3) * scale, 1)
        return curve
    if kind == 3:
        text = bpy.data.curves.new(f"text {k}", "FONT")
        text.body, text.extrude = choose.one(("", "a", "LiPaC")), choose.one((0.0, 0.1))
        return text
    mesh = bpy.data.meshes.new(f"mesh {k}")
    rng = choose.numbers()
    count = choose.integer(0, 12)
    points = rng.normal(size=(count, 3)) * scale
    if count and choose.rarely():
        points[choose.integer(0, count - 1), 0] = choose.one(NONSENSE)
    faces = [rng.choice(count, 3, replace=False).tolist() for _ in range(choose.integer(0, 12))] if count > 3 else []
    edges = [(0, 1)] if count > 1 and choose.rarely() else []
    if kind == 4:
        corners = [(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
        points, faces, edges = (
            np.array(corners) * scale / 2,
            [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)],
            [],
        )
    mesh.from_pydata(points.tolist(), edges, faces)
    if choose.integer(0, 1):
        mesh.shade_smooth()
    return mesh


def _modify(choose: Seeded, item: Any) -> None:
    for _ in range(choose.integer(0, 2)):
        kind = choose.one(
            (
                "SUBSURF", "ARRAY", "MIRROR", "SOLIDIFY", "DECIMATE", "BEVEL", "WAVE", "TRIANGULATE", "WELD", "CAST",
                "BUILD", "WIREFRAME"
            )
        )
        modifier = item.modifiers.new(kind, kind)
        if kind == "SUBSURF":
            modifier.render_levels = choose.integer(0, 2)
        elif kind == "ARRAY":
            modifier.count = choose.integer(0, 4)
        elif kind == "DECIMATE":
            modifier.ratio = choose.one((0.0, 0.5, 1.0))


def _scatter(choose: Seeded, host: Any, source: Any) -> None:
    """Geometry nodes that put instances of an object, or of one another's geometry, on the faces of a host."""
    tree = bpy.data.node_groups.new("scatter", "GeometryNodeTree")
    for side in ("INPUT", "OUTPUT"):
        tree.interface.new_socket("Geometry", in_out=side, socket_type="NodeSocketGeometry")
    new, link = tree.nodes.new, tree.links.new
    start, end, points, info, instances = (
        new(f"{name}")
        for name in (
            "NodeGroupInput", "NodeGroupOutput", "GeometryNodeMeshToPoints", "GeometryNodeObjectInfo",
            "GeometryNodeInstanceOnPoints"
        )
    )
    info.inputs["Object"].default_value = source
    info.inputs["As Instance"].default_value = bool(choose.integer(0, 1))
    instances.inputs["Scale"].default_value = choose.one(
        ((0.3, 0.3, 0.3), (0.3, -0.2, 0.1), (0.0, 0.3, 0.3), (0.3, 1e-8, 0.3))
    )
    link(start.outputs[0], points.inputs[0])
    link(points.outputs[0], instances.inputs["Points"])
    link(info.outputs["Geometry"], instances.inputs["Instance"])
    link(instances.outputs[0], end.inputs[0])
    host.modifiers.new("scatter", "NODES").node_group = tree


def _material(choose: Seeded, k: int) -> Any:
    material = bpy.data.materials.new(f"material {k}")
    if material.node_tree is None:
        material.use_nodes = True
    tree, kind = material.node_tree, choose.one(SHADERS)
    if kind == "Principled":
        inputs = tree.nodes["Principled BSDF"].inputs
        for name in ("Metallic", "Roughness", "Alpha", "Transmission Weight", "Coat Weight"):
            inputs[name].default_value = choose.one((0.0, 0.3, 1.0))
        inputs["Emission Strength"].default_value = choose.one((0.0, 0.0, 1.0, 1e6))
        return material
    tree.nodes.clear()
    names = {"Emission": "ShaderNodeEmission", "Holdout": "ShaderNodeHoldout"}
    shader, output = (
        tree.nodes.new(names.get(kind, f"ShaderNodeBsdf{kind}")),
        tree.nodes.new("ShaderNodeOutputMaterial"),
    )
    tree.links.new(shader.outputs[0], output.inputs[0])
    if "Strength" in shader.inputs:
        shader.inputs["Strength"].default_value = 10.0 ** choose.integer(-12, 12)
    return material


def snapshot() -> dict[str, Any]:
    """What of the file write-back may touch: which data there is, and the plain properties of objects, collections,
    modifiers and scenes."""
    kept: dict[str, Any] = {
        name: sorted(item.name_full for item in getattr(bpy.data, name))
        for name in ("objects", "collections", "meshes", "node_groups", "attributes")
        if hasattr(bpy.data, name)
    }
    for item in (*bpy.data.objects, *bpy.data.collections, *bpy.data.scenes):
        kept[repr(item)] = _plain(item) | {"data": repr(getattr(item, "data", None))}
        for modifier in getattr(item, "modifiers", ()):
            kept[repr(modifier)] = _plain(modifier)
    for mesh in bpy.data.meshes:
        kept[repr(mesh)] = [a.name for a in mesh.attributes], _plain(mesh)
    for tree in bpy.data.node_groups:
        kept[repr(tree)] = [n.name for n in tree.nodes], len(tree.links)
    return kept


def _plain(thing: Any) -> dict[str, str]:
    # of what is evaluated, not of the data
    skipped = {
        "session_uid", "is_updated", "is_updated_data", "execution_time", "dimensions", "matrix_world", "matrix_local"
    }
    return {
        p.identifier: _text(thing, p)
        for p in thing.bl_rna.properties
        if p.identifier not in skipped and p.type not in ("COLLECTION", "POINTER")
    }


def _text(thing: Any, prop: Any) -> str:
    value = getattr(thing, prop.identifier)
    return str(list(value)) if getattr(prop, "is_array", False) and prop.type != "STRING" else str(value)


def check(choose: Seeded, seed: int = 0) -> None:
    """Extraction, everything that must hold for its scene, and visibility put back exactly. Raises AssertionError."""
    with muted():
        build(choose)
        bpy.context.view_layer.update()
        before = snapshot()
        try:
            extraction = extract_frame(bpy.context.scene)
        except InputError as error:
            assert "\n" not in str(error)
            return
        again = extract_frame(bpy.context.scene)
    scene = extraction.scene
    assert same(scene, again.scene), "two extractions differ"
    fuzz_core.check(scene, seed)
    with muted():
        culled = choose.numbers().random(len(scene.instances)) < 0.5
        writeback.apply(culled, extraction.keys, levels=levels(extraction), faces=faces(extraction))
        writeback.restore()
        after = snapshot()
    changed = [name for name in before.keys() | after.keys() if before.get(name) != after.get(name)]
    assert not changed, f"not as before: {changed[:3]}"


def levels(extraction: Extraction) -> dict[str, AnyLevel]:
    """Some triangles of meshes that may be exchanged, drawn by their number, for every other of them; and fewer levels
    of subdivision."""
    scene, out = extraction.scene, dict[str, AnyLevel]()
    rng = np.random.default_rng(len(scene.instances))
    assert scene.simplifiable is not None and scene.coarser is not None
    for number in np.flatnonzero(scene.coarser.steps).tolist():
        if steps := int(rng.integers(0, scene.coarser.steps[number] + 1)):
            out[scene.meshes.sources[number].owner] = Steps(steps)  # type: ignore[attr-defined]
    for number in np.flatnonzero(scene.simplifiable & (rng.random(len(scene.meshes)) < 0.5)).tolist():
        mesh = scene.meshes.sources[number].geometry.mesh  # type: ignore[attr-defined]
        corners = corners_of(mesh)
        chosen = rng.random(len(corners)) < 0.5
        level = Level(corners[chosen], faces_of(mesh)[chosen])
        shown = extraction.keys.records["object"][scene.instances.mesh == number]
        out.update({extraction.keys.names[n]: level for n in np.unique(shown[shown >= 0]).tolist() if chosen.any()})
    return out


def faces(extraction: Extraction) -> dict[str, np.ndarray]:
    """Some faces of the meshes of objects, for one of three, drawn by their number."""
    scene, records, out = extraction.scene, extraction.keys.records, {}
    rng = np.random.default_rng(len(scene.instances))
    for row in np.flatnonzero(records["kind"] == Kind.OBJECT).tolist():
        mesh = scene.meshes.sources[scene.instances.mesh[row]].geometry.mesh  # type: ignore[attr-defined]
        if mesh is not None and len(mesh.polygons) and not rng.integers(0, 3):
            out[extraction.keys.names[records["object"][row]]] = rng.random(len(mesh.polygons)) < 0.5
    return out


def same(a: Scene, b: Scene) -> bool:
    """Whether two scenes hold the same numbers."""
    arrays: list[Callable[[Scene], np.ndarray]] = [
        lambda s: s.instances.transform,
        lambda s: s.instances.mesh,
        lambda s: s.instances.bounds,
        lambda s: s.instances.flags,
        lambda s: s.mesh_bounds,
        lambda s: s.materials,
        lambda s: s.lights,
    ]
    return all(f(a).tobytes() == f(b).tobytes() for f in arrays)
