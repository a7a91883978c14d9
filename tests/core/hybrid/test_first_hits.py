"""Paths that start at first hits found elsewhere."""

import dataclasses

import numpy as np
import pytest

from lipac.core.accel.blas import BlasCache
from lipac.core.accel.tlas import Tlas
from lipac.core.hybrid.first_hits import in_view, pass_camera, trace_primary
from lipac.core.scene import model as s
from lipac.core.scene.camera import projection
from lipac.core.scene.mesh import MeshTable
from lipac.core.scene.model import HIT, FirstHitBuffer
from lipac.core.tracing.tracer import prepare, trace

from ..scenes import build, lamp, look_at, material, placed, quad, render, sphere

SIZE = (48, 27)
NEEDLE = 1e-6  # pixels: a filter of this width samples pixel centres


def mixed(filter_width: float = NEEDLE) -> s.Scene:
    """Ground, a mirror, glass, an emitter and something half transparent under two lamps and a sky."""
    materials = [
        material(base_color=0.8),
        material(s.Shader.GLOSSY, base_color=0.9, roughness=0.0),
        material(s.Shader.GLASS, base_color=0.95, roughness=0.0, ior=1.5),
        material(s.Shader.EMISSION, emission=2.0),
        material(s.Shader.PRINCIPLED, base_color=0.6, alpha=0.5),
    ]
    placement = [(0, placed((0, 0, 0), 8.0), 0)]
    placement += [
        (1, placed(at, r), k + 1)
        for k, (at, r) in enumerate((((0, 0, 1), 1.0), ((2, 0, 1), 0.8), ((-2, 0, 1), 0.5), ((-1, -2, 0.6), 0.5)))
    ]
    lights = np.concatenate(
        [lamp(s.LightKind.POINT, (1, -2, 3), radius=0.3), lamp(s.LightKind.SUN, (0, 0, 3), power=2.0)]
    )
    scene = build([quad(), sphere(12)], placement, materials, lights=lights, world=(0.3, 0.4, 0.5), size=SIZE)
    return dataclasses.replace(scene, film=dataclasses.replace(scene.film, filter_width=filter_width))


def first_hits(scene: s.Scene, index: int = 0, count: int = 1, size: tuple[int, int] = SIZE) -> FirstHitBuffer:
    """Found by rays over everything."""
    blas = BlasCache(scene.meshes)
    blas.need(scene.instances.mesh)
    tlas = Tlas(scene.instances, blas, np.ones(len(scene.instances), bool))
    return trace_primary(
        tlas,
        MeshTable(scene.meshes),
        pass_camera(scene.camera, scene.film, size, index, count),
        size,
        scene.instances.mesh,
    )


def from_hits(scene: s.Scene, primary: FirstHitBuffer) -> s.Scene:
    return dataclasses.replace(scene, first_hits={SIZE: primary})


def test_same_as_camera_rays():
    """The same random numbers from the same hits: the same picture but for rounding, which a few bounces multiply."""
    scene = mixed()
    a = render(scene, 4, seed=1).mean
    b = render(from_hits(scene, first_hits(scene)), 4, seed=1).mean
    assert (np.abs(a - b) < 1e-4 * (1 + a)).mean() > 0.999
    assert np.abs(a.mean() - b.mean()) < 1e-4 * a.mean()


def test_parts_sum_to_the_whole():
    """What the parts leave of the total is light of further bounces, of emitters and of the sky: never less than
    nothing."""
    scene = mixed()
    picture = render(from_hits(scene, first_hits(scene)), 4)
    rest = picture.sums[..., :3] - picture.parts[..., :9].reshape(*picture.sums.shape[:2], 3, 3).sum(axis=2)
    assert rest.min() > -1e-4 * picture.sums.max()
    black = dataclasses.replace(
        scene,
        world=s.World(np.zeros(3, np.float32)),
        limits=s.PathLimits(total=0),
        materials=scene.materials[[0, 0, 0, 0, 0]],
    )
    # lamps on diffuse surfaces, no bounce: all is direct light of lamps
    lit = render(from_hits(black, first_hits(black)), 4)
    np.testing.assert_allclose(lit.sums[..., :3], lit.parts[..., 3:6] + lit.parts[..., 6:9], atol=1e-4)
    assert lit.sums[..., :3].mean() > 0.1


def test_culled_instances_are_seen():
    """A surface that is not built is shaded where the hits say it is; everything else is as if it were not there."""
    scene = mixed()
    primary = first_hits(scene)
    nothing = np.zeros(5, bool)
    picture = render(from_hits(scene, primary), 2, active=nothing).mean
    glowing = primary.hits["instance"] == 3
    assert glowing.sum() > 10
    np.testing.assert_allclose(picture[glowing][:, :3], 2.0, rtol=1e-5)
    ground = primary.hits["instance"] == 0
    assert picture[ground][:, :3].min() > 0.8 * 0.3 * 0.5  # no sky is hidden from it: at least that of one path in two
    # camera rays alone see the sky there
    assert render(scene, 2, active=nothing).mean[ground][:, 2].max() <= 0.5 + 1e-6


def test_feedback_counts_no_first_hit():
    """What is only seen, and blocks and reflects nothing, is not asked for."""
    from lipac.core.feedback.hits import Feedback

    scene = build([quad()], [(0, placed((0, 0, 0), 8.0), 0)], world=(1, 1, 1), size=SIZE)
    counts = []
    for known in ({}, {SIZE: first_hits(scene)}):
        one = dataclasses.replace(scene, first_hits=known)
        blas = BlasCache(one.meshes)
        blas.need(one.instances.mesh)
        feedback = Feedback.zeros(1)
        trace(prepare(one, blas), Tlas(one.instances, blas, np.ones(1, bool)), 1, feedback=feedback)
        counts.append(int(feedback.hits.sum()))
    assert counts[0] > 100
    assert counts[1] == 0


def test_passes_anti_alias():
    """16 passes, each of one hit per pixel, see an edge as the filter does. A pass's mean over a row of edge pixels
    differs by the filter's spread over 16."""
    above, glowing = look_at((0.013, 0, 4), (0.013, 0, 0)), material(s.Shader.EMISSION, emission=1.0)
    scene = build([quad()], [(0, placed((0, 0, 0), (1.0, 4.0, 1.0)), 0)], [glowing], above, world=(0, 0, 0), size=SIZE)
    truth = render(scene, 512).mean[13, :, 0]
    passes = [render(from_hits(scene, first_hits(scene, k, 16)), 1).mean[13, :, 0] for k in range(16)]
    one = passes[0]
    assert set(np.unique(one)) <= {0.0, 1.0}
    edge = (truth > 0.02) & (truth < 0.98)
    assert 2 <= edge.sum() <= 8
    assert np.abs(np.mean(passes, axis=0) - truth)[edge].max() < 1.5 / 16 + 3 * np.sqrt(0.25 / 512)
    assert np.abs(one - truth)[edge].max() > 0.2


def test_passes_focus():
    """With a lens, what lies at the distance of focus stands still from pass to pass, what lies nearer moves."""
    camera = dataclasses.replace(look_at((0, 0, 4), (0, 0, 0)), aperture=0.5, focus=4.0)
    film = s.Film(*SIZE, filter_width=NEEDLE)
    for point, moves in (((0.0, 0.0, 0.0), False), ((0.0, 0.0, 2.0), True)):
        seen = []
        for k in range(8):
            c = pass_camera(camera, film, SIZE, k, 8)
            x, y, z = c.to_world[:, :3].T @ (np.array(point) - c.to_world[:, 3])
            seen.append(
                ((-x / z - c.frame[0]) / (c.frame[1] - c.frame[0]), (-y / z - c.frame[2]) / (c.frame[3] - c.frame[2]))
            )
        assert (np.ptp(seen, axis=0).max() > 1e-2) == moves
        assert moves or np.ptp(seen, axis=0).max() < 1e-6


def test_hit_layout():
    """The kernel reads records of 16 bytes."""
    assert HIT.itemsize == 16
    assert [HIT.fields[name][1] for name in ("instance", "triangle", "b1", "b2")] == [0, 4, 8, 12]


@pytest.mark.parametrize(("focus", "aperture"), [(0.5, 0.018), (0.3, 0.009), (5.0, 0.1)])
def test_what_any_pass_sees_is_in_view(focus, aperture):
    """Close focus with a wide lens shifts the picture of a pass by more than the margin: no small thing at its edge is
    left out."""
    rng = np.random.default_rng(2)
    camera = dataclasses.replace(look_at((0, 0, 0), (0, 1, 0), half_width=0.36), aperture=aperture, focus=focus)
    points = rng.uniform((-2, 0.05, -1.5), (2, 3, 1.5), (4000, 3))
    scene = build([quad()], [(0, placed(tuple(p), 1e-3), 0) for p in points], camera=camera)
    found = in_view(scene)
    seen = np.zeros(len(points), bool)
    for index in range(200):
        matrix, _ = projection(pass_camera(camera, scene.film, SIZE, index, 200))
        clip = np.c_[points, np.ones(len(points))] @ matrix.T
        seen |= (np.abs(clip[:, :2]) < clip[:, 3:]).all(axis=1)
    assert (seen & ~found).sum() == 0
    assert found.sum() < len(points)
