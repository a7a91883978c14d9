"""Primary rays against the pinhole, thin lens and parallel projections they stand for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lipac.core.scene import model as s
from lipac.core.scene.camera import aperture_point, camera_constants, camera_ray

from ..scenes import build, look_at, material, placed, quad, render

F = np.float32
TURNED = np.array([[0.0, 0.0, 1.0, 2.0], [1.0, 0.0, 0.0, -3.0], [0.0, 1.0, 0.0, 0.5]])  # looks along -X, up +Z
FRAME = np.array([-0.3, 0.5, -0.2, 0.4])


def ray(
    camera: s.Camera, u: float, v: float, lens: tuple[float, float] = (0.5, 0.5)
) -> tuple[np.ndarray, np.ndarray, float]:
    r = np.array(camera_ray(camera_constants(camera), F(u), F(v), F(lens[0]), F(lens[1])), np.float64)
    return r[:3], r[3:6], r[6]


@pytest.mark.parametrize(("u", "v"), [(0.0, 0.0), (1.0, 1.0), (0.25, 0.8)])
def test_perspective_rays_pass_the_frame(u: float, v: float) -> None:
    origin, direction, _ = ray(s.Camera(TURNED, FRAME), u, v)
    x, y = FRAME[0] + (FRAME[1] - FRAME[0]) * u, FRAME[2] + (FRAME[3] - FRAME[2]) * v
    expected = TURNED[:, :3] @ [x, y, -1]
    assert direction == pytest.approx(expected / np.linalg.norm(expected), abs=1e-6)
    assert origin == pytest.approx(TURNED[:, 3], abs=1e-6)


def test_clipping_is_measured_along_the_axis() -> None:
    origin, direction, length = ray(s.Camera(TURNED, FRAME, clip_start=0.5, clip_end=10.0), 0.1, 0.9)
    depth = lambda p: -(TURNED[:, 2] @ (p - TURNED[:, 3]))  # noqa: E731
    assert depth(origin) == pytest.approx(0.5, abs=1e-6)
    assert depth(origin + length * direction) == pytest.approx(10.0, abs=1e-5)


def test_orthographic_rays_are_parallel() -> None:
    camera = s.Camera(TURNED, FRAME, orthographic=True, clip_start=0.25)
    origin, direction, _ = ray(camera, 0.25, 0.5)
    assert direction == pytest.approx(-TURNED[:, 2], abs=1e-6)
    assert origin == pytest.approx(TURNED[:, 3] + TURNED[:, :3] @ [-0.1, 0.1, -0.25], abs=1e-6)


def test_a_scaled_camera_sees_the_same() -> None:
    scaled = TURNED.copy()
    scaled[:, :3] *= [2.0, 3.0, 0.5]
    assert ray(s.Camera(scaled, FRAME), 0.2, 0.7)[1] == pytest.approx(
        ray(s.Camera(TURNED, FRAME), 0.2, 0.7)[1], abs=1e-6
    )


@pytest.mark.parametrize("blades", [0, 5])
def test_all_rays_of_a_pixel_meet_on_the_plane_of_focus(blades: int) -> None:
    camera = s.Camera(TURNED, FRAME, aperture=0.3, focus=4.0, blades=blades, aperture_ratio=2.0)
    rng = np.random.default_rng(1)
    x, y = FRAME[0] + (FRAME[1] - FRAME[0]) * 0.3, FRAME[2] + (FRAME[3] - FRAME[2]) * 0.6
    focus = TURNED[:, 3] + TURNED[:, :3] @ (np.array([x, y, -1]) * 4.0)
    across = []
    for _ in range(50):
        origin, direction, _ = ray(camera, 0.3, 0.6, tuple(rng.random(2)))
        t = (focus - origin) @ direction
        assert origin + t * direction == pytest.approx(focus, abs=1e-5)
        across.append(TURNED[:, :3].T @ (origin - TURNED[:, 3]))
    assert np.abs(across)[:, 0].max() < 0.151  # squeezed by the aperture ratio
    assert 0.2 < np.abs(across)[:, 1].max() < 0.301


def test_the_polygonal_aperture_is_uniform() -> None:
    c = camera_constants(s.Camera(TURNED, FRAME, aperture=1.0, blades=6, blade_rotation=0.2))
    rng = np.random.default_rng(2)
    p = np.array([aperture_point(c, F(a), F(b)) for a, b in rng.random((6000, 2))])
    area = 3 * np.sqrt(3) / 2  # of a hexagon of circumradius 1
    assert np.hypot(*p.T).max() <= 1 + 1e-6
    for radius in (0.3, 0.8):  # both within the incircle
        share = np.pi * radius**2 / area
        inside = (np.hypot(*p.T) < radius).mean()
        assert abs(inside - share) < 5 * np.sqrt(share * (1 - share) / len(p))


def test_paths_take_a_camera_of_the_shutter() -> None:
    """A picture over a shutter is the mean of those that its cameras make, whatever the scene's own camera sees."""
    glow = [material(s.Shader.EMISSION, emission=c) for c in np.eye(3)]
    placement = [(0, placed((4.0 * k, 0, 0), 2.0), k) for k in range(3)]
    cameras = tuple(look_at((4.0 * k, 0, 10), (4.0 * k, 0, 0), 0.05, 1.0) for k in range(3))
    scene = replace(
        build([quad()], placement, glow, look_at((0, 0, 10), (0, 0, 20)), world=(0, 0, 0), size=(16, 16)),
        shutter=cameras,
    )
    np.testing.assert_allclose(render(scene, 64).mean[..., :3].mean((0, 1)), [1 / 3, 1 / 3, 1 / 3], atol=0.02)
