"""Which switches of the viewport take culled instances out of it."""

from __future__ import annotations

import bpy
import numpy as np

from ..keys import Keys, Kind
from .plan import METABALL, MISSING, MORE, SIMULATION, UNBAKED, Mask, Planner
from .references import simulates


def viewport_plan(
    culled: Mask, keys: Keys, scene: bpy.types.Scene
) -> tuple[tuple[bpy.types.Object, ...], tuple[tuple[bpy.types.Object, Mask], ...], Mask]:
    """Objects whose eyes to close, hosts with their (R,) bool rows to take out, and (N,) bool, the instances that go by
    that.

    culled: (N,) bool of the instances of keys. An eye hides an object and what it instances, and nothing that others
    instance of it.
    """
    planner = _ViewportPlanner(culled, keys, scene, False, False)
    hidden = planner.hidden_objects()
    masks = tuple(planner.masks(hidden))
    return tuple(hidden.values()), masks, planner.removed & culled


class _ViewportPlanner(Planner):
    """What differs from the plan for renders."""

    def hidden_objects(self) -> dict[int, bpy.types.Object]:
        """Objects by their name index, of which all that their eye hides is culled."""
        own = np.where(self.columns.kind == Kind.OBJECT, self.columns.object, self.columns.host)
        there = own >= 0
        count = np.bincount(own[there], minlength=len(self.names))
        kept = np.bincount(own[there & ~self.culled], minlength=len(self.names))
        found = ((int(n), self.found.get(self.names[n])) for n in np.flatnonzero((count > 0) & (kept == 0)))
        hidden = {n: ob for n, ob in found if ob is not None and self.obstacle(ob) is None}
        gone = np.zeros(len(self.names) + 1, bool)
        gone[list(hidden)] = True
        self.removed = gone[own]  # index -1: nobody
        return hidden

    def obstacle(self, ob: bpy.types.Object | None) -> str | None:
        if ob is None:
            return MISSING
        if ob.type == "META":
            return METABALL
        if self.references.carries_more(ob):
            return MORE
        if simulates(ob):
            return SIMULATION
        return UNBAKED if self.references.holds_cache(ob) else None
