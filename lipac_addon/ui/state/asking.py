"""What a frame that was extracted is asked beside its error budget: levels of detail, and a limit to the memory of
renders; and what these are then predicted to take."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import bpy
import numpy as np

from ....core.culling.policies import LIGHT_PATHS
from ....core.errors import InputError
from ....core.files.memory_table import merged
from ....core.files.usage import give_back, resident_memory
from ... import roles
from ...writeback.plan import Plan, make_plan
from . import results, topology
from .results import FrameResult, Taken

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from ....core.arrays import I64
    from ....core.culling.options import CullOptions
    from ....core.culling.result import CullingResult
    from ....core.scene.model import Scene
    from ...extract import Extraction
    from ...extract.graph import GraphReader
    from ...extract.graph_items import Node

OF_FRAMES = "Limit Memory is for frames that are culled each by itself: switch it off to bake a shot"
OF_THE_CPU = "Limit Memory is for renders by Cycles on the processor: switch it off, or have the scene render there"
TWO_LIMITS = "Levels of Detail and Limit Memory do not go with the preference Memory Budget: set that to 0"


def check(scene: bpy.types.Scene, options: CullOptions, bake: bool) -> None:
    """Raise InputError where what is asked for does not go together."""
    if options.memory and bake:
        raise InputError(OF_FRAMES)
    if options.memory and not by_cycles_on_the_cpu(scene):
        raise InputError(OF_THE_CPU)
    if (options.memory or options.levels) and options.blas_budget_bytes:
        raise InputError(TWO_LIMITS)


def by_cycles_on_the_cpu(scene: bpy.types.Scene) -> bool:
    """Whether it is known what renders of a scene take."""
    from ...batch.engines.choices import AS_SET, CPU
    from ...batch.engines.devices import find_device

    return scene.render.engine == "CYCLES" and find_device(scene, AS_SET).kind == CPU


def asked(
    extraction: Extraction, uids: I64, options: CullOptions, scene: bpy.types.Scene, pinned: NDArray[np.bool_] | None
) -> tuple[Scene, NDArray[np.bool_] | None]:
    """What is looked at of an extracted frame of a scene, and (N,) bool, what stays, so that it is as Apply leaves it
    for renders. uids: of the names of its keys; pinned: what stays whatever is asked."""
    from ...memory.limit import limited

    one, own = extraction.scene, _as_the_user_has_it(extraction, uids)
    if options.levels:
        one = _without_levels(one, own)
    if options.memory:  # renders show what is ignored, whatever is decided on it
        one, stays = limited(replace(extraction, scene=one), scene, _held(), lasting=True)
        pinned = stays | own | (False if pinned is None else pinned)
    return one, pinned


def _held() -> int:
    """Bytes that Blender takes already."""
    give_back()
    return resident_memory()


def forms_of(extraction: Extraction, uids: I64, options: CullOptions) -> dict[int, bytes]:
    """As of `FrameResult`, of all objects that may have levels."""
    from ....core.culling.levels.candidates import may_be_levelled

    simplifiable, steps = may_be_levelled(extraction.scene)
    if not options.levels or not len(steps):
        return {}
    may = np.flatnonzero(simplifiable | (steps > 0))
    objects = np.unique(extraction.keys.records["object"][np.isin(extraction.scene.instances.mesh, may)])
    return topology.forms_of(uids[objects[objects >= 0]].tolist())


def _as_the_user_has_it(extraction: Extraction, uids: I64) -> NDArray[np.bool_]:
    """(N,) bool: instances that nothing is done to, pinned or ignored."""
    return roles.instances_of(extraction.keys, results.among(uids, roles.marked(roles.PIN, roles.IGNORE)))


def _without_levels(scene: Scene, own: NDArray[np.bool_]) -> Scene:
    """A scene in which the meshes of own, (N,) bool, stay as they are."""
    from ...extract.geometry.coarser import EvaluatedCoarser

    simplifiable, coarser = scene.simplifiable, scene.coarser
    fixed = np.isin(np.arange(len(scene.meshes)), scene.instances.mesh[own])
    return replace(
        scene,
        simplifiable=None if simplifiable is None else simplifiable & ~fixed,
        coarser=coarser.without(fixed) if isinstance(coarser, EvaluatedCoarser) else None,
    )


def weighed(
    found: FrameResult, extraction: Extraction, result: CullingResult, options: CullOptions, scene: bpy.types.Scene
) -> FrameResult:
    """With what a render of a frame of a scene takes, who takes it, and which levels stay. Where memory is limited, it
    is what Apply can do that counts."""
    from ...batch.session import with_levels_that_stay
    from ...memory.rows import Weighed

    if options.levels:
        lines = with_levels_that_stay(result, extraction.scene).warnings[len(result.warnings) :]
        found = replace(found, warnings=(*found.warnings, *lines))
    one = Weighed.of(extraction, result, found.frame, scene)
    rows = tuple(merged(one.rows()))
    if not by_cycles_on_the_cpu(scene):
        return replace(found, memory=rows)
    process = _held() if options.memory else resident_memory()
    full = one.in_full.figures(process)["memory_bytes"]
    now = (one.by(_plan(found, scene)) if options.memory else one).figures(process)
    taken = Taken(full, now["memory_bytes"], now["memory_bytes"] + now["memory_error_bytes"], process)
    return replace(found, memory=rows, taken=taken)


def ended(found: Mapping[int, FrameResult]) -> dict[int, FrameResult]:
    """What frames were found to take, where that is not limited, without what the analysis took itself, which has
    ended."""
    process = _held()
    return {
        number: one
        if one.taken is None or "memory_limit_bytes" in one.stats
        else replace(one, taken=one.taken.after(process))
        for number, one in found.items()
    }


def _plan(found: FrameResult, scene: bpy.types.Scene) -> Plan:
    """What Apply is about to do."""
    names = dict(zip(found.uids.tolist(), found.keys.names, strict=True))
    faces = {names[uid]: mask for uid, mask in found.faces.items()}
    levels = {names[uid]: level for uid, level in found.levels.items()}
    return make_plan(found.culled, found.keys, scene, lasting=True, faces=faces, levels=levels)


def exceeds(found: FrameResult, options: CullOptions) -> bool:
    """Whether a render may take more than it should."""
    return bool(options.memory) and found.taken is not None and found.taken.most > options.memory


def may_be_futile(scene: bpy.types.Scene, options: CullOptions) -> bool:
    """Whether it is known what an analysis costs and saves, and nothing else is asked for."""
    asked_more = options.levels or options.memory
    return options.policy == LIGHT_PATHS and not asked_more and by_cycles_on_the_cpu(scene)


def futile(
    reader: GraphReader,
    nodes: Sequence[Node],
    scene: bpy.types.Scene,
    options: CullOptions,
    frames: int,
    evaluated_s: float,
) -> str:
    """Why culling can save less of a frame than the analysis takes, as commands say it before they render without one;
    "" where it may save more, or that is not known. frames, evaluated_s: as of `stakes_of`."""
    from ...memory.stakes import stakes_of, why

    stakes = stakes_of(reader, nodes, scene, options, scene.cycles.samples, frames, evaluated_s)
    return f"Nothing can be won: {why(stakes)}" if stakes is not None and stakes.nothing_to_win else ""
