"""Demo scenes into Blender data: meshes from `Solid`s, Principled materials, scatter by geometry nodes."""

from __future__ import annotations

from collections.abc import Sequence

import bpy
import numpy as np

from .solids import Solid

Color = tuple[float, float, float]


def material(name: str, color: Color, roughness: float = 0.6, metallic: float = 0.0) -> bpy.types.Material:
    """A Principled material; linear Rec.709 colour."""
    mat = bpy.data.materials.get(name) or bpy.data.materials.new(name)
    bsdf = mat.node_tree.nodes["Principled BSDF"]
    bsdf.inputs["Base Color"].default_value = (*color, 1.0)
    bsdf.inputs["Roughness"].default_value = roughness
    bsdf.inputs["Metallic"].default_value = metallic
    mat.diffuse_color = (*color, 1.0)
    return mat


def mesh(name: str, solid: Solid, materials: Sequence[bpy.types.Material]) -> bpy.types.Mesh:
    """A flat-shaded mesh; slot k of the solid gets `materials[k]`."""
    data = bpy.data.meshes.new(name)
    sides = np.concatenate([np.full(len(f), f.shape[1]) for f in solid.faces])
    corners = np.concatenate([f.ravel() for f in solid.faces])
    vertices = np.concatenate(solid.vertices)
    data.vertices.add(len(vertices))
    data.loops.add(len(corners))
    data.polygons.add(len(sides))
    data.vertices.foreach_set("co", vertices.ravel().astype(np.float32))
    data.loops.foreach_set("vertex_index", corners.astype(np.int32))
    data.polygons.foreach_set("loop_start", (np.cumsum(sides) - sides).astype(np.int32))
    for mat in materials:
        data.materials.append(mat)
    data.polygons.foreach_set("material_index", np.concatenate(solid.slots).astype(np.int32))
    data.update(calc_edges=True)
    data.shade_flat()
    return data


def scatter(
    name: str,
    sources: Sequence[bpy.types.Object | bpy.types.Collection],
    points: np.ndarray,
    kind: np.ndarray,
    turn: np.ndarray,
    size: np.ndarray,
) -> bpy.types.Object:
    """An object whose geometry nodes place `sources[kind[i]]` at `points[i]`, turned and scaled, for every i.

    sources: objects, or collections, which come as wholes. points (N, 3) metres, kind (N,) index, turn (N,) radians
    about Z or (N, 3) Euler angles, size (N,) factor. The instances are rows 0..N-1 of the object's instance cloud.
    """
    library = bpy.data.collections.new(f"{name} parts")  # linked to no scene: its objects appear as instances only
    for k, source in enumerate(sources):
        source.name = f"{k:02d} {source.name}"  # Collection Info sorts children by name
        (library.children if isinstance(source, bpy.types.Collection) else library.objects).link(source)
    data = bpy.data.meshes.new(name)
    data.vertices.add(len(points))
    data.vertices.foreach_set("co", points.ravel().astype(np.float32))
    for attribute, type_, values in (("kind", "INT8", kind), ("size", "FLOAT", size)):
        data.attributes.new(attribute, type_, "POINT").data.foreach_set(
            "value", values.astype(np.int8 if type_ == "INT8" else np.float32)
        )
    turns = turn if turn.ndim == 2 else np.column_stack([np.zeros((len(turn), 2)), turn])
    data.attributes.new("turn", "FLOAT_VECTOR", "POINT").data.foreach_set("vector", turns.ravel().astype(np.float32))
    host = bpy.data.objects.new(name, data)
    bpy.context.scene.collection.objects.link(host)
    host.modifiers.new("Scatter", "NODES").node_group = _scatter_nodes(name, library)
    return host


def _scatter_nodes(name: str, library: bpy.types.Collection) -> bpy.types.NodeTree:
    tree = bpy.data.node_groups.new(f"{name} scatter", "GeometryNodeTree")
    tree.interface.new_socket("Geometry", in_out="INPUT", socket_type="NodeSocketGeometry")
    tree.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")

    def node(kind: str, x: float, y: float, **settings: object) -> bpy.types.Node:
        made = tree.nodes.new(kind)
        made.location = (x, y)
        for key, value in settings.items():
            setattr(made, key, value)
        return made

    def attribute(text: str, type_: str, y: float) -> bpy.types.NodeSocket:
        made = node("GeometryNodeInputNamedAttribute", -600, y, data_type=type_)
        made.inputs["Name"].default_value = text
        return next(s for s in made.outputs if s.name == "Attribute" and s.enabled)

    source = node("NodeGroupInput", -600, 200)
    sink = node("NodeGroupOutput", 400, 200)
    parts = node("GeometryNodeCollectionInfo", -300, 60)
    place = node("GeometryNodeInstanceOnPoints", 100, 200)
    parts.inputs["Collection"].default_value = library
    parts.inputs["Separate Children"].default_value = True
    parts.inputs["Reset Children"].default_value = True
    place.inputs["Pick Instance"].default_value = True
    links = (
        (source.outputs[0], place.inputs["Points"]),
        (parts.outputs[0], place.inputs["Instance"]),
        (attribute("kind", "INT", -60), place.inputs["Instance Index"]),
        (attribute("turn", "FLOAT_VECTOR", -220), place.inputs["Rotation"]),
        (attribute("size", "FLOAT", -380), place.inputs["Scale"]),
        (place.outputs[0], sink.inputs[0]),
    )
    for output, target in links:
        tree.links.new(output, target)
    return tree
