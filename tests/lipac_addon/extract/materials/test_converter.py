"""Node trees -> MATERIAL records and textures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy
import numpy as np
import pytest

from lipac.core.arrays import Records
from lipac.core.scene.model import (
    BY_ANGLE,
    MATERIAL,
    VIEWS,
    Extension,
    RayType,
    Shader,
    Textures,
    Unsure,
    default_material,
)
from lipac.lipac_addon import attributes
from lipac.lipac_addon.extract import extract_frame
from lipac.lipac_addon.extract.materials.converter import DARK
from lipac.lipac_addon.extract.materials.material_table import PICKED, MaterialTable
from lipac.lipac_addon.extract.materials.ranges import FARTHEST
from lipac.lipac_addon.extract.materials.reader import ANGLES, LUMINANCE, WORTHLESS
from lipac.lipac_addon.extract.materials.textures import TextureTable, srgb_to_linear

from ..conftest import add, cube


class Tree:
    """A material's tree, emptied to its output; `new(type, **inputs)` makes nodes, input names with spaces as
    underscores."""

    def __init__(self) -> None:
        self.material = bpy.data.materials.new("m")
        self.tree = self.material.node_tree
        self.tree.nodes.clear()
        self.output = self.tree.nodes.new("ShaderNodeOutputMaterial")

    def new(self, kind: str, inputs: dict[Any, Any] | None = None, **properties: Any) -> Any:
        node = self.tree.nodes.new(kind)
        for key, value in properties.items():
            setattr(node, key, value)
        for key, value in (inputs or {}).items():
            if isinstance(value, bpy.types.NodeSocket):
                self.tree.links.new(value, node.inputs[key])
            else:
                node.inputs[key].default_value = value
        return node

    def parts(self, surface: Any) -> tuple[Records, Textures, list[str]]:
        """The record of the material, and of its parts, where it has any."""
        if surface is not None:
            self.tree.links.new(surface.outputs[0], self.output.inputs["Surface"])
        textures = TextureTable(print)
        table = MaterialTable(textures)
        table.index(self.material)
        return table.build(), textures.build(), list(table.approximated)

    def record(self, surface: Any) -> tuple[Records, Textures, list[str]]:
        records, textures, lines = self.parts(surface)
        assert len(records) == 1
        return records[0], textures, lines


def image(pixels: np.ndarray, name: str = "image", data: bool = False, floats: bool = False) -> Any:
    """(H, W, 4) in [0, 1] as a Blender image."""
    item = bpy.data.images.new(name, pixels.shape[1], pixels.shape[0], alpha=True, float_buffer=floats, is_data=data)
    item.pixels.foreach_set(np.ascontiguousarray(pixels, np.float32).ravel())
    return item


def random_pixels(seed: int = 0) -> np.ndarray:
    """(16, 8, 4) with values a byte holds, opaque."""
    pixels = np.random.default_rng(seed).integers(0, 256, (16, 8, 4)) / 255
    pixels[..., 3] = 1
    return pixels


def pixels_of(textures: Textures, index: Any) -> np.ndarray:
    """(H, W, 4) as stored: 0 to 255, or floats."""
    r = textures.records[index]
    pool = textures.floats if r["is_float"] else textures.bytes
    return pool[r["offset"] : r["offset"] + r["width"] * r["height"] * 4].reshape(r["height"], r["width"], 4)


def test_none_is_the_default() -> None:
    """A mesh without a material, and with an empty slot."""
    table = MaterialTable(TextureTable(print))
    np.testing.assert_array_equal(table.records[table.index(None)], default_material())


def test_principled_constants() -> None:
    """Every field of MATERIAL comes from its socket."""
    t = Tree()
    values = {
        "Base Color": (0.1, 0.2, 0.3, 1),
        "Metallic": 0.4,
        "Roughness": 0.6,
        "Diffuse Roughness": 0.15,
        "IOR": 1.7,
        "Specular IOR Level": 0.3,
        "Specular Tint": (0.9, 0.8, 0.7, 1),
        "Transmission Weight": 0.25,
        "Alpha": 0.75,
        "Coat Weight": 0.35,
        "Coat Roughness": 0.05,
        "Coat IOR": 1.4,
        "Coat Tint": (0.5, 0.6, 0.7, 1),
        "Emission Color": (1, 0.5, 0.25, 1),
        "Emission Strength": 4.0,
    }
    record, _, lines = t.record(t.new("ShaderNodeBsdfPrincipled", values))
    assert not lines
    expected = default_material()
    fields = dict(
        zip(
            [
                "base_color",
                "metallic",
                "roughness",
                "diffuse_roughness",
                "ior",
                "specular_level",
                "specular_tint",
                "transmission",
                "alpha",
                "coat",
                "coat_roughness",
                "coat_ior",
                "coat_tint",
            ],
            values.values(),
            strict=False,
        )
    )
    for name, value in fields.items():
        expected[name] = value[:3] if isinstance(value, tuple) else value
    expected["emission"] = (4, 2, 1)
    for name in MATERIAL.names or ():
        np.testing.assert_allclose(record[name], expected[name], rtol=1e-6, err_msg=name)


def test_principled_extras_are_reported() -> None:
    """Subsurface and the like are named."""
    t = Tree()
    _, _, lines = t.parts(
        t.new("ShaderNodeBsdfPrincipled", {"Subsurface Weight": 0.5, "Sheen Weight": 1.0, "Anisotropic": 0.2})
    )
    assert lines == [
        "material m: subsurface not rendered: half of it comes out at the other side",
        "material m: sheen not rendered",
        "material m: anisotropy not rendered",
    ]


@pytest.mark.parametrize("kind", ["ShaderNodeBsdfPrincipled", "ShaderNodeBsdfAnisotropic", "ShaderNodeBsdfGlass"])
def test_bumps_spread_half_of_what_is_reflected(kind: str) -> None:
    """How much normals turn is not known: half of the material is as it is, half is rough; once, in a mix of shaders
    too."""
    t = Tree()
    bump = t.new("ShaderNodeBump")
    shader = t.new(kind, {"Roughness": 0.05, "Normal": bump.outputs[0]})
    mix = t.new("ShaderNodeMixShader", {0: 0.25, 1: t.new("ShaderNodeBsdfDiffuse").outputs[0], 2: shader.outputs[0]})
    records, _, lines = t.parts(mix)
    assert lines == ["material m: Bump node on Normal not rendered: half of what is reflected is spread"]
    mixes = records[records["shader"] == Shader.MIX]
    assert sorted(mixes["alpha"].tolist()) == [0.25, 0.5]
    sharp = records[(records["shader"] != Shader.MIX) & (records["shader"] != Shader.DIFFUSE)]
    assert sorted(sharp["roughness"].tolist()) == pytest.approx([0.05, 0.5])


@pytest.mark.parametrize(("kind", "sure"), [("ShaderNodeBsdfAnisotropic", 1), ("ShaderNodeBsdfPrincipled", 2)])
def test_normals_of_which_nothing_is_known_spread_all_around(kind: str, sure: int) -> None:
    """A mirror by a Bevel node may show anything: half of that is not what changes are relative to."""
    t = Tree()
    shader = t.new(kind, {"Roughness": 0.05, "Normal": t.new("ShaderNodeBevel").outputs[0]})
    records, _, lines = t.parts(shader)
    assert lines == ["material m: Bevel node on Normal not rendered: half of what is reflected is spread"]
    parts = records[records["shader"] != Shader.MIX]
    assert sorted(parts["roughness"].tolist()) == pytest.approx([0.05, 1.0])
    assert np.count_nonzero(parts["unsure"] == 0) == sure


@pytest.mark.parametrize(
    ("output", "sampling", "stays"),
    [
        ("Is Diffuse Ray", "AUTO", [True, False]),
        ("Is Reflection Ray", "FRONT", [True, False]),
        ("Is Diffuse Ray", "NONE", None),
        ("Is Camera Ray", "AUTO", None),
        ("Is Shadow Ray", "AUTO", None),
    ],
)
def test_what_emits_stays_where_light_sampling_sees_other_emission(
    output: str, sampling: str, stays: list[bool] | None
) -> None:
    """Of what rays meet Cycles then drops the share that light sampling would have, which hangs on all emitters."""
    t = Tree()
    t.material.cycles.emission_sampling = sampling
    light, glow = t.new("ShaderNodeLightPath"), t.new("ShaderNodeEmission")
    mix = t.new("ShaderNodeMixShader", {0: light.outputs[output], 2: glow.outputs[0]})
    t.tree.links.new(mix.outputs[0], t.output.inputs[0])
    for name in ("lantern", "stone"):
        mesh = cube(name)
        if name == "lantern":
            mesh.materials.append(t.material)
        add(name, mesh)
    scene = extract_frame(bpy.context.scene).scene
    assert (None if scene.stays is None else scene.stays.tolist()) == stays
    assert any(line.endswith(PICKED) for line in scene.approximated) == (stays is not None)


def test_bumps_of_what_is_rough_change_nothing() -> None:
    for kind in ("ShaderNodeBsdfDiffuse", "ShaderNodeBsdfPrincipled"):
        t = Tree()
        record, _, _ = t.record(t.new(kind, {"Roughness": 0.7, "Normal": t.new("ShaderNodeBump").outputs[0]}))
        assert record["shader"] != Shader.MIX


@pytest.mark.parametrize(
    ("kind", "shader"),
    [
        ("ShaderNodeBsdfDiffuse", Shader.DIFFUSE),
        ("ShaderNodeBsdfAnisotropic", Shader.GLOSSY),
        ("ShaderNodeBsdfGlass", Shader.GLASS),
        ("ShaderNodeBsdfRefraction", Shader.REFRACTION),
        ("ShaderNodeBsdfTranslucent", Shader.TRANSLUCENT),
        ("ShaderNodeBsdfTransparent", Shader.TRANSPARENT),
        ("ShaderNodeHoldout", Shader.HOLDOUT),
        ("ShaderNodeEmission", Shader.EMISSION),
    ],
)
def test_plain_shaders(kind: str, shader: Shader) -> None:
    """One model each, with colour, roughness and IOR."""
    t = Tree()
    node = t.new(kind)
    if hasattr(node, "distribution"):
        node.distribution = "GGX"
    values = {"Color": (0.1, 0.2, 0.3, 1), "Roughness": 0.4, "IOR": 1.2, "Strength": 3.0}
    for name, value in values.items():
        if name in node.inputs:
            node.inputs[name].default_value = value
    record, _, lines = t.record(node)
    assert not lines
    assert record["shader"] == shader
    if shader == Shader.EMISSION:
        np.testing.assert_allclose(record["emission"], [0.3, 0.6, 0.9], rtol=1e-6)
    elif shader != Shader.HOLDOUT:
        np.testing.assert_allclose(record["base_color"], [0.1, 0.2, 0.3], rtol=1e-6)
    if "IOR" in node.inputs:
        assert record["ior"] == np.float32(1.2)
    if "Roughness" in node.inputs:
        assert record["diffuse_roughness" if shader == Shader.DIFFUSE else "roughness"] == np.float32(0.4)


def test_groups_and_arithmetic_fold() -> None:
    """Constants through groups, reroutes, Math and Mix come out as numbers, unreported."""
    group = bpy.data.node_groups.new("g", "ShaderNodeTree")
    group.interface.new_socket("In", in_out="INPUT", socket_type="NodeSocketFloat")
    group.interface.new_socket("Out", in_out="OUTPUT", socket_type="NodeSocketFloat")
    source, sink, math = (group.nodes.new(k) for k in ("NodeGroupInput", "NodeGroupOutput", "ShaderNodeMath"))
    math.operation, math.inputs[1].default_value = "MULTIPLY", 0.5
    group.links.new(source.outputs[0], math.inputs[0])
    group.links.new(math.outputs[0], sink.inputs[0])
    t = Tree()
    node = t.new("ShaderNodeGroup", node_tree=group)
    node.inputs[0].default_value = 0.6
    mix = t.new("ShaderNodeMix", {0: 0.25, 6: (1, 0, 0, 1), 7: (0, 1, 0, 1)}, data_type="RGBA")
    ramp = t.new("ShaderNodeValToRGB", {0: 0.5})
    record, _, lines = t.record(
        t.new(
            "ShaderNodeBsdfPrincipled",
            {"Roughness": node.outputs[0], "Base Color": mix.outputs[2], "Metallic": ramp.outputs[0]},
        )
    )
    assert not lines
    assert record["roughness"] == pytest.approx(0.3)
    assert record["metallic"] == pytest.approx(0.5, abs=1 / 256)  # a table of 256 steps
    np.testing.assert_allclose(record["base_color"], [0.75, 0.25, 0], atol=1e-6)


def test_shader_combinations() -> None:
    """Transparent becomes a Principled's alpha, Emission the emission of plain shaders; all else shows either part, by
    its share, unreported."""
    t = Tree()
    a = t.new("ShaderNodeBsdfDiffuse", {"Color": (0.8, 0.4, 0.2, 1)})
    principled, lamp = t.new("ShaderNodeBsdfPrincipled"), t.new("ShaderNodeEmission", {"Strength": 2.0})
    clear, glossy = t.new("ShaderNodeBsdfTransparent"), t.new("ShaderNodeBsdfAnisotropic")

    def mix(factor: float, first: Any, second: Any) -> Records:
        parts, _, lines = t.parts(t.new("ShaderNodeMixShader", {0: factor, 1: first.outputs[0], 2: second.outputs[0]}))
        assert not lines
        return parts

    assert [
        float(record["alpha"])
        for factor, *two in ((0.3, clear, principled), (0.7, principled, clear))
        for record in mix(factor, *two)
    ] == [np.float32(0.3), np.float32(0.3)]
    record = mix(0.25, a, lamp)[0]
    np.testing.assert_allclose(record["emission"], [0.5, 0.5, 0.5], rtol=1e-6)
    np.testing.assert_allclose(record["base_color"], [0.6, 0.3, 0.15], rtol=1e-6)
    for first, second, shaders in (
        (clear, a, (5, 1)),
        (a, clear, (1, 5)),
        (a, glossy, (1, 2)),
        (principled, lamp, (0, 4)),
        (principled, principled, (0, 0)),
    ):
        head, *below = mix(0.7, first, second)
        assert (head["shader"], head["alpha"], head["parts"].tolist()) == (Shader.MIX, np.float32(0.7), [1, 2])
        assert tuple(part["shader"] for part in below) == shaders
        assert head["emission"].tolist() == ([2, 2, 2] if second is lamp else [0, 0, 0])
    record = mix(1.0, a, glossy)[0]
    assert record["shader"] == Shader.GLOSSY
    parts, _, lines = t.parts(t.new("ShaderNodeAddShader", {0: a.outputs[0], 1: lamp.outputs[0]}))
    assert (len(parts), parts[0]["shader"], float(parts[0]["emission"][0]), lines) == (1, Shader.DIFFUSE, 2.0, [])
    (head, one, two), _, lines = t.parts(t.new("ShaderNodeAddShader", {0: a.outputs[0], 1: clear.outputs[0]}))
    assert (head["alpha"], two["shader"], lines) == (0.5, Shader.TRANSPARENT, [])
    np.testing.assert_allclose(one["base_color"], [1.6, 0.8, 0.4])


def test_a_mix_of_mixes_refers_to_its_own_parts() -> None:
    """Whatever else is in the table."""
    t = Tree()
    kinds = ("Diffuse", "Transparent", "Glass", "Translucent")
    nodes = [t.new(f"ShaderNodeBsdf{kind}") for kind in kinds]
    for one in nodes[1:]:
        nodes.append(
            t.new(
                "ShaderNodeMixShader",
                {0: 0.5, 1: nodes[-1].outputs[0] if len(nodes) > 4 else nodes[0].outputs[0], 2: one.outputs[0]},
            )
        )
    t.tree.links.new(nodes[-1].outputs[0], t.output.inputs["Surface"])
    table = MaterialTable(TextureTable(print))
    indices = [table.index(None), table.index(t.material)]
    assert indices == [0, 1]
    records = table.build()
    at, found = 1, []
    while records[at]["shader"] == Shader.MIX:
        at, leaf = records[at]["parts"]
        found.append(Shader(int(records[leaf]["shader"])))
    assert found == [Shader.TRANSLUCENT, Shader.GLASS, Shader.TRANSPARENT]
    assert records[at]["shader"] == Shader.DIFFUSE


def test_thin_walls_let_rays_straight_through() -> None:
    """Half of them; without transmission there is nothing to pass."""
    t = Tree()
    node = t.new("ShaderNodeBsdfPrincipled", {"Transmission Weight": 1.0})
    if "Thin Wall" not in node.inputs:
        pytest.skip("this Blender has no thin walls")
    node.inputs["Thin Wall"].default_value = True
    (head, *parts), _, lines = t.parts(node)
    assert (head["shader"], [int(part["unsure"]) for part in parts], len(lines)) == (Shader.MIX, [1, 1], 1)
    node.inputs["Transmission Weight"].default_value = 0.0
    assert t.record(node)[0]["shader"] == Shader.PRINCIPLED


def views(rays: Any) -> list[set[int]]:
    """What sees the second part: ray types from the front, and from the back."""
    return [{k for k in range(VIEWS) if int(rays) >> (k + side) & 1} for side in (0, VIEWS)]


def test_rays_and_sides_are_told_apart() -> None:
    """By Light Path, also through arithmetic, and by Backfacing: each ray sees what Cycles shows it, unreported."""
    t = Tree()
    clear, solid = t.new("ShaderNodeBsdfTransparent"), t.new("ShaderNodeBsdfDiffuse")
    light, geometry = t.new("ShaderNodeLightPath"), t.new("ShaderNodeNewGeometry")
    either = t.new(
        "ShaderNodeMath",
        {0: light.outputs["Is Camera Ray"], 1: light.outputs["Is Reflection Ray"]},
        operation="MAXIMUM",
    )
    for factor, front, back in (
        (light.outputs["Is Camera Ray"], {RayType.CAMERA}, {RayType.CAMERA}),
        (light.outputs["Is Shadow Ray"], {RayType.SHADOW}, {RayType.SHADOW}),
        (either.outputs[0], {0, 1, 2}, {0, 1, 2}),
        (geometry.outputs["Backfacing"], set(), set(range(VIEWS))),
    ):
        (head, *parts), _, lines = t.parts(
            t.new("ShaderNodeMixShader", {0: factor, 1: solid.outputs[0], 2: clear.outputs[0]})
        )
        assert not lines
        assert head["shader"] == Shader.BY_RAY
        shaders = [int(part["shader"]) for part in parts]
        sees = views(head["rays"])
        if shaders == [Shader.TRANSPARENT, Shader.DIFFUSE]:  # the first part is what camera rays see
            sees = [set(range(VIEWS)) - side for side in sees]
        assert sees == [front, back]
    record = t.parts(t.new("ShaderNodeBsdfPrincipled", {"Alpha": light.outputs["Is Shadow Ray"]}))[0]
    assert [float(part["alpha"]) for part in record[1:]] == [0, 1]


@pytest.mark.parametrize("kind", ["TexNoise", "ParticleInfo", "ObjectInfo", "CameraData"])
def test_half_passes_where_nobody_knows_how_much(kind: str) -> None:
    """A share, an alpha or a transmission by what the tracer does not evaluate: a half, marked as unsure, and reported;
    other inputs are not."""
    t = Tree()
    source = t.new(f"ShaderNode{kind}").outputs
    value = next(s for s in source if s.type == "VALUE" and s.name not in {"Alpha"})
    clear = t.new("ShaderNodeBsdfTransparent")
    for factor in (value, t.new("ShaderNodeMath", {0: value, 1: 0.1}, operation="MULTIPLY").outputs[0]):
        (head, *parts), _, lines = t.parts(
            t.new(
                "ShaderNodeMixShader", {0: factor, 1: clear.outputs[0], 2: t.new("ShaderNodeBsdfPrincipled").outputs[0]}
            )
        )
        assert (head["shader"], head["alpha"], [int(part["unsure"]) for part in parts]) == (Shader.MIX, 0.5, [7, 7])
        assert len(lines) == 1
    for socket, field in (("Alpha", "alpha"), ("Transmission Weight", "transmission")):
        (record,), _, _ = t.parts(t.new("ShaderNodeBsdfPrincipled", {socket: value}))
        assert (record[field], record["unsure"]) == (0.5, 3 if field == "alpha" else Unsure.BEHIND)
    (record,), _, lines = t.parts(t.new("ShaderNodeBsdfPrincipled", {"Metallic": value}))
    assert (record["metallic"], record["unsure"], len(lines)) == (0.5, Unsure.LIGHT, 1)
    (record,), _, lines = t.parts(t.new("ShaderNodeBsdfPrincipled", {"Diffuse Roughness": value}))
    assert (record["unsure"], len(lines)) == (0, 1)


@pytest.mark.parametrize(
    ("kind", "output", "most"),
    [
        ("ObjectInfo", "Random", 1.0),
        ("TexNoise", 0, 1.0),
        ("Wireframe", 0, 1.0),
        ("Attribute", 2, 100.0),
        ("LightPath", "Ray Length", 100.0),
    ],
)
def test_emission_that_is_not_known_is_the_most_that_it_may_be(kind: str, output: str | int, most: float) -> None:
    """A strength or a colour by what the tracer does not evaluate, or behind a share that it does not: the most, marked
    as unsure, and said where nothing bounds it; emission beside a colour that is not known is sure."""
    t = Tree()
    source = t.new(f"ShaderNode{kind}").outputs[output]
    scaled = t.new("ShaderNodeMath", {0: source, 1: 8.0}, operation="MULTIPLY").outputs[0]
    for node in (
        t.new("ShaderNodeEmission", {"Color": (1, 0.5, 0.25, 1), "Strength": scaled}),
        t.new("ShaderNodeBsdfPrincipled", {"Emission Color": (1, 0.5, 0.25, 1), "Emission Strength": scaled}),
    ):
        record, _, lines = t.record(node)
        strength = 8 * most
        np.testing.assert_allclose(record["emission"], strength * np.array([1, 0.5, 0.25]))
        assert record["unsure_emission"] == 1
        assert [line.endswith(WORTHLESS) for line in lines] == ([False] if most == 1.0 else [False, True])
    record, _, _ = t.record(t.new("ShaderNodeEmission", {"Color": source, "Strength": 3.0}))
    np.testing.assert_allclose(record["emission"], 3 * most)
    assert record["unsure_emission"] == 1
    glow = t.new("ShaderNodeEmission", {"Strength": 3.0}).outputs[0]
    _, *parts = t.parts(t.new("ShaderNodeMixShader", {0: source, 1: glow}))[0]
    assert [(part["emission"][0], part["unsure_emission"]) for part in parts] == [(6.0, 1), (0.0, 0)]
    record, _, _ = t.record(t.new("ShaderNodeBsdfPrincipled", {"Base Color": source, "Emission Strength": 1.0}))
    assert (record["emission"][0], record["unsure_emission"]) == (1.0, 0)


def test_what_is_there_but_cannot_be_read_may_show_anything(tmp_path: Path) -> None:
    """A picture with layers, whose passes Blender does not give out; what is not there is magenta, as in Cycles."""
    scene, there, missing = bpy.context.scene, tmp_path / "layers.exr", tmp_path / "missing.exr"
    settings = scene.render.image_settings
    if hasattr(settings, "media_type"):
        settings.media_type = "MULTI_LAYER_IMAGE"
    settings.file_format = "OPEN_EXR_MULTILAYER"
    scene.render.resolution_x = scene.render.resolution_y = 16
    scene.render.engine, scene.cycles.samples, scene.render.filepath = "CYCLES", 1, str(there)
    bpy.ops.render.render(write_still=True)
    first = bpy.data.images.load(str(there))
    for path, unsure in ((there, 3), (missing, 0)):
        t = Tree()
        first.filepath = str(path)
        node = t.new("ShaderNodeTexImage", image=first)
        (record, *_), _, lines = t.parts(t.new("ShaderNodeBsdfPrincipled", {"Alpha": node.outputs[1]}))
        assert (record["unsure"], any("magenta" in line for line in lines)) == (unsure, unsure == 0)


@pytest.mark.parametrize("floats", [False, True])
def test_films_may_show_anything(tmp_path: Path, floats: bool) -> None:
    """Blender reads the picture of number 0 at most, which most sequences lack: of theirs nothing is known, and nothing
    is magenta. They emit as much as white, and may be brighter where they are of floats, which is said."""
    t = Tree()
    first = image(np.ones((4, 4, 4), np.float32), floats=floats)
    first.file_format, kind = ("OPEN_EXR", "exr") if floats else ("PNG", "png")
    first.filepath_raw = str(tmp_path / f"film0001.{kind}")
    first.save()
    node = t.new("ShaderNodeTexImage", image=bpy.data.images.load(first.filepath_raw))
    node.image.source = "SEQUENCE"
    record, _, lines = t.record(t.new("ShaderNodeEmission", {"Color": node.outputs[0], "Strength": 3.0}))
    np.testing.assert_allclose(record["emission"], 30.0 if floats else 3.0)
    assert record["unsure_emission"] == 1
    assert any(line.endswith(WORTHLESS) for line in lines) == floats
    (record,), _, _ = t.parts(t.new("ShaderNodeBsdfPrincipled", {"Alpha": node.outputs[1]}))
    assert (record["alpha"], record["unsure"]) == (0.5, 3)
    (record,), _, _ = t.parts(t.new("ShaderNodeBsdfPrincipled", {"Base Color": node.outputs[0]}))
    assert record["unsure"] & Unsure.LIGHT
    bumped = t.new("ShaderNodeNormalMap", {"Color": node.outputs[0]}).outputs[0]
    parts, _, _ = t.parts(t.new("ShaderNodeBsdfGlossy", {"Roughness": 0.0, "Normal": bumped}))
    assert sorted(float(part["roughness"]) for part in parts[-2:]) == [0.0, 0.5]


def test_emission_that_takes_light_away_gives_as_much() -> None:
    """None of it is sure, and it may take as much: a constant, and what lies between -8 and 2."""
    t = Tree()
    noise = t.new("ShaderNodeTexNoise").outputs[0]
    either = t.new("ShaderNodeMapRange", {0: noise, 3: -8.0, 4: 2.0}).outputs[0]
    for strength, most in ((-3.0, 3.0), (either, 8.0)):
        record, _, lines = t.record(t.new("ShaderNodeEmission", {"Color": (1, 0.5, 0, 1), "Strength": strength}))
        np.testing.assert_allclose(record["emission"], most * np.array([1, 0.5, 0]))
        assert record["unsure_emission"] == 2
        assert "material m: that it takes light away is not rendered: it gives as much" in lines


@pytest.mark.parametrize("kind", ["ShaderNodeBsdfPrincipled", "ShaderNodeSubsurfaceScattering"])
def test_light_goes_through_subsurface(kind: str) -> None:
    """Half of its share comes out at the other side: a flame within wax is seen."""
    t = Tree()
    weight = {"Subsurface Weight": 0.8} if kind.endswith("Principled") else {}
    (head, outside, through), _, lines = t.parts(t.new(kind, weight))
    np.testing.assert_allclose(head["alpha"], 0.4 if weight else 0.5)
    assert (outside["shader"] != Shader.TRANSLUCENT, through["shader"]) == (True, Shader.TRANSLUCENT)
    np.testing.assert_allclose(through["base_color"], outside["base_color"])
    assert (outside["unsure"], through["unsure"], len(lines)) == (0, Unsure.LIGHT, 1)


def test_where_a_portal_leads_is_not_known() -> None:
    """Nothing is culled, and that is said."""
    t = Tree()
    ob = add("cube", cube())
    ob.data.materials.append(t.material)
    t.parts(t.new("ShaderNodeBsdfRayPortal"))
    assert extract_frame(bpy.context.scene).scene.whole.startswith("material m: Ray Portal")


def test_alpha_of_an_image_elsewhere_is_not_known() -> None:
    """An image that is not placed by UVs has its holes elsewhere."""
    t = Tree()
    for place, known in ((t.new("ShaderNodeUVMap"), True), (t.new("ShaderNodeTexCoord").outputs["Object"].node, False)):
        output = place.outputs[0] if known else place.outputs["Object"]
        node = t.new("ShaderNodeTexImage", {"Vector": output}, image=image(random_pixels()))
        (record,), _, lines = t.parts(t.new("ShaderNodeBsdfPrincipled", {"Alpha": node.outputs["Alpha"]}))
        assert (record["unsure"], bool(lines), record["alpha_texture"] >= 0) == (3 * (not known), not known, known)


@pytest.mark.parametrize(
    ("kind", "inputs", "glow"),
    [
        ("VolumePrincipled", {"Emission Strength": 3.0, "Emission Color": (1, 0.5, 0, 1)}, 3.0),
        ("VolumePrincipled", {"Blackbody Intensity": 0.1}, 10.0),
        ("VolumePrincipled", {}, 0.0),
        ("Emission", {"Strength": 4.0, "Color": (0.5, 0, 0, 1)}, 2.0),
        ("VolumeScatter", {}, 0.0),
    ],
)
@pytest.mark.parametrize("surface", [False, True])
def test_what_glows_within_lights_what_is_around(kind: str, inputs: dict[str, Any], glow: float, surface: bool) -> None:
    """A volume's emission, of a metre, is seen by half of the paths, and marked as unsure: alone, and in a surface."""
    t = Tree()
    t.tree.links.new(t.new(f"ShaderNode{kind}", inputs).outputs[0], t.output.inputs["Volume"])
    records, _, _ = t.parts(t.new("ShaderNodeBsdfGlass") if surface else None)
    _, first, within = records
    if surface and not glow:
        assert (int(first["shader"]), int(within["shader"])) == (Shader.GLASS, Shader.TRANSLUCENT)
        assert first["unsure"] & within["unsure"] & Unsure.LIGHT
        return
    assert first["shader"] == (Shader.GLASS if surface else Shader.TRANSPARENT)
    np.testing.assert_allclose(within["emission"], 2 * glow)
    assert (within["unsure_emission"], first["emission"].any()) == (glow > 0, False)


@pytest.mark.parametrize("kind", ["BsdfGlass", "BsdfDiffuse", "BsdfPrincipled"])
def test_of_light_that_a_volume_may_absorb_none_is_sure(kind: str) -> None:
    """Where a surface lets light in; what is opaque hides its volume."""
    t = Tree()
    t.tree.links.new(t.new("ShaderNodeVolumeAbsorption").outputs[0], t.output.inputs["Volume"])
    (record,), _, _ = t.parts(t.new(f"ShaderNode{kind}"))
    assert record["unsure"] == (Unsure.LIGHT if kind == "BsdfGlass" else 0)


@pytest.mark.parametrize(
    ("kind", "inputs", "own", "reach"),
    [
        ("AmbientOcclusion", {"Distance": 2.0}, False, 2.0),
        ("AmbientOcclusion", {"Distance": 0.0}, False, FARTHEST),
        ("AmbientOcclusion", {"Distance": 2.0}, True, 0.0),
        ("Raycast", {"Length": 3.0}, False, 3.0),
        ("Raycast", {"Length": 3.0}, True, 0.0),
    ],
)
def test_what_looks_around_reaches_as_far_as_it_looks(
    kind: str, inputs: dict[str, Any], own: bool, reach: float
) -> None:
    if not hasattr(bpy.types, f"ShaderNode{kind}"):
        pytest.skip("no such node")
    t = Tree()
    looks = t.new(f"ShaderNode{kind}", inputs, only_local=own)
    records, _, lines = t.parts(t.new("ShaderNodeBsdfDiffuse", {"Color": looks.outputs[0]}))
    np.testing.assert_allclose(records["reach"], reach)
    assert any(line.endswith("what is within its reach stays") for line in lines) == (reach > 0)


@pytest.mark.parametrize(("kind", "through"), [("Toon", False), ("HairPrincipled", True)])
def test_of_what_is_taken_for_diffuse_half_is_sure(kind: str, through: bool) -> None:
    """Half of its light is what changes are relative to; through hair light comes."""
    t = Tree()
    (head, sure, doubtful), _, lines = t.parts(t.new(f"ShaderNodeBsdf{kind}"))
    assert (head["alpha"], sure["unsure"], doubtful["unsure"]) == (0.5, 0, Unsure.LIGHT)
    assert (sure["shader"], doubtful["shader"]) == (Shader.DIFFUSE, Shader.TRANSLUCENT if through else Shader.DIFFUSE)
    assert len(lines) == 1


@pytest.mark.parametrize(("kind", "known"), [("Attribute", False), ("TexNoise", True), ("Wireframe", True)])
def test_a_colour_that_may_be_anything_is_not_sure(kind: str, known: bool) -> None:
    """By an instance's attribute; noise, which is a half on the whole, is taken for that."""
    t = Tree()
    source = t.new(f"ShaderNode{kind}")
    if kind == "Attribute":
        source.attribute_type = "INSTANCER"
    for node in ("Principled", "Diffuse"):
        name = "Base Color" if node == "Principled" else "Color"
        (record,), _, lines = t.parts(t.new(f"ShaderNodeBsdf{node}", {name: source.outputs[0]}))
        assert (record["unsure"], len(lines)) == (0 if known else Unsure.LIGHT, 1)


@pytest.mark.parametrize("kind", ["Noise", "Checker", "Brick"])
def test_patterns_stand_for_patterns(kind: str) -> None:
    """What is dark here and bright there is so in the analysis, elsewhere, by the place on the mesh: small things
    differ from it as they do in truth. Where it is dark in truth it surely is as bright as that, and half of all is
    not sure where that is much darker; tiles are one or the other."""
    t = Tree()
    texture = t.new(f"ShaderNodeTex{kind}")
    if kind == "Noise":
        ramp = t.new("ShaderNodeValToRGB", {0: texture.outputs[0]})
        for element, x, color in zip(ramp.color_ramp.elements, (0.4, 0.6), (0.1, 0.9), strict=True):
            element.position, element.color = x, (color, color, color, 1)
        color = ramp.outputs[0]
    else:
        texture.inputs["Color1"].default_value, texture.inputs["Color2"].default_value = (0.1,) * 4, (0.9,) * 4
        color = texture.outputs["Color"]
    (head, record, doubtful), textures, lines = t.parts(t.new("ShaderNodeBsdfDiffuse", {"Color": color}))
    assert lines == [f"material m: {texture.bl_label} node replaced by a pattern"]
    shown = pixels_of(textures, record["base_color_texture"])[..., 0]
    np.testing.assert_allclose((shown.min(), shown.max(), shown.mean()), (0.1, 0.9, 0.5), atol=0.02)
    assert np.isin(shown, np.array((0.1, 0.9), np.float32)).mean() > (0.75 if kind == "Noise" else 0.999)
    tiles = shown.reshape(8, 32, 8, 32).mean(axis=(1, 3))
    assert tiles.min() < 0.25
    assert tiles.max() > 0.75
    np.testing.assert_allclose((head["alpha"], record["sure"], doubtful["sure"]), (0.5, 0.2, 0.2), rtol=0.05)
    assert (record["unsure"], doubtful["unsure"]) == (0, Unsure.LIGHT)
    add("cube", cube()).data.materials.append(t.material)
    scene = extract_frame(bpy.context.scene).scene
    uvs = scene.meshes[0].uvs
    assert uvs is not None
    assert len(np.unique(uvs[scene.textures.records["uv_map"][0]].reshape(-1, 2).round(4), axis=0)) == 8  # its corners
    table = MaterialTable(TextureTable(print), most=False)
    table.index(t.material)
    assert table.build()[0]["base_color_texture"] < 0


def test_transparent_shadows_that_are_off() -> None:
    """What may be seen through is opaque to the light of lamps."""
    t = Tree()
    clear, solid = t.new("ShaderNodeBsdfTransparent"), t.new("ShaderNodeBsdfDiffuse")
    mix = t.new("ShaderNodeMixShader", {0: 0.1, 1: clear.outputs[0], 2: solid.outputs[0]})
    assert t.parts(mix)[0][0]["shader"] == Shader.MIX
    t.material.use_transparent_shadow = False
    head, *parts = t.parts(mix)[0]
    assert head["shader"] == Shader.BY_RAY
    assert views(head["rays"]) == [{int(RayType.SHADOW)}, {int(RayType.SHADOW)}]
    assert parts[head["parts"][1] - 1]["shader"] == Shader.EMISSION
    assert not parts[head["parts"][1] - 1]["emission"].any()
    assert t.record(solid)[0]["shader"] == Shader.DIFFUSE


def test_of_sheen_none_is_sure() -> None:
    """Looked at from above it is dark."""
    t = Tree()
    (record,), _, lines = t.parts(t.new("ShaderNodeBsdfSheen", {"Color": (0.8, 0.4, 0.2, 1)}))
    np.testing.assert_allclose(record["base_color"], 0.15 * np.array((0.8, 0.4, 0.2)), rtol=1e-5)
    assert (record["shader"], record["unsure"], len(lines)) == (Shader.DIFFUSE, Unsure.LIGHT, 1)


@pytest.mark.parametrize("same", [False, True])
def test_the_colour_of_objects(same: bool) -> None:
    """That of those that show the material, or their mean, which is said; others do not count."""
    t = Tree()
    info = t.new("ShaderNodeObjectInfo").outputs
    for k, color in enumerate(((0.1, 0.2, 0.3, 1), (0.3, 0.4, 0.5, 0), (1, 1, 1, 0.5))):
        ob = add(f"{k}", cube(f"{k}"))
        ob.color = (0.1, 0.2, 0.3, 1) if same and k < 2 else color
        if k < 2:
            ob.data.materials.append(t.material)
    surface = t.new("ShaderNodeBsdfPrincipled", {"Base Color": info["Color"], "Alpha": info["Alpha"]})
    t.tree.links.new(surface.outputs[0], t.output.inputs["Surface"])
    scene = extract_frame(bpy.context.scene).scene
    record = scene.materials[scene.slot_materials[scene.instances.slots[0]]]
    np.testing.assert_allclose(record["base_color"], (0.1, 0.2, 0.3) if same else (0.2, 0.3, 0.4), rtol=1e-6)
    known = (1, 0, False) if same else (0.5, 7, True)
    assert (record["alpha"], record["unsure"], bool(scene.approximated)) == known


@pytest.mark.parametrize(("kind", "output"), [("Fresnel", 0), ("LayerWeight", "Fresnel"), ("LayerWeight", "Facing")])
@pytest.mark.parametrize("more", [False, True])
def test_shares_by_the_angle_are_followed(kind: str, output: str | int, more: bool) -> None:
    """Through what nodes make of them, too; but not with normals of their own."""
    t = Tree()
    source = t.new(f"ShaderNode{kind}", {0: 1.5 if kind == "Fresnel" else 0.3})
    share = source.outputs[output]
    if more:
        share = t.new("ShaderNodeMath", {0: share, 1: 0.5}, operation="MULTIPLY").outputs[0]
    mix = t.new("ShaderNodeMixShader", {0: share, 1: t.new("ShaderNodeBsdfDiffuse").outputs[0]})
    records, textures, lines = t.parts(mix)
    head = records[0]
    if output != "Facing":  # from behind it is another
        assert head["shader"] == Shader.BY_RAY
        head = records[head["parts"][0]]
    assert (head["shader"], head["alpha_channel"], lines) == (Shader.MIX, BY_ANGLE, [])
    x = (np.arange(ANGLES) + 0.5) / ANGLES
    g = np.sqrt((1.5 if kind == "Fresnel" else 1 / 0.7) ** 2 - 1 + x * x)
    r = (g - x) / (g + x)
    known = 1 - x**0.6 if output == "Facing" else r**2 / 2 * (1 + ((x * (g + x) - 1) / (x * (g - x) + 1)) ** 2)
    np.testing.assert_allclose(
        pixels_of(textures, head["alpha_texture"])[0, :, 0], known * (0.5 if more else 1.0), rtol=1e-4, atol=1e-6
    )
    t.tree.links.new(t.new("ShaderNodeBump").outputs[0], source.inputs["Normal"])
    (head, *_), _, lines = t.parts(mix)
    assert (head["alpha"], head["alpha_texture"], len(lines)) == (0.5, -1, 1)


def test_of_a_mix_that_is_not_known_what_both_send_on_is_sure() -> None:
    """Where one of them may show nothing but what it reflects, nothing."""
    t = Tree()
    doubt = t.new("ShaderNodeParticleInfo").outputs["Age"]
    pixels = random_pixels()
    pixels[:8, :, :3] = 0.5
    texture = t.new("ShaderNodeTexImage")
    texture.image = image(pixels, data=True)
    nodes = {
        "light": t.new("ShaderNodeBsdfDiffuse", {0: (0.8, 0.8, 0.8, 1)}),
        "dark": t.new("ShaderNodeBsdfPrincipled", {0: (0.2, 0.2, 0.2, 1)}),
        "image": t.new("ShaderNodeBsdfDiffuse", {0: texture.outputs[0]}),
        "glossy": t.new("ShaderNodeBsdfAnisotropic", {0: (0.8, 0.8, 0.8, 1)}),
        "metal": t.new("ShaderNodeBsdfPrincipled", {0: (0.8, 0.8, 0.8, 1), "Metallic": 1.0}),
    }

    def sure(first: str, second: str) -> list[float]:
        inputs = {0: doubt, 1: nodes[first].outputs[0], 2: nodes[second].outputs[0]}
        parts = t.parts(t.new("ShaderNodeMixShader", inputs))[0][1:]
        return [0.0 if part["unsure"] & Unsure.LIGHT else float(part["sure"]) for part in parts]

    np.testing.assert_allclose(sure("light", "dark"), (0.25, 1.0), rtol=1e-4)
    np.testing.assert_allclose(sure("dark", "dark"), (1.0, 1.0), rtol=1e-4)
    bright = np.quantile(pixels[..., :3] @ LUMINANCE, DARK)
    np.testing.assert_allclose(sure("light", "image")[0], bright / 0.8, rtol=1e-3)
    assert sure("light", "glossy") == sure("metal", "dark") == [0.0, 0.0]


@pytest.mark.parametrize("owner", ["object", "data", "instance", "none"])
def test_emission_by_what_objects_have_of_their_own(owner: str) -> None:
    """A property or an attribute of instances, of thousands: as much; where nothing has it, nobody knows."""
    t = Tree()
    source = t.new("ShaderNodeAttribute", attribute_type="INSTANCER", attribute_name="power")
    ob = add("cube", cube())
    if owner in {"object", "data"}:
        (ob if owner == "object" else ob.data)["power"] = 2500.0
    owners = attributes.Owners(list(bpy.data.objects), {"power": (0.0, 2500.0)} if owner == "instance" else {})
    with attributes.owned_by(owners):
        record, _, _ = t.record(t.new("ShaderNodeEmission", {"Strength": source.outputs[2]}))
    assert (record["emission"][0], record["unsure_emission"]) == (100.0 if owner == "none" else 2500.0, 1)


def test_colours_of_objects_may_be_bright() -> None:
    """An object's colour has no upper end."""
    t = Tree()
    for k, color in enumerate(((40, 20, 10, 1), (0, 0, 0, 1))):
        ob = add(f"{k}", cube(f"{k}"))
        ob.color = color
        ob.data.materials.append(t.material)
    info = t.new("ShaderNodeObjectInfo").outputs["Color"]
    record, _, _ = t.record(t.new("ShaderNodeEmission", {"Color": info}))
    assert (record["emission"].max(), record["unsure_emission"]) == (40.0, 1)


@pytest.mark.parametrize("kind", ["Principled", "Glossy", "Metallic", "Glass"])
def test_a_roughness_that_is_not_known_is_any(kind: str) -> None:
    """Half as sharp as it may be, half as rough."""
    t = Tree()
    noise = t.new("ShaderNodeTexNoise").outputs[0]
    ramp = t.new("ShaderNodeMapRange", {0: noise, 3: 0.1, 4: 0.6}).outputs[0]
    (head, sharp, rough), _, _ = t.parts(t.new(f"ShaderNodeBsdf{kind}", {"Roughness": ramp}))
    np.testing.assert_allclose((head["alpha"], sharp["roughness"], rough["roughness"]), (0.5, 0.1, 0.6))
    (record,), _, lines = t.parts(t.new(f"ShaderNodeBsdf{kind}", {"Roughness": 0.3}))
    np.testing.assert_allclose(record["roughness"], 0.3)
    assert not lines


@pytest.mark.parametrize(
    ("kind", "name", "field", "most"),
    [
        ("Principled", "Metallic", "metallic", 0.5),
        ("Principled", "Specular IOR Level", "specular_level", 1.0),
        ("Principled", "Coat Weight", "coat", 1.0),
        ("Principled", "Coat Roughness", "coat_roughness", 0.0),
        ("Principled", "Coat IOR", "coat_ior", 1.5),
        ("Principled", "IOR", "ior", 1.5),
        ("Principled", "Coat Tint", "coat_tint", 1.0),
        ("Metallic", "Base Color", "base_color", 1.0),
        ("Metallic", "Edge Tint", "specular_tint", 1.0),
    ],
)
def test_what_nobody_knows_of_a_surface_is_not_sure(kind: str, name: str, field: str, most: float) -> None:
    """Where instances have an attribute each, what reflects is as strong and sharp as it may be, and no change is
    relative to it. Where it is a constant, it is that."""
    t = Tree()
    of_instances = t.new("ShaderNodeAttribute", attribute_type="INSTANCER", attribute_name="own")
    surface = t.new(f"ShaderNodeBsdf{kind}")
    if name == "Coat IOR":
        surface.inputs["Coat Weight"].default_value = 1.0
    (record,), _, lines = t.parts(surface)
    assert (record["unsure"], lines) == (0, [])
    source = of_instances.outputs["Color" if "Color" in name or "Tint" in name else "Fac"]
    t.tree.links.new(source, surface.inputs[name])
    (record,), _, lines = t.parts(surface)
    np.testing.assert_allclose(record[field], most, rtol=1e-6)
    assert (record["unsure"], len(lines)) == (Unsure.LIGHT, 1)


@pytest.mark.parametrize("kind", ["Glass", "Refraction"])
def test_where_glass_of_any_index_leads_is_not_known(kind: str) -> None:
    """Half of what is seen through it is spread, and what is there stays."""
    t = Tree()
    of_instances = t.new("ShaderNodeAttribute", attribute_type="INSTANCER", attribute_name="own").outputs["Fac"]
    shader = f"ShaderNodeBsdf{kind}" if kind == "Glass" else "ShaderNodeBsdfRefraction"
    (_, sharp, rough), _, lines = t.parts(t.new(shader, {"IOR": of_instances, "Roughness": 0.0}))
    assert sharp["ior"] > 1 and sharp["roughness"] == 0 and rough["roughness"] > 0.3
    assert (sharp["unsure"], rough["unsure"]) == (5, 5) and lines


@pytest.mark.parametrize("kind", ["SubsurfaceScattering", "BsdfToon", "BsdfHair"])
def test_of_a_colour_that_may_be_anything_none_is_sure(kind: str) -> None:
    """Whatever stands for the surface that has it."""
    t = Tree()
    color = t.new("ShaderNodeAttribute", attribute_type="INSTANCER", attribute_name="own").outputs["Color"]
    node = f"ShaderNode{kind}"
    parts, _, _ = t.parts(t.new(node, {"Color": color}))
    shown = [p for p in parts if p["shader"] != Shader.MIX and p["base_color"].any()]
    assert shown and all(p["unsure"] & Unsure.LIGHT for p in shown)


def test_a_volume_alone_lets_light_pass() -> None:
    """Half of it straight on; beside a surface that surface counts."""
    t = Tree()
    t.tree.links.new(t.new("ShaderNodeVolumeScatter").outputs[0], t.output.inputs["Volume"])
    (head, clear, scatters), _, lines = t.parts(None)
    assert (head["alpha"], clear["shader"], scatters["shader"], clear["unsure"]) == (
        0.5,
        Shader.TRANSPARENT,
        Shader.TRANSLUCENT,
        1,
    )
    assert [line.startswith("material m: volume not rendered: ") for line in lines] == [True]
    (record,), _, lines = t.parts(t.new("ShaderNodeBsdfDiffuse"))
    assert (record["shader"], len(lines)) == (Shader.DIFFUSE, 1)


def test_image_with_mapping() -> None:
    """Byte pixels come bottom row first, exactly; sRGB flag, extension, UV map and the matrix of Mapping nodes
    follow."""
    t = Tree()
    pixels = random_pixels()
    place = t.new("ShaderNodeUVMap", uv_map="other")
    mapping = t.new(
        "ShaderNodeMapping",
        {"Vector": place.outputs[0], "Location": (0.1, 0.2, 0), "Rotation": (0, 0, np.pi / 2), "Scale": (2, 3, 1)},
    )
    node = t.new(
        "ShaderNodeTexImage",
        {"Vector": mapping.outputs[0]},
        image=image(pixels),
        extension="MIRROR",
        interpolation="Closest",
    )
    tint = t.new(
        "ShaderNodeMix", {0: 1.0, 6: node.outputs[0], 7: (0.5, 0.25, 1, 1)}, data_type="RGBA", blend_type="MULTIPLY"
    )
    record, textures, lines = t.record(t.new("ShaderNodeBsdfPrincipled", {"Base Color": tint.outputs[2]}))
    assert not lines
    np.testing.assert_allclose(record["base_color"], [0.5, 0.25, 1])
    r = textures.records[record["base_color_texture"]]
    assert (r["srgb"], r["is_float"], r["closest"], r["extension"], r["uv_map"]) == (1, 0, 1, Extension.MIRROR, 1)
    np.testing.assert_allclose(r["uv_matrix"], [[0, -3, 0.1], [2, 0, 0.2]], atol=1e-6)  # rotate (scale u)
    np.testing.assert_array_equal(pixels_of(textures, record["base_color_texture"]), np.round(pixels * 255))


def test_pixel_arithmetic_is_baked() -> None:
    """What is no product with a constant is computed pixel by pixel: here gloss to roughness, and the alpha that mixes
    in Transparent."""
    t = Tree()
    pixels = random_pixels(1)
    node = t.new("ShaderNodeTexImage", image=image(pixels, data=True))
    red = t.new("ShaderNodeSeparateColor", {0: node.outputs[0]})
    rough = t.new("ShaderNodeMath", {0: 1.0, 1: red.outputs[1]}, operation="SUBTRACT")
    bsdf = t.new("ShaderNodeBsdfPrincipled", {"Roughness": rough.outputs[0], "Metallic": red.outputs[2]})
    record, textures, lines = t.record(
        t.new(
            "ShaderNodeMixShader",
            {0: red.outputs[0], 1: bsdf.outputs[0], 2: t.new("ShaderNodeBsdfTransparent").outputs[0]},
        )
    )
    assert not lines
    assert record["metallic_channel"] == 2
    np.testing.assert_array_equal(
        pixels_of(textures, record["metallic_texture"])[..., 2], np.round(pixels[..., 2] * 255)
    )
    assert textures.records[record["metallic_texture"]]["srgb"] == 0
    np.testing.assert_allclose(pixels_of(textures, record["roughness_texture"])[..., 0], 1 - pixels[..., 1], atol=1e-6)
    np.testing.assert_allclose(pixels_of(textures, record["alpha_texture"])[..., 0], 1 - pixels[..., 0], atol=1e-6)


def test_averages_are_linear() -> None:
    """An input that takes no texture gets the mean of linear values, reported; float images are stored as they are."""
    t = Tree()
    pixels = random_pixels(2)
    coded, floats = (t.new("ShaderNodeTexImage", image=image(pixels, floats=f)) for f in (False, True))
    record, textures, lines = t.record(
        t.new("ShaderNodeBsdfPrincipled", {"Specular Tint": coded.outputs[0], "Base Color": floats.outputs[0]})
    )
    assert len(lines) == 1
    np.testing.assert_allclose(record["specular_tint"], srgb_to_linear(pixels[..., :3]).mean(axis=(0, 1)), rtol=1e-5)
    np.testing.assert_allclose(pixels_of(textures, record["base_color_texture"]), pixels, atol=1e-6)


def test_missing_image_is_magenta() -> None:
    """As in Cycles, and said."""
    t = Tree()
    gone = bpy.data.images.new("gone", 1, 1)
    gone.source, gone.filepath = "FILE", "//nowhere.png"
    record, textures, lines = t.record(
        t.new("ShaderNodeBsdfPrincipled", {"Base Color": t.new("ShaderNodeTexImage", image=gone).outputs[0]})
    )
    assert len(lines) == 1
    assert "nowhere.png" in lines[0]
    np.testing.assert_array_equal(pixels_of(textures, record["base_color_texture"])[0, 0], [1, 0, 1, 1])


def test_gltf_import(tmp_path: Path) -> None:
    """A textured material through Blender's own glTF exporter and importer: factors, ORM channels, normal map,
    emission, alpha, texture transform."""
    t = Tree()
    color, orm, normal, emission = random_pixels(3), random_pixels(4), random_pixels(5), random_pixels(6)
    color[..., 3] = np.random.default_rng(7).integers(1, 256, (16, 8)) / 255
    place = t.new(
        "ShaderNodeMapping", {"Vector": t.new("ShaderNodeUVMap", uv_map="UVMap").outputs[0], "Scale": (2, 2, 1)}
    )
    tex = {
        name: t.new("ShaderNodeTexImage", {"Vector": place.outputs[0]}, image=image(p, name, data))
        for name, p, data in (
            ("color", color, False),
            ("orm", orm, True),
            ("normal", normal, True),
            ("emission", emission, False),
        )
    }
    tint = t.new(
        "ShaderNodeMix",
        {0: 1.0, 6: tex["color"].outputs[0], 7: (0.5, 0.25, 1, 1)},
        data_type="RGBA",
        blend_type="MULTIPLY",
    )
    split = t.new("ShaderNodeSeparateColor", {0: tex["orm"].outputs[0]})
    rough = t.new("ShaderNodeMath", {0: split.outputs[1], 1: 0.5}, operation="MULTIPLY")
    inputs = {
        "Base Color": tint.outputs[2],
        "Alpha": tex["color"].outputs[1],
        "Roughness": rough.outputs[0],
        "Metallic": split.outputs[2],
        "Normal": t.new("ShaderNodeNormalMap", {"Color": tex["normal"].outputs[0], "Strength": 0.7}).outputs[0],
        "Emission Color": tex["emission"].outputs[0],
        "Emission Strength": 3.0,
    }
    t.tree.links.new(t.new("ShaderNodeBsdfPrincipled", inputs).outputs[0], t.output.inputs[0])
    mesh = cube()
    mesh.uv_layers.new(name="UVMap")
    mesh.materials.append(t.material)
    add("cube", mesh)
    path = tmp_path / "scene.glb"
    bpy.ops.export_scene.gltf(filepath=str(path))
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.import_scene.gltf(filepath=str(path))
    extraction = extract_frame(bpy.context.scene, allow_no_camera=True)
    scene = extraction.scene
    assert scene.approximated == ()
    record = scene.materials[scene.slot_materials[scene.instances.slots[0]]]
    np.testing.assert_allclose(record["base_color"], [0.5, 0.25, 1], rtol=1e-5)
    np.testing.assert_allclose([record["roughness"], record["metallic"], record["alpha"]], [0.5, 1, 1], rtol=1e-5)
    assert [record[f"{n}_channel"] for n in ("roughness", "metallic", "alpha")] == [1, 2, 3]
    np.testing.assert_allclose(record["emission"], [3, 3, 3], rtol=1e-5)
    assert record["normal_strength"] == pytest.approx(0.7)
    for name, pixels in (
        ("base_color", color),
        ("alpha", color),
        ("roughness", orm),
        ("metallic", orm),
        ("normal", normal),
        ("emission", emission),
    ):
        index = record[f"{name}_texture"]
        assert index >= 0, name
        np.testing.assert_array_equal(pixels_of(scene.textures, index), np.round(pixels * 255), err_msg=name)
        assert scene.textures.records[index]["srgb"] == (name in {"base_color", "alpha", "emission"})
        np.testing.assert_allclose(scene.textures.records[index]["uv_matrix"][:, :2], [[2, 0], [0, 2]], atol=1e-6)
    assert scene.meshes[0].uvs is not None


def test_an_output_for_cycles_counts_though_another_is_active() -> None:
    material = bpy.data.materials.new("two outputs")
    tree = material.node_tree
    tree.nodes.clear()
    for target, color in (("EEVEE", (1, 0, 0, 1)), ("CYCLES", (0, 1, 0, 1))):
        output, node = tree.nodes.new("ShaderNodeOutputMaterial"), tree.nodes.new("ShaderNodeBsdfDiffuse")
        output.target, output.is_active_output = target, target == "EEVEE"
        node.inputs["Color"].default_value = color
        tree.links.new(node.outputs[0], output.inputs[0])
    tree.nodes["Material Output"].is_active_output = True
    table = MaterialTable(TextureTable(print))
    table.index(material)
    assert table.records[0]["base_color"].tolist() == [0, 1, 0]


@pytest.mark.parametrize(("side", "lean"), [(2048, 0.35), (2048, 0.0), (512, 0.35)])
def test_normals_that_a_reduced_map_has_lost_spread_what_is_reflected(side: int, lean: float) -> None:
    """Normals that lean by chance from pixel to pixel: twice as many as are looked at become smooth, and the roughness
    that stands for them is that of their slopes (alpha the root of twice the variance, 0.35 ** 2 / 3). A map that is
    looked at as it is, or is smooth, changes nothing."""
    slopes = np.random.default_rng(0).uniform(-lean, lean, (side, side, 2))
    pixels = np.ones((side, side, 4), np.float32)
    pixels[..., :2] = 0.5 * slopes + 0.5
    pixels[..., 2] = 0.5 * np.sqrt(1 - (slopes**2).sum(axis=2)) + 0.5
    t = Tree()
    texture = t.new("ShaderNodeTexImage", image=image(pixels, data=True, floats=True))
    normal = t.new("ShaderNodeNormalMap", {"Color": texture.outputs[0]})
    records, _, lines = t.parts(t.new("ShaderNodeBsdfAnisotropic", {"Roughness": 0.05, "Normal": normal.outputs[0]}))
    if side <= 1024 or not lean:
        assert len(records) == 1 and not lines
        return
    assert lines == ["material m: normal map looked at with fewer pixels: half of what is reflected is spread"]
    mean_of_four = 3 / 4  # of the variance is within the boxes of 2 x 2 pixels that are averaged
    expected = (2 * mean_of_four * 0.35**2 / 3) ** 0.25
    assert sorted(records["roughness"].tolist())[-1] == pytest.approx(expected, rel=0.1)
    assert (records["normal_texture"] >= 0).sum() == 2


@pytest.mark.parametrize("kind", ["occlusion", "own", "fog", "drink"])
def test_what_sees_more_than_light_paths_warns(kind: str) -> None:
    """What only lights fog can go: that is a warning, not a remark. Not so of what is within a surface, nor of what an
    Ambient Occlusion node looks at, which stays."""
    t = Tree()
    if kind in {"fog", "drink"}:
        t.tree.links.new(t.new("ShaderNodeVolumeScatter").outputs[0], t.output.inputs["Volume"])
        if kind == "drink":
            t.tree.links.new(t.new("ShaderNodeBsdfGlass").outputs[0], t.output.inputs["Surface"])
    else:
        occlusion = t.new("ShaderNodeAmbientOcclusion", only_local=kind == "own")
        t.tree.links.new(t.new("ShaderNodeEmission", {0: occlusion.outputs[0]}).outputs[0], t.output.inputs["Surface"])
    add("cube", cube()).data.materials.append(t.material)
    add("lamp", bpy.data.lights.new("lamp", "POINT"))
    warnings = extract_frame(bpy.context.scene).warnings
    assert len(warnings) == (kind == "fog")
    assert all(line.endswith("is taken to be worth nothing") for line in warnings)


def test_a_tiled_image_may_show_anything() -> None:
    """Only its first picture can be read: what light comes by the others is not known."""
    material = bpy.data.materials.new("tiled")
    tree = material.node_tree
    node = tree.nodes.new("ShaderNodeTexImage")
    node.image = bpy.data.images.new("tiles", 4, 4, tiled=True)
    assert node.image.source == "TILED"
    tree.links.new(node.outputs["Color"], tree.nodes["Principled BSDF"].inputs["Base Color"])
    table = MaterialTable(TextureTable(lambda _: None))
    table.index(material)
    assert table.build()["unsure"][0] & Unsure.LIGHT
