"""Both of Cycles' cullings, as it combines them: culled is what both would cull."""

from __future__ import annotations

import numpy as np

from ...scene.model import Scene
from .distance import DISTANCE, keep_distance
from .frustum import keep_frustum
from .policy import Policy


def keep_either(scene: Scene, distance: float = DISTANCE.default) -> np.ndarray:
    """Instances in the camera's view, or within distance (metres) of it: (N,) bool."""
    return keep_frustum(scene) | keep_distance(scene, distance)


POLICY = Policy(
    "camera+distance",
    "Camera view and distance",
    "Keep what is in the camera's view or near it",
    4,
    keep_either,
    DISTANCE,
    listed=False,
)
