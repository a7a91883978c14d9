"""What a policy is, and geometry that rules share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ...arrays import F32, F64
from ...scene.model import Camera, Instances, Scene

BLOCK = 1 << 17  # instances at a time: temporaries stay small at a million


@dataclass(frozen=True)
class Setting:
    """The number that a rule goes by.

    name: of the command's option and of the panel's property, such as solid_angle; label, description: in the panel;
    unit: in the command's help, M for metres; default; most: the largest value; kind: Blender's subtype of the
    property. ladder: of a scene, values from least kept to most, for `lipac evaluate`.
    """

    name: str
    label: str
    description: str
    unit: str
    default: float
    ladder: Callable[[Scene], F64]
    most: float = float("inf")
    kind: str = "NONE"

    @property
    def option(self) -> str:
        """Of the command line."""
        return "--" + self.name.replace("_", "-")


@dataclass(frozen=True)
class Policy:
    """What decides which instances stay.

    name: on the command line; label, description: in the panel. rank: place in lists, and its number in saved files: a
    new policy takes the next one. keep: of a scene and the value of the setting, (N,) bool instances that stay; None
    where light paths decide. listed: whether users are offered it; else it is there to be compared with.
    """

    name: str
    label: str
    description: str
    rank: int
    keep: Callable[[Scene, float], np.ndarray] | None = None
    setting: Setting | None = None
    listed: bool = True


def corners(instances: Instances, mesh_bounds: F32, a: int, b: int) -> F64:
    """Corners of the oriented boxes of instances a to b: (b - a, 8, 3) float64, world."""
    box = mesh_bounds[instances.mesh[a:b]].astype(np.float64)
    pick = (np.arange(8)[:, None] >> np.arange(3)) & 1
    corner = np.where(pick[None], box[:, None, 1], box[:, None, 0])
    transform = instances.transform[a:b].astype(np.float64)
    return np.einsum("nij,nkj->nki", transform[:, :, :3], corner) + transform[:, None, :, 3]


def blockwise(scene: Scene, test: Callable[[F64], np.ndarray]) -> np.ndarray:
    """test(corners (n, 8, 3)) -> (n,) bool, over all instances, a block at a time."""
    n = len(scene.instances)
    out = np.zeros(n, bool)
    for a in range(0, n, BLOCK):
        b = min(a + BLOCK, n)
        out[a:b] = test(corners(scene.instances, scene.mesh_bounds, a, b))
    return out


def to_camera(camera: Camera) -> tuple[F64, F64]:
    """Rotation (3, 3) and translation (3,) from world to camera, scale removed as Cycles does."""
    axes = camera.to_world[:, :3] / np.linalg.norm(camera.to_world[:, :3], axis=0)
    return axes.T, -axes.T @ camera.to_world[:, 3]


def extent(scene: Scene) -> float:
    """Diagonal in metres of the box around all instances that have one."""
    bounds = scene.instances.bounds[np.isfinite(scene.instances.bounds).all(axis=(1, 2))]
    return float(np.linalg.norm(bounds[:, 1].max(axis=0) - bounds[:, 0].min(axis=0)))
