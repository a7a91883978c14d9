"""Materials that consist of others: by shares, and by what sees them."""

from __future__ import annotations

import numpy as np
import pytest

from lipac.core.accel.blas import BlasCache
from lipac.core.accel.tlas import Tlas
from lipac.core.culling.analysis import analyze
from lipac.core.culling.options import CullOptions
from lipac.core.feedback.hits import Feedback, Weights
from lipac.core.scene import model as s
from lipac.core.scene.model import RayType, Shader
from lipac.core.tracing.tracer import prepare, trace

from ..scenes import build, cube, lamp, look_at, material, placed, quad, render

DOWN = look_at((0, 0, 10), (0, 0, 0), 0.05, 1.0)  # at a square of 1 m from above
CLEAR = material(Shader.TRANSPARENT, base_color=1.0)


def bit(*views: int, back: bool = False) -> int:
    """Of `rays`."""
    return sum(1 << (view + (s.VIEWS if back else 0)) for view in views)


def composed(shader: Shader, first: int, second: int, **fields: object) -> s.Records:
    return material(shader, parts=(first, second), **fields)


def seen(materials: list[s.Records], samples: int = 64, **scene: object) -> np.ndarray:
    """Mean colour of a square of 4 m with material 0 over one of 8 m, 2 m below it, with material 1, from above, under
    a white sky."""
    placement = [(0, placed((0, 0, 0), 4.0), 0), (0, placed((0, 0, -2), 8.0), 1)]
    options: dict[str, object] = {"camera": DOWN, "size": (32, 32), "limits": s.PathLimits(total=0)}
    built = build([quad()], placement, materials, **(options | scene))  # type: ignore[arg-type]
    return np.asarray(render(built, samples).mean[..., :3].mean((0, 1)))


def test_shares_are_means() -> None:
    """A MIX shows the mean of its parts, also where these are mixes, or let through to what lies behind."""
    red, green, blue = (material(Shader.EMISSION, emission=c) for c in np.eye(3))
    inner = composed(Shader.MIX, 4, 5, alpha=0.5, emission=1.0)
    mix = composed(Shader.MIX, 2, 3, alpha=0.75, emission=1.0)
    color = seen([mix, blue, red, inner, green, CLEAR])
    np.testing.assert_allclose(color, [0.25, 0.375, 0.375], atol=0.01)


def test_light_of_a_mix_is_its_mean() -> None:
    """Light sampling, hits of its triangles, and both together agree on what a mix of emissions sheds."""
    bright, dark = material(Shader.EMISSION, emission=8.0), material(Shader.EMISSION, emission=0.0)
    mix = composed(Shader.MIX, 2, 3, alpha=0.75, emission=8.0)
    plain = material(Shader.EMISSION, emission=2.0)
    placement = [(0, placed((0, 0, 0), 8.0), 0), (0, placed((5.2, 0, 2), 3.0), 1)]
    grey = material(Shader.DIFFUSE, base_color=0.5)
    pictures = []
    for records, strategy in (
        ([grey, plain], 0),
        ([grey, mix, bright, dark], 0),
        ([grey, mix, bright, dark], 1),
        ([grey, mix, bright, dark], 2),
    ):
        scene = build(
            [quad()],
            placement,
            records,
            look_at((0, 0, 10), (0, 0, 0), 0.3, 1.0),
            world=(0, 0, 0),
            size=(32, 32),
            limits=s.PathLimits(total=1),
        )
        pictures.append(render(scene, 256, strategy=strategy).mean[..., 0].mean())
    np.testing.assert_allclose(pictures[1:], pictures[0], rtol=0.03)


@pytest.mark.parametrize("back", [False, True])
def test_a_side_sees_its_part(back: bool) -> None:
    """The front shows one part, the back the other, whichever way the square is turned."""
    red, green = (material(Shader.EMISSION, emission=c) for c in np.eye(3)[:2])
    turn = placed((0, 0, 0), (4.0, 4.0, 4.0))
    turn[:, :3] = np.diag([4.0, -4.0, -4.0]) if back else turn[:, :3]
    by_side = composed(Shader.BY_RAY, 1, 2, rays=bit(*range(s.VIEWS), back=True), emission=1.0)
    scene = build([quad()], [(0, turn, 0)], [by_side, red, green], DOWN, size=(8, 8), limits=s.PathLimits(total=0))
    np.testing.assert_allclose(render(scene, 4).mean[4, 4, :3], [0, 1, 0] if back else [1, 0, 0])


def test_a_ray_sees_its_part() -> None:
    """What is clear to camera rays alone shows what lies behind, and shades it; what is clear to shadow rays too, on
    their side, lets light pass."""
    white = material(Shader.DIFFUSE, base_color=1.0)
    sun = lamp(s.LightKind.SUN, power=1.0)
    options: dict[str, object] = {"lights": sun, "world": (0, 0, 0)}
    lit = seen([CLEAR, white], 4, **options)[0]
    assert lit > 0.2
    for rays, expected in (
        (bit(RayType.CAMERA), 0.0),
        (bit(RayType.CAMERA, RayType.SHADOW), 0.0),  # shadow rays come from below
        (bit(RayType.CAMERA) | bit(RayType.SHADOW, back=True), lit),
    ):
        veil = [composed(Shader.BY_RAY, 2, 3, rays=rays), white, material(Shader.EMISSION), CLEAR]
        np.testing.assert_allclose(seen(veil, 4, **options)[0], expected, rtol=1e-5)


def test_what_shows_through_the_unsure_is_kept() -> None:
    """Behind something of which nobody knows how clear it is all that paths see stays, whatever it is worth; behind
    glass of known clarity it may go."""
    dim = material(Shader.DIFFUSE, base_color=0.001)
    kept = {}
    for unsure in (0, 1):
        veil = composed(Shader.MIX, 2, 3, alpha=0.5)
        opaque, clear = material(Shader.DIFFUSE, base_color=1.0), CLEAR.copy()
        opaque["unsure"] = clear["unsure"] = unsure
        placement = [
            (1, placed((0, 0, 0), 4.0), 0),
            (1, placed((0, 0, -6), 40.0), 1),
            (0, placed((0.2, 0, -5.9), 0.1), 1),
        ]
        scene = build([cube(), quad()], placement, [veil, dim, opaque, clear], DOWN, size=(64, 64))
        kept[unsure] = analyze(scene, CullOptions(seed=1)).active
    assert not kept[0][2]
    assert kept[1].all()


def veiled(count: int, *more: tuple[int, np.ndarray, int], **options: object) -> s.Scene:
    """So many sheets of 4 m, one above the other, of which it is not known whether they are there, over a ground that
    is dark; more instances of materials 0 (the ground's) and 2 (white)."""
    veil, solid, clear = (
        composed(Shader.MIX, 3, 4, alpha=0.5), material(Shader.DIFFUSE, base_color=1.0), CLEAR.copy()
    )
    solid["unsure"] = clear["unsure"] = s.Unsure.BEHIND | s.Unsure.CLEAR
    dark, white = material(Shader.DIFFUSE, base_color=0.2), material(Shader.DIFFUSE, base_color=0.8)
    sheets = [(0, placed((0, 0, 0.1 * k), 4.0), 1) for k in range(count)]
    return build(
        [quad(), cube()],
        [(0, placed((0, 0, -6), 40.0), 0), *sheets, *more],
        [dark, veil, white, solid, clear],
        **options,  # type: ignore[arg-type]
    )


def test_behind_many_that_may_not_be_there_all_is_kept() -> None:
    """What is behind thirty sheets is met, though one path in 2^30 would pass if half passed each; and all of them
    are kept, for each may be the only one that is there."""
    thing = (1, placed((0.2, 0, -5.9), 0.1), 2)
    scene = veiled(30, thing, camera=DOWN, size=(64, 64), limits=s.PathLimits(transparent=64))
    assert analyze(scene, CullOptions(seed=1)).active.all()


def test_what_may_shade_is_kept() -> None:
    """Light passes all that may not be there, so what shades below counts with all of it; and each of them may be what
    shades, so each is kept, which what is there anyway is not."""
    camera = look_at((0, 0, -2), (0, 0, -6), 0.7, 1.0)
    roof = (1, placed((0.5, 0.5, -5), (1.0, 1.0, 0.1)), 2)
    far = (1, placed((19, 19, -5), 0.01), 2)
    lit = {"lights": lamp(s.LightKind.SUN, power=1.0), "world": (0, 0, 0), "limits": s.PathLimits(transparent=64)}
    scene = veiled(12, roof, far, camera=camera, size=(64, 64), **lit)
    assert analyze(scene, CullOptions(seed=1)).active.tolist() == [True] * 14 + [False]


def test_determinism() -> None:
    """One and several threads give the same picture and weights."""
    placement = [(1, placed((0, 0, 0), 4.0), 0), (0, placed((0, 0, -1), 1.0), 1)]
    records = [composed(Shader.MIX, 1, 2, alpha=0.5), material(Shader.DIFFUSE), CLEAR]
    scene = build([cube(), quad()], placement, records, DOWN, size=(48, 48))
    blas = BlasCache(scene.meshes)
    blas.need(scene.instances.mesh)
    tlas = Tlas(scene.instances, blas, np.ones(2, bool))
    results = []
    for threads in (1, 4):
        feedback = Feedback.zeros(2, weights=Weights.zeros(2, 1.0))
        picture = trace(prepare(scene, blas), tlas, 4, feedback=feedback, threads=threads)
        assert feedback.weights is not None
        results.append((picture.sums, feedback.weights.light))
    for a, b in zip(*results, strict=True):
        np.testing.assert_array_equal(a, b)
