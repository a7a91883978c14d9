"""Small Blender scenes, one per instancer, built by code."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import bpy
import pytest

SHARED = Path(__file__).parents[3] / ".." / "shared" / "scenes"


@pytest.fixture(autouse=True)
def empty_file() -> None:
    """Every test starts from an empty file with a camera."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    camera = add("Camera", bpy.data.cameras.new("Camera"), location=(3.0, -20.0, 8.0), rotation=(1.2, 0.0, 0.1))
    bpy.context.scene.camera = camera


@pytest.fixture
def shared() -> Path:
    """The folder of supplied scenes."""
    if not SHARED.is_dir():
        pytest.skip("the supplied scenes (../shared/scenes) are not here")
    return SHARED.resolve()


def add(
    name: str,
    data: Any = None,
    collection: Any = None,
    location: Any = (0, 0, 0),
    rotation: Any = (0, 0, 0),
    scale: Any = (1, 1, 1),
    parent: Any = None,
) -> Any:
    """An object with the given data in a collection (default: the scene's)."""
    item = bpy.data.objects.new(name, data)
    (collection or bpy.context.scene.collection).objects.link(item)
    item.location, item.rotation_euler, item.scale, item.parent = location, rotation, scale, parent
    return item


def cube(name: str = "cube", size: float = 1.0) -> Any:
    """Mesh: a cube."""
    mesh = bpy.data.meshes.new(name)
    corners = [(x, y, z) for x in (-size, size) for y in (-size, size) for z in (-size, size)]
    mesh.from_pydata(corners, [], [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)])
    return mesh


def wedge(name: str = "wedge") -> Any:
    """Mesh: a tetrahedron without any symmetry, so that wrong axes show."""
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata([(0, 0, 0), (1, 0, 0), (0, 2, 0), (0, 0, 3)], [], [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)])
    return mesh


def collection(name: str, parent: Any = None, linked: bool = True) -> Any:
    """A collection, linked to the scene or only kept in the file."""
    item = bpy.data.collections.new(name)
    if linked:
        (parent or bpy.context.scene.collection).children.link(item)
    return item


def instance_of(name: str, instanced: Any, **place: Any) -> Any:
    """An empty that instances a collection."""
    item = add(name, None, **place)
    item.instance_type, item.instance_collection = "COLLECTION", instanced
    return item


def nodes(host: Any, build: Callable[[Any, Callable[..., Any]], Any]) -> Any:
    """A geometry-nodes modifier on an object. build(input geometry socket, new) returns the output geometry socket;
    new(type, {input: value}, **properties) makes a node whose inputs are set from values or sockets."""
    tree = bpy.data.node_groups.new("nodes", "GeometryNodeTree")
    tree.interface.new_socket("Geometry", in_out="INPUT", socket_type="NodeSocketGeometry")
    tree.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    source, sink = tree.nodes.new("NodeGroupInput"), tree.nodes.new("NodeGroupOutput")

    def new(kind: str, inputs: dict[Any, Any], **properties: Any) -> Any:
        node = tree.nodes.new(kind)
        for key, value in properties.items():
            setattr(node, key, value)
        for key, value in inputs.items():
            for one in value if isinstance(value, list) else [value]:
                if isinstance(one, bpy.types.NodeSocket):
                    tree.links.new(one, node.inputs[key])
                else:
                    node.inputs[key].default_value = one
        return node

    tree.links.new(build(source.outputs[0], new), sink.inputs[0])
    modifier = host.modifiers.new("nodes", "NODES")
    modifier.node_group = tree
    return modifier


def scattered(new: Callable[..., Any], points: Any, instance: Any, seed: int = 0, pick: bool = False) -> Any:
    """Instances on points with random rotation and a scale that is non-uniform and negative for some."""
    rotation = new(
        "FunctionNodeRandomValue", {0: (0, 0, 0), 1: (6, 6, 6), "Seed": seed}, data_type="FLOAT_VECTOR"
    ).outputs[0]
    scale = new(
        "FunctionNodeRandomValue", {0: (-1, 0.2, 0.5), 1: (1.5, 2, 1), "Seed": seed + 1}, data_type="FLOAT_VECTOR"
    ).outputs[0]
    inputs = {"Points": points, "Instance": instance, "Rotation": rotation, "Scale": scale, "Pick Instance": pick}
    return new("GeometryNodeInstanceOnPoints", inputs).outputs[0]


def grid(new: Callable[..., Any], side: int, size: float = 20.0) -> Any:
    """Points of a grid, side x side."""
    return new(
        "GeometryNodeMeshGrid", {"Size X": size, "Size Y": size, "Vertices X": side, "Vertices Y": side}
    ).outputs[0]
