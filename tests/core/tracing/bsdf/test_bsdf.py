"""The surface model against itself (statistics, energy, symmetry) and against Cycles' own pictures."""

from __future__ import annotations

import warnings
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numba import njit
from numpy.typing import NDArray

from lipac.core.scene.model import Shader, Shading
from lipac.core.tracing.bsdf import ggx_albedo, lobes
from lipac.core.tracing.bsdf.evaluate import bsdf_eval
from lipac.core.tracing.bsdf.sample import bsdf_sample
from lipac.core.tracing.bsdf.setup import bsdf_blur, bsdf_setup, bsdf_transparency
from lipac.tests.stats import assert_mean, chi_square, level, standard_error, z_limit

F64 = NDArray[np.float64]
Case = tuple[Shader, dict[str, Any]]
UP = (0.0, 0.0, 1.0)

SLOTS = {
    "base": (lobes.P_BASE, "Base Color"),
    "metallic": (lobes.P_METALLIC, "Metallic"),
    "roughness": (lobes.P_ROUGHNESS, "Roughness"),
    "diffuse_roughness": (lobes.P_DIFFUSE_ROUGHNESS, "Diffuse Roughness"),
    "ior": (lobes.P_IOR, "IOR"),
    "specular_level": (lobes.P_SPECULAR_LEVEL, "Specular IOR Level"),
    "specular_tint": (lobes.P_SPECULAR_TINT, "Specular Tint"),
    "transmission": (lobes.P_TRANSMISSION, "Transmission Weight"),
    "alpha": (lobes.P_ALPHA, "Alpha"),
    "coat": (lobes.P_COAT, "Coat Weight"),
    "coat_roughness": (lobes.P_COAT_ROUGHNESS, "Coat Roughness"),
    "coat_ior": (lobes.P_COAT_IOR, "Coat IOR"),
    "coat_tint": (lobes.P_COAT_TINT, "Coat Tint"),
}
DEFAULTS: dict[str, Any] = {
    "base": (0.8, 0.8, 0.8),
    "metallic": 0.0,
    "roughness": 0.5,
    "diffuse_roughness": 0.0,
    "ior": 1.5,
    "specular_level": 0.5,
    "specular_tint": (1.0, 1.0, 1.0),
    "transmission": 0.0,
    "alpha": 1.0,
    "coat": 0.0,
    "coat_roughness": 0.03,
    "coat_ior": 1.5,
    "coat_tint": (1.0, 1.0, 1.0),
}
WHITE, ORANGE = (1.0, 1.0, 1.0), (0.8, 0.5, 0.2)


def principled(**inputs: Any) -> Case:
    return Shader.PRINCIPLED, {"base": ORANGE, **inputs}


CASES: list[Case] = [
    (Shader.PRINCIPLED, {}),
    principled(roughness=0.2),
    principled(roughness=1.0),
    principled(roughness=0.0),
    principled(roughness=0.3, ior=2.2, specular_level=0.9, specular_tint=(1.0, 0.6, 0.3)),
    principled(roughness=0.4, ior=1.0),
    principled(roughness=0.4, specular_level=0.0),
    principled(roughness=0.4, ior=0.7, specular_level=0.3),
    principled(metallic=1.0, roughness=0.3),
    principled(metallic=1.0, roughness=0.8, specular_tint=(0.3, 0.6, 0.9)),
    principled(metallic=0.4),
    principled(base=WHITE, metallic=1.0, roughness=1.0),
    principled(transmission=1.0, roughness=0.3),
    principled(transmission=1.0, roughness=0.7, ior=1.33),
    principled(transmission=0.6, ior=1.8, specular_tint=(0.5, 0.7, 1.0)),
    principled(base=WHITE, transmission=1.0, roughness=0.0, ior=1.45),
    principled(coat=1.0, coat_roughness=0.2, roughness=0.6),
    principled(coat=0.7, coat_roughness=0.5, roughness=0.6, coat_ior=1.8, coat_tint=(0.9, 0.6, 0.4), alpha=0.6),
    principled(alpha=0.3, diffuse_roughness=0.7),
    principled(base=(0.0, 0.0, 0.0)),
    principled(diffuse_roughness=1.0, roughness=0.15, metallic=0.2, transmission=0.3, coat=0.5, alpha=0.8),
    (Shader.DIFFUSE, {"base": ORANGE}),
    (Shader.DIFFUSE, {"base": ORANGE, "diffuse_roughness": 0.8}),
    (Shader.GLOSSY, {"base": ORANGE, "roughness": 0.25}),
    (Shader.GLOSSY, {"base": ORANGE, "roughness": 0.9}),
    (Shader.GLASS, {"base": ORANGE, "roughness": 0.2}),
    (Shader.GLASS, {"base": WHITE, "roughness": 0.6, "ior": 1.33}),
    (Shader.GLASS, {"base": WHITE, "roughness": 0.0}),
    (Shader.REFRACTION, {"base": ORANGE, "roughness": 0.3, "ior": 1.45}),
    (Shader.TRANSLUCENT, {"base": ORANGE}),
    (Shader.TRANSPARENT, {"base": ORANGE}),
]


def direction(degrees: float, azimuth: float = 90.0) -> F64:
    """Unit direction at an angle from +Z."""
    t, p = np.radians(degrees), np.radians(azimuth)
    return np.array([np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)])


def unit(v: Any) -> F64:
    return np.asarray(v, float) / np.linalg.norm(v)


def params(inputs: dict[str, Any]) -> NDArray[np.float32]:
    out = np.zeros(lobes.PARAMS, np.float32)
    for name, value in {**DEFAULTS, **inputs}.items():
        values = np.atleast_1d(value)
        out[SLOTS[name][0] : SLOTS[name][0] + len(values)] = values
    return out


MODELS = sorted(lobes.SHADING_FLAGS.values())


def setup(case: Case, wi: Any, flags: int = 0, n: Any = UP, ns: Any = UP) -> F64:
    """Closure of a case seen along wi, on a surface that faces +Z."""
    closure = np.full(lobes.CLOSURE, np.nan)
    frame = np.concatenate([wi, unit(n), unit(ns), UP]).astype(np.float32)
    bsdf_setup(closure, params(case[1]), int(case[0]), frame, flags)
    return closure


@njit(error_model="numpy")  # not cached: the cache of a caller does not notice that `bsdf` changed
def _draw(closure: Any, u: Any, out: Any) -> None:
    for i in range(len(u)):
        out[i, :8] = 0.0
        out[i, 8] = bsdf_sample(closure, u[i, 0], u[i, 1], u[i, 2], out[i])


@njit(error_model="numpy")  # not cached: the cache of a caller does not notice that `bsdf` changed
def _evaluate(closure: Any, w: Any, out: Any) -> None:
    for i in range(len(w)):
        bsdf_eval(closure, w[i, 0], w[i, 1], w[i, 2], out[i])


def draw(closure: F64, count: int, seed: int = 1) -> F64:
    """(count, 9): out of bsdf_sample, then the label."""
    out = np.zeros((count, lobes.OUT + 1))
    _draw(closure, np.random.default_rng(seed).random((count, 3)), out)
    out[out[:, 8] == 0, :8] = 0.0
    return out


def evaluate(closure: F64, w: F64) -> F64:
    """(len(w), 4): value and pdf."""
    out = np.zeros((len(w), lobes.OUT))
    _evaluate(closure, np.ascontiguousarray(w, dtype=np.float64), out)
    return out[:, [0, 1, 2, lobes.O_PDF]]


def albedo(closure: F64, count: int) -> tuple[F64, F64]:
    """Mean sample weight and its standard error."""
    weight = draw(closure, count)[:, lobes.O_WEIGHT : lobes.O_WEIGHT + 3]
    return weight.mean(0), weight.std(0) / np.sqrt(count)


SMOOTH = [
    c
    for c in CASES
    if not (c[0] == Shader.TRANSPARENT or params(c[1])[lobes.P_ROUGHNESS] == 0.0 or params(c[1])[lobes.P_ALPHA] < 1.0)
]


@pytest.mark.parametrize("degrees", [20.0, 75.0])
@pytest.mark.parametrize("flags", [0, lobes.BACKFACING])
def test_samples_follow_the_pdf(degrees: float, flags: int) -> None:
    """Chi-square over cells of the sphere. How directions are distributed does not depend on the model but for the
    lobes' shares: one of them is enough."""
    wi = direction(degrees)
    bins, fine, count = (16, 12), 32, 40000  # cos x azimuth, fine**2 midpoints a cell
    z = (np.arange(bins[0] * fine) + 0.5) / (bins[0] * fine) * 2.0 - 1.0
    phi = (np.arange(bins[1] * fine) + 0.5) / (bins[1] * fine) * 2.0 * np.pi
    zz, pp = np.meshgrid(z, phi, indexing="ij")
    ss = np.sqrt(1.0 - zz**2)
    w = np.stack([ss * np.cos(pp), ss * np.sin(pp), zz], -1).reshape(-1, 3)
    for case in SMOOTH:
        closure = setup(case, wi, flags)
        pdf = evaluate(closure, w)[:, 3]
        # Cycles' density of refraction does not vanish where no microfacet refracts wi to w; sampling never goes there.
        eta = params(case[1])[lobes.P_IOR] ** (-1.0 if flags & lobes.BACKFACING else 1.0)
        half = np.sign(1.0 - eta) * (eta * w + wi)
        refracts = case[0] in (Shader.GLASS, Shader.REFRACTION) or params(case[1])[lobes.P_TRANSMISSION] > 0.0
        impossible = (
            (w[:, 2] < 0.0) & ((half @ wi <= 0.0) | (half[:, 2] <= 0.0) | ((half * w).sum(1) >= 0.0)) & refracts
        )
        pdf[impossible] = 0.0
        cells = pdf.reshape(bins[0], fine, bins[1], fine).mean((1, 3)).ravel() * (4.0 * np.pi / (bins[0] * bins[1]))
        out = draw(closure, count)
        hit = out[:, 8] != 0
        i = np.clip(((out[hit, 2] + 1.0) / 2.0 * bins[0]).astype(int), 0, bins[0] - 1)
        j = ((np.arctan2(out[hit, 1], out[hit, 0]) / (2.0 * np.pi)) % 1.0 * bins[1]).astype(int) % bins[1]
        observed = np.bincount(i * bins[1] + j, minlength=bins[0] * bins[1])
        expected = cells * count
        share = hit.mean()
        # The pdf integrates to the sampled share; the midpoint rule is not exact: 5e-3 of the whole, and 1 % of a cell
        # where lobes are sharp.
        assert_mean(share, cells.sum(), np.sqrt(share * (1.0 - share) / count), 4 * len(SMOOTH), 5e-3, case)
        assert chi_square(observed, expected, bias=0.01, least=10.0) > level(4 * len(SMOOTH)), case


@pytest.mark.parametrize("case", CASES, ids=str)
def test_weight_is_value_over_pdf(case: Case) -> None:
    """Float64 against itself: the value seen from the sampled direction is the value that was sampled."""
    for flags in (0, lobes.BACKFACING, lobes.BLENDER_5_3, lobes.BLENDER_5_3 | lobes.BACKFACING):
        closure = setup(case, direction(50.0), flags)
        out = draw(closure, 300)
        out = out[(out[:, 8] != 0) & (out[:, 8].astype(int) & (lobes.SINGULAR | lobes.TRANSPARENT) == 0)]
        value = evaluate(closure, out[:, :3])
        np.testing.assert_allclose(value[:, 3], out[:, lobes.O_PDF], rtol=1e-6)
        np.testing.assert_allclose(value[:, :3] / value[:, 3:], out[:, 3:6], rtol=1e-6, atol=1e-12)
        assert np.allclose(np.linalg.norm(out[:, :3], axis=1), 1.0, atol=1e-6)


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("roughness", [0.0, 0.1, 8 / 31, 16 / 31, 1.0])
@pytest.mark.parametrize("shader", [Shader.GLOSSY, Shader.GLASS])
def test_white_furnace(shader: Shader, roughness: float, model: int) -> None:
    """White metal and clear glass (from outside) return all light. Off the tables' nodes interpolation may cost a
    percent."""
    roughness = round(roughness * 15) / 15 if shader == Shader.GLASS and not model else roughness
    for node in (4 / 15, 8 / 15, 1.0):
        mu = node**2 if model else node
        mean, error = albedo(
            setup((shader, {"base": WHITE, "roughness": roughness}), direction(np.degrees(np.arccos(mu))), model), 40000
        )
        assert_mean(mean, 1.0, error, 3 * 3 * 20, 0.015)


# Cycles itself makes energy below an IOR of 1
@pytest.mark.parametrize("case", [case for case in CASES if case[1].get("ior", 1.5) >= 1.0], ids=str)
def test_no_energy_is_made(case: Case) -> None:
    """Albedo of anything is at most 1, but for noise and two percent of table interpolation at grazing angles."""
    for degrees, model in product((0.0, 60.0, 88.0), MODELS):
        mean, error = albedo(setup(case, direction(degrees), model), 10000)
        assert (mean < 1.02 + z_limit(6 * 3 * len(CASES)) * error).all()


def test_reciprocity() -> None:
    """Oren-Nayar is reciprocal; glossy is once the energy preservation, a factor of the incoming angle alone, is
    divided out (on nodes of its table)."""
    energy = ggx_albedo.load()["reflection"][0]
    diffuse: Case = (Shader.DIFFUSE, {"base": ORANGE, "diffuse_roughness": 0.9})
    glossy: Case = (Shader.GLOSSY, {"base": WHITE, "roughness": 12 / 31})
    for a, b in ((5, 25), (20, 30), (12, 17)):
        wi, wo = direction(np.degrees(np.arccos(a / 31))), direction(np.degrees(np.arccos(b / 31)), 200.0)
        for case, scale in ((diffuse, (1.0, 1.0)), (glossy, energy[[a, b], 12])):
            there = evaluate(setup(case, wi), wo[None])[0, :3] / wo[2] * scale[0]
            back = evaluate(setup(case, wo), wi[None])[0, :3] / wi[2] * scale[1]
            np.testing.assert_allclose(there, back, rtol=1e-5)  # float32 directions


def test_nothing_breaks_at_the_edges() -> None:
    """No NaN, infinity or negative value for inputs at and beyond their limits, grazing and bent normals."""
    rng = np.random.default_rng(3)
    ends = {name: [0.0, 1e-6, 0.5, 1.0] for name in SLOTS}
    ends |= {
        "ior": [0.0, 0.5, 1.0, 1.00001, 1.5, 50.0],
        "coat_ior": [1.0, 1.5, 4.0],
        "specular_level": [0.0, 0.5, 1.0, 40.0],
    }
    ends |= {"alpha": [0.0, 0.5, 1.0, 1.0], "coat": [0.0, 0.0, 1.0, 1.5]}
    for trial in range(1500):
        inputs: dict[str, Any] = {name: rng.choice(values) for name, values in ends.items()}
        inputs |= {name: rng.choice([0.0, 1.0, 0.3, 3.0], 3) for name in ("base", "specular_tint", "coat_tint")}
        n = unit([0.6 * rng.standard_normal(), 0.6 * rng.standard_normal(), 1.0])
        ns = n if trial % 2 else unit([0.2, 0.1, 1.0])
        case = (Shader(int(rng.integers(0, 9))), inputs)
        wi = direction(float(rng.choice([0.0, 30.0, 85.0, 89.999])), rng.uniform(0, 360))
        closure = setup(case, wi, int(rng.integers(0, 16)), *((n, ns) if trial % 3 else (UP, UP)))
        if trial % 5 == 0:
            bsdf_blur(closure, 0.3)
        public = closure[: lobes.C_HAS_EVAL + 1]
        assert np.isfinite(public).all() and (public >= 0.0).all(), case
        out = draw(closure, 20, trial)
        assert np.isfinite(out).all() and (out[:, 3:8] >= 0.0).all(), case
        value = evaluate(closure, np.concatenate([out[:, :3], [unit(v) for v in rng.standard_normal((5, 3))]]))
        assert np.isfinite(value).all() and (value >= 0.0).all(), case


def test_tables_are_what_the_module_computes() -> None:
    tables = ggx_albedo.load()
    rough, coarse, iors = ggx_albedo.grid(32), ggx_albedo.grid(16), ggx_albedo.ior_grid(16)
    fine, cosines, many = ggx_albedo.grid(32), ggx_albedo.fine_cosines(32), ggx_albedo.ior_grid(32)
    entries = {
        ("reflection", 0, 7, 20): (ggx_albedo.REFLECTION, rough[20], rough[7], 1.0),
        ("glass", 6, 2, 9): (ggx_albedo.GLASS, coarse[9], coarse[2], iors[6]),
        ("glass_inside", 4, 1, 12): (ggx_albedo.GLASS, coarse[12], coarse[1], 1.0 / iors[4]),
        ("schlick", 0, 3, 8): (ggx_albedo.SCHLICK, coarse[8], coarse[3], 1.0),
        ("schlick_ior", 7, 1, 5): (ggx_albedo.SCHLICK_IOR, coarse[5], coarse[1], iors[7]),
        ("fine_reflection", 0, 7, 20): (ggx_albedo.REFLECTION, fine[20], cosines[7], 1.0),
        ("fine_glass", 12, 3, 9): (ggx_albedo.GLASS, fine[9], cosines[3], many[12]),
        ("fine_glass_inside", 6, 3, 12): (ggx_albedo.GLASS_BELOW, fine[12], cosines[3], 1.0 / many[6]),
        ("fine_schlick", 0, 3, 8): (ggx_albedo.SCHLICK, fine[8], cosines[3], 1.0),
        ("fine_schlick_ior", 20, 4, 5): (ggx_albedo.SCHLICK_IOR, fine[5], cosines[4], many[20]),
    }
    for (name, k, j, i), arguments in entries.items():
        points, others = (256, 400) if name.startswith("fine") else (512, 300)
        # float32 of the same sum
        assert tables[name][k, j, i] == pytest.approx(ggx_albedo.integrate(*arguments, points), abs=1e-7)
        # and it has converged
        assert tables[name][k, j, i] == pytest.approx(ggx_albedo.integrate(*arguments, others), abs=5e-4)
    mean = ggx_albedo.average(ggx_albedo.REFLECTION, 2, [1.0], 128)
    np.testing.assert_allclose(tables["reflection_mean"][0, 0, [0, -1]], mean[0, 0], atol=1e-7)


def test_public_slots() -> None:
    """Emission is dimmed by alpha and coat, transparency is 1 - alpha, sharp surfaces have nothing for light sampling
    until blurred."""
    out = np.zeros(lobes.OUT)
    closure = setup(principled(alpha=0.25), direction(30.0))
    assert closure[lobes.C_EMISSION] == pytest.approx(0.25) and closure[lobes.C_TRANSPARENCY] == pytest.approx(0.75)
    bsdf_transparency(params({"alpha": 0.25}), int(Shader.PRINCIPLED), out)
    assert out[:3] == pytest.approx(0.75)
    bsdf_transparency(params({"base": ORANGE}), int(Shader.TRANSPARENT), out)
    assert out[:3] == pytest.approx(ORANGE)
    bsdf_transparency(params({}), int(Shader.GLASS), out)
    assert not out[:3].any()
    # 4 % reflected at normal incidence
    assert 0.9 < setup(principled(coat=1.0), direction(30.0))[lobes.C_EMISSION] < 0.97
    mirror = setup((Shader.GLOSSY, {"base": WHITE, "roughness": 0.0}), direction(30.0))
    assert mirror[lobes.C_HAS_EVAL] == 0.0
    assert draw(mirror, 1)[0, 8] == lobes.REFLECT | lobes.SINGULAR
    np.testing.assert_allclose(draw(mirror, 1)[0, :3], direction(30.0, -90.0), atol=1e-7)
    bsdf_blur(mirror, 0.2)
    assert mirror[lobes.C_HAS_EVAL] == 1.0
    assert draw(mirror, 1)[0, 8] == lobes.REFLECT | lobes.GLOSSY
    assert draw(mirror, 1)[0, lobes.O_ROUGHNESS] == pytest.approx(0.2)


def test_caustics_off() -> None:
    """The flags leave no glossy reflection, or no refraction."""
    glass = (Shader.GLASS, {"base": WHITE, "roughness": 0.2})
    labels = draw(setup(glass, direction(30.0), lobes.NO_REFLECTIVE_CAUSTICS), 500)[:, 8].astype(int)
    assert not (labels & lobes.REFLECT).any() and (labels & lobes.TRANSMIT).any()
    labels = draw(setup(glass, direction(30.0), lobes.NO_REFRACTIVE_CAUSTICS), 500)[:, 8].astype(int)
    assert not (labels & lobes.TRANSMIT).any() and (labels & lobes.REFLECT).any()
    labels = draw(setup((Shader.PRINCIPLED, {}), direction(30.0), lobes.NO_REFLECTIVE_CAUSTICS), 500)[:, 8].astype(int)
    assert set(labels) <= {0, lobes.REFLECT | lobes.DIFFUSE}


# Cycles as the judge: one strip of a plane per case, seen by an orthographic camera, so that every pixel of a strip has
# the same two directions.

NODES = {
    Shader.PRINCIPLED: "Principled",
    Shader.DIFFUSE: "Diffuse",
    Shader.GLOSSY: "Glossy",
    Shader.GLASS: "Glass",
    Shader.REFRACTION: "Refraction",
    Shader.TRANSLUCENT: "Translucent",
    Shader.TRANSPARENT: "Transparent",
}
PIXELS = 4  # a strip is PIXELS x PIXELS


def model_of_cycles() -> int:
    """Flags of the surface models that the Cycles at hand has."""
    import bpy

    return lobes.SHADING_FLAGS[Shading.of(bpy.app.version)]


def cycles_material(case: Case, normal: Any) -> Any:
    import bpy

    shader, inputs = case
    material = bpy.data.materials.new("case")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        material.use_nodes = True
    tree = material.node_tree
    tree.nodes.clear()
    node = tree.nodes.new("ShaderNodeBsdf" + NODES[shader])
    tree.links.new(node.outputs[0], tree.nodes.new("ShaderNodeOutputMaterial").inputs[0])
    if shader == Shader.REFRACTION:
        node.distribution = "GGX"
    for name, value in {**DEFAULTS, **inputs}.items():
        socket = SLOTS[name][1]
        if shader != Shader.PRINCIPLED:
            rough = "diffuse_roughness" if shader == Shader.DIFFUSE else "roughness"
            socket = {"base": "Color", rough: "Roughness", "ior": "IOR"}.get(name, "")
        if socket in node.inputs:
            node.inputs[socket].default_value = (*value, 1.0) if np.ndim(value) else value
    if normal is not None and "Normal" in node.inputs:
        constant = tree.nodes.new("ShaderNodeCombineXYZ")
        for k in range(3):
            constant.inputs[k].default_value = normal[k]
        tree.links.new(constant.outputs[0], node.inputs["Normal"])
    return material


def cycles_strips(back: bool, smooth: Any, normal: Any) -> Any:
    """A Blender scene with a strip per case: seen from behind, with tilted smooth normals, with a bent shading
    normal."""
    import bpy

    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    cycles = scene.cycles
    cycles.device = "CPU"
    cycles.use_adaptive_sampling = cycles.use_denoising = cycles.use_light_tree = False
    cycles.pixel_filter_type = "BOX"
    cycles.sample_clamp_direct = cycles.sample_clamp_indirect = cycles.blur_glossy = cycles.light_sampling_threshold = (
        0.0
    )
    cycles.caustics_reflective = cycles.caustics_refractive = True
    scene.render.image_settings.file_format = "OPEN_EXR"
    scene.render.image_settings.color_depth = "32"
    for i, case in enumerate(CASES):
        mesh = bpy.data.meshes.new("strip")
        mesh.from_pydata(
            [(i, -50, 0), (i + 1, -50, 0), (i + 1, 50, 0), (i, 50, 0)], [], [(3, 2, 1, 0) if back else (0, 1, 2, 3)]
        )
        if smooth is not None:
            mesh.normals_split_custom_set([tuple(-unit(smooth) if back else unit(smooth))] * 4)
        mesh.materials.append(cycles_material(case, normal))
        scene.collection.objects.link(bpy.data.objects.new("strip", mesh))
    camera = bpy.data.cameras.new("camera")
    camera.type, camera.ortho_scale, camera.clip_end = "ORTHO", len(CASES), 1000.0
    scene.camera = bpy.data.objects.new("camera", camera)
    scene.collection.objects.link(scene.camera)
    scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = (
        len(CASES) * PIXELS,
        PIXELS,
        100,
    )
    return scene


def aim(thing: Any, towards: F64) -> None:
    """Turn a light or camera, which look along -Z, to look from direction `towards` at the origin."""
    from mathutils import Vector

    thing.rotation_mode = "QUATERNION"
    thing.rotation_quaternion = Vector(towards).to_track_quat("Z", "Y")


def cycles_picture(scene: Any, wi: F64, samples: int, folder: Path) -> F64:
    """(cases, pixels, 3) radiance along wi."""
    import bpy
    import OpenEXR

    aim(scene.camera, wi)
    scene.camera.location = np.array([len(CASES) / 2.0, 0.0, 0.0]) + 100.0 * wi
    scene.cycles.samples = samples
    scene.render.filepath = str(folder / "picture.exr")
    bpy.ops.render.render(write_still=True)
    with OpenEXR.File(scene.render.filepath) as file:
        rgb = file.channels()["RGBA"].pixels[..., :3].astype(np.float64)
    # The camera's up leans along wi, which puts +X on the left.
    return rgb.reshape(PIXELS, len(CASES), PIXELS, 3).transpose(1, 0, 2, 3).reshape(len(CASES), -1, 3)[::-1]


TILTS = [(None, None), ((-0.1, 0.3, 0.95), None), (None, (0.25, 0.2, 0.947)), ((-0.1, 0.3, 0.95), (0.25, 0.2, 0.947))]


@pytest.mark.blender
@pytest.mark.parametrize("back", [False, True], ids=["front", "back"])
@pytest.mark.parametrize(("smooth", "normal"), TILTS, ids=["flat", "smooth", "bump", "both"])
def test_agrees_with_cycles_in_sunlight(back: bool, smooth: Any, normal: Any, tmp_path: Path) -> None:
    """A point sun makes the picture f * |cos| itself, with no noise. Tolerance: float32 and 1e-4 of the tables; normals
    of a mesh are stored in 16 bits."""
    bpy = pytest.importorskip("bpy")
    scene = cycles_strips(back, smooth, normal)
    lamp = bpy.data.lights.new("sun", "SUN")
    lamp.energy, lamp.angle = 1.0, 0.0
    sun = bpy.data.objects.new("sun", lamp)
    scene.collection.objects.link(sun)
    ns = UP if smooth is None else smooth
    n = ns if normal is None else normal
    flags = model_of_cycles() | (lobes.BACKFACING if back else 0)
    for degrees in (10.0, 45.0, 80.0):
        wi = direction(degrees)
        for polar, azimuth in ((5.0, 90.0), (45.0, -60.0), (80.0, -85.0), (125.0, -90.0), (165.0, 30.0)):
            wo = direction(polar, azimuth)
            aim(sun, wo)
            picture = cycles_picture(scene, wi, 1, tmp_path).mean(1)
            ours = np.array([evaluate(setup(case, wi, flags, n, ns), wo[None])[0, :3] for case in CASES])
            wrong = np.abs(ours - picture) > (2e-3 if smooth is not None else 3e-4) * np.maximum(picture, 1e-2)
            assert not wrong.any(), [
                (CASES[i], degrees, polar, ours[i], picture[i]) for i in np.flatnonzero(wrong.any(1))[:3]
            ]


@pytest.mark.blender
@pytest.mark.parametrize("back", [False, True], ids=["front", "back"])
def test_agrees_with_cycles_under_a_white_sky(back: bool, tmp_path: Path) -> None:
    """Mean radiance is the albedo: sampling, sharp lobes and transparency as well. Z-test over all cases and channels,
    plus the 3e-4 of the tables."""
    bpy = pytest.importorskip("bpy")
    scene = cycles_strips(back, None, None)
    scene.world = bpy.data.worlds.new("world")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        scene.world.use_nodes = True
    scene.world.node_tree.nodes["Background"].inputs[0].default_value = (1.0, 1.0, 1.0, 1.0)
    for degrees in (20.0, 80.0):
        wi = direction(degrees)
        picture = cycles_picture(scene, wi, 512, tmp_path)
        for i, case in enumerate(CASES):
            mean, error = albedo(setup(case, wi, model_of_cycles() | (lobes.BACKFACING if back else 0)), 60000)
            noise = np.hypot(error, standard_error(picture[i]))
            assert_mean(mean, picture[i].mean(0), noise, 2 * 2 * 3 * len(CASES), 3e-4, (case, degrees))
