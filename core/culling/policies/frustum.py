"""What is in the camera's view: Cycles' Simplify > Camera Culling."""

from __future__ import annotations

import numpy as np

from ...arrays import F64
from ...scene.model import Scene
from .policy import Policy, Setting, blockwise, to_camera


def keep_frustum(scene: Scene, margin: float = 0.1) -> np.ndarray:
    """Instances whose box touches the picture widened by margin (a share of it) on each side: (N,) bool.

    Cycles' Simplify > Camera Culling (intern/cycles/blender/object_cull.cpp): all eight corners off one side of the
    picture, or behind the near plane, culls.
    """
    camera = scene.camera
    rotation, translation = to_camera(camera)
    left, right, bottom, top = camera.frame
    near, far = camera.clip_start, camera.clip_end

    def visible(corners: F64) -> np.ndarray:
        local = corners @ rotation.T + translation
        depth = -local[..., 2]
        # The sign convention of a projection matrix with planes near and far; behind the near plane z is negative, the
        # picture is mirrored there.
        z = (depth - near) * far / (far - near) if not camera.orthographic else (depth - near) / (far - near)
        w = np.where(depth == 0, 1e-30, depth) if not camera.orthographic else np.ones_like(depth)
        x = (local[..., 0] / w - left) / (right - left)
        y = (local[..., 1] / w - bottom) / (top - bottom)
        x, y = np.where(z < 0, 1 - x, x), np.where(z < 0, 1 - y, y)
        behind = (z < -margin).all(axis=1)
        outside = (
            (x.min(axis=1) >= 1 + margin)
            | (y.min(axis=1) >= 1 + margin)
            | (x.max(axis=1) <= -margin)
            | (y.max(axis=1) <= -margin)
        )
        return ~(behind | outside)

    return blockwise(scene, visible)


MARGIN = Setting(
    name="margin",
    label="Margin",
    description="Widen the camera's view by this share on each side",
    unit="S",
    default=0.1,  # Cycles'
    ladder=lambda _scene: np.append(0.0, np.geomspace(0.05, 50, 31)),
)
POLICY = Policy(
    "frustum",
    "Camera view",
    "Keep what is in the camera's view; loses what only mirrors or shadows show",
    1,
    keep_frustum,
    MARGIN,
)
