"""Light records against Blender's properties."""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np
import pytest

from lipac.core.arrays import Records
from lipac.core.scene.known_light import known_light
from lipac.core.scene.model import AreaShape, LightKind, RayType
from lipac.lipac_addon.extract import Extraction, extract_frame

from .conftest import add, collection, cube, instance_of


def lamp(kind: str, **values: Any) -> Any:
    """Light data with properties set."""
    data = bpy.data.lights.new(kind, kind)
    for name, value in values.items():
        setattr(data, name, value)
    return data


def extracted() -> Extraction:
    add("floor", cube())
    return extract_frame(bpy.context.scene)


def one() -> Records:
    lights = extracted().scene.lights
    assert len(lights) == 1
    record: Records = lights[0]
    return record


def test_area_light_takes_the_scale() -> None:
    """Size is the light's times the object's scale, axes are unit; exposure doubles, colour multiplies."""
    data = lamp(
        "AREA", shape="ELLIPSE", size=2.0, size_y=3.0, energy=10.0, exposure=1.0, color=(1, 0.5, 0.25), spread=1.0
    )
    add("lamp", data, location=(1, 2, 3), rotation=(0, np.pi / 2, 0), scale=(2, 0.5, 1))
    r = one()
    assert (r["kind"], r["shape"]) == (LightKind.AREA, AreaShape.ELLIPSE)
    np.testing.assert_allclose(r["size"], [4, 1.5], rtol=1e-6)
    np.testing.assert_allclose(r["power"], [20, 10, 5], rtol=1e-6)
    np.testing.assert_allclose(r["axis_z"], [1, 0, 0], atol=1e-6)
    assert r["spread"] == 1.0
    np.testing.assert_allclose(r["position"] + extract_frame(bpy.context.scene).scene.origin, [1, 2, 3], atol=1e-5)


def test_temperature_nodes_and_visibility() -> None:
    """A colour temperature multiplies; a constant Emission node too; hidden lights are out; visible_camera decides who
    sees the shape."""
    data = lamp("POINT", energy=2.0, use_temperature=True, temperature=3000.0, shadow_soft_size=0.3, normalize=False)
    item = add("lamp", data)
    item.visible_camera = True
    tree = data.node_tree
    if tree is None:
        pytest.skip("this Blender makes lights without a node tree")
    emission = next((n for n in tree.nodes if n.type == "EMISSION"), None) or tree.nodes.new("ShaderNodeEmission")
    emission.inputs["Strength"].default_value = 4.0
    add("hidden", lamp("SUN")).hide_render = True
    r = one()
    np.testing.assert_allclose(r["power"], 8 * np.array(data.temperature_color), rtol=1e-5)
    assert (r["radius"], r["normalize"], r["soft_falloff"]) == (np.float32(0.3), 0, data.use_soft_falloff)
    assert r["visibility"] & (1 << RayType.CAMERA)


def test_light_passes_what_may_not_block_it() -> None:
    """Light linking that names blockers: nobody here knows which are, so the light is there with shadows and without,
    at each place of the lamp, and changes are relative to neither."""
    held, blockers = collection("held", linked=False), collection("blockers", linked=False)
    item = add("lamp", lamp("POINT", energy=8.0), held, location=(0, 0, 5))
    item.light_linking.blocker_collection = blockers
    item.visible_camera = False
    for k in range(2):
        instance_of(f"e {k}", held, location=(k, 0, 0))
    extraction = extracted()
    lights, origin = extraction.scene.lights, extraction.scene.origin
    np.testing.assert_allclose(lights["position"] + origin, [[0, 0, 5], [1, 0, 5]] * 2, atol=1e-6)
    assert lights["cast_shadow"].tolist() == [0, 0, 1, 1]
    np.testing.assert_allclose(lights["power"], 8.0)
    assert lights["unsure"].all()
    assert extraction.scene.approximated == (
        "light POINT: shadow linking not rendered: it is there twice, once without shadows",
    )


@pytest.mark.parametrize("linking", ["receiver_collection", "blocker_collection"])
def test_what_links_light_is_none_that_changes_are_relative_to(linking: str) -> None:
    """A lamp, and a mesh that glows; others of the same kind are as sure as ever, and so is a mesh that glows not."""
    plain, linked = add("plain", lamp("POINT")), add("linked", lamp("SPOT"))
    glowing, other, dull = (add(name, cube(name)) for name in ("glowing", "other", "dull"))
    for item, strength in ((glowing, 2.0), (other, 3.0), (dull, 0.0)):
        material = bpy.data.materials.new(item.name)
        material.node_tree.nodes["Principled BSDF"].inputs["Emission Strength"].default_value = strength
        item.data.materials.append(material)
    for item in (linked, glowing, dull):
        setattr(item.light_linking, linking, collection("some", linked=False))
    scene = extracted().scene
    known = known_light(scene)
    assert known is not None
    assert plain.type == "LIGHT"
    assert known.lights["kind"].tolist() == [LightKind.POINT]
    assert sorted(scene.materials["emission"][:, 0].tolist()) == [0.0, 0.0, 2.0, 3.0]  # with the floor's
    assert sorted(known.materials["emission"][:, 0].tolist()) == [0.0, 0.0, 0.0, 3.0]
    assert [line for line in scene.approximated if line.startswith("object")] == [
        "object glowing: light linking of its emission not rendered: everything is lit"
    ]


def test_a_strength_by_nodes_is_at_most_what_they_may_give() -> None:
    """A lamp that shines by a pattern: all of it counts, and nothing is relative to it."""
    data = lamp("POINT", energy=2.0)
    tree = data.node_tree
    if tree is None:
        pytest.skip("this Blender makes lights without a node tree")
    emission = next((n for n in tree.nodes if n.type == "EMISSION"), None) or tree.nodes.new("ShaderNodeEmission")
    checker, scaled = tree.nodes.new("ShaderNodeTexChecker"), tree.nodes.new("ShaderNodeMath")
    scaled.operation, scaled.inputs[1].default_value = "MULTIPLY", 5.0
    tree.links.new(checker.outputs[1], scaled.inputs[0])
    tree.links.new(scaled.outputs[0], emission.inputs["Strength"])
    add("lamp", data)
    r = one()
    np.testing.assert_allclose(r["power"], 10.0)
    assert r["unsure"] == 1


def test_a_lamp_that_takes_light_away() -> None:
    """Counts as if it gave as much, and what changes are relative to is less by that."""
    add("lamp", lamp("POINT", energy=-2.0))
    r = one()
    np.testing.assert_allclose(r["power"], 2.0)
    assert r["unsure"] == 2


def test_the_scale_of_a_spot_is_that_of_its_cone() -> None:
    """As in Cycles, by the lengths of its axes across against that along it; of other lamps it counts nothing."""
    add("spot", lamp("SPOT", energy=2.0), scale=(3, 1, 2))
    np.testing.assert_allclose(one()["size"], (1.5, 0.5), rtol=1e-6)


def test_a_lamp_of_other_nodes_than_emission_is_as_bright_as_they_may_be() -> None:
    """Two emissions mixed by what looks, a third one added."""
    data = lamp("POINT", energy=2.0)
    tree = data.node_tree
    if tree is None:
        pytest.skip("this Blender makes lights without a node tree")
    tree.nodes.clear()
    output, mix, plus = (
        tree.nodes.new(f"ShaderNode{kind}") for kind in ("OutputLight", "MixShader", "AddShader")
    )
    emissions = [tree.nodes.new("ShaderNodeEmission") for _ in range(3)]
    for node, strength in zip(emissions, (3.0, 7.0, 5.0), strict=True):
        node.inputs["Strength"].default_value = strength
    tree.links.new(tree.nodes.new("ShaderNodeLightPath").outputs["Is Glossy Ray"], mix.inputs[0])
    for a, b in (
        (emissions[0].outputs[0], mix.inputs[1]),
        (emissions[1].outputs[0], mix.inputs[2]),
        (mix.outputs[0], plus.inputs[0]),
        (emissions[2].outputs[0], plus.inputs[1]),
        (plus.outputs[0], output.inputs["Surface"]),
    ):
        tree.links.new(a, b)
    add("lamp", data)
    r = one()
    np.testing.assert_allclose(r["power"], 2 * (7 + 5))
    assert r["unsure"] == 1


@pytest.mark.parametrize("far", [False, True])  # through another node
@pytest.mark.parametrize(("output", "power"), [("Quadratic", 0), ("Linear", 1), ("Constant", 2)])
def test_a_light_falloff_is_as_bright_as_it_may_be(output: str, power: int, far: bool) -> None:
    """As at a distance of a metre, or, where it falls off by less than light does, at the farthest corner; and said."""
    data = lamp("POINT", energy=2.0)
    tree = data.node_tree
    if tree is None:
        pytest.skip("this Blender makes lights without a node tree")
    emission = next((n for n in tree.nodes if n.type == "EMISSION"), None) or tree.nodes.new("ShaderNodeEmission")
    falloff = tree.nodes.new("ShaderNodeLightFalloff")
    falloff.inputs["Strength"].default_value = 50.0
    socket = falloff.outputs[output]
    if far:
        node = tree.nodes.new("ShaderNodeMath")
        node.operation, node.inputs[1].default_value = "MULTIPLY", 3.0
        tree.links.new(socket, node.inputs[0])
        socket = node.outputs[0]
    tree.links.new(socket, emission.inputs["Strength"])
    add("lamp", data, location=(0, 0, 9))
    extraction = extracted()
    most = 100.0 * (3 if far else 1) * np.sqrt(1 + 1 + 10**2) ** power
    np.testing.assert_allclose(extraction.scene.lights["power"], most, rtol=1e-5)
    assert extraction.scene.lights["unsure"].all()
    assert len(extraction.scene.approximated) == 1


def test_instanced_lights() -> None:
    """A collection with a light, instanced."""
    held = collection("held", linked=False)
    add("lamp", lamp("SPOT", spot_size=1.0), held, location=(0, 0, 5))
    for k in range(3):
        instance_of(f"e {k}", held, location=(k, 0, 0))
    extraction = extracted()
    lights, origin = extraction.scene.lights, extraction.scene.origin
    np.testing.assert_allclose(lights["position"] + origin, [[k, 0, 5] for k in range(3)], atol=1e-6)
    assert (lights["spot_size"] == 1.0).all()
    assert not extraction.warnings


def test_no_light_is_a_warning() -> None:
    """Said once; an emitting material is light enough."""
    assert any("no light" in w for w in extracted().warnings)


@pytest.mark.parametrize("cast", [False, True])
def test_shadow_caustics_warn(cast: bool) -> None:
    """What is between a lamp and what it shines through is met by no path."""
    add("lamp", lamp("POINT"))
    add("lens", cube()).cycles.is_caustics_caster = cast
    assert any("shadow caustics" in line for line in extracted().warnings) == cast
