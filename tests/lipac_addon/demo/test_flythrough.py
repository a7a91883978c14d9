"""flythrough: the camera drives on, turns the corner without a jump, is elsewhere for a while, and ends where
mirror-city stands; nothing is in its way."""

from __future__ import annotations

import bpy
import numpy as np
import pytest

from lipac.core.errors import InputError
from lipac.lipac_addon.demo import build, flythrough, mirror_city


def test_the_drive_is_smooth_and_turns_a_corner() -> None:
    build("flythrough", 1500, 0)
    scene = bpy.context.scene
    assert (scene.frame_start, scene.frame_end) == (1, flythrough.FRAMES)
    place, ahead = [], []
    for frame in range(1, flythrough.FRAMES + 1):
        scene.frame_set(frame)
        matrix = np.array(scene.camera.matrix_world)
        place.append(matrix[:3, 3])
        ahead.append(-matrix[:3, 2])
    away = slice(flythrough.CUT, flythrough.BACK)
    # metres
    assert np.linalg.norm(np.array(place[away])[:, None] - np.delete(place, away, axis=0), axis=2).min() > 80.0
    place, ahead = list(np.delete(place, away, axis=0)), list(np.delete(ahead, away, axis=0))
    step = np.linalg.norm(np.diff(place, axis=0), axis=1)
    assert step.max() < 3.0
    assert np.abs(np.diff(step)).max() < 0.5  # metres per frame: no jerk
    np.testing.assert_allclose(place[-1], mirror_city.CAMERA, atol=1e-4)
    start, end = np.array(ahead[0]), np.array(ahead[-1])
    assert start @ end < 0.25  # about a quarter turn
    turn = np.arccos(np.clip((np.array(ahead[1:]) * np.array(ahead[:-1])).sum(axis=1), -1, 1))
    assert np.degrees(turn.max()) < 12


def test_nothing_stands_in_the_way() -> None:
    points, kind, _, _ = mirror_city.layout(3000, np.random.default_rng(0), leave_out=flythrough._in_the_way)
    assert len(points) == 3000
    path = flythrough.path()[:, :2]
    distance = np.linalg.norm(points[:, None, :2] - path[None], axis=2).min(axis=1)
    # houses: half of their width, or of a road
    assert distance[kind < mirror_city.TOWN_HOUSES + mirror_city.SUBURB_HOUSES].min() >= 7.0
    assert distance.min() > 1.5


@pytest.mark.parametrize("count", [999, 1_000_001])
def test_unusable_requests_say_what_to_do(count: int) -> None:
    with pytest.raises(InputError, match="--instances"):
        build("flythrough", count)
