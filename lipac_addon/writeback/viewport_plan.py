"""Which switches of the viewport take culled instances out of it.

In two steps, for a million instances take a while: what their keys alone say, which any thread can find out, and what
Blender allows of that, which only the main thread may ask.
"""

from __future__ import annotations

from dataclasses import dataclass

import bpy
import numpy as np
from numpy.typing import NDArray

from ..keys import Keys, Kind
from .plan import MISSING, UNBAKED, Columns, Mask, Obstacles, deletable_rows, hosts


@dataclass(frozen=True)
class Candidates:
    """What could go by the keys of instances. objects: name indices of those whose eye hides nothing that stays. rows:
    by the name index of a host the (R,) bool rows to take out: all, and those that are not nested."""

    objects: NDArray[np.int64]
    rows: dict[int, tuple[Mask, Mask]]


def candidates(culled: Mask, keys: Keys) -> Candidates:
    """The candidates, culled being (N,) bool of the instances of keys; asks nothing of Blender."""
    columns = Columns.of(keys.records)
    own = np.where(columns.kind == Kind.OBJECT, columns.object, columns.host)
    there = own >= 0
    count = np.bincount(own[there], minlength=len(keys.names))
    kept = np.bincount(own[there & ~culled], minlength=len(keys.names))
    rows = {}
    for n, instances in hosts(columns, Kind.GEOMETRY_NODES):
        if culled[instances].any():
            row, stays = columns.row[instances], ~culled[instances]
            rows[n] = deletable_rows(row, stays), deletable_rows(row, stays | columns.deep[instances])
    return Candidates(np.flatnonzero((count > 0) & (kept == 0)), rows)


def viewport_plan(
    found: Candidates, names: tuple[str, ...], scene: bpy.types.Scene
) -> tuple[tuple[bpy.types.Object, ...], tuple[tuple[bpy.types.Object, Mask], ...]]:
    """Objects whose eyes to close, and hosts with their (R,) bool rows to take out. names: full names as they are now,
    by the indices of the candidates. An eye hides an object and what it instances, and nothing that others instance of
    it."""
    obstacles = _Obstacles(scene, lasting=False, in_render=False)
    objects = {int(n): obstacles.found.get(names[n]) for n in found.objects}
    hidden = {n: ob for n, ob in objects.items() if ob is not None and obstacles.obstacle(ob) is None}
    masks = []
    for n, (every, unnested) in found.rows.items():
        ob = obstacles.found.get(names[n])
        if n in hidden or ob is None or obstacles.modifier_obstacle(ob) or obstacles.references.ids_are_read:
            continue
        # nested parts may hold lights, which have no instance here
        rows = unnested if obstacles.references.carries_more(ob) else every
        if rows.any():
            masks.append((ob, rows))
    return tuple(hidden.values()), tuple(masks)


class _Obstacles(Obstacles):
    """What stands against closing an object's eye."""

    def obstacle(self, ob: bpy.types.Object | None) -> str | None:
        if ob is None:
            return MISSING
        return self.hiding_does_more(ob) or (UNBAKED if self.references.holds_cache(ob) else None)
