"""What a camera sees, as a volume to test boxes against."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..arrays import F32, F64
from .model import Camera


@dataclass(frozen=True)
class View:
    """The volume of a camera's picture.

    planes: (6, 4) float64, a point p is inside where planes[:, :3] @ p + planes[:, 3] >= 0. eye: (3,) float64, world.
    width: of the picture, in metres at distance 1 (perspective) or at any distance (orthographic).
    """

    planes: F64
    eye: F64
    width: float
    orthographic: bool

    @staticmethod
    def of(camera: Camera, lens: bool = False) -> View:
        """The view of a camera. lens: with all that is seen out of focus, too."""
        axes = camera.to_world[:, :3] / np.linalg.norm(camera.to_world[:, :3], axis=0)
        eye = camera.to_world[:, 3].astype(np.float64)
        left, right, bottom, top = camera.frame
        sides = np.array([[1, 0, 0, -left], [-1, 0, 0, right], [0, 1, 0, -bottom], [0, -1, 0, top]], np.float64)
        if not camera.orthographic:  # offsets grow with the distance -z
            sides[:, 2], sides[:, 3] = -sides[:, 3], 0
        if lens and camera.aperture > 0:  # a point at distance z spreads over |z / focus - 1| of the lens
            reach = camera.aperture * max(1.0, 1 / camera.aperture_ratio)
            sides[:, 2] -= reach / camera.focus
            sides[:, 3] += reach
        local = np.vstack([sides, [[0, 0, -1, -camera.clip_start], [0, 0, 1, camera.clip_end]]])
        normals = local[:, :3] @ axes.T
        return View(
            np.column_stack([normals, local[:, 3] - normals @ eye]), eye, float(right - left), camera.orthographic
        )

    def shows(self, boxes: F32, extent: F32, share: float) -> np.ndarray:
        """(K,) bool: boxes (K, 2, 3) that touch the volume, and at whose nearest point something of extent (K,) metres
        spans this share of the picture's width.

        Conservative: a box beside an edge of the volume may pass (Assarsson, Moeller, "Optimized View Frustum Culling
        Algorithms", 2000).
        """
        low, high = boxes[:, 0].astype(np.float64), boxes[:, 1].astype(np.float64)
        center, half = (low + high) * 0.5, (high - low) * 0.5
        inside = (center @ self.planes[:, :3].T + half @ np.abs(self.planes[:, :3]).T + self.planes[:, 3] >= 0).all(
            axis=1
        )
        distance = 1.0 if self.orthographic else np.linalg.norm(np.clip(self.eye, low, high) - self.eye, axis=1)
        return inside & (extent >= share * self.width * distance)
