"""Shadows from paths and raster together, and the light that paths bring to a raster's hits: known answers."""

import dataclasses

import numpy as np
import pytest

from lipac.core.accel.blas import BlasCache
from lipac.core.accel.hitboxes import Hitboxes
from lipac.core.accel.tlas import Tlas
from lipac.core.culling.loop import Loop
from lipac.core.culling.options import CullOptions
from lipac.core.culling.result import CullingResult
from lipac.core.errors import InputError
from lipac.core.hybrid.composition import (
    Light,
    added,
    boxes_before_lamps,
    in_question,
    mixture,
    reference,
    share_of_paths,
    with_mode,
)
from lipac.core.hybrid.modes import MODES
from lipac.core.scene import model as s
from lipac.core.scene.film import LUMINANCE
from lipac.core.tracing.tracer import prepare, trace

from ..scenes import build, cube, lamp, look_at, material, placed, quad, sphere
from .test_first_hits import NEEDLE, SIZE, first_hits, mixed


def light(scene: s.Scene, keep: np.ndarray | list[bool] | None = None, samples: int = 8, **options: object) -> Light:
    """Light of one pass at pixel centres, with keep (N,) bool built; boxes of instances stand for the rest."""
    active = np.ones(len(scene.instances), bool) if keep is None else np.asarray(keep)
    blas = BlasCache(scene.meshes)
    blas.need(scene.instances.mesh[active])
    one = dataclasses.replace(scene, first_hits={SIZE: first_hits(scene)})
    prepared = prepare(one, blas).with_emitters(active)
    boxes = Hitboxes(scene.instances.bounds[~active])
    return Light.of(trace(prepared, Tlas(scene.instances, blas, active), samples, boxes=boxes, **options))  # type: ignore[arg-type]


def picture(of: Light, visible: np.ndarray | None = None) -> np.ndarray:
    return of.straight + of.lamps(visible) + of.indirect


def centred(scene: s.Scene) -> s.Scene:
    return dataclasses.replace(scene, film=dataclasses.replace(scene.film, filter_width=NEEDLE))


def shadowed(height: float = 2.0) -> s.Scene:
    """Ground below a blocker below a point lamp, seen from the side; no other light."""
    lights = lamp(s.LightKind.POINT, (0, 0, 2 * height), radius=0.0)
    placement = [(0, placed((0, 0, 0), 12.0), 0), (1, placed((0, 0, height), (1.0, 1.0, 0.1)), 0)]
    return centred(
        build(
            [quad(), cube()],
            placement,
            [material(base_color=0.8)],
            look_at((0, -9, 5), (0, 0, 0.5)),
            lights,
            world=(0, 0, 0),
            size=SIZE,
        )
    )


def test_white_furnace():
    """Surfaces that absorb nothing under a sky of 1 look like 1, whichever of them are built: energy is neither made
    nor lost. A path's Russian roulette never ends it, so what is missing from 1 is what many bounces between the
    spheres have not brought out yet: a share that the limit of 64 bounces makes tiny."""
    white = material(base_color=1.0)
    limits = s.PathLimits(64, 64, 64, 64)
    placement = [(0, placed((x, 0, 0), 0.9), 0) for x in (-1.0, 1.0)]
    scene = centred(
        build(
            [sphere(12)], placement, [white], look_at((0, -6, 1), (0, 0, 0)), world=(1, 1, 1), size=SIZE, limits=limits
        )
    )
    for keep in ([True, True], [True, False], [False, False]):
        seen = picture(light(scene, keep, 16))
        assert abs(seen.mean() - 1.0) < 2e-3
        assert np.abs(seen - 1.0).max() < 0.3  # one path of 16 that got lost


def test_unculled_is_traced():
    """With everything built nothing is in doubt: the raster's shadows, here none at all and full ones, change
    nothing."""
    all_of_it = light(mixed())
    assert (all_of_it.maybe == 0).all()
    for visible in (0.0, 1.0):
        np.testing.assert_array_equal(all_of_it.lamps(np.full(SIZE[::-1], visible, np.float32)), all_of_it.clear)


def test_blocker_built_or_culled():
    """A shadow that is traced, and one that the raster knows, are the same; without either the light arrives."""
    scene = shadowed()
    traced = light(scene)
    ground = first_hits(scene).hits["instance"] == 0
    dark = ground & (traced.clear.sum(axis=2) == 0)
    assert 20 < dark.sum() < 0.5 * ground.sum()
    visible = np.where(dark, 0.0, 1.0).astype(np.float32)
    culled = light(scene, [True, False])
    assert culled.clear[dark].max() == 0 and culled.maybe[dark].min() > 0
    # The blocker's own pixels are left out: which of its sides are lit is for a raster to say, and `dark` is about the
    # ground.
    np.testing.assert_allclose(culled.lamps(visible)[ground], traced.lamps(None)[ground], atol=1e-6)
    assert culled.lamps(None)[dark].min() > 0.1 * traced.clear[ground].max()


def test_raster_decides_only_over_what_is_in_doubt():
    """Where no box of what is culled lies on the way to the lamp, a raster that says dark is wrong, and is not
    asked."""
    scene = shadowed()
    ground = first_hits(scene).hits["instance"] == 0
    culled = light(scene, [True, False])
    free = ground & (culled.maybe.sum(axis=2) == 0)
    assert free.sum() > 100
    black = np.zeros(SIZE[::-1], np.float32)
    assert culled.lamps(black)[free].min() > 0
    assert culled.lamps(black)[ground & ~free].max() == 0


@pytest.mark.parametrize("known", [True, False])
def test_analysis_weighs_what_the_picture_loses(known):
    """Light of lamps at first hits whose shadows the raster knows is not lost with its blocker: no weight, and no part
    of what a trial compares. The light of the other bounces is, as without a raster."""
    limits = s.PathLimits(total=1, diffuse=1)
    scene = dataclasses.replace(shadowed(), limits=limits)
    size = CullOptions().picture_size(scene.film)
    hits = dataclasses.replace(first_hits(scene), lamps_known=known)
    loop = Loop(dataclasses.replace(scene, first_hits={size: hits}), CullOptions(paths=16))
    loop.ambient = 0.05  # as rounds would find it, about
    measured = loop.measure(loop.tracer.build(np.ones(2, bool)))
    traced = light(scene, samples=measured.log.shape[2])
    lamps, rest = (float((x @ LUMINANCE).mean()) for x in (traced.clear, traced.indirect))
    assert lamps > 3 * rest > 0
    # The same paths, so the same sums but for the order in which single precision adds them.
    assert measured.log.luminance.mean() == pytest.approx(rest if known else lamps + rest, rel=1e-4)
    assert measured.weights.total.sum() * measured.weights.unit / measured.log.luminance.size == pytest.approx(
        lamps + rest, rel=1e-3
    )
    blocker = int(np.flatnonzero(measured.tlas.ids == 1)[0])
    denied = measured.weights.light[blocker].sum() * measured.weights.unit / measured.log.luminance.size
    # what comes through without it
    unblocked = float((light(scene, [True, False], measured.log.shape[2]).maybe @ LUMINANCE).mean())
    assert denied < 0.5 * unblocked if known else denied > 0.5 * unblocked


def test_boxes_of_shadowers():
    """Every culled instance that can keep light off has a box of its own or shares one, and no other has; sharing is of
    neighbours."""
    rng = np.random.default_rng(3)
    low = rng.uniform(-50, 50, (1000, 3)).astype(np.float32)
    bounds = np.stack([low, low + 1], axis=1)
    bounds[7] = [[1, 1, 1], [-1, -1, -1]]  # a mesh without triangles
    blocks = np.ones(1000, bool)
    blocks[13] = False
    alone = boxes_before_lamps(bounds, blocks)
    assert len(alone) == 998
    shared = boxes_before_lamps(bounds, blocks, most=100)
    assert len(shared) <= 100
    inside = (shared[None, :, 0] <= alone[:, None, 0]).all(axis=2) & (alone[:, None, 1] <= shared[None, :, 1]).all(
        axis=2
    )
    assert inside.any(axis=1).all()
    volume = np.prod(shared[:, 1] - shared[:, 0], axis=1).mean()
    assert volume < 0.1 * (100 * 9 / 11) ** 3  # of the box of ten that lie anywhere


def test_everything_culled_is_the_raster():
    """Where every lamp's light crosses boxes, its share that arrives is the raster's, whatever that is."""
    scene = shadowed()
    box = Hitboxes(np.array([[[-20, -20, -1], [20, 20, 3.5]]], np.float32))
    one = dataclasses.replace(scene, first_hits={SIZE: first_hits(scene)})
    blas = BlasCache(scene.meshes)
    nothing = Tlas(scene.instances, blas, np.zeros(2, bool))
    of = Light.of(trace(prepare(one, blas), nothing, 4, boxes=box))
    assert (of.clear == 0).all()
    visible = np.linspace(0, 1, SIZE[0] * SIZE[1], dtype=np.float32).reshape(SIZE[::-1])
    np.testing.assert_allclose(of.lamps(visible), visible[..., None] * of.maybe, rtol=1e-5, atol=1e-7)


def test_mirror_shows_what_is_built():
    """A mirror's pixels show the traced scene, known colours each, and do not change by a bit however much is culled
    that it does not show."""
    mirror, red, blue = (
        material(s.Shader.GLOSSY, base_color=1.0, roughness=0.0),
        material(s.Shader.EMISSION, emission=(1, 0, 0)),
        material(base_color=0.5),
    )
    facing = np.array([[4, 0, 0, 0], [0, 0, -4, 3], [0, 4, 0, 1]], np.float32)  # a wall at y = 3, normal -Y
    placement = [(0, facing, 0), (1, placed((0, -7, 1), 1.5), 1), (1, placed((0, 8, 1)), 2), (1, placed((30, 0, 1)), 2)]
    scene = centred(
        build(
            [quad(), sphere(12)],
            placement,
            [mirror, red, blue],
            look_at((0, -5, 1), (0, 3, 1)),
            world=(0.1, 0.2, 0.3),
            size=SIZE,
        )
    )
    seen = first_hits(scene).hits["instance"] == 0
    everything, shown = picture(light(scene)), picture(light(scene, [False, True, False, False]))
    np.testing.assert_array_equal(everything[seen], shown[seen])
    reflected = np.abs(shown - (1, 0, 0)).max(axis=2) < 1e-5
    assert (reflected & seen).sum() > 20
    sky = np.abs(shown - (0.1, 0.2, 0.3)).max(axis=2) < 1e-5
    assert (seen & ~sky & ~reflected).sum() == 0


def test_interior_lit_by_bounce():
    """A floor under a lid, the lamp beside it: light comes by way of the ground alone. The mean is the path tracer's,
    to 4 standard errors of the pixels' differences: a tenth of it."""
    walls = [(0, placed((0, 0, 0), 14.0), 0), (1, placed((0, 0, 1.2), (4.0, 4.0, 0.1)), 0)]
    lights = lamp(s.LightKind.SPOT, (5, 0, 4), radius=0.05, spot_size=1.2, power=800.0)
    scene = centred(
        build(
            [quad(), cube()],
            walls,
            [material(base_color=0.8)],
            look_at((0, -6, 0.5), (0, 0, 0.4), 0.2),
            lights,
            world=(0, 0, 0),
            size=SIZE,
        )
    )
    of = light(scene, samples=256)
    under = first_hits(scene).hits["instance"] == 0
    hidden = under & (of.clear.sum(axis=2) == 0)
    assert hidden.sum() > 50
    blas = BlasCache(scene.meshes)
    blas.need(scene.instances.mesh)
    paths = trace(prepare(scene, blas), Tlas(scene.instances, blas, np.ones(2, bool)), 256, first_sample=256).mean[
        ..., 0
    ]
    difference = of.indirect[..., 0][hidden] - paths[hidden]
    error = difference.std() / np.sqrt(hidden.sum())
    assert 4 * error < 0.15 * paths[hidden].mean()
    assert abs(difference.mean()) < 4 * error


@pytest.mark.parametrize("mode", MODES[:3])
def test_modes(mode):
    """What a mode traces: sky and emitters light diffuse surfaces in all, mirrors reflect in all; light from a second
    surface comes only by way of a bounce."""
    scene = with_mode(mixed(), mode)
    assert (scene.limits.diffuse == 0) == (mode == "reflections")
    of = light(scene, samples=16)
    full = light(mixed(), samples=16)
    hits = first_hits(scene).hits["instance"]
    assert of.indirect[hits == 0].mean() > 0.1
    assert of.indirect[hits == 1].mean() > 0.1
    assert of.indirect.mean() <= full.indirect.mean() * 1.02
    if mode != "path":
        assert of.indirect[hits == 0].mean() < 0.98 * full.indirect[hits == 0].mean()


def test_mode_unknown():
    with pytest.raises(InputError, match="unknown global illumination 'radiosity'"):
        with_mode(mixed(), "radiosity")


def test_sums_of_passes():
    """Two traces of half the samples are added to what one of all would be, to the order in which single precision
    adds."""
    scene = centred(mixed())
    blas = BlasCache(scene.meshes)
    blas.need(scene.instances.mesh)
    prepared = prepare(dataclasses.replace(scene, first_hits={SIZE: first_hits(scene)}), blas)
    tlas, boxes = (
        Tlas(scene.instances, blas, np.ones(len(scene.instances), bool)),
        Hitboxes(np.zeros((0, 2, 3), np.float32)),
    )
    first, second, both = (trace(prepared, tlas, n, start, boxes=boxes) for n, start in ((3, 0), (5, 3), (8, 0)))
    rays = first.rays + second.rays
    total = added(added(None, first), second)
    assert (total.samples, total.rays, total.paths) == (8, rays, both.paths)
    a, b = Light.of(total), Light.of(both)
    for name in ("clear", "indirect", "sampled", "alpha"):
        np.testing.assert_allclose(getattr(a, name), getattr(b, name), rtol=1e-4, atol=1e-5)


SHARES = np.linspace(0, 1, 41)


def panel(rng: np.random.Generator, size: tuple[int, int] = (36, 64)) -> np.ndarray:
    """A picture (4 h, 4 w, 3) of cells with light of their own."""
    return (
        np.kron(rng.uniform(0.2, 1.0, (size[0] // 4, size[1] // 4)), np.ones((16, 16)))[..., None]
        .repeat(3, axis=2)
        .astype(np.float32)
    )


def seen(true: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """One path per pixel of a quarter of the size: as noisy as the truth it stands for is bright."""
    return (true[::4, ::4, 0] * rng.exponential(1.0, (true.shape[0] // 4, true.shape[1] // 4))).astype(np.float32)


def test_share_of_two_pictures():
    """A picture that is nearly the truth is shown all but whole, a raster that is is shown alone, for all the noise of
    the truth; of equals it is the same."""
    rng = np.random.default_rng(5)
    true = panel(rng)
    near, far = (
        true * 1.02,
        true * rng.uniform(0.3, 2.0, (36, 64)).repeat(4, 0).repeat(4, 1)[..., None].astype(np.float32),
    )
    assert share_of_paths(seen(true, rng), near, far) > 0.9
    assert share_of_paths(seen(true, rng), far, near) == 0.0
    assert share_of_paths(seen(true, rng), near, near) == 1.0


def test_share_is_never_worse_than_the_raster():
    """Whatever the picture and the raster are off by, the mixture's error is at most the raster's: always where the
    truth is free of noise; with the noise of one path per pixel in all but what two standard errors leave, 2.3 %: of
    200 cases at most 12, which is three standard deviations more than 4.6."""
    rng = np.random.default_rng(6)
    worse = {"exact": 0, "noisy": 0}
    for _ in range(200):
        true = panel(rng)
        amounts = rng.uniform(0, 0.6, 2)
        picture, raster = (
            true * (1 + a * np.kron(rng.normal(size=(9, 16)), np.ones((16, 16))))[..., None].astype(np.float32)
            for a in amounts
        )
        for name, truth in (("exact", true[::4, ::4, 0]), ("noisy", seen(true, rng))):
            shown = mixture(picture, raster, share_of_paths(truth, picture, raster))
            errors = [
                float(((p[..., 0] - true[..., 0]) ** 2 / (true[..., 0] ** 2 + 0.01)).mean()) for p in (shown, raster)
            ]
            worse[name] += errors[0] > errors[1] * 1.001
    assert worse["exact"] <= 2  # whose weights are those of cells around
    assert worse["noisy"] <= 12


def test_share_follows_what_changes():
    """A picture that gets worse from frame to frame, as more is culled: what is shown goes over to the raster by a
    fraction, each frame, of what the two differ by; a choice between them would jump by all of it."""
    rng = np.random.default_rng(7)
    true = panel(rng)
    raster = true * 1.3
    off = np.kron(rng.normal(size=(9, 16)), np.ones((16, 16)))[..., None].astype(np.float32)
    truth = seen(true, rng)
    pictures = [true * (1 + np.float32(amount) * off) for amount in SHARES]
    shares = [share_of_paths(truth, picture, raster) for picture in pictures]
    assert shares[0] > 0.9 and shares[-1] < 0.3
    assert np.abs(np.diff(shares)).max() < 8 * SHARES[1]
    shown = np.array([mixture(picture, raster, share) for picture, share in zip(pictures, shares, strict=True)])
    steps = np.abs(np.diff(shown, axis=0)).mean(axis=(1, 2, 3))
    apart = np.abs(pictures[20] - raster).mean()
    assert steps.max() < 0.25 * apart


def test_question():
    """What changed little by measurement, or culled nothing, needs no comparison; what nobody measured does; between
    them there is no step."""
    one = np.zeros(1)

    def result(boxes: int, **stats: float) -> CullingResult:
        return CullingResult(one, one, one, np.zeros((boxes, 2, 3), np.float32), stats)  # type: ignore[arg-type]

    assert in_question(result(0)) == in_question(result(3, certified_mean=0.01)) == 0
    assert in_question(result(3)) == in_question(result(3, certified_mean=0.2)) == 1
    between = [in_question(result(3, certified_mean=change)) for change in np.linspace(0.015, 0.035, 41)]
    assert 0 < max(np.diff(between)) < 0.06


def test_reference_is_the_picture_with_everything():
    """The truth of the comparison is the path tracer's picture, though nothing was built before: means agree within 4
    standard errors of its paths."""
    scene = mixed()
    seen = reference(scene, CullOptions(policy="distance", setting=0.0, paths=16), lambda: False)
    blas = BlasCache(scene.meshes)
    blas.need(scene.instances.mesh)
    full = (
        trace(prepare(scene, blas), Tlas(scene.instances, blas, np.ones(len(scene.instances), bool)), 64).mean[..., :3]
        @ LUMINANCE
    )
    assert seen.shape == full.shape
    assert abs(seen.mean() - full.mean()) < 4 * np.hypot((seen - full).std(), full.std() / 8) / np.sqrt(seen.size)
