"""What comes into view at once: large things that are out of the viewport, looked for whenever the camera has moved,
before the frame is drawn and any path was traced."""

from __future__ import annotations

import math

import bpy
import numpy as np
from numpy.typing import NDArray

from ....core.arrays import F32, F64, I64

LARGE = 0.05  # of its distance that something must be wide


class Foresight:
    """Balls around the boxes of all instances, to be asked by each new view."""

    def __init__(self, bounds: F32, last: Foresight | None = None) -> None:
        """bounds: (N, 2, 3). last: of the same instances, where they were before."""
        self.bounds = bounds
        self._centre = bounds.mean(axis=1)
        self._radius = 0.5 * np.linalg.norm(bounds[:, 1] - bounds[:, 0], axis=1)
        self._square = np.einsum("ij,ij->i", self._centre, self._centre)
        self._last: I64 | None = last._last if last is not None and len(last.bounds) == len(bounds) else None

    def appearing(self, to_world: F64, half_angle: float) -> I64:
        """Numbers of the instances that look large now, and did not in the view that was asked for last; none in the
        first. to_world, half_angle: as of `seen`."""
        now, last = self.seen(to_world, half_angle), self._last
        self._last = now
        return np.setdiff1d(now, now if last is None else last, assume_unique=True)

    def seen(self, to_world: F64, half_angle: float) -> I64:
        """Numbers of the instances that look large in the cone of a camera. to_world: (4, 4), in the coordinates of the
        bounds; half_angle: of the cone, in radians."""
        eye = to_world[:3, 3].astype(np.float32)
        distance = np.sqrt(np.maximum(self._square - 2 * (self._centre @ eye) + eye @ eye, 0))  # one pass over them
        large = np.flatnonzero(is_large(2 * self._radius, distance - self._radius))
        away, radius = self._centre[large] - eye, self._radius[large]
        length = np.maximum(distance[large], 1e-6)
        angle = np.arccos(np.clip((away @ -to_world[:3, 2].astype(np.float32)) / length, -1, 1))
        width = np.where(radius < length, np.arcsin(np.minimum(radius / length, 1)), np.pi)  # or the camera is in it
        return large[angle - width <= half_angle]


def is_large(size: NDArray[np.floating], gap: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Whether things of a size look large over a gap."""
    return np.asarray(size >= LARGE * np.maximum(gap, 0))


def half_angle(camera: bpy.types.Object) -> float | None:
    """Of the cone around all that a camera sees, in radians; None where that is no cone."""
    if camera.type != "CAMERA" or camera.data.type != "PERSP":
        return None
    shift = 2 * math.hypot(camera.data.shift_x, camera.data.shift_y)
    return math.atan(math.tan(camera.data.angle / 2) * (math.sqrt(2) + shift))
