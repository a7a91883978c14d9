"""Material slots: which materials the triangles of an object's mesh have, by name."""

from __future__ import annotations

from typing import Any

import numpy as np

from ....core.arrays import I32

Slots = tuple[str | None, ...]
"""Names of the materials of a mesh's slots, at least one; None for the default. Past the last slot the last one
counts."""


def material_slots(item: Any, mesh: Any, override: Any, materials: dict[str, Any]) -> Slots:
    """Names of the materials of an object's mesh: a slot linked to the object comes before the mesh's own. The
    materials are added to `materials`."""
    if override is not None:
        found = [override]
    else:
        own, data = item.material_slots, mesh.materials
        linked = {i: s.material for i, s in enumerate(own) if s.link == "OBJECT" and s.material is not None}
        found = [linked.get(i, data[i] if i < len(data) else None) for i in range(max(len(own), len(data)))] or [None]
    names = [None if material is None else material.name_full for material in found]
    materials.update({name: material for name, material in zip(names, found, strict=True) if name is not None})
    return tuple(names)


class SlotTable:
    """`Scene.slot_materials` of a frame: each list of materials once.

    order: names of materials by index, in the order in which they are first needed.
    """

    def __init__(self) -> None:
        self.order: dict[str | None, int] = {}
        self._table: list[int] = []
        self._known: dict[Slots, int] = {}

    def offset(self, slots: Slots, count: int) -> int:
        """Where the materials of a mesh with count slots begin."""
        key = slots[:count] + slots[-1:] * (count - len(slots))
        if key not in self._known:
            self._known[key] = len(self._table)
            self._table += [self.order.setdefault(name, len(self.order)) for name in key]
        return self._known[key]

    def table(self) -> I32:
        """(S,) int32 into the materials."""
        return np.array(self._table, np.int32)
