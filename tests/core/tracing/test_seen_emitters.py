"""What the camera sees of small emitters, against closed forms and against paths from the camera."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from lipac.core.accel.blas import BlasCache
from lipac.core.accel.tlas import Tlas
from lipac.core.feedback.tiles import TILES, tile_means
from lipac.core.scene import model as s
from lipac.core.tracing.seen_emitters import POINTS, SMALL, SeenEmitters, polished, seen_emitters
from lipac.core.tracing.tracer import prepare, trace

from .. import scenes
from ..scenes import material

SIZE = (160, 90)
RADIANCE = 700.0
SIDE = 0.004  # of an emitter, metres: 0.1 pixels at 4 metres
PERSPECTIVE = scenes.look_at((0, -4, 0), (0, 0, 0))
ORTHOGRAPHIC = dataclasses.replace(PERSPECTIVE, frame=np.array([-1.6, 1.6, -0.9, 0.9]), orthographic=True)
WALL, GLASS, GLOW, ONE_SIDED = range(4)


def facing(x: float, z: float, y: float = 0.0, side: float = SIDE) -> np.ndarray:
    """A square at (x, y, z) whose front looks at a camera on -Y."""
    return np.array([[side, 0, 0, x], [0, 0, -side, y], [0, side, 0, z]], float)


def scene(extra: list[tuple[int, np.ndarray, int]], camera: s.Camera = PERSPECTIVE) -> s.Scene:
    """Before a large wall of albedo 0.5 under a dim sky."""
    one_sided = material(s.Shader.EMISSION, emission=RADIANCE)
    one_sided["single_sided_emission"] = 1
    materials = [
        material(base_color=0.5),
        material(s.Shader.GLASS),
        material(s.Shader.EMISSION, emission=RADIANCE),
        one_sided,
    ]
    wall = (0, facing(0, 0, 3, 60), WALL)
    return scenes.build(
        [scenes.quad()], [wall, *extra], materials, camera, None, (0.2, 0.2, 0.2), SIZE, s.PathLimits(total=0)
    )


def seen(built: s.Scene) -> SeenEmitters:
    blas = BlasCache(built.meshes)
    everything = np.ones(len(built.instances), bool)
    blas.need(built.instances.mesh)
    size = (built.film.width, built.film.height)
    return seen_emitters(prepare(built, blas), Tlas(built.instances, blas, everything), size)


def of_tiles(found: SeenEmitters, first: int = 1, last: int = 1000) -> np.ndarray:
    """(T,) red, of some instances."""
    keep = np.ones(1000, bool)
    keep[first:last] = False
    return found.without(keep)[:, 0]


def pixels(camera: s.Camera, side: float, distance: float) -> float:
    """That a square before the middle of the picture takes."""
    across = (camera.frame[1] - camera.frame[0]) * (1 if camera.orthographic else distance)
    return float((side / across * SIZE[0]) ** 2)


@pytest.mark.parametrize("camera", [PERSPECTIVE, ORTHOGRAPHIC], ids=["perspective", "orthographic"])
@pytest.mark.parametrize("one_sided", [False, True])
def test_a_speck_is_as_bright_as_its_area_on_the_picture(camera: s.Camera, one_sided: bool) -> None:
    found = seen(scene([(0, facing(0.02, 0.02), ONE_SIDED if one_sided else GLOW)], camera))
    expected = RADIANCE * pixels(camera, SIDE, 4) / (SIZE[0] * SIZE[1] / TILES)
    assert len(found) == 1
    assert found.instance[0] == 1
    assert of_tiles(found).sum() == pytest.approx(expected, rel=0.02)  # its points are at angles of up to 0.3 degrees


def test_of_a_one_sided_speck_the_back_is_dark() -> None:
    turned = facing(0, 0)
    turned[:, 0] *= -1
    assert not len(seen(scene([(0, turned, ONE_SIDED)])))
    assert len(seen(scene([(0, turned, GLOW)])))


def test_paths_from_the_camera_find_the_same_in_every_tile() -> None:
    """Twenty specks of up to two pixels, some half behind a strip of wall, by 500 paths per pixel."""
    rng = np.random.default_rng(1)
    x, z = rng.uniform(-1.4, 1.4, 20), rng.uniform(-0.7, 0.7, 20)
    specks = [
        (0, facing(a, b, 0.0, side), GLOW)
        for a, b, side in zip(x.tolist(), z.tolist(), rng.uniform(0.01, 0.08, 20).tolist(), strict=True)
    ]
    strips = [(0, facing(a, 0.0, -0.1, 0.02) * [[1], [1], [100]], WALL) for a in x[:5].tolist()]
    built = scene([*specks, *strips])
    assert SMALL > 4
    blas = BlasCache(built.meshes)
    blas.need(built.instances.mesh)
    means = []
    for flags in (31, 0):  # with the specks, and without
        instances = built.instances
        instances = dataclasses.replace(instances, flags=instances.flags.copy())
        instances.flags[1:21] = flags
        shown = dataclasses.replace(built, instances=instances)
        tlas = Tlas(instances, blas, np.ones(len(instances), bool))
        means.append(tile_means(trace(prepare(built, blas).with_instances(shown.instances), tlas, 500).mean))
    found = of_tiles(seen(built), 1, 21)  # white
    traced = means[0] - means[1]
    assert traced.max() > 1
    # of POINTS[1] points on each speck, and of 50,000 paths per tile
    noise = 4 * RADIANCE * np.sqrt(2.0 / 50_000) + 4 * traced / np.sqrt(POINTS[1])
    assert (np.abs(found - traced) <= noise).all()


@pytest.mark.parametrize(("before", "visible"), [(WALL, False), (GLASS, True)])
def test_what_is_surely_opaque_hides_a_speck_and_glass_does_not(before: int, visible: bool) -> None:
    built = scene([(0, facing(0, 0), GLOW), (0, facing(0, 0, -1, 0.5), before)])
    assert bool(of_tiles(seen(built), 1, 2).any()) == visible


@pytest.mark.parametrize("count", [1, 2])
def test_what_alone_hides_a_speck_has_its_light(count: int) -> None:
    """As much as the speck would bring without it; of two that hide it neither has."""
    speck = (0, facing(0.02, 0.02), GLOW)
    walls = [(0, facing(0, 0, -1 - k, 0.5), WALL) for k in range(count)]
    found, bare = seen(scene([speck, *walls])), seen(scene([speck]))
    assert not of_tiles(found, 1, 2).any()
    np.testing.assert_allclose(of_tiles(found, 2), of_tiles(bare) * (count == 1), rtol=1e-5)


@pytest.mark.parametrize("camera", [PERSPECTIVE, ORTHOGRAPHIC], ids=["perspective", "orthographic"])
@pytest.mark.parametrize("side", [1, 3], ids=["right", "top"])
def test_beside_the_picture_a_speck_is_seen_out_of_focus(camera: s.Camera, side: int) -> None:
    """A part of its disk reaches into the picture; in focus it does not, nor further away."""
    lens = dataclasses.replace(camera, aperture=0.25, focus=2.0)
    edge = float(camera.frame[side]) * (1 if camera.orthographic else 4) + 0.05
    x, z = (edge, 0.0) if side == 1 else (0.0, edge)
    assert of_tiles(seen(scene([(0, facing(x, z), GLOW)], lens))).any()
    assert not of_tiles(seen(scene([(0, facing(x, z), GLOW)], camera))).any()
    assert not of_tiles(seen(scene([(0, facing(2 * x, 2 * z), GLOW)], lens))).any()


@pytest.mark.parametrize(
    ("camera", "blades"), [(PERSPECTIVE, 5), (ORTHOGRAPHIC, 0)], ids=["perspective", "orthographic"]
)
def test_out_of_focus_a_speck_is_where_paths_see_it(camera: s.Camera, blades: int) -> None:
    """In tiles all about; beside it, before the lens, one that hides a part of that. By 250 paths per pixel."""
    lens = dataclasses.replace(camera, aperture=0.25, focus=2.0, blades=blades, aperture_ratio=1.5)
    half = facing(-0.2, 0, -1.8, 0.4)
    built = scene([(0, facing(0.03, 0.02, 0, 0.06), GLOW), (0, half, WALL)], lens)
    blas = BlasCache(built.meshes)
    blas.need(built.instances.mesh)
    means = []
    for keep in ([True] * 3, [True, False, True]):
        shown = np.array(keep)
        prepared = prepare(built, blas)
        tlas = Tlas(built.instances, blas, shown)
        means.append(tile_means(trace(prepared, tlas, 250).mean))
    found, traced = of_tiles(seen(built), 1, 2), means[0] - means[1]
    assert (traced > 0.02 * traced.sum()).sum() > 2
    np.testing.assert_allclose(found.sum(), traced.sum(), rtol=0.15)
    np.testing.assert_allclose(found, traced, atol=0.1 * traced.sum())


@pytest.mark.parametrize("size", [(1, 1), (5, 3), (16, 9), (160, 1)])
def test_of_a_picture_smaller_than_the_tiles(size: tuple[int, int]) -> None:
    """Of the tiles that have pixels, one has all of a speck's light."""
    built = dataclasses.replace(scene([(0, facing(0.02, 0.02), GLOW)]), film=s.Film(*size))
    tiles = min(size[0], 16) * min(size[1], 9)
    expected = RADIANCE * pixels(PERSPECTIVE, SIDE, 4) / (SIZE[0] * SIZE[1]) * tiles
    assert of_tiles(seen(built)).sum() == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize(
    ("smooth", "expected"),
    [
        (material(s.Shader.PRINCIPLED, roughness=0.5), False),
        (material(s.Shader.PRINCIPLED, roughness=0.05), True),
        (material(s.Shader.PRINCIPLED, roughness=0.5, roughness_texture=0), True),
        (material(s.Shader.PRINCIPLED, roughness=0.5, coat=1.0, coat_roughness=0.03), True),
        (material(s.Shader.DIFFUSE, roughness=0.0), False),
        (material(s.Shader.GLASS, roughness=0.0), True),
    ],
)
def test_what_may_show_the_image_of_a_speck(smooth: s.Records, expected: bool) -> None:
    built = scene([])
    materials = built.materials.copy()
    materials[WALL], materials[GLASS] = smooth, material(s.Shader.DIFFUSE)
    assert polished(dataclasses.replace(built, materials=materials)) == expected


def test_a_speck_out_of_the_picture_and_one_as_large_as_a_tile_are_left_to_paths() -> None:
    outside, large = facing(30, 0), facing(0, 0, 0.0, 0.5)
    assert not len(seen(scene([(0, outside, GLOW), (0, large, GLOW)])))
