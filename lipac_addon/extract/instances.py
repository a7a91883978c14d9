"""What a graph's objects place -> arrays of instances, without a Python step per instance.

NumPy composes the transforms of everything that objects, collections and instance references place: the instances of geometry nodes come as arrays, the
contents of a collection are composed with all objects that instance it at once. What was placed from the same things in the frame before is taken over.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.arrays import F32, F64, I32, U8, Records
from ...core.scene.model import Camera, InstanceFlag, Instances, RayType
from ...core.scene.placing import compose_rows, finish, local_origin, local_reach, shifted
from ..keys import KEY, MAX_DEPTH, Kind
from .graph import Geometry, GraphReader, Members, Node
from .lights import Lamp

BLOCK = 1 << 14  # instances composed at a time: their float64 temporaries stay in the cache
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
    """Where something is placed: transform (n, 3, 4) float64 object to world, and for each what the key and the flags of its instances need.

    host: name index (-1: the object is real, not instanced). visible: ray visibility of the top-level object. marks: HOLDOUT and SHADOW_CATCHER of the same.
    path: one value per level of instancing.
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
        return Placements(transform, _take(self.kind, index), _take(self.host, index), _take(self.visible, index), _take(self.marks, index), path)

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
            return np.concatenate([np.full(n, v, np.int32) if isinstance(v, int) else v for v, n in zip(values, sizes, strict=True)])

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
        columns = [(getattr(self, name), getattr(other, name)) for name in Rows.__dataclass_fields__ if name != "records"]
        columns += [(self.records[name], other.records[name]) for name in KEY.names or ()]
        return all(np.array_equal(a, b) for a, b in columns)

    def instances(self) -> Instances:
        """For the core."""
        return Instances(self.transform, self.mesh, self.slots, self.flags, self.bounds)


@dataclass
class Block:
    """What one top-level instancer placed, or all objects that are not instanced: rows [first, first + count) of a frame.

    key: what makes it the same block in another frame; of: names of the objects that it was placed from. pairs: meshes with their offsets into the slot table.
    dropped: unusable placements by mesh name. reach: metres that its meshes reach from their own origins, at most.
    """

    key: tuple[str, str]
    of: tuple[str, ...]
    first: int = 0
    count: int = 0
    pairs: set[tuple[int, int]] = field(default_factory=set)
    lamps: list[Lamp] = field(default_factory=list)
    dropped: dict[str, int] = field(default_factory=dict)
    reach: float = 0.0


@dataclass
class Placed:
    """A frame: rows, the blocks that they consist of, in order, and where its coordinates begin.

    before: for each block, the block of the same key in the frame before, and whether its rows were taken over.
    """

    origin: F64
    rows: Rows
    blocks: list[Block]
    before: list[tuple[Block | None, bool]]


class _Output:
    """The final arrays, grown as needed: untouched memory costs nothing, and no instance is copied twice."""

    def __init__(self) -> None:
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


class Placer:
    """Places what a reader found in a frame.

    origin: (3,) float64, subtracted from all positions before they become float32. camera: what looks at the scene, in world space; where it is None, all
    meshes keep their own origins. before: the frame before, of the same reader.
    """

    def __init__(self, reader: GraphReader, origin: F64, camera: Camera | None = None, before: Placed | None = None) -> None:
        self.reader, self.meshes = reader, reader.meshes
        self.origin, self.camera = origin, camera
        self.limit = np.inf if camera is None else local_reach(camera)
        self._before = before if before is not None and np.array_equal(before.origin, origin) else None
        self._known = {block.key: block for block in before.blocks} if before is not None else {}
        self._latest: dict[int, int] = {}
        self._output = _Output()
        self._blocks: list[tuple[Block, Block | None, bool]] = []

    def place(self, nodes: Sequence[Node]) -> Placed:
        """All instances of the objects at the top, in a stable order."""
        self.meshes.place_anew()
        self._plain([node for node in nodes if node.shown and not node.replaced])
        together: dict[tuple[str, str], list[Node]] = {}
        for node in nodes:
            if node.kind == Kind.OBJECT:
                continue
            if node.kind != Kind.COLLECTION and node.geometry is not None:
                self._instancer(("object", node.full_name), [node])
            else:
                members = self.reader.members(node.collection)
                inside = any(child is node for _, child in members.objects)
                together.setdefault(("object", node.full_name) if inside else ("collection", members.full_name), []).append(node)
        for key, hosts in together.items():
            self._instancer(key, hosts)
        return self._placed()

    def _placed(self) -> Placed:
        fresh, old = self._output.rows, self._before
        blocks: list[Block] = []
        before: list[tuple[Block | None, bool]] = []
        parts, at = [], 0
        for block, known, still in self._blocks:
            rows = None if known is None or old is None else old.rows[known.first : known.first + known.count]
            own = fresh[at : at + (0 if still else block.count)]
            at += len(own)
            taken = still or (rows is not None and own.same(rows))  # placed again, and nothing came of it
            parts.append(rows if taken else own)
            before.append((known, taken))
            block.first = blocks[-1].first + blocks[-1].count if blocks else 0
            blocks.append(block)
        count = sum(block.count for block in blocks)
        in_place = all(taken and known is not None and known.first == block.first for block, (known, taken) in zip(blocks, before, strict=True))
        if old is not None and in_place and len(old.rows) == count:
            rows = old.rows
        else:
            rows = fresh[:at] if at == count else Rows.join([part for part in parts if part is not None])
        return Placed(self.origin, rows, blocks, before)

    # Blocks

    def _begin(self, key: tuple[str, str], nodes: Sequence[Node]) -> bool:
        """Begin a block; False where all that it is placed from is as it was in the frame before, whose rows are then taken over."""
        of, known = tuple(node.full_name for node in nodes), self._known.get(key)
        if known is not None and self._is_still(known, of, nodes):
            for mesh, _ in known.pairs:
                self.meshes.source(mesh).origin = np.zeros(3)
            self._blocks.append((replace(known), known, True))
            return False
        self.block = Block(key, of, self._output.count)
        self._blocks.append((self.block, known, False))
        return True

    def _is_still(self, known: Block, of: tuple[str, ...], nodes: Sequence[Node]) -> bool:
        if self._before is None or known.of != of or known.reach > self.limit or not all(self.meshes.keeps_place(mesh) for mesh, _ in known.pairs):
            return False
        return all(self.reader.latest(node, self._latest) < self.reader.frame for node in nodes)

    def _plain(self, nodes: list[Node]) -> None:
        """Objects themselves."""
        if not self._begin(("", ""), nodes):
            return
        groups: dict[int, list[int]] = {}
        shown: list[Node] = []
        for node in nodes:
            if node.lamp is not None:
                self._lamp(node, Placements(node.world[None], int(Kind.OBJECT), -1, node.visible, node.marks))
            elif node.geometry is not None and node.geometry.mesh >= 0:
                groups.setdefault(node.geometry.mesh, []).append(len(shown))
                shown.append(node)
        if not shown:
            return
        world = np.stack([node.world for node in shown])
        columns = [(n.geometry.offset, n.name, n.visible, n.marks) for n in shown if n.geometry is not None]
        slots, names, visible, marks = np.array(columns, np.int32).T
        for mesh, members in groups.items():
            at = Placements(world[members], int(Kind.OBJECT), -1, visible[members].astype(np.uint8), marks[members].astype(np.uint8))
            self._emit(mesh, slots[members], names[members], VISIBLE, 0, at)
        self.block.count = self._output.count - self.block.first

    def _instancer(self, key: tuple[str, str], hosts: list[Node]) -> None:
        """What objects instance: one that does by nodes, or several that instance the same collection."""
        if self._begin(key, hosts):
            self._instances_of([(n, Placements(n.world[None], int(n.kind), n.name, n.visible, n.marks)) for n in hosts], (), 0)
            self.block.count = self._output.count - self.block.first

    # Placing

    def _object(self, node: Node, at: Placements, replaced: bool = False) -> None:
        """An instanced object, without what it instances itself. replaced: by its parent's vertex or face instancing."""
        if not node.shown or node.alone or (node.replaced and not replaced):
            return
        if node.lamp is not None:
            self._lamp(node, at)
        elif node.geometry is not None and node.geometry.mesh >= 0:
            self._emit(node.geometry.mesh, node.geometry.offset, node.name, node.visible, node.marks & int(InstanceFlag.SHADOW_CATCHER), at)

    def _instances_of(self, hosts: Sequence[tuple[Node, Placements]], stack: tuple[int, ...], depth: int) -> None:
        """What objects instance, for objects placed at the same depth. Those of one collection are taken together."""
        if depth >= MAX_DEPTH:
            return
        together: dict[str, tuple[Members, list[Placements]]] = {}
        for node, at in hosts:
            if node.key in stack or not len(at):
                continue
            if node.kind != Kind.COLLECTION and node.geometry is not None:
                self._geometry_instances(node.geometry, node, at, (*stack, node.key))
            else:
                members = self.reader.members(node.collection)
                if any(child is node for _, child in members.objects):
                    self._collection(members, compose(at.transform, members.offset), at, (*stack, node.key))
                else:
                    together.setdefault(members.full_name, (members, []))[1].append(at)
        for members, parts in together.values():
            at = Placements.join(parts)
            self._collection(members, compose(at.transform, members.offset), at, stack)

    def _collection(self, members: Members, spaces: F64, at: Placements, stack: tuple[int, ...]) -> None:
        """The objects of a collection in each of `spaces` (n, 3, 4)."""
        hosts = []
        for place, node in members.objects:
            if node.key in stack:
                continue
            child = at.inside(compose(spaces, node.world), slice(None), place)
            self._object(node, child)
            if node.kind != Kind.OBJECT:
                hosts.append((node, child))
        if hosts:
            self._instances_of(hosts, stack, len(at.path) + 1)

    def _geometry_instances(self, geometry: Geometry, owner: Node, at: Placements, stack: tuple[int, ...]) -> None:
        """The instances of a geometry, in blocks of all (placement, row) pairs."""
        if len(at.path) >= MAX_DEPTH:
            return
        self._output.reserve(len(at) * len(geometry.columns))
        for rows, target in geometry.groups:
            if target is None:
                continue
            count = len(geometry.columns) if rows is None else len(rows)
            for start in range(0, len(at) * count, BLOCK):
                flat = np.arange(start, min(start + BLOCK, len(at) * count))
                placement, row = flat // count, flat % count
                row = row if rows is None else rows[row]
                child = self._place_rows(geometry, at, placement, row)
                if isinstance(target, Node):
                    self._object(target, child, owner.kind == Kind.DUPLI)
                    if owner.recursive and target.kind != Kind.OBJECT:
                        self._instances_of([(target, child)], stack, len(child.path))
                elif isinstance(target, Members):
                    self._collection(target, compose(child.transform, target.offset), child, stack)
                else:
                    if target.mesh >= 0:
                        self._emit(target.mesh, target.offset, owner.name, VISIBLE, 0, child)
                    self._geometry_instances(target, owner, child, stack)

    @staticmethod
    def _place_rows(geometry: Geometry, at: Placements, placement: NDArray[np.int64], row: NDArray[np.int64]) -> Placements:
        transform = np.empty((len(row), 3, 4))
        compose_rows(at.transform, placement, geometry.columns, row, transform)
        return at.inside(transform, placement, row.astype(np.int32))

    def _lamp(self, node: Node, at: Placements) -> None:
        assert node.lamp is not None
        transform = at.transform.copy()
        transform[:, :, 3] -= self.origin
        self.block.lamps.append(Lamp(node.lamp, node.visible & at.visible, transform))

    def _emit(self, mesh: int, slots: Ints, name: Ints, visible: int, marks: int, at: Placements) -> None:
        """Instances of a mesh: visibility of the object and of the top-level object combined (invisible ones left out), unusable transforms left out."""
        flags: Ints = (at.visible & visible) | at.marks | marks
        if not isinstance(flags, int):
            flags = np.asarray(flags, np.uint8)
        seen = (flags & VISIBLE) != 0
        source, out, count = self.meshes.source(mesh), self._output, len(at)
        out.reserve(count)
        rows = out.rows[out.count : out.count + count]
        good = np.empty(count, np.bool_)
        low, high = source.box().astype(np.float64)
        if source.origin is None:
            source.origin = np.zeros(3) if self.camera is None else local_origin(low, high, at.transform, self.camera)
        placed = shifted(at.transform, source.origin) if source.origin.any() else np.ascontiguousarray(at.transform)
        usable, stretch = finish(placed, self.origin, low - source.origin, high - source.origin, rows.transform, rows.bounds, good)
        reach = float(np.maximum(np.abs(low), np.abs(high)).max()) * stretch
        self.block.reach = max(self.block.reach, reach if np.isfinite(reach) else np.inf)
        keep: Any = slice(None)
        if usable < count:
            self.block.dropped[source.name] = self.block.dropped.get(source.name, 0) + count - usable
        if usable < count or not np.all(seen):
            keep = good & seen
            count = int(keep.sum())
            rows.transform[:count], rows.bounds[:count] = rows.transform[keep], rows.bounds[keep]
        if not count:
            return
        part = slice(out.count, out.count + count)
        out.count += count
        out.rows.mesh[part], out.rows.slots[part], out.rows.flags[part] = mesh, _take(slots, keep), _take(flags, keep)
        self.block.pairs.update((mesh, offset) for offset in ([slots] if isinstance(slots, int) else np.unique(slots).tolist()))
        record, arrays = np.zeros((), KEY), {}
        record["path"] = -1
        for name_, value in (("kind", at.kind), ("host", at.host), ("object", name)):
            if isinstance(value, int):
                record[name_] = value
            else:
                arrays[name_] = value[keep]
        out.rows.records[part] = record
        for name_, values in arrays.items():
            out.rows.records[name_][part] = values
        for depth, level in enumerate(at.path):
            out.rows.records["path"][part, depth] = _take(level, keep)
