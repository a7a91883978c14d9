"""Light that is very bright, very dim, very small, very large; surfaces that lose nothing, or everything."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np

from lipac.core.culling.analysis import analyze
from lipac.core.culling.options import CullOptions
from lipac.core.scene import model as s
from lipac.core.scene.film import Picture
from lipac.core.tracing import path_state

from ..core import scenes
from ..core.scenes import lamp, material, render
from .case import Figure, case
from .places import SIZE, changed, still_life
from .transforms import rotation

GROUP = "Light"
FURNACE = s.PathLimits(total=1024, diffuse=1024, glossy=1024, transmission=1024, transparent=1024)


def errors(picture: Picture, wanted: float) -> float:
    """Distance of a picture's mean from what it should be, in standard errors (of float32 sums at least)."""
    x = picture.mean[..., 0].astype(np.float64)
    error = max(x.std() / np.sqrt(x.size), 1e-6 * abs(wanted))
    return float(abs(x.mean() - wanted) / error)


@case(GROUP)
def brightness() -> Iterator[Figure]:
    """All light times a power of two: every bit the same, and the same instances kept."""
    reference, options = render(still_life(), 4).mean, CullOptions(width=SIZE[0])
    states = analyze(still_life(), options).state
    for exponent in (-40, 40):
        scene = still_life(brightness=2.0**exponent)
        what = f"all light times 2^{exponent} ({2.0**exponent:.0e})"
        picture = render(scene, 4).mean[..., :3] / np.float32(2.0**exponent)
        yield Figure(what, "pixels that differ in any bit", changed(reference[..., :3], picture, 0.0), 0.0)
        yield Figure(
            f"{what}, culled by light paths",
            "states that differ",
            float((analyze(scene, options).state != states).mean()),
            0.0,
        )


@case(GROUP)
def bright_and_dim_together() -> Figure:
    """A lamp of 1e12 W far away and one of 1e-12 W near: the picture is the sum of both, and finite."""
    camera = scenes.look_at((0, -4, 2), (0, 0, 0))
    strong, weak = lamp(s.LightKind.POINT, (0, 0, 1e5), power=1e12), lamp(s.LightKind.POINT, (0, 0, 1e-6), power=1e-12)
    pictures = []
    for lights in (strong, weak, np.concatenate([strong, weak])):
        scene = scenes.build(
            [scenes.quad()], [(0, scenes.placed((0, 0, 0), 4.0), 0)], [material()], camera, lights, (0, 0, 0), (64, 36)
        )
        pictures.append(render(scene, 256, strategy=path_state.BOTH).mean[..., 0].astype(np.float64).mean())
    return Figure(
        "lamps of 10^12 W and 10^-12 W, 10^5 m and 10^-6 m away",
        "mean against the sum of both alone",
        abs(pictures[2] / (pictures[0] + pictures[1]) - 1),
        0.05,
    )


def under_sphere(radius: float) -> float:
    """Standard errors between the light of an emissive sphere of a radius at height 2 (radius 1e4: the floor stands in
    it) and its closed form."""
    inside = radius > 2
    height = radius * 0.5 if inside else 2.0
    to_world = np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 1.0]], float)
    camera = s.Camera(to_world, np.array([-0.01, 0.01, -0.01, 0.01]), orthographic=True)
    glow = material(s.Shader.EMISSION, emission=1.0 / radius**2 if not inside else 1.0)
    placement = [(0, scenes.placed((0, 0, 0), 4.0), 0), (1, scenes.placed((0, 0, height), radius), 1)]
    scene = scenes.build(
        [scenes.quad(), scenes.sphere(48)],
        placement,
        [material(base_color=1.0), glow],
        camera,
        None,
        (0, 0, 0),
        (32, 32),
        s.PathLimits(total=0),
    )
    picture = render(scene, 64)
    # irradiance: pi L (r / d)^2, inside pi L; the polyhedron's mean projected area is that of the sphere within 0.2 %
    wanted = 1.0 if inside else 1.0 / height**2
    x = picture.mean[..., 0].astype(np.float64)
    return float(max(abs(x.mean() / wanted - 1) - 0.004, 0) / (x.std() / np.sqrt(x.size) / wanted + 1e-6))


@case(GROUP)
def sizes_of_emitters() -> Iterator[Figure]:
    """Emissive meshes from 1e-6 m to 1e4 m across."""
    why = "0.4 % allowed to the polyhedron that stands for a sphere"
    small = (
        "an emitter below 10^-6 of its distance is smaller than the error at its place: its far side shines "
        "through its near one, twice as bright at most"
    )
    for radius in (1e-6, 2e-5, 1e-3, 0.5, 1e4):
        yield Figure(
            f"emissive sphere of radius {radius:g} m, 2 m away",
            "standard errors from the closed form",
            under_sphere(radius),
            *((4.0, why) if radius > 2e-6 else (1e3, small)),
        )


@case(GROUP)
def emitters_do_not_shadow_themselves() -> Iterator[Figure]:
    """A small square that shines at a floor from far, tilted to grazing: irradiance is L A cos cos / d^2. The origin
    lies at either of them."""
    for distance in (1e2, 1e5):
        for degrees in (0.0, 80.0, 89.0):
            for at_emitter in (True, False):
                angle = np.radians(degrees)
                turn = rotation(14)
                tilt = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
                emitter = np.zeros((3, 4), np.float32)
                emitter[:, :3] = turn @ tilt * 0.01 * distance
                place = turn @ np.array([0, 0, -1.0]) * distance
                emitter[:, 3] = 0 if at_emitter else -place
                ground = np.zeros((3, 4), np.float32)
                ground[:, :3], ground[:, 3] = turn * 1e-3 * distance, place if at_emitter else 0
                eye = ground[:, 3] + turn[:, 2] * 1e-4 * distance
                camera = s.Camera(
                    np.concatenate([turn, eye[:, None]], axis=1),
                    np.array([-1, 1, -1, 1]) * 1e-5 * distance,
                    orthographic=True,
                )
                glow = material(s.Shader.EMISSION, emission=np.pi)
                placement = [(0, emitter, 1), (0, ground, 0)]
                scene = scenes.build(
                    [scenes.quad()],
                    placement,
                    [material(base_color=1.0), glow],
                    camera,
                    None,
                    (0, 0, 0),
                    (32, 32),
                    s.PathLimits(total=0),
                )
                x = render(scene, 16, strategy=path_state.LIGHT_ONLY).mean[..., 0].astype(np.float64)
                wanted = 1e-4 * np.cos(angle)
                where = "at the origin" if at_emitter else "far from it"
                what = f"emissive square {where}, {distance:g} m away, tilted by {degrees:g} degrees"
                yield Figure(
                    what,
                    "light missing",
                    max(1 - float(x.mean() / wanted), 0.0),
                    2e-3,
                    "the square's own extent: 1 % of the distance, squared, and sampling noise",
                )


def inside_furnace(fields: dict[str, object], shader: s.Shader) -> s.Scene:
    """A body in a uniform world of radiance 1."""
    camera = scenes.look_at((0, -4, 0), (0, 0, 0), 0.25)
    return scenes.build(
        [scenes.sphere(24)],
        [(0, scenes.placed((0, 0, 0)), 0)],
        [material(shader, **fields)],
        camera,
        size=(48, 27),
        limits=FURNACE,
    )


@case(GROUP)
def white_furnace() -> Iterator[Figure]:
    """What absorbs nothing is invisible in uniform light, at any roughness; what absorbs all is black."""
    for shader in (s.Shader.DIFFUSE, s.Shader.GLOSSY, s.Shader.GLASS):
        for roughness in (0.0, 0.01, 0.1, 0.3, 0.7, 1.0):
            if shader == s.Shader.DIFFUSE and roughness not in (0.0, 1.0):
                continue
            fields: dict[str, object] = {"base_color": 1.0, "roughness": roughness, "diffuse_roughness": roughness}
            x = render(inside_furnace(fields, shader), 64).mean[..., 0].astype(np.float64)
            excess = abs(x.mean() - 1) - 4 * x.std() / np.sqrt(x.size)
            limit, why = (
                (0.02, "rough glass and metal make up for lost bounces by a table, to 2 %")
                if shader != s.Shader.DIFFUSE
                else (1e-5, "float32 sums")
            )
            if shader == s.Shader.DIFFUSE and roughness:
                limit, why = 0.02, "Oren-Nayar, as Cycles has it, loses a little at albedo 1"
            yield Figure(
                f"white furnace: {shader.name.lower()}, roughness {roughness:g}",
                "light won or lost beyond 4 standard errors",
                max(float(excess), 0.0),
                limit,
                why,
            )
    for shader in (s.Shader.DIFFUSE, s.Shader.GLOSSY):
        inner = render(inside_furnace({"base_color": 0.0, "roughness": 0.3}, shader), 8).mean[12:15, 22:26, :3]
        yield Figure(
            f"black {shader.name.lower()} body in uniform light", "light from its middle", float(inner.max()), 0.0
        )


@case(GROUP)
def total_internal_reflection() -> Iterator[Figure]:
    """A camera in a glass cube in a uniform world: all light that is seen comes from the world, undimmed, whatever the
    number of bounces."""
    camera = scenes.look_at((0.1, -0.2, 0.05), (0.3, 0.4, 0.2), 1.0)
    for ior in (1.0, 1.0001, 1.5, 2.4, 10.0):
        m = material(s.Shader.GLASS, roughness=0.0, base_color=1.0, ior=ior)
        limits = s.PathLimits(total=128, diffuse=128, glossy=128, transmission=128)
        scene = scenes.build(
            [scenes.cube()], [(0, scenes.placed((0, 0, 0), 2.0), 0)], [m], camera, size=(48, 27), limits=limits
        )
        x = render(scene, 8).mean[..., 0].astype(np.float64)
        # Roulette ends nothing here: throughput stays 1. What is trapped for ever in a cube (three reflections turn a
        # ray back) ends at the limit.
        lost = 1 - x.mean()
        yield Figure(
            f"inside of a clear glass cube of ior {ior:g}",
            "light won",
            max(float(x.max() - 1), 0.0),
            1e-4,
            "float32 products of up to 128 weights",
        )
        if ior <= 1.4:
            yield Figure(
                f"inside of a clear glass cube of ior {ior:g}",
                "light lost",
                max(float(lost), 0.0),
                1e-5,
                "float32 sums",
            )


@case(GROUP)
def long_glass_path() -> Iterator[Figure]:
    """A stack of clear panes in a uniform world: every pane splits the ray, nothing is lost."""
    limits = s.PathLimits(total=20_000, diffuse=20_000, glossy=20_000, transmission=20_000)
    for panes in (4, 32):
        slab = scenes.placed((0, 0, 0), (4.0, 4.0, 0.01))
        placement = []
        for k in range(panes):
            at = slab.copy()
            at[2, 3] = -0.05 * k
            placement.append((0, at, 0))
        to_world = np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 2]], float)
        camera = s.Camera(to_world, np.array([-0.1, 0.1, -0.1, 0.1]), orthographic=True)
        scene = scenes.build(
            [scenes.cube()],
            placement,
            [material(s.Shader.GLASS, roughness=0.0, base_color=1.0)],
            camera,
            size=(32, 32),
            limits=limits,
        )
        x = render(scene, 16).mean[..., 0].astype(np.float64)
        yield Figure(
            f"{panes} panes of clear glass, as many bounces as it takes",
            "light won or lost",
            abs(float(x.mean() - 1)),
            1e-3,
            "float32 products of thousands of weights",
        )


@case(GROUP)
def fireflies() -> Iterator[Figure]:
    """A tiny sun seen in rough metal through BSDF sampling alone: rare, very bright paths. Weights do not overflow, the
    picture is finite, the mean right."""
    scene = still_life()
    lights = lamp(s.LightKind.SUN, power=1e6, angle=1e-3)
    scene = dataclasses.replace(scene, lights=lights)
    picture = render(scene, 16, strategy=path_state.BSDF_ONLY)
    yield Figure(
        "a sun of 10^6 W/m2 and 1e-3 rad met by chance alone",
        "pixels that are not finite",
        float((~np.isfinite(picture.mean)).mean()),
        0.0,
    )
    result = analyze(scene, CullOptions(width=SIZE[0]))
    bad = float((~np.isfinite(result.score)).sum() + (result.score < 0).sum())
    yield Figure("the same, culled by light paths", "scores that are negative or not finite", bad, 0.0)
    limits = dataclasses.replace(scene.limits, clamp_direct=1.0, clamp_indirect=1.0)
    clamped = render(dataclasses.replace(scene, limits=limits), 1, strategy=path_state.BSDF_ONLY).mean[..., :3]
    bounces = 13  # contributions of one path at most, each clamped to three times the clamp over its channels
    yield Figure(
        "the same, clamped to 1",
        "brightest channel over what the clamp allows",
        float(clamped.max()) / (3 * bounces),
        1.0,
    )


@case(GROUP)
def terminator() -> Iterator[Figure]:
    """A smooth-shaded sphere of few triangles in the sun: its lit half is as bright as that of a fine one."""
    fine = lit_sphere(128)
    for rings in (6, 12, 24):
        coarse = lit_sphere(rings)
        both = (fine > 0.05) & (coarse > 0)
        darker = np.maximum(fine - coarse, 0)[fine > 0.05].sum() / fine[fine > 0.05].sum()
        why = (
            "a polyhedron's own outline and shape, first order in the triangle's size; Cycles' geometry offset "
            "of 0.1 is what is meant"
        )
        yield Figure(
            f"terminator of a smooth sphere of {rings} rings",
            "light missing from the lit side",
            float(darker),
            3.0 / rings**1.0 * 0.5,
            why,
        )
        assert both.any()


def lit_sphere(rings: int) -> np.ndarray:
    """(90, 90) brightness of a smooth-shaded unit sphere, sun from the side."""
    ball = scenes.sphere(rings)
    normals = ball.positions[ball.triangles]
    smooth = dataclasses.replace(ball, normals=np.ascontiguousarray(normals, np.float32))
    camera = scenes.look_at((0, -6, 0), (0, 0, 0), 0.2, 1.0)
    sun = lamp(s.LightKind.SUN, power=np.pi)
    sun["axis_z"] = (0.98, -0.2, 0.0)
    scene = scenes.build(
        [smooth],
        [(0, scenes.placed((0, 0, 0)), 0)],
        [material(base_color=1.0)],
        camera,
        sun,
        (0, 0, 0),
        (90, 90),
        s.PathLimits(total=0),
    )
    return render(scene, 4).mean[..., 0].astype(np.float64)
