"""Which instances stay: heuristics from bounds and camera, and the states that light paths decide."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from .budget import Budget
from .errors import InputError
from .scene import F32, F64, Camera, Film, Instances, Scene
from .tiles import TILES

# Something that a coarse tile's paths do not meet may be worth some of them, each as bright as what stands behind it: so many paths, over the tile's bound.
TILE_PATHS = 120
COUNTED_PATHS = 4  # per pixel, by counts
MOST_PATHS = 64  # per pixel
BLOCK = 1 << 17  # instances at a time: temporaries stay small at a million


class State(IntEnum):
    """Activation state of an instance."""

    CULLED = 0
    PENDING = 1
    ACTIVE = 2


DEFAULT_BUDGET = Budget(0.01, 0.05)
POLICIES = ("none", "frustum", "distance", "solid-angle", "light-paths")


@dataclass(frozen=True)
class CullOptions:
    """How to cull. Defaults suit a first scene.

    policy: one of POLICIES. margin: `frustum`, share of the picture (Cycles' default). distance: metres from the camera; for `distance`.
    solid_angle: degrees that an instance's bounding sphere must span; for `solid-angle`.
    max_error: `light-paths`: how much the picture may change. min_share: `light-paths` by plain counts instead: an instance stays if at least this share of the
    paths meets it. paths: per pixel, for the measurement of both; 0: as many as the bounds need.
    width: of the analysis picture in pixels (its height follows the film). nearest: boxes of a ray that are counted at a cold start;
    hitbox_every: on one path in so many. settled: segments per path that may still ask for a box when the rounds of a frame end, 0: none;
    max_iterations: rounds of a frame at most.

    Over the frames of a shot: hysteresis: how many times less than what is newly kept an instance must be worth to be culled again, 1 for none; mitigation:
    large instances that come into view are active at once. blas_budget_ms: milliseconds of BLAS building per frame, the rest is done in later frames;
    blas_budget_bytes: of all BLASes together; 0: no limit, as a final render wants it.
    """

    policy: str = "light-paths"
    margin: float = 0.1
    distance: float = 50.0
    solid_angle: float = 1.0
    max_error: Budget = DEFAULT_BUDGET
    min_share: float | None = None
    paths: int = 0
    width: int = 240
    nearest: int = 4
    hitbox_every: int = 1
    settled: float = 0.02
    max_iterations: int = 64
    hysteresis: float = 2.0
    mitigation: bool = True
    blas_budget_ms: float = 0.0
    blas_budget_bytes: int = 0
    seed: int = 0
    threads: int = 0

    def picture_size(self, film: Film) -> tuple[int, int]:
        """Width and height of the analysis picture."""
        return min(self.width, film.width), min(max(1, round(self.width * film.height / film.width)), film.height)

    def coarse_size(self, film: Film) -> tuple[int, int]:
        """Width and height of the picture of coarse rounds."""
        width, height = self.picture_size(film)
        return max(width // 2, 1), max(height // 2, 1)

    def paths_per_pixel(self, film: Film) -> int:
        """Paths per pixel of a measurement, and of the certificate of what is chosen by it."""
        if self.by_counts:
            return self.paths or COUNTED_PATHS
        if self.paths:
            return max(self.paths, 2)
        width, height = self.picture_size(film)
        return int(np.clip(np.ceil(TILE_PATHS * TILES / (max(self.max_error.worst, 1e-3) * width * height)), 2, MOST_PATHS))

    def first_paths_per_pixel(self, film: Film) -> int:
        """Paths per pixel of a first measurement: half of all, for the others judge what is chosen by these; by counts all."""
        samples = self.paths_per_pixel(film)
        return samples if self.by_counts else -(-samples // 2)

    def round_paths_per_pixel(self, film: Film) -> int:
        """Paths per pixel of a round at full size that comes before: half of a first measurement's."""
        return max(1, self.first_paths_per_pixel(film) // 2)

    @property
    def by_counts(self) -> bool:
        """Whether no budget is kept."""
        return self.min_share is not None or self.policy != "light-paths"

    def __post_init__(self) -> None:
        if self.policy not in POLICIES:
            raise InputError(f"unknown culling policy '{self.policy}': choose one of {', '.join(POLICIES)}")


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
