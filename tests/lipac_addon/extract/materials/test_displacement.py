"""How far materials displace, and the shells that stand for what they displace."""

from __future__ import annotations

from functools import partial
from typing import Any

import bpy
import numpy as np
import pytest

from lipac.core.scene.mesh import Mesh
from lipac.core.scene.model import Shader
from lipac.lipac_addon.extract import Extractor, extract_frame
from lipac.lipac_addon.extract.materials.displacement import Relief, relief_of, shells
from lipac.lipac_addon.extract.scene import DISPLACED

from ..conftest import add, cube
from .test_converter import Tree, image


def displaced(source: Any = None, **inputs: float) -> Tree:
    """A diffuse material that displaces; source: makes the socket of the height."""
    t = Tree()
    t.material.displacement_method = "DISPLACEMENT"
    node = t.new("ShaderNodeDisplacement", {name.title(): value for name, value in inputs.items()})
    if source is not None:
        t.tree.links.new(source(t), node.inputs[0])
    t.tree.links.new(node.outputs[0], t.output.inputs["Displacement"])
    t.tree.links.new(t.new("ShaderNodeBsdfDiffuse").outputs[0], t.output.inputs["Surface"])
    return t


def noise(t: Tree) -> Any:
    return t.new("ShaderNodeTexNoise").outputs[0]


def fitted(t: Tree) -> Any:
    return t.new("ShaderNodeMapRange", {0: unbounded(t), 3: -4.0, 4: 0.5}).outputs[0]


def arithmetic(t: Tree) -> Any:
    twice = t.new("ShaderNodeMath", {0: noise(t), 1: -2.0}, operation="MULTIPLY")
    return t.new("ShaderNodeMath", {0: twice.outputs[0], 1: 0.25}, operation="ADD").outputs[0]


def ramp(t: Tree) -> Any:
    return t.new("ShaderNodeValToRGB", {0: noise(t)}).outputs[0]


def unbounded(t: Tree) -> Any:
    return t.new(
        "ShaderNodeVectorMath", {0: t.new("ShaderNodeTexCoord").outputs["Object"]}, operation="LENGTH"
    ).outputs["Value"]


def voronoi(t: Tree, output: str = "Distance", **of: Any) -> Any:
    inputs = {name: of.pop(name) for name in ("Detail",) if name in of}
    return t.new("ShaderNodeTexVoronoi", inputs, **of).outputs[output]


def floats(t: Tree) -> Any:
    pixels = np.ones((4, 4, 4), np.float32)
    pixels[..., :3] = np.linspace(-3, 5, 16).reshape(4, 4, 1)
    return t.new("ShaderNodeTexImage", image=image(pixels, floats=True, data=True)).outputs[0]


def of(kind: str, inputs: dict[int | str, Any], output: int | str = 0) -> Any:
    """A node's output, by the names of its inputs; "noise" stands for one."""

    def source(t: Tree) -> Any:
        values = {k: noise(t) if isinstance(v, str) and v == "noise" else v for k, v in inputs.items()}
        return t.new(kind, values).outputs[output]

    return source


@pytest.mark.parametrize(
    ("source", "inputs", "expected"),
    [
        (of("ShaderNodeTexChecker", {"Color1": (6, 3, 1, 1), "Color2": (0, 0, 0, 1)}), {}, (0.0, 6.0)),
        (of("ShaderNodeTexChecker", {"Color1": (6, 3, 1, 1)}, 1), {}, (0.0, 1.0)),
        (of("ShaderNodeTexBrick", {"Color1": (2, 3, 1, 1), "Mortar": (7, 0, 0, 1)}), {}, (0, 7)),
        (of("ShaderNodeInvert", {1: (5, 5, 0, 1), 0: "noise"}), {}, (-4.0, 5.0)),
        (of("ShaderNodeHueSaturation", {"Color": "noise", "Value": 20.0}), {}, (0.0, 20.0)),
        (of("ShaderNodeBrightContrast", {0: "noise", 1: 3.0, 2: 2.0}), {}, (2.0, 5.0)),
        (of("ShaderNodeGamma", {0: "noise", 1: 2.0}), {}, (0.0, 1.0)),
        (of("ShaderNodeLightFalloff", {"Strength": 3.0}, "Quadratic"), {}, (0.0, 3.0)),
        (of("ShaderNodeLightFalloff", {"Strength": 3.0}, "Constant"), {}, (0.0, 30000.0)),
        (None, {"height": 0.7, "midlevel": 0.5, "scale": 2.0}, (0.4, 0.4)),
        (noise, {"midlevel": 0.5, "scale": 0.2}, (-0.1, 0.1)),
        (noise, {"midlevel": 0.0, "scale": -3.0}, (-3.0, 0.0)),
        (fitted, {"midlevel": 0.0, "scale": 1.0}, (-4.0, 0.5)),
        (arithmetic, {"midlevel": 0.0, "scale": 1.0}, (-1.75, 0.25)),
        (ramp, {"midlevel": 0.0, "scale": 1.0}, (0.0, 1.0)),
        (floats, {"midlevel": 1.0, "scale": 1.0}, (-4.0, 4.0)),
        (unbounded, {"midlevel": 0.0, "scale": 1.0}, (-np.inf, np.inf)),
        (voronoi, {"midlevel": 0.0, "scale": 1.0}, (0.0, np.sqrt(3))),
        (partial(voronoi, feature="F2", distance="MANHATTAN"), {"midlevel": 0.0, "scale": 1.0}, (0.0, 6.0)),
        (partial(voronoi, voronoi_dimensions="2D", Detail=2.0), {"midlevel": 0.0, "scale": 1.0}, (0.0, 3 * np.sqrt(2))),
        (partial(voronoi, feature="SMOOTH_F1"), {"midlevel": 0.0, "scale": 1.0}, (-np.inf, np.inf)),
        (partial(voronoi, output="Position", normalize=True), {"midlevel": 0.0, "scale": 1.0}, (-np.inf, np.inf)),
    ],
)
def test_ranges(source: Any, inputs: dict[str, float], expected: tuple[float, float]) -> None:
    """What heights lie within, by their nodes; infinite where nobody can say."""
    t = displaced(source, **(inputs or {"midlevel": 0.0, "scale": 1.0}))
    inlined = t.material.inline_shader_nodes()
    relief = relief_of(inlined.node_tree)
    assert relief is not None
    np.testing.assert_allclose((relief.low, relief.high), expected, atol=1e-6)


def test_no_relief() -> None:
    """Where nothing is moved."""
    inlined = displaced(None, height=0.5, midlevel=0.5).material.inline_shader_nodes()
    assert relief_of(inlined.node_tree) is None


def test_shells_are_of_what_is_displaced() -> None:
    """A triangle of two: twice, moved along its normals, and walls of its three edges between; the other stays."""
    positions = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], np.float32)
    uvs = np.arange(24, dtype=np.float32).reshape(2, 2, 3, 2)
    mesh = Mesh(positions, np.array([[0, 1, 2], [1, 3, 2]], np.uint32), uvs=uvs, slots=np.array([0, 1], np.uint16))
    out = shells(mesh, np.tile(np.array([0, 0, 1], np.float32), (4, 1)), Relief(-0.5, 2.0, slots=(False, True)))
    assert out.uvs is not None
    assert out.slots is not None
    assert len(out.triangles) == 3 + 6
    np.testing.assert_allclose(out.positions[out.triangles[:3]][..., 2], np.repeat([[0.0], [-0.5], [2.0]], 3, axis=1))
    np.testing.assert_array_equal(
        out.positions[out.triangles[:3]][:, :, :2], positions[mesh.triangles[[0, 1, 1]]][:, :, :2]
    )
    np.testing.assert_array_equal(out.uvs, uvs[:, [0] + 8 * [1]])
    assert out.slots.tolist() == [0] + 8 * [1]


def test_what_is_displaced_is_closed() -> None:
    """Shells and walls of a sheet of 2 x 3 squares: each edge belongs to two triangles, so that no path gets in by
    none."""
    rows, columns = 3, 4
    y, x = np.divmod(np.arange(rows * columns), columns)
    positions = np.stack((x, y, np.zeros(len(x))), axis=1).astype(np.float32)
    low = np.flatnonzero((x < columns - 1) & (y < rows - 1))
    squares = [
        np.stack((low, low + 1, low + columns + 1), axis=1),
        np.stack((low, low + columns + 1, low + columns), axis=1),
    ]
    mesh = Mesh(positions, np.concatenate(squares).astype(np.uint32))
    out = shells(mesh, np.tile(np.array([0, 0, 1], np.float32), (len(x), 1)), Relief(-0.5, 2.0, slots=(True,)))
    edges = np.sort(out.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    _, times = np.unique(edges, axis=0, return_counts=True)
    assert len(out.triangles) == 2 * 12 + 2 * 10
    assert (times == 2).all()


@pytest.fixture
def rock() -> Any:
    """A cube with half a metre of noise."""
    mesh = cube("rock")
    t = displaced(noise, midlevel=0.5, scale=1.0)
    mesh.materials.append(t.material)
    add("rock", mesh)
    return t


def test_boxes_and_meshes_of_displaced_objects(rock: Tree) -> None:
    """The box holds all that the surface may be; half of all rays pass each shell, and what they see is kept; said in
    the report. Bump moves nothing."""
    scene = extract_frame(bpy.context.scene).scene
    np.testing.assert_allclose(scene.instances.bounds[0] + scene.origin, [[-1.5] * 3, [1.5] * 3], atol=1e-5)
    np.testing.assert_allclose(scene.mesh_bounds[0], [[-1.5] * 3, [1.5] * 3], atol=1e-5)
    mesh = scene.meshes[0]
    assert len(mesh.triangles) == 24
    reach = np.abs(mesh.positions[mesh.triangles]).reshape(24, -1)  # corners move along (1, 1, 1) / sqrt 3
    np.testing.assert_allclose(
        np.sort(np.unique(reach.round(4))), [1 - 0.5 / np.sqrt(3), 1 + 0.5 / np.sqrt(3)], atol=1e-4
    )
    head, *parts = scene.materials
    assert (head["shader"], head["alpha"], [int(p["shader"]) for p in parts], [int(p["unsure"]) for p in parts]) == (
        Shader.MIX,
        0.5,
        [1, 5],
        [3, 3],  # by more than a quarter of its diagonal
    )
    line = "material m: displacement taken for two surfaces, at its lowest and its highest: half of the rays pass each"
    assert scene.stays is not None and scene.stays.all()
    assert scene.approximated == (DISPLACED, line)
    for method, whole, line in (
        ("BUMP", True, "material m: bump not rendered: half of what is reflected is spread"),
        ("BOTH", False, "material m: displacement not rendered"),
    ):
        rock.material.displacement_method = method
        scene = Extractor(bpy.context.scene, whole=whole).frame(keep=False).scene
        assert len(scene.meshes[0].triangles) == 12
        assert (len(scene.materials), scene.approximated) == (1, (line,))


def test_unknown_heights_reach_as_far_as_the_object() -> None:
    mesh = cube("rock")
    mesh.materials.append(displaced(unbounded).material)
    add("rock", mesh)
    scene = extract_frame(bpy.context.scene).scene
    np.testing.assert_allclose(scene.mesh_bounds[0], np.array([[-1] * 3, [1] * 3]) * (1 + np.sqrt(12)), rtol=1e-5)


@pytest.mark.parametrize(("scale", "clear"), [(0.5, False), (1.5, True)])
def test_displaced_by_much_of_its_size_it_may_not_be_there(scale: float, clear: bool) -> None:
    """By more than a quarter of the diagonal of its box: then what lies within as many metres may shade it. A cube that
    is displaced by less, and one of another material, are there."""
    for name, times in (("rock", 1.0), ("plain", 0.0)):
        mesh = cube(name)
        mesh.materials.append(displaced(noise, midlevel=0.5, scale=scale * times * np.sqrt(12) / 4).material)
        add(name, mesh, location=(4 * times, 0, 0), scale=(1, 3, 2))
    scene = extract_frame(bpy.context.scene).scene
    by_name = dict(zip(scene.slot_materials.tolist(), scene.materials, strict=False))
    displacing = [m for m in by_name.values() if m["shader"] == Shader.MIX]
    rows = [row for m in displacing for row in m["parts"].tolist()]
    assert len(displacing) == 1
    assert [int(scene.materials[row]["unsure"]) for row in rows] == 2 * [3 if clear else 1]
    assert sum(int(m["unsure"]) > 0 for m in scene.materials) == (3 if clear else 2)
    reach = sorted(scene.materials["reach"].tolist())[-3:]
    np.testing.assert_allclose(reach, 3 * scale * np.sqrt(12) / 4 if clear else 0.0, rtol=1e-5)
    assert (None if scene.stays is None else scene.stays.tolist()) == ([True, False] if clear else None)


def test_displacement_in_world_space_is_scaled_back(rock: Tree) -> None:
    """Of an object of a tenth, half a metre in the world is five of its own."""
    node = next(n for n in rock.tree.nodes if n.type == "DISPLACEMENT")
    node.space = "WORLD"
    bpy.data.objects["rock"].scale = (0.1, 0.1, 0.1)
    scene = extract_frame(bpy.context.scene).scene
    np.testing.assert_allclose(scene.instances.bounds[0] + scene.origin, [[-0.6] * 3, [0.6] * 3], atol=1e-5)


def test_a_change_of_the_displacement_is_a_change(rock: Tree) -> None:
    """The next frame has the new box and shells, and says so, though nothing else changed."""
    with Extractor(bpy.context.scene) as extractor:
        first = extractor.frame().scene
        assert len(first.meshes[0].triangles) == 24
        next(n for n in rock.tree.nodes if n.type == "DISPLACEMENT").inputs["Scale"].default_value = 4.0
        extraction = extractor.frame()
        scene, change = extraction.scene, extraction.change
        assert change is not None
        assert change.moved is not None
        assert (change.moved.tolist(), [*change.deformed, *change.replaced]) == ([True], [0])
        np.testing.assert_allclose(scene.mesh_bounds[0], [[-3] * 3, [3] * 3], atol=1e-5)
        assert np.abs(scene.meshes[0].positions).max() == pytest.approx(1 + 2 / np.sqrt(3), rel=1e-4)
        assert extractor.frame().change.still  # type: ignore[union-attr]
