"""Whether an analysis of a frame could win anything, from what Blender has evaluated, before anything else is read."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import bpy
import numpy as np

from ...core.culling.options import CullOptions
from ...core.files.figures import size
from ...core.scene.model import Film
from ...core.scene.render_costs import Stakes
from ...core.threads import processors
from ..extract.graph import GraphReader
from ..extract.graph_items import Node
from ..extract.instances import Placer
from ..extract.placements import Rows
from ..keys import Kind
from .costs import NamedCosts, SlotMaterials, named_costs


class NothingToWin(Exception):
    """Culling cannot save what the analysis of a frame takes; the message says so in one line. seconds: that finding
    out took."""

    def __init__(self, stakes: Stakes, seconds: float) -> None:
        self.seconds = seconds
        super().__init__(f"nothing is culled: {why(stakes)}")


def why(stakes: Stakes) -> str:
    """Why nothing can be won."""
    return (
        f"with {stakes.instances:,} instances ({size(stakes.saved)}) and {stakes.paths:,} paths of a picture, culling "
        f"would save less than the {stakes.analysed:,} paths of an analysis take"
    )


def weigh(reader: GraphReader, nodes: Sequence[Node], scene: bpy.types.Scene) -> tuple[NamedCosts, Rows]:
    """What a render takes of a scene, of whose graph these objects were read; and its instances."""
    rows = Placer(reader, np.zeros(3)).place(nodes).rows
    slots = SlotMaterials(reader.geometry.slots.table(), tuple(reader.geometry.slots.order))
    return named_costs(reader.geometry.meshes.sources, rows.mesh, rows.slots, rows.records, slots, scene), rows


def stakes_of(
    reader: GraphReader,
    nodes: Sequence[Node],
    scene: bpy.types.Scene,
    options: CullOptions,
    samples: int,
    frames: int,
    evaluated_s: float,
) -> Stakes | None:
    """What a render of a scene by Cycles on the CPU could save, of whose graph these objects were read; None where that
    is not known. samples: per pixel; the others as of `Stakes.of`."""
    if reader.unsupported or _unmeasured(scene):
        return None
    named, rows = weigh(reader, nodes, scene)
    if not len(rows):  # light paths meet nothing; who analyses tells what that means
        return None
    objects = int(np.count_nonzero(rows.records["kind"] == Kind.OBJECT))
    scale = scene.render.resolution_percentage / 100
    film = Film(max(int(scene.render.resolution_x * scale), 1), max(int(scene.render.resolution_y * scale), 1))
    width, height = options.picture_size(film)
    analysed = width * height * (options.first_paths_per_pixel(film) + options.paths_per_pixel(film))
    paths = film.width * film.height * samples
    return Stakes.of(named.costs, objects, evaluated_s, paths, analysed, frames, processors())


def _unmeasured(scene: bpy.types.Scene) -> bool:
    """Whether a render of a scene takes what the rates of `core.scene.render_costs` know nothing of."""
    trees = [block.node_tree for block in (*bpy.data.materials, *bpy.data.worlds) if block.node_tree is not None]
    return (
        scene.render.use_motion_blur
        or any(_is_volume(node) for tree in (*trees, *bpy.data.node_groups) for node in tree.nodes)
        or any(getattr(m, "use_adaptive_subdivision", False) for ob in bpy.data.objects for m in ob.modifiers)
    )


def _is_volume(node: Any) -> bool:
    return node.bl_idname.startswith("ShaderNodeVolume")
