"""Lamps, world and emissive meshes: samples follow their densities, and what they send is what Blender's units say."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from lipac.core.jit.pointers import address
from lipac.core.scene import model as s
from lipac.core.tracing.lights.environment import (
    build_environment,
    direction_uv,
    environment_pdf,
    environment_radiance,
    sample_environment,
    uv_direction,
)
from lipac.core.tracing.lights.lamps import (
    K_RADIANCE,
    lamp_constants,
    lamp_hit,
    lamp_pdf,
    lamp_share,
    sample_lamp,
    spot_falloff,
)
from lipac.core.tracing.lights.lights import Lights, emissive_instances

from ... import scenes

F = np.float32
FAR = F(1e30)
TURN = np.linalg.qr(np.random.default_rng(5).normal(size=(3, 3)))[0]
TURN[:, 2] *= np.sign(np.linalg.det(TURN))


def lamp(kind: s.LightKind, **fields: object) -> s.Records:
    """One lamp at (1, 2, 3), turned at random."""
    light = np.zeros(1, s.LIGHT)
    light["kind"], light["position"], light["power"] = kind, (1, 2, 3), 100.0
    light["axis_x"], light["axis_y"], light["axis_z"] = TURN.T
    light["size"] = 1.0 if kind == s.LightKind.SPOT else (1.5, 0.7)
    light["spread"], light["spot_size"], light["spot_blend"] = np.pi, 1.2, 0.3
    light["visibility"], light["cast_shadow"], light["normalize"], light["use_mis"], light["max_bounces"] = (
        s.ALL_RAYS, 1, 1, 1, 1024
    )
    for name, value in fields.items():
        light[name] = value
    return light


SHAPES = {
    "sphere": lamp(s.LightKind.POINT, radius=0.4),
    "disk": lamp(s.LightKind.POINT, radius=0.4, soft_falloff=1),
    "spot": lamp(s.LightKind.SPOT, radius=0.3),
    "wide spot": lamp(s.LightKind.SPOT, radius=0.3, size=(2.0, 0.5)),
    "soft spot": lamp(s.LightKind.SPOT, radius=0.3, soft_falloff=1),
    "rectangle": lamp(s.LightKind.AREA),
    "ellipse": lamp(s.LightKind.AREA, shape=s.AreaShape.ELLIPSE),
    "spread": lamp(s.LightKind.AREA, spread=1.0),
    "sun": lamp(s.LightKind.SUN, angle=0.3),
}
# a point that every lamp shines at
BEFORE = (np.array([1, 2, 3]) - TURN[:, 2] * 2.5 + TURN[:, 0] * 0.4).astype(np.float32)


def samples(light: s.Records, p: np.ndarray, count: int, seed: int = 0) -> list[np.ndarray]:
    k, out, found = lamp_constants(light)[0], np.zeros(8, np.float32), []
    for a, b in np.random.default_rng(seed).random((count, 2), dtype=np.float32):
        if sample_lamp(k, *p, a, b, out):
            found.append(out.copy())
    return found


@pytest.mark.parametrize("name", SHAPES)
def test_a_sampled_direction_meets_the_lamp_with_the_same_density_and_radiance(name: str) -> None:
    k = lamp_constants(SHAPES[name])[0]
    found = samples(SHAPES[name], BEFORE, 200)
    assert len(found) > 150
    misses = 0
    for o in found:
        t = lamp_hit(k, *BEFORE, *o[:3], FAR)
        if t < 0:
            misses += 1  # rounding at the rim
            continue
        assert t == pytest.approx(o[3], rel=2e-3)  # a sphere's distance is the root of a small difference near its rim
        assert lamp_pdf(k, *BEFORE, *o[:3], t) == pytest.approx(o[4], rel=2e-3)
        assert lamp_share(k, *BEFORE, *o[:3]) == pytest.approx(o[5], abs=2e-3)
    assert misses <= 3


@pytest.mark.parametrize("name", SHAPES)
def test_the_density_integrates_to_one(name: str) -> None:
    """Uniform directions that meet the lamp, weighed by its density: mean 1 within five standard errors. Lamps are seen
    from near, so that many do."""
    light = SHAPES[name]
    p = (np.array([1, 2, 3]) - TURN[:, 2] * 0.7).astype(np.float32)
    k = lamp_constants(light)[0]
    d = np.random.default_rng(1).normal(size=(60000, 3))
    d = (d / np.linalg.norm(d, axis=1)[:, None]).astype(np.float32)
    axis = TURN[:, 2] if name == "sun" else np.array([1, 2, 3]) - p
    d = d[d @ axis / np.linalg.norm(axis) > 0.0]
    x = np.zeros(len(d))
    for i, w in enumerate(d):
        t = lamp_hit(k, *p, *w, FAR)
        if t >= 0:
            x[i] = lamp_pdf(k, *p, *w, t) * 2 * np.pi
    assert abs(x.mean() - 1) < 5 * x.std() / np.sqrt(len(x))


@pytest.mark.parametrize("size", [(1.0, 1.0), (3.0, 0.5), (0.0, 0.0)])
def test_the_cone_of_a_spot_is_as_wide_as_its_scale(size: tuple[float, float]) -> None:
    """As far as the tangent of half its angle times its width; a cone of no size given is round."""
    k = lamp_constants(lamp(s.LightKind.SPOT, size=size, spot_size=1.0, spot_blend=0.0))[0]
    for axis, wide in enumerate(size):
        for slope, lit in ((0.98, 1.0), (1.02, 0.0)):
            d = TURN[:, axis] * np.tan(0.5) * slope * (wide or 1.0) - TURN[:, 2]
            assert spot_falloff(k, *(d / np.linalg.norm(d)).astype(np.float32)) == lit


@pytest.mark.parametrize("kind", ["sphere", "disk", "no size"])
def test_irradiance_of_a_point_lamp_far_away(kind: str) -> None:
    """Facing it at distance d: P / (4 pi d^2)."""
    light = lamp(s.LightKind.POINT, radius=0.0) if kind == "no size" else SHAPES[kind]
    k = lamp_constants(light)[0]
    p = np.array([1, 2, 43], np.float32)
    irradiance = [o[5] * k[K_RADIANCE] / o[4] * -o[2] for o in samples(light, p, 400)]
    assert np.mean(irradiance) == pytest.approx(100 / (4 * np.pi * 40**2), rel=2e-3)


def test_an_area_lamp_radiates_its_power_whatever_its_spread() -> None:
    """Flux through the hemisphere: A x integral of L cos = P."""
    theta = (np.arange(20000) + 0.5) / 20000 * np.pi / 2
    for spread in (np.pi, 2.0, 0.6, 0.04):
        k = lamp_constants(lamp(s.LightKind.AREA, spread=spread))[0]
        share = np.array(
            [lamp_share(k, 1.0, 2.0, 3.0, *(TURN[:, 2] * np.cos(a) + TURN[:, 0] * np.sin(a))) for a in theta[::10]]
        )
        flux = (
            1.5
            * 0.7
            * k[K_RADIANCE]
            * (share * np.cos(theta[::10]) * np.sin(theta[::10])).sum()
            * (np.pi / 2 / 2000)
            * 2
            * np.pi
        )
        # few angles fall into a narrow beam
        assert flux == pytest.approx(100, rel=0.02 if spread < 0.1 else 2e-3), spread


def test_a_sun_gives_its_irradiance() -> None:
    for angle in (0.0, 0.2):
        light = lamp(s.LightKind.SUN, angle=angle, power=3.0)
        k = lamp_constants(light)[0]
        e = [o[5] * k[K_RADIANCE] / o[4] * (o[:3] @ TURN[:, 2]) for o in samples(light, BEFORE, 500)]
        assert np.mean(e) == pytest.approx(3.0, rel=1e-3)


def test_the_back_of_an_area_lamp_is_dark() -> None:
    behind = (np.array([1, 2, 3]) + TURN[:, 2]).astype(np.float32)
    assert not samples(SHAPES["rectangle"], behind, 20)
    assert lamp_hit(lamp_constants(SHAPES["rectangle"])[0], *behind, *(-TURN[:, 2]).astype(np.float32), FAR) < 0


def test_inside_of_a_lamp_all_directions_meet_it() -> None:
    k = lamp_constants(SHAPES["sphere"])[0]
    inside = np.array([1.1, 2.1, 2.9], np.float32)
    for o in samples(SHAPES["sphere"], inside, 50):
        assert lamp_hit(k, *inside, *o[:3], FAR) == pytest.approx(o[3], rel=1e-4)
        assert o[4] == pytest.approx(1 / (4 * np.pi))


def spotted_world() -> s.World:
    image = np.full((24, 48, 3), 0.05, np.float32)
    image[18, 7] = 300.0
    image[3, 30:34] = (4.0, 8.0, 2.0)
    return s.World(np.zeros(3, np.float32), image)


def test_directions_and_places_in_the_world_image_match() -> None:
    for u, v in np.random.default_rng(0).random((50, 2)):
        d = uv_direction(F(u), F(v))
        assert np.linalg.norm(d) == pytest.approx(1, abs=1e-6)
        assert direction_uv(*d) == pytest.approx((u, v), abs=2e-5)
    # core.scene.model.World: u = atan2(y, -x) / 2 pi + 0.5
    assert direction_uv(F(-1), F(0), F(0)) == pytest.approx((0.5, 0.5))
    assert direction_uv(F(0), F(1), F(0)) == pytest.approx((0.75, 0.5))
    assert direction_uv(F(0), F(0), F(1))[1] == pytest.approx(1.0)


def test_world_samples_follow_their_density() -> None:
    e = build_environment(spotted_world())
    assert e is not None
    h, w = e.image.shape[:2]
    a, b = np.uint64(address(e.marginal)), np.uint64(address(e.conditional))
    u = np.random.default_rng(1).random((20000, 2), dtype=np.float32)
    places = np.zeros((len(u), 2))
    for i, x in enumerate(u):
        dx, dy, dz, pdf = sample_environment(a, b, w, h, *x)
        places[i] = direction_uv(dx, dy, dz)
        if i < 300:
            # near the poles the cosine is small and rounded
            assert environment_pdf(a, b, w, h, dx, dy, dz) == pytest.approx(pdf, rel=0.02)
    share = np.diff(e.marginal)[:, None] * np.diff(e.conditional, axis=1)
    bins = share.reshape(12, 2, 24, 2).sum((1, 3)).ravel() * len(u)
    observed = np.histogram2d(places[:, 1], places[:, 0], bins=(12, 24), range=[[0, 1], [0, 1]])[0].ravel()
    rare = bins < 5
    assert (
        stats.chisquare(
            np.append(observed[~rare], observed[rare].sum()),
            np.append(bins[~rare], bins[rare].sum() + 1e-3),
            sum_check=False,
        ).pvalue
        > 1e-4
    )


def test_world_density_integrates_to_one() -> None:
    e = build_environment(spotted_world())
    assert e is not None
    h, w = e.image.shape[:2]
    a, b = np.uint64(address(e.marginal)), np.uint64(address(e.conditional))
    v, u = np.meshgrid((np.arange(4 * h) + 0.5) / (4 * h), (np.arange(4 * w) + 0.5) / (4 * w), indexing="ij")
    total = 0.0
    for x, y in zip(u.ravel(), v.ravel(), strict=True):
        d = uv_direction(F(x), F(y))
        total += environment_pdf(a, b, w, h, *d) * np.cos((y - 0.5) * np.pi)
    assert total * np.pi / (4 * h) * 2 * np.pi / (4 * w) == pytest.approx(1, rel=1e-3)


def test_world_lookup_interpolates_and_wraps() -> None:
    e = build_environment(spotted_world())
    assert e is not None
    image = np.uint64(address(e.image))
    assert environment_radiance(image, 48, 24, *uv_direction(F(7.5 / 48), F(18.5 / 24))) == pytest.approx(
        (300, 300, 300), rel=1e-3
    )
    middle = environment_radiance(image, 48, 24, *uv_direction(F(8.0 / 48), F(18.5 / 24)))
    assert middle == pytest.approx((150.025,) * 3, rel=1e-3)
    across = environment_radiance(image, 48, 24, *uv_direction(F(1e-4), F(0.5)))
    assert across == pytest.approx((0.05,) * 3, rel=1e-4)


def test_a_constant_world_is_not_sampled() -> None:
    assert build_environment(s.World(np.ones(3, np.float32))) is None
    assert build_environment(s.World(np.ones(3, np.float32), np.zeros((2, 4, 3), np.float32))) is None


def glowing(strength: float) -> s.Records:
    m = s.default_material()
    m["shader"], m["emission"] = s.Shader.EMISSION, strength
    return m


def test_emissive_instances_are_found_by_material_and_seen_by_rays() -> None:
    off = glowing(2.0)
    off["mis_emission"] = 0
    flags = np.array([31, 31, 31, 1 << s.RayType.CAMERA], np.uint8)
    placement = [(0, scenes.placed((i, 0, 0)), m) for i, m in enumerate((0, 1, 2, 1))]
    scene = scenes.build([scenes.quad()], placement, [s.default_material(), glowing(3.0), off], flags=flags)
    assert emissive_instances(scene).tolist() == [1]
    lights = Lights(scene)
    assert lights.emissive.tolist() == [1]
    assert Lights(scene, np.zeros(0, np.int64)).emissive.tolist() == []


def test_many_emitters_share_their_distribution() -> None:
    placement = [(0, scenes.placed((3.0 * i, 0, 0), 1.0 + 0.1 * i), 0) for i in range(50)]
    lights = Lights(scenes.build([scenes.sphere(8)], placement, [glowing(1.0)]))
    assert len(lights.emissive) == 50 and len(lights.nodes) == 99 and len(lights.meshes) == 1


@pytest.mark.parametrize("broken", [np.inf, -np.inf, np.nan])
def test_one_broken_pixel_of_a_world_poisons_nothing(broken: float) -> None:
    """It gives no light, as in Cycles, which drops such paths; the others are sampled as without it."""
    image = np.random.default_rng(0).random((8, 16, 3), np.float32)
    dark = image.copy()
    image[3, 5, 1], dark[3, 5, 1] = broken, 0
    found, wanted = (build_environment(s.World(np.zeros(3, np.float32), each)) for each in (image, dark))
    assert found is not None and wanted is not None
    for name in ("image", "marginal", "conditional"):
        assert (getattr(found, name) == getattr(wanted, name)).all(), name
