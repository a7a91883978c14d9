"""Nothing is culled."""

from __future__ import annotations

import numpy as np

from ...scene.model import Scene
from .policy import Policy


def keep_all(scene: Scene, _setting: float = 0.0) -> np.ndarray:
    """All instances: (N,) bool."""
    return np.ones(len(scene.instances), bool)


POLICY = Policy("none", "Nothing", "Keep everything", -1, keep_all)
