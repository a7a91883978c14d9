"""Where things are placed, level by level of instancing, and the rows of instances that come of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.arrays import F32, F64, I32, U8, Records
from ...core.scene.model import Camera, InstanceFlag, Instances, RayType
from ...core.scene.placing import finish, local_origin, shifted
from ..keys import KEY
from .geometry.mesh_table import MeshTable
from .lights import Lamp

VISIBLE = (1 << len(RayType)) - 1
Ints = int | NDArray[Any]  # one for all, or one per placement


def _take(values: Ints, index: NDArray[Any] | slice) -> Ints:
    return values if isinstance(values, int) else values[index]


def compose(a: F64, b: F64) -> F64:
    """Affine products a b: (n, 3, 4) or (3, 4) with the same, broadcast."""
    out = a[..., :3] @ b
    out[..., 3] += a[..., 3]
    return out


@dataclass(frozen=True)
class Placements:
    """Where something is placed: transform (n, 3, 4) float64 object to world, and for each what the key and the flags
    of its instances need.

    host: name index (-1: the object is real, not instanced). visible: ray visibility of the top-level object. marks:
    HOLDOUT and SHADOW_CATCHER of the same. path: one value per level of instancing.
    """

    transform: F64
    kind: Ints
    host: Ints
    visible: Ints
    marks: Ints
    path: tuple[Ints, ...] = ()

    def __len__(self) -> int:
        return len(self.transform)

    def inside(self, transform: F64, index: NDArray[Any] | slice, place: Ints) -> Placements:
        """One level deeper: placement k stems from placement `index[k]` of this, at `place` of that level."""
        path = (*(_take(level, index) for level in self.path), place)
        return Placements(
            transform,
            _take(self.kind, index),
            _take(self.host, index),
            _take(self.visible, index),
            _take(self.marks, index),
            path,
        )

    @staticmethod
    def join(parts: Sequence[Placements]) -> Placements:
        """All placements of several objects at the same depth."""
        if len(parts) == 1:
            return parts[0]
        sizes = [len(p) for p in parts]

        def column(values: Sequence[Ints]) -> Ints:
            first = values[0]
            if isinstance(first, int) and all(isinstance(v, int) and v == first for v in values):
                return first
            return np.concatenate(
                [np.full(n, v, np.int32) if isinstance(v, int) else v for v, n in zip(values, sizes, strict=True)]
            )

        return Placements(
            np.concatenate([p.transform for p in parts]),
            column([p.kind for p in parts]),
            column([p.host for p in parts]),
            column([p.visible for p in parts]),
            column([p.marks for p in parts]),
            tuple(column([p.path[d] for p in parts]) for d in range(len(parts[0].path))),
        )


@dataclass
class Rows:
    """Instances and their keys, as in `core.scene.model.Instances` and `keys.Keys`."""

    transform: F32
    bounds: F32
    mesh: I32
    slots: I32
    flags: U8
    records: Records

    @staticmethod
    def empty(count: int) -> Rows:
        """Room for count rows."""
        return Rows(
            np.empty((count, 3, 4), np.float32),
            np.empty((count, 2, 3), np.float32),
            np.empty(count, np.int32),
            np.empty(count, np.int32),
            np.empty(count, np.uint8),
            np.zeros(count, KEY),
        )

    @staticmethod
    def join(parts: Sequence[Rows]) -> Rows:
        """All rows, one part after the other."""
        if len(parts) == 1:
            return parts[0]
        if not parts:
            return Rows.empty(0)
        return Rows(*(np.concatenate([getattr(part, name) for part in parts]) for name in Rows.__dataclass_fields__))

    def __len__(self) -> int:
        return len(self.mesh)

    def __getitem__(self, part: slice) -> Rows:
        return Rows(*(getattr(self, name)[part] for name in Rows.__dataclass_fields__))

    def same(self, other: Rows) -> bool:
        """Whether all rows are the same."""
        if len(self) != len(other):
            return False
        columns = [
            (getattr(self, name), getattr(other, name)) for name in Rows.__dataclass_fields__ if name != "records"
        ]
        columns += [(self.records[name], other.records[name]) for name in KEY.names or ()]
        return all(np.array_equal(a, b) for a, b in columns)

    def instances(self) -> Instances:
        """For the core."""
        return Instances(self.transform, self.mesh, self.slots, self.flags, self.bounds)


@dataclass
class Block:
    """What one top-level instancer placed, or all objects that are not instanced: rows [first, first + count) of a
    frame.

    key: what makes it the same block in another frame; of: names of the objects that it was placed from. pairs: meshes
    with their offsets into the slot table. dropped: unusable placements by mesh name. reach: metres that its meshes
    reach from their own origins, at most.
    """

    key: tuple[str, str]
    of: tuple[str, ...]
    first: int = 0
    count: int = 0
    pairs: set[tuple[int, int]] = field(default_factory=set)
    lamps: list[Lamp] = field(default_factory=list)
    dropped: dict[str, int] = field(default_factory=dict)
    reach: float = 0.0


class Output:
    """The final arrays, grown as needed: untouched memory costs nothing, and no instance is copied twice.

    origin, camera: as of `Placer`. rows: of which the first count are placed.
    """

    def __init__(self, meshes: MeshTable, origin: F64, camera: Camera | None) -> None:
        self._meshes, self._origin, self._camera = meshes, origin, camera
        self.count = 0
        self.rows = Rows.empty(0)

    def reserve(self, more: int) -> None:
        """Makes room for `more` instances."""
        need = self.count + more
        if need <= len(self.rows):
            return
        new = Rows.empty(max(need, 2 * len(self.rows)))
        for name in Rows.__dataclass_fields__:
            getattr(new, name)[: self.count] = getattr(self.rows, name)[: self.count]
        self.rows = new

    def emit(self, block: Block, mesh: int, slots: Ints, name: Ints, visible: int, marks: int, at: Placements) -> None:
        """Instances of a mesh, for a block: visibility of the object and of the top-level object combined. What is
        invisible or not placeable is left out."""
        flags: Ints = (at.visible & visible) | at.marks | marks
        if not isinstance(flags, int):
            flags = np.asarray(flags, np.uint8)
        seen = (flags & VISIBLE) != 0
        source, count = self._meshes.source(mesh), len(at)
        if source.relief is None and not source.broken:
            source.divisible |= bool(np.any(np.asarray(flags) & int(InstanceFlag.DIVISIBLE)))
        else:
            flags = flags & (255 - int(InstanceFlag.DIVISIBLE))
        self.reserve(count)
        rows = self.rows[self.count : self.count + count]
        good = np.empty(count, np.bool_)
        low, high = source.box().astype(np.float64)
        if source.origin is None:
            source.origin = np.zeros(3) if self._camera is None else local_origin(low, high, at.transform, self._camera)
        placed = shifted(at.transform, source.origin) if source.origin.any() else np.ascontiguousarray(at.transform)
        usable, stretch = finish(
            placed, self._origin, low - source.origin, high - source.origin, rows.transform, rows.bounds, good
        )
        reach = float(np.maximum(np.abs(low), np.abs(high)).max()) * stretch
        block.reach = max(block.reach, reach if np.isfinite(reach) else np.inf)
        keep: Any = slice(None)
        if usable < count:
            block.dropped[source.name] = block.dropped.get(source.name, 0) + count - usable
        if usable < count or not np.all(seen):
            keep = good & seen
            count = int(keep.sum())
            rows.transform[:count], rows.bounds[:count] = rows.transform[keep], rows.bounds[keep]
        if not count:
            return
        part = slice(self.count, self.count + count)
        self.count += count
        self.rows.mesh[part], self.rows.slots[part], self.rows.flags[part] = (
            mesh,
            _take(slots, keep),
            _take(flags, keep),
        )
        block.pairs.update(
            (mesh, offset) for offset in ([slots] if isinstance(slots, int) else np.unique(slots).tolist())
        )
        record, arrays = np.zeros((), KEY), {}
        record["path"] = -1
        for name_, value in (("kind", at.kind), ("host", at.host), ("object", name)):
            if isinstance(value, int):
                record[name_] = value
            else:
                arrays[name_] = value[keep]
        self.rows.records[part] = record
        for name_, values in arrays.items():
            self.rows.records[name_][part] = values
        for depth, level in enumerate(at.path):
            self.rows.records["path"][part, depth] = _take(level, keep)
