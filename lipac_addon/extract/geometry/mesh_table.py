"""Meshes over the frames of a shot: which are new, deformed, replaced or gone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ....core.arrays import F32, F64, I32
from ....core.scene.mesh import DIVIDED_MOST
from ..materials.displacement import Relief
from .fibres import Fibres
from .meshes import NO_BOUNDS, Loaded, MeshSource, describe, has_velocities, load


class MeshTable:
    """The meshes of all frames so far: each keeps its index while it is there; the index of one that vanished goes to
    another in a later frame.

    Whether a mesh that Blender evaluated anew is another is found by reading it, where somebody holds what it was (that
    is, where it is active); where nobody does, it counts as another. Index -1 is a geometry without faces.
    """

    def __init__(self) -> None:
        self.sources: list[MeshSource | None] = []
        self._index: dict[str, int] = {}
        self._free: list[int] = []
        self._used: set[str] = set()
        self._before: dict[int, MeshSource | None] = {}  # what this frame replaced
        self._origins: dict[int, F64 | None] = {}  # of the frame before
        self._reliefs: dict[int, Relief | None] = {}
        self._uv_maps: tuple[str, ...] = ("",)

    def begin(self) -> None:
        """A new frame."""
        self._used.clear()
        self._before.clear()
        self._origins = {m: source.origin for m, source in enumerate(self.sources) if source is not None}
        self._reliefs = {m: source.relief for m, source in enumerate(self.sources) if source is not None}

    def place_anew(self) -> None:
        """Forget where the coordinates of the meshes begin: the first placement of each decides."""
        for source in self.sources:
            if source is not None:
                source.origin = None

    def taken(self, key: str) -> bool:
        """Whether something of this frame has the key."""
        return key in self._used

    def known(self, key: str) -> bool:
        """Whether the key has an index."""
        return key in self._index

    def touch(self, key: str) -> int:
        """The index of what is still there as it was."""
        self._used.add(key)
        return self._index[key]

    def read(self, key: str, geometry: Any, kept: Any, name: str, fibres: Fibres | None = None) -> int:
        """The index of what is new or may have changed; its bounds are read.

        geometry, kept: two GeometrySets of the same. What is read of one becomes a copy of its own, so one is read now,
        and the other, which goes on to share Blender's memory, is kept. fibres: what is rendered beside its faces.
        """
        self._used.add(key)
        index = self._index.get(key, -1)
        source = describe(geometry, name, fibres)
        if source is None:
            if index >= 0:
                self._drop(index)
            self._index[key] = -1
            return -1
        source.moving = has_velocities(geometry)
        # asked for its mesh it makes one of its own, which outlives the graph and shares its arrays
        source.geometry, _ = kept, kept.mesh
        if index < 0:
            if self._free:
                index = self._free.pop(0)
            else:
                index = len(self.sources)
                self.sources.append(None)
            self._index[key] = index
        self._before.setdefault(index, self.sources[index])
        self.sources[index] = source
        return index

    def spare(self, index: int, evaluated: Callable[[], Any]) -> None:
        """Keep one more GeometrySet of the same for a large mesh (`MeshSource.spare`). evaluated: makes it."""
        source = self.source(index)
        mesh = source.geometry.mesh
        if mesh is not None and len(mesh.loops) >= 2 * DIVIDED_MOST and source.spare is None:
            source.spare = evaluated()
            _ = source.spare.mesh

    def source(self, index: int) -> MeshSource:
        """What is at an index that is in use."""
        source = self.sources[index]
        assert source is not None
        return source

    def displace(self, reliefs: dict[int, Relief]) -> None:
        """Set how the meshes are displaced, by index, before they are placed; all others are not."""
        for index, source in enumerate(self.sources):
            if source is not None:
                relief = reliefs.get(index)
                if relief is not None:
                    most = float(np.linalg.norm(source.bounds[1] - source.bounds[0]))  # where nothing better is known
                    relief = replace(
                        relief,
                        low=relief.low if np.isfinite(relief.low) else -most,
                        high=relief.high if np.isfinite(relief.high) else most,
                    )
                source.relief = relief

    def keeps_place(self, index: int) -> bool:
        """Whether the coordinates of a mesh began at its own origin in the frame before, and it was displaced as it is,
        and nothing says otherwise in this."""
        source = self.sources[index]
        if source is None or source.relief != self._reliefs.get(index):
            return False
        return not _differ(self._origins.get(index), None) and not _differ(source.origin, None)

    def bounds(self) -> F32:
        """(M, 2, 3) float32, as `core.scene.model.Scene.mesh_bounds`."""
        boxes = [NO_BOUNDS if source is None else source.local_bounds() for source in self.sources]
        return np.stack(boxes) if boxes else np.zeros((0, 2, 3), np.float32)

    def triangles(self) -> NDArray[np.int64]:
        """(M,) int64, as `core.scene.model.Scene.triangles`."""
        meshes = [None if source is None else source.geometry.mesh for source in self.sources]
        return np.array([0 if m is None else max(len(m.loops) - 2 * len(m.polygons), 0) for m in meshes], np.int64)

    def simplifiable(self) -> NDArray[np.bool_]:
        """(M,) bool, as `core.scene.model.Scene.simplifiable`."""
        return np.array([s is not None and bool(s.simplifiable) and s.plain for s in self.sources], bool)

    def steps(self) -> NDArray[np.int64]:
        """(M,) int64, as `core.scene.mesh.CoarserMeshes.steps`."""
        return np.array([0 if s is None or not s.plain else s.steps for s in self.sources], np.int64)

    def finish(self, textured: set[int], uv_maps: tuple[str, ...]) -> tuple[I32, I32]:
        """End a frame. textured: meshes with a material that needs UVs; uv_maps: `core.scene.model.Scene.uv_maps`.

        Returns the indices of deformed and of replaced meshes, as `core.scene.change.Change` has them.
        """
        for key in [k for k in self._index if k not in self._used]:
            index = self._index.pop(key)
            if index >= 0:
                self._drop(index)
        other_maps, self._uv_maps = uv_maps != self._uv_maps, uv_maps
        kinds: dict[bool, list[int]] = {True: [], False: []}
        for index, source in enumerate(self.sources):
            needs_uv = index in textured
            if index in self._before:
                before = self._before[index]
            elif source is not None and (
                needs_uv != source.needs_uv or (needs_uv and other_maps) or self._shaped_anew(index, source)
            ):
                before = source
            else:
                continue
            kind = self._deformed(before, source, needs_uv)
            if kind is not None:
                kinds[kind].append(index)
        self._before.clear()
        return np.array(kinds[True], np.int32), np.array(kinds[False], np.int32)

    def _shaped_anew(self, index: int, source: MeshSource) -> bool:
        return source.relief != self._reliefs.get(index) or _differ(source.origin, self._origins.get(index))

    def _drop(self, index: int) -> None:
        self._before.setdefault(index, self.sources[index])
        self.sources[index] = None
        self._free.append(index)

    def _deformed(self, before: MeshSource | None, source: MeshSource | None, needs_uv: bool) -> bool | None:
        """None: the same as before; True: the same triangles with the same slots; False: neither."""
        if source is None:
            return False
        loaded = None if before is None else before.loaded
        source.needs_uv, source.loaded, source.ready = needs_uv, None, None
        if loaded is None or not loaded.held:
            return False
        mesh = load(source, self._uv_maps)
        now = source.loaded = Loaded.of(mesh, loaded)
        if (now.topology, now.shape) == (loaded.topology, loaded.shape):
            return None
        source.ready = mesh
        return now.topology == loaded.topology


def _differ(a: NDArray[Any] | None, b: NDArray[Any] | None) -> bool:
    """Whether two origins differ; None is zero."""
    zero = np.zeros(3)
    return not np.array_equal(zero if a is None else a, zero if b is None else b)
