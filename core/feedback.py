"""What rays met: integer counts per instance and per hitbox, by ray type. Integers add up to the same whatever the order and the number of threads."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .hitboxes import Hitboxes
from .scene import I64, RAY_TYPES


@dataclass
class Feedback:
    """Counts of one trace.

    hits: (N, RAY_TYPES) int64, rays of a type whose closest hit was the instance; in the column SHADOW: shadow rays that it blocked, or that arrived at it
    where it is an emitter. boxes: (H, RAY_TYPES) int64, ray segments that crossed the hitbox. hitboxes: their Embree scene (uint64), 0 for none.
    paths: how many camera paths made these counts.
    """

    hits: I64
    boxes: I64
    hitboxes: np.uint64
    paths: int = 0

    @staticmethod
    def zeros(instances: int, boxes: Hitboxes | None = None) -> Feedback:
        """Nothing met yet."""
        hits = np.zeros((instances, RAY_TYPES), np.int64)
        if boxes is None:
            return Feedback(hits, np.zeros((0, RAY_TYPES), np.int64), np.uint64(0))
        return Feedback(hits, boxes.counters, boxes.handle)
