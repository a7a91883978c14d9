"""What Cycles leaves out of a render by itself: Simplify's camera and distance culling (Cycles'
blender/object_cull.cpp)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ....core.arrays import F32, F64
from ....core.scene.model import Camera

CORNERS = np.array([(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)])


@dataclass(frozen=True)
class Simplify:
    """camera: what the scene is seen by, in world space. beside: how far beside the picture, as a share of it, things
    may lie; distance: how far away, metres; None: they stay wherever they are."""

    camera: Camera
    beside: float | None
    distance: float | None

    @staticmethod
    def of(scene: Any, camera: Camera | None) -> Simplify | None:
        """The settings of a bpy.types.Scene; None where nothing is left out."""
        cycles = getattr(scene, "cycles", None)
        if camera is None or cycles is None or not scene.render.use_simplify or scene.render.use_multiview:
            return None
        beside = cycles.camera_cull_margin if cycles.use_camera_cull else None
        distance = cycles.distance_cull_margin if cycles.use_distance_cull and cycles.distance_cull_margin else None
        return None if beside is None and distance is None else Simplify(camera, beside, distance)

    def gone(self, item: Any, box: F32, placed: F64) -> NDArray[np.bool_]:
        """(n,) which of the places of a bpy.types.Object, (n, 3, 4) to world, are left out: where all that it asks for
        says so. box: (2, 3) of its mesh."""
        asks, tests = getattr(item, "cycles", None), []
        if self.beside is not None and asks is not None and asks.use_camera_cull:
            tests.append(self._outside)
        if self.distance is not None and asks is not None and asks.use_distance_cull:
            tests.append(self._far)
        if not tests:
            return np.zeros(len(placed), bool)
        corners = box[0] + CORNERS * np.ptp(box, axis=0)
        world = np.einsum("nij,kj->nki", placed[:, :, :3], corners) + placed[:, None, :, 3]
        return np.logical_and.reduce([test(world) for test in tests])

    def _outside(self, corners: F64) -> NDArray[np.bool_]:
        """Whether boxes, (n, 8, 3), lie beside the picture or behind the camera."""
        assert self.beside is not None
        c, margin = self.camera, self.beside
        seen = (corners - c.to_world[:, 3]) @ c.to_world[:, :3]
        depth = -seen[..., 2]
        near, span = c.clip_start, c.clip_end - c.clip_start
        front = (depth - near) / span * (1.0 if c.orthographic else c.clip_end)
        with np.errstate(divide="ignore", invalid="ignore"):
            flat = seen[..., :2] / (1.0 if c.orthographic else depth[..., None])
        left, right, bottom, top = c.frame
        place = (flat - (left, bottom)) / (right - left, top - bottom)
        place = np.where(front[..., None] < 0, 1 - place, place)
        low, high = place.min(axis=1), place.max(axis=1)
        return (front < -margin).all(axis=1) | (low >= 1 + margin).any(axis=1) | (high <= -margin).any(axis=1)

    def _far(self, corners: F64) -> NDArray[np.bool_]:
        """Whether boxes, (n, 8, 3), are too far away."""
        assert self.distance is not None
        eye = self.camera.to_world[:, 3]
        nearest = np.clip(eye, corners.min(axis=1), corners.max(axis=1))
        return np.asarray(np.linalg.norm(nearest - eye, axis=1) > self.distance)
