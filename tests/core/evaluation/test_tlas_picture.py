"""The picture of the TLAS: what is active and what is a box is where it should be, and nothing else is drawn."""

from __future__ import annotations

import numpy as np
import pytest

from lipac.core.evaluation.tlas_picture import ACTIVE, HITBOX, PAPER, Viewpoint, render, tlas_picture
from lipac.core.scene.bounds import world_bounds
from lipac.core.scene.mesh import Mesh
from lipac.core.scene.model import (
    ALL_RAYS,
    LIGHT,
    Camera,
    Film,
    Instances,
    Scene,
    World,
    default_material,
)


def _scene() -> Scene:
    """A square of 2 m at the origin and another one 10 m to the right, both looking up."""
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32)
    mesh = Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]], np.uint32))
    mesh_bounds = np.array([[[-1, -1, 0], [1, 1, 0]]], np.float32)
    transform = np.tile(np.eye(3, 4, dtype=np.float32), (2, 1, 1))
    transform[1, 0, 3] = 10
    index = np.zeros(2, np.int32)
    instances = Instances(
        transform, index, index, np.full(2, ALL_RAYS, np.uint8), world_bounds(transform, mesh_bounds, index)
    )
    camera = Camera(
        np.eye(3, 4) + np.array([[0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 5.0]]), np.array([-0.5, 0.5, -0.3, 0.3])
    )
    materials = default_material().reshape(1)
    return Scene(
        instances,
        [mesh],
        mesh_bounds,
        np.zeros(1, np.int32),
        materials,
        np.zeros(0, LIGHT),
        World(np.ones(3, np.float32)),
        camera,
        Film(64, 36),
    )


DOWN = Viewpoint(np.zeros(3), np.array([1.0, 0, 0]), np.array([0, 1.0, 0]), np.array([0, 0, -1.0]), 8.0, 20.0)


def test_active_geometry_covers_its_pixels_and_culled_geometry_none() -> None:
    scene = _scene()
    picture = render(scene, np.array([True, False]), np.zeros((0, 2, 3), np.float32), DOWN, 80, 40)
    square = np.zeros((40, 80), bool)
    square[10:30, 30:50] = True  # 2 m at 10 pixels a metre
    np.testing.assert_allclose(picture[~square], np.broadcast_to(PAPER, (picture[~square]).shape), atol=1e-6)
    hue = picture[square] / picture[square].max(axis=1, keepdims=True)
    np.testing.assert_allclose(hue, np.broadcast_to(np.array(ACTIVE) / max(ACTIVE), hue.shape), atol=1e-5)
    nothing = render(scene, np.array([False, True]), np.zeros((0, 2, 3), np.float32), DOWN, 80, 40)
    np.testing.assert_allclose(nothing, 1.0)  # the second square lies outside of the view


def test_boxes_tint_what_is_behind_them_and_have_edges() -> None:
    box = np.array([[[-3, -1, 1], [-1.5, 1, 2]]], np.float32)
    picture = render(_scene(), np.array([False, False]), box, DOWN, 80, 40)
    tinted = picture[..., 0] < 1 - 1e-6
    expected = np.zeros((40, 80), bool)
    expected[10:30, 10:25] = True
    np.testing.assert_array_equal(tinted, expected)
    inside, edge = picture[20, 17], picture[20, 10]
    toward = np.array(PAPER) - np.array(HITBOX)
    for pixel in (inside, edge):  # a mixture of paper and the boxes' colour
        cover = (np.array(PAPER) - pixel) / toward
        assert np.ptp(cover) < 1e-5
    assert (edge < inside).all()


def test_a_box_below_geometry_is_hidden() -> None:
    box = np.array([[[-0.9, -0.9, -3], [0.9, 0.9, -1]]], np.float32)
    active = np.array([True, False])
    np.testing.assert_array_equal(
        render(_scene(), active, box, DOWN, 80, 40), render(_scene(), active, box[:0], DOWN, 80, 40)
    )


@pytest.mark.parametrize("active", [[True, True], [True, False], [False, False]])
def test_the_whole_picture_with_legend(active: list[bool]) -> None:
    picture = tlas_picture(_scene(), np.array(active), np.array([[[9, -1, 0], [11, 1, 1]]], np.float32), (160, 90))
    assert picture.shape == (90, 160, 3)
    assert picture.dtype == np.uint8
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 3
