"""What a render by Cycles takes of the host's memory, in bytes, by what is in it: meshes, images, instances, and what
is there whatever is culled; and of its time, whether an analysis could win anything of it.

A rate is what a sweep of synthetic scenes measured for each thing more of a kind (`lipac.scripts.studies.memory.sweep`,
docs/memory.md), Blender's own copy of it included. Cycles builds BVHes side by side, so how much of them is there at
the same time depends on the processors; rates are those of many meshes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..arrays import F64, I32, I64
from ..errors import InputError

# Bytes of a mesh: (of each triangle, vertex, and corner of a triangle with UVs that a material reads)
TRIANGLE, VERTEX, UV_CORNER = 44, 28, 16
BVH_TRIANGLE = 84  # Embree's tree, and the boxes that it is built from
MESH = 2_000
ERROR, SLACK = 0.12, 12_000_000  # of a prediction, the process before the render left out: a share, and bytes
DELETING_TRIANGLE = 50  # of a mesh of which faces are deleted before the render, that of all of them
ROW = 200  # of what geometry nodes place, whether it is deleted before the render or not
OBJECT, EMPTY, PLACED = 21_000, 12_400, 1_600  # of an object, of one that instances a collection, of what is instanced

# Processor seconds (`lipac.scripts.studies.memory.seconds`, docs/memory.md), at most: of one thing more until Cycles
# samples
OBJECT_S, PLACED_S, TRIANGLE_S, IMAGE_BYTE_S = 2e-4, 1e-5, 6e-7, 1e-8
# of a path of Cycles, at least and at most; what culling saves of it, at most
PATH_S, CHEAPER = (5e-7, 1e-5), 0.15
# of an analysis, at least: once, with bytes; of a path of it, times what one of Cycles takes, with bytes
LOADING_S, LOADED, ANALYSED, ANALYSED_BYTES = 0.2, 20_000_000, 1.0, 100


@dataclass(frozen=True)
class Stakes:
    """What culling could win of a frame. seconds: by which what it saves, at most, is more than what the analysis
    takes, at least; saved: bytes, at most. instances; paths: of the picture; analysed: of the analysis."""

    seconds: float
    saved: int
    instances: int
    paths: int
    analysed: int

    @staticmethod
    def of(
        costs: RenderCosts, objects: int, evaluated_s: float, paths: int, analysed: int, frames: int, processors: int
    ) -> Stakes:
        """Of a scene with such costs, in which so many of the instances are objects by themselves. evaluated_s: what
        Blender took to evaluate it; frames: that share what is loaded once."""
        count = len(costs.instance)
        size = [int(part.sum(dtype=np.int64)) for part in (costs.mesh, costs.instance, costs.image)]
        read = objects * OBJECT_S + (count - objects) * PLACED_S + size[2] * IMAGE_BYTE_S
        read += int(costs.bvh.sum()) / BVH_TRIANGLE * TRIANGLE_S
        sampling = CHEAPER * paths - ANALYSED * analysed  # in paths of Cycles
        sampling *= PATH_S[sampling > 0] / processors
        return Stakes(evaluated_s + read + sampling - LOADING_S / frames, sum(size), count, paths, analysed)

    @property
    def nothing_to_win(self) -> bool:
        """Whether neither seconds nor bytes can be saved."""
        return self.seconds < 0 and self.saved < LOADED + ANALYSED_BYTES * self.analysed


@dataclass(frozen=True)
class RenderCosts:
    """Bytes by what is in a scene with N instances, M meshes and I images.

    geometry, bvh: (M,) int64, of each mesh. cutting: (M,) int64, of one of which some faces are deleted, on top.
    instance: (N,) int32. image: (I,) int64. uses: (U, 2) int32, pairs: objects whose materials begin at a number of
    `Instances.slots` have an image. fixed: what is there whatever is culled; process: before the render begins.
    """

    geometry: I64
    bvh: I64
    cutting: I64
    instance: I32
    image: I64
    uses: I32
    fixed: int = 0
    process: int = 0

    @staticmethod
    def of_meshes(triangles: I64, vertices: I64, textured: NDArray[np.bool_]) -> tuple[I64, I64, I64]:
        """Geometry, BVH and what cutting takes of meshes, (M,) int64 each, with so many triangles and vertices, (M,).
        textured: (M,) whether a material reads UVs."""
        some = (triangles > 0).astype(np.int64)
        geometry = (
            TRIANGLE * triangles
            + VERTEX * vertices
            + 3 * UV_CORNER * triangles * textured.astype(np.int64)
            + MESH * some
        )
        return geometry, BVH_TRIANGLE * triangles, DELETING_TRIANGLE * triangles

    @property
    def mesh(self) -> I64:
        """(M,) int64 bytes of each mesh."""
        return np.asarray(self.geometry + self.bvh)

    def images_of(self, slots: NDArray[np.integer]) -> NDArray[np.bool_]:
        """(I,) bool, images of objects whose materials begin at these numbers, any shape."""
        out = np.zeros(len(self.image), bool)
        out[self.uses[np.isin(self.uses[:, 0], slots), 1]] = True
        return out

    def total(self, mesh: I32, slots: I32, keep: NDArray[np.bool_], share: F64 | None = None) -> int:
        """Bytes of a render with the instances of keep, (N,) bool. mesh, slots: (N,), as of `Instances`; share: (M,) of
        each mesh that is there, where faces are deleted."""
        meshes = np.zeros(len(self.geometry), bool)
        meshes[mesh[keep]] = True
        held = (self.mesh * meshes).astype(np.float64)
        if share is not None:
            held = held * share + self.cutting * (meshes & (share < 1))
        images = self.images_of(np.unique(slots[keep]))
        parts = held.sum(), self.instance[keep].sum(dtype=np.int64), self.image[images].sum()
        return self.process + self.fixed + sum(map(int, parts))

    def at_most(self, total: int) -> int:
        """What a render does not exceed for which so many bytes are predicted."""
        return total + round(ERROR * (total - self.process)) + SLACK

    def too_little(self, needed: int, limit: int) -> InputError:
        """What is said where a render takes more than a limit, whatever is culled. needed: what it takes at least."""
        fixed = self.at_most(self.fixed + self.process)
        return InputError(
            f"a memory limit of {_megabytes(limit)} is too little: the render takes at least {_megabytes(needed)}: "
            f"{_megabytes(fixed)} for Blender, the file and the picture, {_megabytes(needed - fixed)} for what cannot "
            "be culled"
        )

    def with_images_that_stay(self, stay: NDArray[np.bool_]) -> RenderCosts:
        """Where images, (I,) bool, are loaded whatever is culled."""
        return replace(self, image=np.where(stay, 0, self.image), fixed=self.fixed + int(self.image[stay].sum()))

    def with_levels(self, shares: Sequence[tuple[I32, float]]) -> RenderCosts:
        """Where meshes have a share of their triangles. Of several, which are parts of one, what is left is there
        whatever of them is culled."""
        geometry, bvh, fixed = self.geometry.copy(), self.bvh.copy(), self.fixed
        for meshes, share in shares:
            of = self.mesh[meshes].sum() if len(meshes) > 1 else 0
            fixed += int(np.ceil(share * of))
            for bytes_of in (geometry, bvh):
                bytes_of[meshes] = 0 if len(meshes) > 1 else np.ceil(share * bytes_of[meshes])
        return replace(self, geometry=geometry, bvh=bvh, fixed=fixed)

    def divided(self, owner: I64, parts: list[tuple[int, I64]]) -> RenderCosts:
        """Of the scene in which meshes are divided: parts have a share of the bytes by triangles, instances of them
        come behind. owner: (P,) instance that each part belongs to; parts: each such mesh, and triangles of its
        parts."""
        geometry, bvh, cutting, fixed = self.geometry.copy(), self.bvh.copy(), self.cutting.copy(), self.fixed
        more: list[list[I64]] = [[], []]
        for mesh, triangles in parts:
            for found, of in zip(more, (geometry, bvh), strict=True):
                found.append(np.ceil(of[mesh] * (triangles / max(int(triangles.sum()), 1))).astype(np.int64))
            fixed += int(cutting[mesh])
            geometry[mesh] = bvh[mesh] = 0
        geometry, bvh = (np.concatenate([of, *found]) for of, found in zip((geometry, bvh), more, strict=True))
        fixed += int(self.instance[np.unique(owner)].sum(dtype=np.int64))  # each is there while a part of it is
        none: I64 = np.zeros(len(geometry) - len(cutting), np.int64)
        instance = np.concatenate([self.instance, np.zeros(len(owner), np.int32)])
        return replace(
            self, geometry=geometry, bvh=bvh, cutting=np.append(cutting, none), instance=instance, fixed=fixed
        )


def _megabytes(count: int) -> str:
    """Rounded up."""
    return f"{-(-count // 1_000_000):,} MB"
