"""Attributes of meshes that materials read."""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np
import pytest

from lipac.core.arrays import F32
from lipac.lipac_addon.attributes import palette, places
from lipac.lipac_addon.extract import extract_frame

from .conftest import add, cube, grid, nodes, scattered


def shown(uvs: F32, pixels: F32) -> F32:
    """The pixels of (..., 2) places."""
    height, width = pixels.shape[:2]
    return pixels[(uvs[..., 1] * height).astype(int), (uvs[..., 0] * width).astype(int)]


def test_the_palette_has_all_colours() -> None:
    """Within an eighth of an octave where colours are, within a quarter where what glows is; less is less, and what is
    no colour is black."""
    for low, high, within in ((-6.0, 2.0, 0.1251), (2.0, 15.5, 0.2501), (-9.0, -6.0, 0.5001)):
        colors = 2.0 ** np.random.default_rng(0).uniform(low, high, (1000, 3))
        found = shown(places(colors), palette())
        np.testing.assert_allclose(np.log2(found[:, :3] / colors), 0, atol=within)
        assert (found[:, 3] == 1).all()
    rest = shown(places(np.array([[0, 1e-9, 1e-4], [-1, np.nan, 1e9]])), palette())[:, :3]
    assert (rest[[0, 0, 0, 1, 1], [0, 1, 2, 0, 1]] == 0).all()
    assert rest[1, 2] > 40_000


def material(kind: str, name: str) -> Any:
    """Its base colour and, doubled, its emission's strength are an attribute."""
    out = bpy.data.materials.new("m")
    if out.node_tree is None:
        out.use_nodes = True
    tree, surface = out.node_tree, out.node_tree.nodes["Principled BSDF"]
    node, double = tree.nodes.new(f"ShaderNode{kind}"), tree.nodes.new("ShaderNodeMath")
    setattr(node, "layer_name" if kind == "VertexColor" else "attribute_name", name)
    double.operation = "MULTIPLY"
    double.inputs[1].default_value = 2
    tree.links.new(node.outputs["Color"], surface.inputs["Base Color"])
    tree.links.new(node.outputs["Color"], double.inputs[0])
    tree.links.new(double.outputs[0], surface.inputs["Emission Strength"])
    surface.inputs["Emission Color"].default_value = (1, 1, 1, 1)
    return out


@pytest.mark.parametrize(
    ("kind", "type_", "domain"),
    [
        ("VertexColor", "FLOAT_COLOR", "POINT"), ("VertexColor", "BYTE_COLOR", "CORNER"),
        ("Attribute", "FLOAT_COLOR", "CORNER"), ("Attribute", "FLOAT", "FACE"), ("Attribute", "BOOLEAN", "FACE"),
        ("Attribute", "FLOAT_VECTOR", "POINT"),
    ],
)
def test_what_meshes_have_is_what_they_show(kind: str, type_: str, domain: str) -> None:
    """Each triangle the mean of its corners, of every mesh its own; black where a mesh has none. Nothing of it is an
    approximation."""
    rng, values = np.random.default_rng(1), {}
    shared = material(kind, "Col")
    for name in ("one", "two", "none"):
        mesh = cube(name)
        mesh.materials.append(shared)
        add(name, mesh, location=(0, 0, 0))
        if name == "none":
            values[name] = np.zeros((len(mesh.loops), 3))
            continue
        attribute = mesh.attributes.new("Col", type_, domain)
        count = len(attribute.data)
        if "COLOR" in type_:
            data = rng.uniform(0.02, 1, (count, 4)).astype(np.float32)
            attribute.data.foreach_set("color", data.ravel())
        elif type_ == "FLOAT_VECTOR":
            data = rng.uniform(0.02, 1, (count, 3)).astype(np.float32)
            attribute.data.foreach_set("vector", data.ravel())
        else:
            data = rng.uniform(0.02, 1, (count, 1)).astype(np.float32)
            data = (data > 0.5).astype(np.float32) if type_ == "BOOLEAN" else data
            attribute.data.foreach_set("value", data.ravel().astype(bool) if type_ == "BOOLEAN" else data.ravel())
        of = {
            "CORNER": range(len(mesh.loops)),
            "POINT": [loop.vertex_index for loop in mesh.loops],
            "FACE": [face.index for face in mesh.polygons for _ in face.loop_indices],
        }[domain]
        values[name] = np.broadcast_to(data[list(of)][:, :3], (len(mesh.loops), 3))
    extraction = extract_frame(bpy.context.scene)
    scene = extraction.scene
    assert not scene.approximated
    record = scene.materials[0]
    base, light = (scene.textures.records[record[f"{name}_texture"]] for name in ("base_color", "emission"))
    assert base["uv_map"] == light["uv_map"] > 0
    for row, number in zip(extraction.keys.records["object"], scene.instances.mesh, strict=True):
        name = extraction.keys.names[row]
        mesh = scene.meshes[number]
        bpy.data.objects[name].data.calc_loop_triangles()
        corners = [list(t.loops) for t in bpy.data.objects[name].data.loop_triangles]
        expected = values[name][np.array(corners)].mean(axis=1)
        assert mesh.uvs is not None
        uvs = mesh.uvs[base["uv_map"]]
        assert (uvs == uvs[:, :1]).all()
        for texture, factor, times in ((base, record["base_color"], 1), (light, record["emission"], 2)):
            size = int(texture["height"]) * int(texture["width"]) * 4
            pixels = scene.textures.floats[int(texture["offset"]) :][:size].reshape(
                int(texture["height"]), int(texture["width"]), 4
            )
            found = shown(uvs[:, 0], pixels)[:, :3] * factor
            if times == 2:
                expected = np.repeat((expected @ (0.2126, 0.7152, 0.0722))[:, None], 3, axis=1)
            np.testing.assert_allclose(found, times * expected, rtol=0.1, atol=2e-3)


def test_within_what_attributes_of_instances_lie() -> None:
    """Those that emit by such an attribute emit as much as it says, by thousands too."""
    glow = bpy.data.materials.new("glow")
    tree, surface = glow.node_tree, glow.node_tree.nodes["Principled BSDF"]
    node = tree.nodes.new("ShaderNodeAttribute")
    node.attribute_type, node.attribute_name = "INSTANCER", "power"
    tree.links.new(node.outputs[2], surface.inputs["Emission Strength"])
    surface.inputs["Emission Color"].default_value = (1, 1, 1, 1)
    lantern = add("lantern", cube())
    lantern.data.materials.append(glow)

    def build(_: Any, new: Any) -> Any:
        inputs = {"Object": lantern, "As Instance": True}
        rows = scattered(new, grid(new, 3), new("GeometryNodeObjectInfo", inputs).outputs["Geometry"])
        stored = new("GeometryNodeStoreNamedAttribute", {"Geometry": rows, "Name": "power"}, domain="INSTANCE")
        next(s for s in stored.inputs if s.name == "Value" and s.type == "VALUE").default_value = 2500.0
        return stored.outputs[0]

    nodes(add("host", cube("host")), build)
    scene = extract_frame(bpy.context.scene).scene
    assert scene.materials["emission"].max() == 2500.0
