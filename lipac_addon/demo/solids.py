"""Modelling with arrays: boxes, rectangles, prisms and leaves collected into one mesh. Metres, Z up; no bpy."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

F64 = NDArray[np.floating]  # float64 throughout; NumPy types some of its results loosely

_BOX_CORNERS = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)], float)
_BOX_FACES = np.array([[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]])


class Solid:
    """Faces gathered so far; `slot` is an index into the material names of the mesh."""

    def __init__(self) -> None:
        self.vertices: list[F64] = []
        self.faces: list[NDArray[np.int64]] = []
        self.slots: list[NDArray[np.int64]] = []
        self._count = 0

    def add(self, vertices: F64, faces: NDArray[np.int64], slot: int) -> None:
        """Add (V, 3) vertices and (F, 3) or (F, 4) faces into them, counter-clockwise seen from outside."""
        self.vertices.append(vertices)
        self.faces.append(faces + self._count)
        self.slots.append(np.full(len(faces), slot))
        self._count += len(vertices)

    def boxes(self, low: ArrayLike, high: ArrayLike, slot: int) -> None:
        """Axis-aligned boxes between corners `low` and `high`, (K, 3) each or (3,) for one."""
        lo, hi = np.broadcast_arrays(np.atleast_2d(np.asarray(low, float)), np.atleast_2d(np.asarray(high, float)))
        vertices = lo[:, None] + (hi - lo)[:, None] * _BOX_CORNERS
        faces = _BOX_FACES + 8 * np.arange(len(lo))[:, None, None]
        self.add(vertices.reshape(-1, 3), faces.reshape(-1, 4), slot)

    def quads(self, corners: ArrayLike, slot: int) -> None:
        """Quadrilaterals (K, 4, 3)."""
        vertices = np.asarray(corners, float).reshape(-1, 3)
        self.add(vertices, np.arange(len(vertices)).reshape(-1, 4), slot)

    def frustum(self, base: ArrayLike, top: ArrayLike, slot: int, cap: int | None = None) -> None:
        """Closed solid between two rings of equally many points (K, 3), counter-clockwise from above; `cap` is the slot
        of the top (default `slot`)."""
        lower, upper = np.asarray(base, float), np.asarray(top, float)
        k, i = len(lower), np.arange(len(lower))
        j = (i + 1) % k
        self.add(np.concatenate([lower, upper]), np.stack([i, j, j + k, i + k], 1), slot)
        for ring, flip, s in ((lower, True, slot), (upper, False, slot if cap is None else cap)):
            fan = np.stack([np.full(k, k), i, j], 1)
            self.add(np.concatenate([ring, ring.mean(0, keepdims=True)]), fan[:, ::-1] if flip else fan, s)

    def column(
        self, center: ArrayLike, radius: tuple[float, float], height: float, slot: int, sides: int = 8, axis: int = 2
    ) -> None:
        """Tapered round column from `center` along an axis, radius at its foot and head."""
        angle = np.arange(sides) * (2 * math.pi / sides)
        ring = np.stack([np.cos(angle), np.sin(angle), np.zeros(sides)], 1)
        ring = np.roll(ring, axis - 2, axis=1)  # cyclic, so handedness stays
        along = np.roll(np.array([0.0, 0.0, height]), axis - 2)
        self.frustum(
            ring * radius[0] + np.asarray(center, float), ring * radius[1] + np.asarray(center, float) + along, slot
        )

    def leaves(
        self, rng: np.random.Generator, center: ArrayLike, radii: ArrayLike, count: int, size: float, slot: int
    ) -> None:
        """Small randomly turned quads in the outer half of an ellipsoid: the crown of a tree."""
        d = rng.normal(size=(count, 3))
        d /= np.linalg.norm(d, axis=1, keepdims=True)
        p = np.asarray(center, float) + d * np.asarray(radii, float) * rng.uniform(0.65, 1.0, (count, 1))
        u = np.cross(d + rng.normal(scale=0.5, size=d.shape), rng.normal(size=d.shape))
        u /= np.linalg.norm(u, axis=1, keepdims=True)
        v = np.cross(d + rng.normal(scale=0.4, size=d.shape), u)
        v /= np.linalg.norm(v, axis=1, keepdims=True)
        u, v = u * size * rng.uniform(0.7, 1.3, (count, 1)), v * size
        self.quads(np.stack([p - u - v, p + u - v, p + u + v, p - u + v], 1), slot)
