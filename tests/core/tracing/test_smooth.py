"""Shading normals by vertex, and by corner."""

from __future__ import annotations

import dataclasses

import numpy as np

from lipac.core.scene import model as s

from .. import scenes


def test_normals_by_vertex_and_the_same_by_corner_give_the_same_picture() -> None:
    """Bit for bit, shadows near the terminator too; flat shading gives another."""
    flat = scenes.sphere(8)
    normals = flat.positions / np.linalg.norm(flat.positions, axis=1, keepdims=True)
    by_vertex = dataclasses.replace(flat, normals=normals.astype(np.float32))
    by_corner = dataclasses.replace(flat, normals=by_vertex.normals[flat.triangles])  # type: ignore[index]
    pictures = []
    for mesh in (by_vertex, by_corner, flat):
        lamp = scenes.lamp(s.LightKind.SUN, angle=0.1, power=3.0)
        scene = scenes.build([mesh], [(0, scenes.placed((0, 0, 0)), 0)], lights=lamp)
        pictures.append(scenes.render(scene, 4).sums)
    assert np.array_equal(pictures[0], pictures[1])
    assert not np.array_equal(pictures[0], pictures[2])
