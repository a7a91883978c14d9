"""Meshes with fewer triangles, as Blender makes them: evaluated once more with other settings of their objects."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ....core.scene.mesh import Mesh
from ....core.scene.model import Scene
from ...coarsening import Setting, setting_of
from ...console import muted
from ...depsgraph import changed, with_render_depsgraph
from .meshes import MeshSource, corners_of, describe, faces_of, load

if TYPE_CHECKING:
    from ....core.culling.levels.stand_ins import Alternative, StandIn
    from ....core.files.level import AnyLevel, Level
    from ...keys import Keys


class EvaluatedCoarser:
    """`core.scene.mesh.CoarserMeshes` of the open file at its current frame. Blender evaluates the whole scene for each
    step: on the main thread, where no render runs and no graph is held."""

    def __init__(
        self,
        steps: NDArray[np.int64],
        sources: Sequence[MeshSource | None],
        uv_maps: Sequence[str],
        scene: bpy.types.Scene,
        layer: str,
    ) -> None:
        """steps: (M,), of the sources; layer: the view layer that these are of."""
        self.steps = steps
        self._sources, self._uv_maps, self._scene, self._layer = list(sources), tuple(uv_maps), scene, layer

    def of(self, scene: bpy.types.Scene) -> EvaluatedCoarser:
        """The same by another reference to the scene: undo makes new ones of everything."""
        return EvaluatedCoarser(self.steps, self._sources, self._uv_maps, scene, self._layer)

    def without(self, fixed: NDArray[np.bool_]) -> EvaluatedCoarser:
        """The same with meshes, (M,) bool, that stay as they are."""
        steps = np.where(fixed, 0, self.steps)
        return EvaluatedCoarser(steps, self._sources, self._uv_maps, self._scene, self._layer)

    def read(self, meshes: Sequence[int]) -> Mapping[int, Sequence[Mesh]]:
        """As `CoarserMeshes`."""
        out: dict[int, list[Mesh]] = {number: [] for number in meshes}
        for step in range(1, 1 + int(self.steps[list(meshes)].max(initial=0))):
            for number, mesh in self.at({n: step for n in meshes if self.steps[n] >= step}).items():
                out[number].append(mesh)
        return {number: found for number, found in out.items() if found}

    def kept(self, shown: NDArray[np.integer]) -> list[str]:
        """Of meshes that are shown, any shape, which keep their levels of subdivision or the resolution of a curve, and
        why: lines for the user."""
        sources = (self._sources[number] for number in np.unique(shown).tolist())
        why = Counter(source.fixed for source in sources if source is not None and source.fixed)
        return [f"{count:,} meshes keep their subdivision or resolution: {reason}" for reason, count in why.items()]

    def at(self, steps: Mapping[int, int]) -> Mapping[int, Mesh]:
        """As `CoarserMeshes`."""
        objects = {}
        with ExitStack() as stack:
            stack.enter_context(muted())
            for number, step in steps.items():
                source = self._sources[number]
                ob = None if source is None else bpy.data.objects.get((source.owner, None))
                setting = "" if ob is None else setting_of(ob, self._scene)
                if ob is not None and isinstance(setting, Setting) and len(setting.values) >= step:
                    stack.enter_context(changed(setting.owner, **{setting.name: setting.values[step - 1]}))
                    objects[number] = ob
            return with_render_depsgraph(self._scene, None, partial(self._evaluated, objects), self._layer)

    def _evaluated(self, objects: Mapping[int, bpy.types.Object], depsgraph: Any) -> dict[int, Mesh]:
        """What a graph has of objects, placed and shaded as the meshes that they stand for."""
        out = {}
        for number, ob in objects.items():
            whole = self._sources[number]
            source = describe(depsgraph.id_eval_get(ob).evaluated_geometry(), ob.name)
            if whole is not None and source is not None and source.slot_count <= whole.slot_count and not source.broken:
                out[number] = load(replace(source, needs_uv=whole.needs_uv, origin=whole.origin), self._uv_maps)
        return out


def alternatives(
    scene: Scene, keys: Keys, active: NDArray[np.bool_], levels: Mapping[str, AnyLevel]
) -> list[tuple[NDArray[np.int64], Alternative]]:
    """Rows of a frame of which active, (N,) bool, stays, and what takes the place of their mesh, by what does of
    objects, by their full names. Raises ValueError where a mesh is another than it was made of."""
    from ....core.culling.levels.stand_ins import Alternative, Coarser
    from ....core.files.level import Steps

    mesh, ob = scene.instances.mesh, keys.records["object"]
    groups: dict[tuple[int, int], tuple[AnyLevel, list[int]]] = {}
    shown = active & np.isin(ob, [n for n, name in enumerate(keys.names) if name in levels])
    for number, name in np.unique(np.stack((mesh[shown], ob[shown])), axis=1).T.tolist():
        level = levels[keys.names[name]]
        groups.setdefault((number, id(level)), (level, []))[1].append(name)
    steps = {number: level.steps for (number, _), (level, _) in groups.items() if isinstance(level, Steps)}
    made = scene.coarser.at(steps) if steps and scene.coarser is not None else {}
    out = []
    for (number, _), (level, names) in groups.items():
        if isinstance(level, Steps):
            if number not in made:
                raise ValueError("an object that cannot be subdivided less")
            found = Alternative(Coarser(level.steps, len(made[number].triangles)), made[number])
        else:
            stand_in = _stand_in(scene, number, level)
            found = Alternative(stand_in, stand_in.of(scene.meshes[number]))
        out.append((np.flatnonzero(shown & (mesh == number) & np.isin(ob, names)), found))
    return out


def _stand_in(scene: Scene, number: int, level: Level) -> StandIn:
    """A level of a mesh by its triangles."""
    from ....core.culling.levels.stand_ins import StandIn

    whole = scene.meshes.sources[number].geometry.mesh  # type: ignore[attr-defined]
    corners, faces = corners_of(whole).reshape(-1), faces_of(whole)
    same = level.corners.max() < len(whole.loops) and level.faces.max() < len(whole.polygons)
    if scene.simplifiable is None or not scene.simplifiable[number] or not same:
        raise ValueError("a mesh of other corners")
    of_corner, of_face = np.zeros(len(whole.loops), np.int32), np.zeros(len(whole.polygons), np.int32)
    of_corner[corners], of_face[faces] = np.arange(len(corners)), np.arange(len(faces))
    return StandIn(of_corner[level.corners], of_face[level.faces])
