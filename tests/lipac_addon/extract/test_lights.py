"""Light records against Blender's properties."""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np
import pytest

from lipac.core.arrays import Records
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


def test_half_the_light_passes_what_may_not_block_it() -> None:
    """Light linking that names blockers: nobody here knows which are, so half of the light has shadows and half has
    none, at each place of the lamp."""
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
    np.testing.assert_allclose(lights["power"], 4.0)
    assert extraction.scene.approximated == (
        "light POINT: shadow linking not rendered: half of the light passes everything",
    )


def test_a_light_falloff_keeps_its_strength() -> None:
    """As at a distance of a metre, and said."""
    data = lamp("POINT", energy=2.0)
    tree = data.node_tree
    if tree is None:
        pytest.skip("this Blender makes lights without a node tree")
    emission = next((n for n in tree.nodes if n.type == "EMISSION"), None) or tree.nodes.new("ShaderNodeEmission")
    falloff = tree.nodes.new("ShaderNodeLightFalloff")
    falloff.inputs["Strength"].default_value = 50.0
    tree.links.new(falloff.outputs["Linear"], emission.inputs["Strength"])
    add("lamp", data)
    extraction = extracted()
    np.testing.assert_allclose(extraction.scene.lights["power"], 100.0)
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
