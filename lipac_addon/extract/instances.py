"""What a graph's objects place -> arrays of instances, without a Python step per instance.

NumPy composes the transforms of everything that objects, collections and instance references place: the instances of
geometry nodes come as arrays, the contents of a collection are composed with all objects that instance it at once. What
was placed from the same things in the frame before is taken over.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...core.arrays import F32, F64
from ...core.scene.model import Camera, InstanceFlag
from ...core.scene.placing import compose_rows, local_reach
from ..keys import MAX_DEPTH, Kind
from .geometry.geometry_sets import Geometry
from .geometry.simplify import Simplify
from .graph import GraphReader
from .graph_items import Members, Node
from .lights import Lamp
from .placements import VISIBLE, Block, Output, Placements, Rows, compose

BLOCK = 1 << 14  # instances composed at a time: their float64 temporaries stay in the cache


@dataclass
class Placed:
    """A frame: rows, the blocks that they consist of, in order, and where its coordinates begin.

    before: for each block, the block of the same key in the frame before, and whether its rows were taken over.
    """

    origin: F64
    rows: Rows
    blocks: list[Block]
    before: list[tuple[Block | None, bool]]


class Placer:
    """Places what a reader found in a frame.

    origin: (3,) float64, subtracted from all positions before they become float32. camera: what looks at the scene, in
    world space; where it is None, all meshes keep their own origins. before: the frame before, of the same reader.
    """

    def __init__(
        self, reader: GraphReader, origin: F64, camera: Camera | None = None, before: Placed | None = None
    ) -> None:
        self.reader, self.meshes = reader, reader.geometry.meshes
        self.origin = origin
        self.limit = np.inf if camera is None else local_reach(camera)
        self._simplify = Simplify.of(reader.depsgraph.scene_eval, camera)
        self._before = before if before is not None and np.array_equal(before.origin, origin) else None
        self._known = {block.key: block for block in before.blocks} if before is not None else {}
        self._latest: dict[int, int] = {}
        self._output = Output(self.meshes, origin, camera)
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
                key = ("object", node.full_name) if inside else ("collection", members.full_name)
                together.setdefault(key, []).append(node)
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
        in_place = all(
            taken and known is not None and known.first == block.first
            for block, (known, taken) in zip(blocks, before, strict=True)
        )
        if old is not None and in_place and len(old.rows) == count:
            rows = old.rows
        else:
            rows = fresh[:at] if at == count else Rows.join([part for part in parts if part is not None])
        return Placed(self.origin, rows, blocks, before)

    # Blocks

    def _begin(self, key: tuple[str, str], nodes: Sequence[Node]) -> bool:
        """Begin a block; False where all that it is placed from is as it was in the frame before, whose rows are then
        taken over."""
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
        if self._before is None or known.of != of or known.reach > self.limit or self._simplify is not None:
            return False
        if not all(self.meshes.keeps_place(mesh) for mesh, _ in known.pairs):
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
            at = Placements(
                world[members], int(Kind.OBJECT), -1, visible[members].astype(np.uint8), marks[members].astype(np.uint8)
            )
            at = _there(self._simplify, [shown[k] for k in members], self.meshes.source(mesh).bounds, at)
            self._output.emit(self.block, mesh, slots[members], names[members], VISIBLE, 0, at)
        self.block.count = self._output.count - self.block.first

    def _instancer(self, key: tuple[str, str], hosts: list[Node]) -> None:
        """What objects instance: one that does by nodes, or several that instance the same collection."""
        if self._begin(key, hosts):
            whole = ~int(InstanceFlag.DIVISIBLE)
            at = [Placements(n.world[None], int(n.kind), n.name, n.visible, n.marks & whole) for n in hosts]
            self._instances_of(list(zip(hosts, at, strict=True)), (), 0)
            self.block.count = self._output.count - self.block.first

    def _object(self, node: Node, at: Placements, replaced: bool = False) -> None:
        """An instanced object, without what it instances itself. replaced: by its parent's vertex or face
        instancing."""
        if not node.shown or node.alone or (node.replaced and not replaced):
            return
        if node.lamp is not None:
            self._lamp(node, at)
        elif node.geometry is not None and node.geometry.mesh >= 0:
            mesh, offset, marks = (
                node.geometry.mesh,
                node.geometry.offset,
                node.marks & int(InstanceFlag.SHADOW_CATCHER),
            )
            there = _there(self._simplify, [node], self.meshes.source(mesh).bounds, at)
            self._output.emit(self.block, mesh, offset, node.name, node.visible, marks, there)

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
                child = _place_rows(geometry, at, placement, row)
                if isinstance(target, Node):
                    self._object(target, child, owner.kind == Kind.DUPLI)
                    if owner.recursive and target.kind != Kind.OBJECT:
                        self._instances_of([(target, child)], stack, len(child.path))
                elif isinstance(target, Members):
                    self._collection(target, compose(child.transform, target.offset), child, stack)
                else:
                    if target.mesh >= 0:
                        there = _there(self._simplify, [owner], self.meshes.source(target.mesh).bounds, child)
                        self._output.emit(self.block, target.mesh, target.offset, owner.name, VISIBLE, 0, there)
                    self._geometry_instances(target, owner, child, stack)

    def _lamp(self, node: Node, at: Placements) -> None:
        assert node.lamp is not None
        transform = at.transform.copy()
        transform[:, :, 3] -= self.origin
        self.block.lamps.append(Lamp(node.lamp, node.visible & at.visible, transform))


def _place_rows(geometry: Geometry, at: Placements, placement: NDArray[np.int64], row: NDArray[np.int64]) -> Placements:
    transform = np.empty((len(row), 3, 4))
    compose_rows(at.transform, placement, geometry.columns, row, transform)
    return at.inside(transform, placement, row.astype(np.int32))


def _there(simplify: Simplify | None, nodes: Sequence[Node], box: F32, at: Placements) -> Placements:
    """Placements of a mesh with a box (2, 3): those that Cycles leaves out are invisible. nodes: the object, or one for
    each placement."""
    if simplify is None:
        return at
    each = [at.transform] if len(nodes) == 1 else np.split(at.transform, len(nodes))
    gone = np.concatenate([simplify.gone(node.item, box, place) for node, place in zip(nodes, each, strict=True)])
    return replace(at, visible=np.where(gone, 0, at.visible)) if gone.any() else at
