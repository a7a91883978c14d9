"""What is near the camera: Cycles' Simplify > Distance Culling."""

from __future__ import annotations

import numpy as np

from ...scene.model import Scene
from .policy import Policy, Setting, blockwise, extent


def keep_distance(scene: Scene, distance: float = 50.0) -> np.ndarray:
    """Instances whose axis-aligned box comes within distance (metres) of the camera: (N,) bool. Cycles' Simplify >
    Distance Culling."""
    eye = scene.camera.to_world[:, 3]
    return blockwise(
        scene, lambda c: np.linalg.norm(np.clip(eye, c.min(axis=1), c.max(axis=1)) - eye, axis=1) <= distance
    )


DISTANCE = Setting(
    name="distance",
    label="Distance",
    description="Keep what is nearer to the camera than this",
    unit="M",
    default=50.0,
    ladder=lambda scene: extent(scene) * np.geomspace(1e-3, 1.0, 48),
    kind="DISTANCE",
)
POLICY = Policy("distance", "Distance", "Keep what is near the camera", 2, keep_distance, DISTANCE)
