"""Culling by bounds and camera alone: the rules that renderers have."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..arrays import F32, F64
from ..scene.model import Camera, Instances, Scene
from .options import CullOptions

BLOCK = 1 << 17  # instances at a time: temporaries stay small at a million


def _corners(instances: Instances, mesh_bounds: F32, a: int, b: int) -> F64:
    """Corners of the oriented boxes of instances a to b: (b - a, 8, 3) float64, world."""
    box = mesh_bounds[instances.mesh[a:b]].astype(np.float64)
    pick = (np.arange(8)[:, None] >> np.arange(3)) & 1
    corner = np.where(pick[None], box[:, None, 1], box[:, None, 0])
    transform = instances.transform[a:b].astype(np.float64)
    return np.einsum("nij,nkj->nki", transform[:, :, :3], corner) + transform[:, None, :, 3]


def _blockwise(scene: Scene, test: Callable[[F64], np.ndarray]) -> np.ndarray:
    """test(corners (n, 8, 3)) -> (n,) bool, over all instances, a block at a time."""
    n = len(scene.instances)
    out = np.zeros(n, bool)
    for a in range(0, n, BLOCK):
        b = min(a + BLOCK, n)
        out[a:b] = test(_corners(scene.instances, scene.mesh_bounds, a, b))
    return out


def _to_camera(camera: Camera) -> tuple[F64, F64]:
    """Rotation (3, 3) and translation (3,) from world to camera, scale removed as Cycles does."""
    axes = camera.to_world[:, :3] / np.linalg.norm(camera.to_world[:, :3], axis=0)
    return axes.T, -axes.T @ camera.to_world[:, 3]


def keep_frustum(scene: Scene, margin: float = 0.1) -> np.ndarray:
    """Instances whose box touches the picture widened by margin (a share of it) on each side: (N,) bool.

    Cycles' Simplify > Camera Culling (intern/cycles/blender/object_cull.cpp): all eight corners off one side of the picture, or behind the near plane, culls.
    """
    camera = scene.camera
    rotation, translation = _to_camera(camera)
    left, right, bottom, top = camera.frame
    near, far = camera.clip_start, camera.clip_end

    def visible(corners: F64) -> np.ndarray:
        local = corners @ rotation.T + translation
        depth = -local[..., 2]
        # The sign convention of a projection matrix with planes near and far; behind the near plane z is negative, the picture is mirrored there.
        z = (depth - near) * far / (far - near) if not camera.orthographic else (depth - near) / (far - near)
        w = np.where(depth == 0, 1e-30, depth) if not camera.orthographic else np.ones_like(depth)
        x = (local[..., 0] / w - left) / (right - left)
        y = (local[..., 1] / w - bottom) / (top - bottom)
        x, y = np.where(z < 0, 1 - x, x), np.where(z < 0, 1 - y, y)
        behind = (z < -margin).all(axis=1)
        outside = (x.min(axis=1) >= 1 + margin) | (y.min(axis=1) >= 1 + margin) | (x.max(axis=1) <= -margin) | (y.max(axis=1) <= -margin)
        return ~(behind | outside)

    return _blockwise(scene, visible)


def keep_distance(scene: Scene, distance: float = 50.0) -> np.ndarray:
    """Instances whose axis-aligned box comes within distance (metres) of the camera: (N,) bool. Cycles' Simplify > Distance Culling."""
    eye = scene.camera.to_world[:, 3]
    return _blockwise(scene, lambda c: np.linalg.norm(np.clip(eye, c.min(axis=1), c.max(axis=1)) - eye, axis=1) <= distance)


def keep_solid_angle(scene: Scene, degrees: float = 1.0) -> np.ndarray:
    """Instances whose bounding sphere spans at least this angle at the camera, or contains it: (N,) bool.

    Size over distance, the culling of ray-traced games (Deligiannis and Schmid, "It Just Works: Ray-Traced Reflections in Battlefield V", GDC 2019).
    """
    eye = scene.camera.to_world[:, 3]
    limit = np.sin(np.radians(degrees) / 2)

    def large(corners: F64) -> np.ndarray:
        center = corners.mean(axis=1)
        radius = np.linalg.norm(corners - center[:, None], axis=2).max(axis=1)
        return radius >= limit * np.linalg.norm(center - eye, axis=1)

    return _blockwise(scene, large)


def heuristic(scene: Scene, options: CullOptions) -> np.ndarray:
    """Instances that a policy without light paths keeps: (N,) bool."""
    if options.policy == "frustum":
        return keep_frustum(scene, options.margin)
    if options.policy == "distance":
        return keep_distance(scene, options.distance)
    if options.policy == "solid-angle":
        return keep_solid_angle(scene, options.solid_angle)
    return np.ones(len(scene.instances), bool)
