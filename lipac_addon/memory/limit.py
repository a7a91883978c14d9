"""What bears on a render whose memory is limited: what of the open file can go, and what goes with it."""

from __future__ import annotations

from dataclasses import replace
from types import MappingProxyType

import bpy
import numpy as np
from numpy.typing import NDArray

from ...core.scene.model import Scene
from ..extract import Extraction
from ..keys import Kind, full_name
from ..writeback.plan import make_plan
from .costs import costs_of

PROCESS = 430_000_000  # bytes of Blender as a module with an empty file, where the process that renders does not say


def limited(
    extraction: Extraction, scene: bpy.types.Scene, process: int, lasting: bool = False
) -> tuple[Scene, NDArray[np.bool_]]:
    """The scene that was extracted, with what a render of it takes; and (N,) bool, instances that no means can take
    away.

    process: bytes of the process before it renders. lasting: as of `writeback.apply`, which then leaves sources as they
    are. Images that something loads whatever is culled are paid for anyway.
    """
    one, keys = extraction.scene, extraction.keys
    count = len(one.instances)
    plan = make_plan(np.ones(count, bool), keys, scene, lasting, faces=MappingProxyType({}), free=not lasting)
    gone = {full_name(ob) for ob in (*plan.objects, *plan.sources)}
    names = np.array([name in gone for name in keys.names] + [False], bool)  # the last is that of -1
    records = keys.records
    vanish = plan.removed & (names[records["object"]] | (names[records["host"]] & (records["object"] < 0)))
    vanish |= plan.removed & (records["kind"] == Kind.OBJECT)
    costs = costs_of(extraction, scene).costs
    costs = costs.with_images_that_stay(costs.images_of(np.unique(one.instances.slots[~vanish])))
    return replace(one, render_costs=replace(costs, process=process)), ~plan.removed
