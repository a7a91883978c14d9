"""Culling written back into Blender, so that an unmodified Cycles or EEVEE render benefits, and taken back exactly.

`apply` chooses the means (see docs/write-back.md):

- `hide_render` of an object, where that takes away culled instances only;
- a mask modifier on geometry-nodes hosts, which removes single instances;
- the render switch of particle systems, as a whole;
- a face modifier on objects of which parts are culled;
- meshes that are exchanged for simplified ones, fewer render levels of subdivision, curves with fewer points;
- and where asked to, objects that only culled instances show are emptied, so that their images, meshes and modifiers
  cost nothing.

Read in the order of use: `references` (who instances whom), `sources` (what else looks at what is instanced), `plan`
(which means for which instance), `marks` (the record kept in the .blend), `mask` and `faces` (the modifiers),
`emptying`, `levels`. Only the last two affect the viewport, and nothing is written to disk.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import bpy
import numpy as np
from numpy.typing import NDArray

from ...core.arrays import F32
from ...core.files.level import AnyLevel, Level
from ..keys import Keys, full_name
from . import emptying, marks, mask
from . import faces as face_mask
from .levels import coarser_settings, simplify
from .plan import EMPTY, NO_LEVELS, Plan, make_plan

__all__ = ["WritebackResult", "apply", "restore"]


@dataclass(frozen=True)
class WritebackResult:
    """What `apply` did.

    removed: (N,) bool, the culled instances that a render no longer meets.
    kept: culled instances that could not be removed, counted by the reason.
    objects, hosts, particle_hosts, sources: numbers of hidden objects, of masked geometry-nodes hosts, of emitters
    switched off, of objects emptied. face_hosts, faces_removed: numbers of objects that lost faces, and of these;
    whole: objects that should have, counted by the reason. simplified: number of objects whose mesh is exchanged, or
    subdivided less.
    reasons: why, by full name of objects of which culled instances could not be removed.
    """

    removed: NDArray[np.bool_]
    kept: dict[str, int]
    objects: int
    hosts: int
    particle_hosts: int
    face_hosts: int
    faces_removed: int
    whole: dict[str, int]
    simplified: int
    sources: int
    reasons: dict[str, str]

    def summary(self) -> dict[str, object]:
        """For the report: plain numbers."""
        return {
            "removed": int(np.count_nonzero(self.removed)),
            "kept": dict(self.kept),
            "hidden_objects": self.objects,
            "masked_hosts": self.hosts,
            "particle_hosts": self.particle_hosts,
            "face_hosts": self.face_hosts,
            "faces_removed": self.faces_removed,
            "whole": dict(self.whole),
            "simplified_objects": self.simplified,
            "emptied_sources": self.sources,
        }


def apply(
    culled: NDArray[np.bool_],
    keys: Keys,
    places: dict[str, F32] | None = None,
    *,
    scene: bpy.types.Scene | None = None,
    lasting: bool = False,
    in_render: bool = False,
    faces: Mapping[str, NDArray[np.bool_]] = EMPTY,
    free: bool = False,
    levels: Mapping[str, AnyLevel] = NO_LEVELS,
) -> WritebackResult:
    """Remove culled instances from renders of the open file.

    culled: (N,) bool, True where an instance goes; keys: of the same N instances, extracted with nothing applied.
    places: by the full name of an object that instances by geometry nodes, (R, 3) where its rows are, in its own space.
    A row is then culled only while the instance of its number is there: what an edit numbers anew is not taken for
    others. Not for objects that move their instances over the frames. scene: the one that was analysed, None: the open
    one. lasting: it is to be saved, or undone, neither of which Blender does for directly linked objects: they stay.
    in_render: a handler of a render calls. free: empty the sources of which nothing stays, too, which the viewport
    shows; not together with places, by which what is culled may come back.
    faces: by the full name of an object, (F,) bool, those faces of its mesh that stay, behind all its modifiers; of
    other objects all do. levels: by the full name of an object, what takes the place of its mesh, which the viewport
    shows, too, but for fewer levels of subdivision and points of curves.
    What an earlier call did is taken back first, so calling twice is as calling once. All or nothing: where something
    fails, what was done is taken back. Raises ValueError where the lengths differ.
    """
    if len(culled) != len(keys.records):
        raise ValueError(f"{len(culled)} states for {len(keys.records)} instances")
    restore(in_render)
    scene = scene or bpy.context.scene
    plan = make_plan(culled, keys, scene, lasting, in_render, faces, free and not places, levels)
    emitters = len({e.name_full for e, _ in plan.particle_modifiers})
    cut = len(plan.faces), sum(int(np.count_nonzero(gone)) for _, gone in plan.faces)
    result = WritebackResult(
        plan.removed,
        plan.kept,
        len(plan.objects),
        len(plan.masks),
        emitters,
        *cut,
        plan.whole,
        len(plan.levels),
        len(plan.sources),
        plan.reasons,
    )
    try:
        _write(plan, places or {}, in_render, scene)
        return result
    except BaseException:
        restore(in_render)
        raise


def restore(in_render: bool = False) -> bool:
    """Take back everything that `apply` did in the open file, also when that was saved and loaded since; True where
    there was something.

    Exact: values, active modifiers, and no data-block or custom property left over. What a user changed since stays as
    the user set it. What a linked file was saved with is taken back until the open one is opened again
    (`marks.culled_libraries`).
    """
    found = mask.remove_all()
    found |= emptying.fill_all()
    return marks.take_back(in_render) or found


def _write(plan: Plan, places: dict[str, F32], in_render: bool, scene: bpy.types.Scene) -> None:
    """Marks first: whatever fails afterwards can be found and taken back."""
    hidden, off = (
        ((ob, marks.HIDDEN) for ob in plan.objects),
        ((ob, marks.particles(ob.modifiers[name])) for ob, name in plan.particle_modifiers),
    )
    emptied = ((ob, word) for ob in plan.sources for word in emptying.words(ob))
    simplified = [(ob, level) for ob, level in plan.levels if isinstance(level, Level)]
    coarser = list(coarser_settings(plan.levels, scene))
    exchanged = ((ob, marks.SIMPLIFIED) for ob, _ in simplified)
    lowered = ((ob, marks.coarser(setting, value)) for ob, setting, value in coarser)
    masked = ((host, marks.MASKED) for host, _ in (*plan.masks, *plan.faces))
    marks.write([*hidden, *off, *exchanged, *lowered, *masked, *emptied])
    marks.set_hidden(list(plan.objects), True, in_render)
    for emitter, modifier in plan.particle_modifiers:
        emitter.modifiers[modifier].show_render = False
    for host, rows in plan.masks:
        mask.add(host, rows, places.get(full_name(host)))
    for ob, gone in plan.faces:
        face_mask.add(ob, gone)
    emptying.empty(plan.sources)
    for _, setting, value in coarser:
        setting.set(value)
    simplify(simplified)
