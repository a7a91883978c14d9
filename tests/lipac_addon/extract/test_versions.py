"""What only some versions of Blender have is reported there, and a newer Blender than we know says so."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import bpy
import pytest

from lipac.core.scene.model import Shading
from lipac.lipac_addon.extract import camera, extract_frame
from lipac.lipac_addon.extract.camera import extract_limits

from .conftest import add, cube
from .materials.test_converter import Tree


def node(tree: Tree, kind: str, inputs: dict[Any, Any] | None = None) -> Any:
    if not hasattr(bpy.types, kind):
        pytest.skip(f"Blender {bpy.app.version_string} has no {kind}")
    return tree.new(kind, inputs)


def test_surfaces_are_those_of_the_blender_that_runs() -> None:
    assert extract_limits(bpy.context.scene).shading == (
        Shading.BLENDER_5_3 if bpy.app.version >= (5, 3, 0) else Shading.BLENDER_5_0
    )


def test_a_newer_blender_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    add("Cube", cube())
    assert not any("newer" in line for line in extract_frame(bpy.context.scene).warnings)
    monkeypatch.setattr(camera, "NEWEST", (4, 9))
    lines = [line for line in extract_frame(bpy.context.scene).warnings if "newer" in line]
    assert len(lines) == 1
    assert bpy.app.version_string in lines[0]


@pytest.mark.parametrize("socket", ["Roughness", "Alpha", "Emission Strength", "Base Color"])
def test_raycast_is_reported(socket: str) -> None:
    tree = Tree()
    ray = node(tree, "ShaderNodeRaycast")
    surface = tree.new("ShaderNodeBsdfPrincipled", {socket: ray.outputs["Hit Distance"]})
    assert any("Raycast" in line for line in tree.parts(surface)[2])


@pytest.mark.parametrize(
    "kind",
    ["ShaderNodeLightAccumulation", "ShaderNodeLightInfo", "ShaderNodeLightEvaluation", "ShaderNodeShadowRaycast"],
)
def test_light_loops_are_reported(kind: str) -> None:
    tree = Tree()
    made = node(tree, kind)
    if kind != "ShaderNodeLightAccumulation":
        made = tree.new("ShaderNodeEmission", {"Color": made.outputs[0]})
    lines = tree.parts(made)[2]
    assert "material m: light loop not rendered" in lines
    inner = bpy.data.node_groups.new("inner", "ShaderNodeTree")
    inner.nodes.new(kind)
    outer = Tree()
    outer.new("ShaderNodeGroup").node_tree = inner
    assert any("light loop" in line for line in outer.parts(outer.new("ShaderNodeBsdfDiffuse"))[2])


def test_dispersion_and_anisotropic_glass_are_reported() -> None:
    tree = Tree()
    surface = tree.new("ShaderNodeBsdfPrincipled", {"Transmission Weight": 1.0})
    if "Transmission Dispersion Scale" not in surface.inputs:
        pytest.skip("no dispersion here")
    assert not tree.parts(surface)[2]
    surface.inputs["Transmission Dispersion Scale"].default_value = 1.0
    assert any("dispersion not rendered" in line for line in tree.parts(surface)[2])
    tree = Tree()
    assert any(
        "anisotropy not rendered" in line
        for line in tree.parts(tree.new("ShaderNodeBsdfGlass", {"Anisotropy": 0.5}))[2]
    )


def test_gaussian_splats_are_reported() -> None:
    if not hasattr(bpy.types, "GeometryNodePointsSetType"):
        pytest.skip("no Gaussian splats here")
    add("Cube", cube())
    ob = add("Splats", cube())
    group = bpy.data.node_groups.new("splats", "GeometryNodeTree")
    group.interface.new_socket("Geometry", in_out="INPUT", socket_type="NodeSocketGeometry")
    group.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    chain = [
        group.nodes.new(kind)
        for kind in ("NodeGroupInput", "GeometryNodeMeshToPoints", "GeometryNodePointsSetType", "NodeGroupOutput")
    ]
    for socket in chain[2].inputs:
        if socket.type == "MENU":
            socket.default_value = "3D Gaussian Splat"
    for a, b in pairwise(chain):
        group.links.new(a.outputs[0], b.inputs[0])
    ob.modifiers.new("splats", "NODES").node_group = group
    assert "object Splats: Gaussian splats not rendered" in extract_frame(bpy.context.scene).scene.approximated
