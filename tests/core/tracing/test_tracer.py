"""The path tracer against known answers: closed forms of light transport, strategies against each other, threads,
scales, instances."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from lipac.core.accel.blas import BlasCache
from lipac.core.accel.tlas import Tlas
from lipac.core.feedback.hits import Feedback
from lipac.core.scene import model as s
from lipac.core.scene.film import Picture
from lipac.core.tracing import path_state
from lipac.core.tracing.tracer import prepare, trace

from .. import scenes
from ..scenes import lamp, material, render


def spot_above(x: float, width: float = 0.02) -> s.Camera:
    """Orthographic, looking down at a patch of the floor around (x, 0) that is so small that light hardly varies over
    it."""
    to_world = np.array([[1, 0, 0, x], [0, 1, 0, 0], [0, 0, 1, 0.5]], float)
    return s.Camera(to_world, np.array([-1, 1, -1, 1]) * width / 2, orthographic=True)


DIRECT = s.PathLimits(total=0, diffuse=0, glossy=0, transmission=0)


def floor(
    lights: s.Records | None = None, x: float = 0.0, extra: list[tuple[int, np.ndarray, int]] | None = None
) -> s.Scene:
    """A floor of albedo 0.5, seen from above at x; material 1 glows with radiance 5."""
    placement = [(0, scenes.placed((0, 0, 0), 50.0), 0), *(extra or [])]
    return scenes.build(
        [scenes.quad(), scenes.sphere(40)],
        placement,
        [material(base_color=0.5), material(s.Shader.EMISSION, emission=5.0)],
        spot_above(x),
        lights,
        world=(0, 0, 0),
        size=(32, 32),
        limits=DIRECT,
    )


def mean(picture: Picture) -> tuple[float, float]:
    """Mean over the pixels, and its standard error."""
    x = picture.mean[..., 0]
    return float(x.mean()), float(x.std() / np.sqrt(x.size))


def rectangle_irradiance(x: float, height: float, half: float = 0.5) -> float:
    """Irradiance over radiance on a floor at (x, 0) under a square at (0, 0, height) that faces it (sum of four corner
    configuration factors)."""

    def corner(a: float, b: float) -> float:
        a, b = a / height, b / height
        return 0.5 * (
            a / np.hypot(1, a) * np.arctan(b / np.hypot(1, a)) + b / np.hypot(1, b) * np.arctan(a / np.hypot(1, b))
        )

    return sum(corner(i * half - i * k * x, half) * 2 for i, k in ((1, 1), (1, -1)))


@pytest.mark.parametrize("x", [0.0, 1.5])
@pytest.mark.parametrize(
    ("name", "light", "expected"),
    [
        ("point", lamp(s.LightKind.POINT), lambda x: 100 / (4 * np.pi) * 2 / (x * x + 4) ** 1.5),
        # exact while all of it is above the horizon
        ("sphere", lamp(s.LightKind.POINT, radius=0.3), lambda x: 100 / (4 * np.pi) * 2 / (x * x + 4) ** 1.5),
        # within the cone
        ("spot", lamp(s.LightKind.SPOT, spot_size=1.6), lambda x: 100 / (4 * np.pi) * 2 / (x * x + 4) ** 1.5),
        # radiance E / (pi sin^2), so the cosine over the disk gives E again
        ("sun", lamp(s.LightKind.SUN, angle=0.1, power=3.0), lambda x: 3.0),
        ("area", lamp(s.LightKind.AREA), lambda x: 100 / np.pi * rectangle_irradiance(x, 2)),
    ],
)
def test_direct_light_of_lamps(name: str, light: s.Records, expected: object, x: float) -> None:
    """Radiance of a white-grey floor: albedo / pi times irradiance, within five standard errors and the patch's own
    variation (1e-3)."""
    value, error = mean(render(floor(light, x), 16))
    wanted = 0.5 / np.pi * expected(x)  # type: ignore[operator]
    assert abs(value - wanted) < 5 * error + 1.5e-3 * wanted


@pytest.mark.parametrize("strategy", [path_state.BOTH, path_state.LIGHT_ONLY, path_state.BSDF_ONLY])
def test_direct_light_of_an_emissive_square(strategy: int) -> None:
    """Also scaled unevenly: the density uses the world-space area."""
    for transform, x in ((scenes.placed((0, 0, 2)), 0.8), (scenes.placed((0, 0, 2), (1.0, -1.0, -3.0)), 0.3)):
        scene = floor(None, x, [(0, transform, 1)])  # the camera starts below the square
        value, error = mean(render(scene, 64, strategy=strategy))
        wanted = 0.5 / np.pi * 5.0 * rectangle_irradiance(x, 2)
        assert abs(value - wanted) < 5 * error + 1.5e-3 * wanted


def test_uneven_scale_of_an_emissive_sphere() -> None:
    """All strategies agree on an ellipsoid lamp."""
    transform = scenes.placed((0.3, 0.2, 2), (0.8, 0.3, 0.5))
    results = [mean(render(floor(None, 0.5, [(1, transform, 1)]), 64, strategy=k)) for k in (0, 1, 2)]
    for value, error in results[1:]:
        assert abs(value - results[0][0]) < 5 * np.hypot(error, results[0][1])


@pytest.mark.parametrize(
    "light", ["sphere", "disk", "area", "ellipse", "spread", "sun", "spot", "world", "two lamps and a mesh"]
)
def test_strategies_agree(light: str) -> None:
    """Light sampling, BSDF sampling and both together have one mean."""
    kinds = {
        "sphere": lamp(s.LightKind.POINT, radius=0.5),
        "disk": lamp(s.LightKind.POINT, radius=0.5, soft_falloff=1),
        "area": lamp(s.LightKind.AREA),
        "ellipse": lamp(s.LightKind.AREA, shape=1, size=(2, 1)),
        "spread": lamp(s.LightKind.AREA, spread=1.5, size=2),
        "sun": lamp(s.LightKind.SUN, angle=0.5, power=3),
        "spot": lamp(s.LightKind.SPOT, radius=0.5, spot_blend=0.5),
        "two lamps and a mesh": np.concatenate(
            [lamp(s.LightKind.POINT, (1, 1, 2), radius=0.5), lamp(s.LightKind.AREA, (-1, 0, 2))]
        ),
        "world": None,
    }
    extra = [(1, scenes.placed((-0.5, -1, 1.5), 0.4), 1)] if light == "two lamps and a mesh" else None
    scene = floor(kinds[light], 0.4, extra)
    if light == "world":
        image = np.full((16, 32, 3), 0.1, np.float32)
        image[12:14, 5:9] = 20.0
        scene = dataclasses.replace(scene, world=s.World(np.zeros(3, np.float32), image))
    results = [mean(render(scene, 96, strategy=k)) for k in (0, 1, 2)]
    for value, error in results[1:]:
        assert abs(value - results[0][0]) < 5 * np.hypot(error, results[0][1]) + 1e-4 * value
    assert results[0][0] > 0


def test_white_furnace() -> None:
    """A convex body that absorbs nothing is invisible in a uniform world."""
    camera = scenes.look_at((0, -4, 0), (0, 0, 0))
    scene = scenes.build(
        [scenes.sphere(24)], [(0, scenes.placed((0, 0, 0)), 0)], [material(base_color=1.0)], camera, size=(48, 27)
    )
    picture = render(scene, 16).mean
    assert picture[..., :3] == pytest.approx(1.0, abs=2e-5)  # float32 sums of 16


@pytest.mark.parametrize("bounces", [0, 1, 5])
def test_closed_furnace(bounces: int) -> None:
    """Inside of a closed body that emits E and reflects rho: E (1 - rho^(b + 2)) / (1 - rho) after b bounces."""
    m = material(s.Shader.PRINCIPLED, base_color=0.6, emission=0.5, specular_level=0.0, ior=1.0)
    limits = s.PathLimits(total=bounces, diffuse=bounces, glossy=bounces, transmission=bounces)
    camera = scenes.look_at((0.2, -0.6, 0.1), (0, 0.4, 0))
    scene = scenes.build(
        [scenes.cube()], [(0, scenes.placed((0, 0, 0), (3, 2, 2)), 0)], [m], camera, size=(48, 27), limits=limits
    )
    value, error = mean(render(scene, 64))
    wanted = 0.5 * (1 - 0.6 ** (bounces + 2)) / (1 - 0.6)
    assert abs(value - wanted) < 5 * error + 1e-4 * wanted


@pytest.mark.parametrize("scale", [1e-4, 1.0, 1e5])
@pytest.mark.parametrize("shift", [0.0, 30.0])
def test_rays_leave_their_surface_at_any_scale(scale: float, shift: float) -> None:
    """From outside of a convex body no bounce meets it again; from inside none gets out. shift: distance from the
    origin, in body sizes."""
    turn = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    transform = np.zeros((3, 4), np.float32)
    transform[:, :3] = turn * scale * np.array([1.0, 0.4, 2.0])
    transform[:, 3] = shift * scale
    centre = transform[:, 3].astype(float)
    limits = s.PathLimits(total=3, diffuse=3)
    for mesh in (scenes.sphere(32), scenes.cube()):
        camera = scenes.look_at(tuple(centre + np.array([1, -8, 2]) * scale), tuple(centre))  # type: ignore[arg-type]
        scene = scenes.build([mesh], [(0, transform, 0)], [material()], camera, size=(64, 36), limits=limits)
        feedback = Feedback.zeros(1)
        render(scene, 16, feedback=feedback)
        assert feedback.hits[0, s.RayType.CAMERA] > 500
        assert feedback.hits[0, s.RayType.DIFFUSE] == 0
        inside = scenes.look_at(tuple(centre + np.array([0, -0.05, 0]) * scale), tuple(centre))  # type: ignore[arg-type]
        leaks = render(dataclasses.replace(scene, camera=inside), 16).mean[..., :3]
        assert leaks.max() == 0.0


def room() -> s.Scene:
    """Mirror, glass, transparency, emitters, lamps and a world: a bit of everything."""
    materials = [
        material(base_color=(0.7, 0.6, 0.5)),
        material(s.Shader.PRINCIPLED, metallic=1.0, roughness=0.1),
        material(s.Shader.GLASS, roughness=0.0, base_color=1.0),
        material(s.Shader.PRINCIPLED, alpha=0.4, base_color=(0.9, 0.2, 0.1)),
        material(s.Shader.EMISSION, emission=(4.0, 5.0, 6.0)),
    ]
    placement = [(0, scenes.placed((0, 0, 0), 8.0), 0)]
    placement += [(1, scenes.placed((i - 1.5, 0.3 * i, 0.45), 0.4), 1 + i) for i in range(4)]
    placement += [(2, scenes.placed((1.5 - i, -1.2, 0.2), 0.3), i % 5) for i in range(4)]
    lights = np.concatenate(
        [lamp(s.LightKind.POINT, (2, -2, 2), radius=0.2), lamp(s.LightKind.SUN, power=1, angle=0.1)]
    )
    meshes = [scenes.quad(), scenes.sphere(12), scenes.cube()]
    return scenes.build(
        meshes, placement, materials, scenes.look_at((0, -5, 2), (0, 0, 0.3)), lights, world=(0.3, 0.3, 0.4)
    )


def test_same_picture_and_counts_at_any_number_of_threads() -> None:
    results = []
    for threads in (1, 2, 4):
        feedback = Feedback.zeros(len(room().instances))
        picture = render(room(), 4, threads=threads, feedback=feedback)
        results.append((picture.sums.tobytes(), feedback.hits.tobytes(), picture.rays))
    assert results[0] == results[1] == results[2]


def test_samples_continue_where_others_ended() -> None:
    """Two halves add up to the whole, and the seed matters."""
    whole = render(room(), 4).sums
    halves = render(room(), 2).sums + render(room(), 2, first_sample=2).sums
    assert halves == pytest.approx(whole, rel=1e-5, abs=1e-5)
    assert (render(room(), 4, seed=1).sums != whole).mean() > 0.5


def test_instanced_equals_flat() -> None:
    """One mesh placed many times, and the same triangles baked into one mesh: same random numbers, same picture but for
    roundings."""
    rng = np.random.default_rng(6)
    transforms = []
    for _ in range(30):
        t = np.zeros((3, 4), np.float32)
        t[:, :3] = np.linalg.qr(rng.normal(size=(3, 3)))[0] * rng.uniform(0.2, 0.7, 3)
        t[:, 3] = rng.uniform((-2, -2, 0.3), (2, 2, 1.5))
        transforms.append(t)
    cube = scenes.cube()
    baked = np.concatenate([cube.positions @ t[:, :3].T + t[:, 3] for t in transforms]).astype(np.float32)
    triangles = np.concatenate(
        [cube.triangles if np.linalg.det(t[:, :3]) > 0 else cube.triangles[:, ::-1] for t in transforms]
    )
    triangles = (triangles.reshape(30, -1, 3) + 8 * np.arange(30)[:, None, None]).reshape(-1, 3).astype(np.uint32)
    sun = lamp(s.LightKind.SUN, power=2, angle=0.05)
    camera = scenes.look_at((0, -6, 3), (0, 0, 0.5))
    common = {"camera": camera, "lights": sun, "world": (0.3, 0.3, 0.3), "size": (96, 54)}
    ground = (1, scenes.placed((0, 0, 0), 9.0), 0)
    instanced = scenes.build([cube, scenes.quad()], [ground, *[(0, t, 0) for t in transforms]], [material()], **common)  # type: ignore[arg-type]
    baked_mesh, once = s.Mesh(baked, triangles), (0, scenes.placed((0, 0, 0)), 0)
    flat = scenes.build([baked_mesh, scenes.quad()], [ground, once], [material()], **common)  # type: ignore[arg-type]
    counts = [Feedback.zeros(31), Feedback.zeros(2)]
    a = render(instanced, 4, feedback=counts[0]).mean
    b = render(flat, 4, feedback=counts[1]).mean
    # Rays that graze an edge may fall to either side of it.
    assert (np.abs(a - b).max(-1) > 1e-3).mean() < 0.02
    together = counts[0].hits[1:].sum(0)
    assert np.abs(together - counts[1].hits[1]).max() <= 0.002 * together.sum()


def test_feedback_of_shadow_rays() -> None:
    """Blockers and emitters are counted, an emitter also where its own geometry is culled."""
    blocker, emitter = 1, 2
    scene = floor(None, 0.0, [(0, scenes.placed((0, 0, 1), 0.3), 0), (0, scenes.placed((0, 0, 2)), 1)])
    feedback = Feedback.zeros(3)
    render(scene, 4, np.array([True, True, False]), feedback=feedback, strategy=path_state.LIGHT_ONLY)
    assert feedback.hits[blocker, s.RayType.SHADOW] > 1000 and feedback.hits[emitter, s.RayType.SHADOW] > 1000
    paths = 32 * 32 * 4
    assert feedback.hits[:, s.RayType.SHADOW].sum() == paths  # each light sample either arrives or is blocked
    assert feedback.hits[0, s.RayType.CAMERA] == paths
    only_active = np.array([True, True, False])
    blas = BlasCache(scene.meshes)
    blas.need(scene.instances.mesh[only_active])
    dark = trace(prepare(scene, blas).with_emitters(only_active), Tlas(scene.instances, blas, only_active), 4)
    assert dark.sums[..., :3].max() == 0


def test_transparency_colours_shadows_up_to_its_limit() -> None:
    sun = lamp(s.LightKind.SUN, power=np.pi)
    for sheets, limit, share in ((1, 8, 0.5), (2, 8, 0.25), (2, 2, 0.25), (3, 2, 0.0)):
        scene = floor(sun, 0.0, [(0, scenes.placed((0, 0, 1 + i)), 1) for i in range(sheets)])
        records = scene.materials.copy()
        records[1] = material(s.Shader.TRANSPARENT, base_color=(0.5, 1.0, 0.0))
        scene = dataclasses.replace(scene, materials=records, limits=dataclasses.replace(DIRECT, transparent=limit))
        picture = render(scene, 4).mean
        assert picture[..., 0] == pytest.approx(0.5 * share, rel=1e-4)
        assert picture[..., 1] == pytest.approx(0.5 if share else 0.0, rel=1e-4)
        assert picture[..., 2].max() == 0


def test_visibility_by_ray_type() -> None:
    """A roof that the camera does not see still casts its shadow; one without shadow rays does not."""
    sun = lamp(s.LightKind.SUN, power=np.pi)
    for hidden, light in ((s.RayType.CAMERA, 0.0), (s.RayType.SHADOW, 0.5)):
        scene = floor(sun, 0.0, [(0, scenes.placed((0, 0, 0.25)), 0)])
        flags = np.array([s.ALL_RAYS, s.ALL_RAYS & ~(1 << hidden)], np.uint8)
        scene = dataclasses.replace(scene, instances=dataclasses.replace(scene.instances, flags=flags))
        expected = light if hidden == s.RayType.CAMERA else 0.5
        assert render(scene, 4).mean[..., 0] == pytest.approx(expected, rel=1e-3, abs=1e-6)


def test_alpha_of_a_transparent_film_and_holdout() -> None:
    scene = floor(None, 25.0)  # half of the patch is beyond the edge of the floor
    scene = dataclasses.replace(scene, world=s.World(np.ones(3, np.float32)))
    film = dataclasses.replace(scene.film, transparent=True, filter="BOX")
    picture = render(dataclasses.replace(scene, film=film), 8).mean
    assert picture[..., 3].mean() == pytest.approx(0.5, abs=0.01)
    assert picture[:, 20:, :].max() == 0
    flags = np.array([s.ALL_RAYS | s.InstanceFlag.HOLDOUT], np.uint8)
    held = dataclasses.replace(scene, instances=dataclasses.replace(scene.instances, flags=flags))
    assert render(held, 4).mean[:, :8].max() == 0


def test_lamps_are_seen_by_the_rays_they_are_visible_to() -> None:
    camera = scenes.look_at((0, 0, 0), (0, 0, 2), half_width=0.1, aspect=1)
    for visible, seen in ((s.ALL_RAYS, True), (s.ALL_RAYS & ~1, False)):
        scene = dataclasses.replace(floor(lamp(s.LightKind.AREA, visibility=visible)), camera=camera)
        value = render(scene, 1).mean[..., 0]
        assert value == pytest.approx(100 / np.pi if seen else 0.0, rel=1e-5)


def test_clamps() -> None:
    """A contribution's channels sum to at most three times the clamp."""
    scene = floor(lamp(s.LightKind.POINT, (0, 0, 0.3)))
    clamped = dataclasses.replace(scene, limits=dataclasses.replace(DIRECT, clamp_direct=0.25))
    assert render(scene, 1).mean[..., 0].min() > 1
    assert render(clamped, 1).mean[..., 0] == pytest.approx(0.25, rel=1e-4)


def test_cancel_keeps_what_is_there() -> None:
    picture = render(room(), 1, cancelled=lambda: True, threads=1)
    assert picture.paths < 64 * 36
    calls: list[float] = []
    render(room(), 1, progress=lambda fraction, what: calls.append(fraction))
    assert calls[-1] == 1.0 and calls == sorted(calls)


@pytest.mark.parametrize(
    ("ceiling", "glow", "reach", "expected"),
    [(20.0, 0.0, 5.0, 1.0), (20.0, 0.0, 200.0, 0.0), (3.0, 0.0, 5.0, 0.36), (3.0, 4.0, 1000.0, 2.0)],
)
def test_fast_gi(ceiling: float, glow: float, reach: float, expected: float) -> None:
    """A floor of albedo 0.5 under a ceiling, in a world of radiance 1: rays that meet nothing within reach see the
    world, twice as bright, through whatever is farther; what glows still lights it."""
    materials = [material(base_color=0.5), material(base_color=0.8, emission=glow)]
    placement = [(0, scenes.placed((0, 0, 0), 50.0), 0), (0, scenes.placed((0, 0, ceiling), 1e4), 1)]
    limits = s.PathLimits(fast_gi=1, fast_reach=reach, fast_factor=2.0)
    scene = scenes.build([scenes.quad()], placement, materials, spot_above(0.0), size=(32, 32), limits=limits)
    found, error = mean(render(scene, 64))
    assert abs(found - expected) <= 4 * error + 0.01
