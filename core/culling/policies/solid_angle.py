"""What looks large from the camera: the culling of ray-traced games."""

from __future__ import annotations

import numpy as np

from ...arrays import F64
from ...scene.model import Scene
from .policy import Policy, Setting, blockwise


def keep_solid_angle(scene: Scene, degrees: float = 1.0) -> np.ndarray:
    """Instances whose bounding sphere spans at least this angle at the camera, or contains it: (N,) bool.

    Size over distance, the culling of ray-traced games (Deligiannis and Schmid, "It Just Works: Ray-Traced Reflections
    in Battlefield V", GDC 2019).
    """
    eye = scene.camera.to_world[:, 3]
    limit = np.sin(np.radians(degrees) / 2)

    def large(corners: F64) -> np.ndarray:
        center = corners.mean(axis=1)
        radius = np.linalg.norm(corners - center[:, None], axis=2).max(axis=1)
        return radius >= limit * np.linalg.norm(center - eye, axis=1)

    return blockwise(scene, large)


ANGLE = Setting(
    name="solid_angle",
    label="Angle",
    description="Keep what spans at least this angle, in degrees, at the camera",
    unit="DEG",
    default=1.0,
    ladder=lambda _scene: np.geomspace(179.0, 0.05, 48),
    most=180.0,
)
POLICY = Policy("solid-angle", "Solid angle", "Keep what looks large from the camera", 3, keep_solid_angle, ANGLE)
