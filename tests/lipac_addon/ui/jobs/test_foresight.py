"""What looks large in a new view, against a plain count."""

import math

import bpy
import numpy as np
import pytest

from lipac.lipac_addon.ui.jobs import foresight
from lipac.lipac_addon.ui.jobs.foresight import Foresight, half_angle


def look_at(eye, target):
    """(4, 4) of a camera."""
    z = (np.array(eye) - target) / np.linalg.norm(np.array(eye) - target)
    x = np.cross((0, 0, 1), z)
    x /= np.linalg.norm(x)
    out = np.eye(4)
    out[:3] = np.column_stack((x, np.cross(z, x), z, eye))
    return out


def test_all_that_is_large_and_in_the_cone_is_seen():
    rng = np.random.default_rng(1)
    low = rng.uniform(-60, 60, (4000, 3)).astype(np.float32)
    bounds = np.stack((low, low + rng.uniform(0.01, 4, (4000, 1)).astype(np.float32)), axis=1)
    sight, angle = Foresight(bounds), 0.4
    for k in range(5):
        pose = look_at(rng.uniform(-30, 30, 3), rng.uniform(-5, 5, 3))
        seen = set(sight.seen(pose, angle).tolist())
        corners = np.stack(
            [np.where([(n >> k) & 1 for k in range(3)], bounds[:, 1], bounds[:, 0]) for n in range(8)], 1
        )
        away = corners - pose[:3, 3]
        distance = np.linalg.norm(away, axis=2)
        inside = np.arccos(np.clip(away @ -pose[:3, 2] / distance, -1, 1)) < angle
        large = np.linalg.norm(bounds[:, 1] - bounds[:, 0], axis=1) > foresight.LARGE * distance.min(axis=1)
        must = set(np.flatnonzero(inside.any(axis=1) & large).tolist())
        assert must, k
        assert must <= seen
        assert len(seen) < 2000  # and not simply all


def test_only_what_was_not_seen_before_appears():
    low = np.array([(0, 10, 0), (0, -10, 0), (0, 1000, 0)], np.float32)
    sight = Foresight(np.stack((low, low + 1), axis=1))
    ahead, back = look_at((0, 0, 0.5), (0, 10, 0.5)), look_at((0, 0, 0.5), (0, -10, 0.5))
    assert sight.appearing(ahead, 0.5).tolist() == []  # the first view
    assert sight.appearing(back, 0.5).tolist() == [1]
    assert sight.appearing(back, 0.5).tolist() == []
    assert sight.appearing(ahead, 0.5).tolist() == [0]
    assert Foresight(sight.bounds + 0.1, sight).appearing(back, 0.5).tolist() == [1]  # they moved
    assert Foresight(sight.bounds[:2], sight).appearing(back, 0.5).tolist() == []  # they are others


def test_the_cone_holds_the_corners_of_the_picture(boxes):
    camera = boxes.camera
    frame = np.array([tuple(corner) for corner in camera.data.view_frame(scene=boxes)])
    corners = np.arccos(-frame[:, 2] / np.linalg.norm(frame, axis=1))
    assert half_angle(camera) >= corners.max() - 1e-6
    camera.data.shift_x = 0.3
    frame = np.array([tuple(corner) for corner in camera.data.view_frame(scene=boxes)])
    assert half_angle(camera) >= np.arccos(-frame[:, 2] / np.linalg.norm(frame, axis=1)).max() - 1e-6
    camera.data.type = "ORTHO"
    assert half_angle(camera) is None
    assert half_angle(bpy.data.objects["box0"]) is None
    assert math.isclose(foresight.LARGE, 0.05)


@pytest.mark.parametrize("size", [0, 1])
def test_few_instances(size):
    bounds = np.zeros((size, 2, 3), np.float32)
    assert Foresight(bounds).appearing(np.eye(4), 0.5).tolist() == []
