"""Node materials -> MATERIAL records.

Principled and the plain BSDF nodes map one to one. Mix and Add shaders become materials composed of others, which paths
pick at random by their shares; with Transparent a Principled gets an alpha, with Emission a plain BSDF an emission. A
tree that tells rays or sides apart is converted for each of them.

What is not modelled errs on the side of seeing more: where nobody can say how much passes through, half of the paths
do, and the record is marked as unsure, so that what they see there is kept. Whatever differs from Blender is reported
as "material NAME: WHAT".
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ....core.arrays import Records
from ....core.scene.model import VIEWS, RayType, Shader, Unsure, default_material
from . import nodes, shaders
from .converter import Converter
from .displacement import Relief, relief_of
from .ranges import reach_of
from .reader import Reader, View, no_objects
from .textures import TextureTable
from .trees import (
    UNKNOWN,
    Composed,
    Tree,
    black,
    clear,
    half_sure,
    heads,
    key_of,
    leaves,
    mixed,
    opaque_to_shadows,
    passes_straight,
    spread,
    unsure,
)

# Where a pattern's dark parts are darker than so much of its mean, half of what it shows is sure: a tile may hold dark
# parts alone, and with them twice as much of what lies on these as the pattern has there
DARKER = 0.25
PICKED = "emission that light sampling sees otherwise than rays not rendered as Cycles weighs it; all that emits stays"
Colors = Mapping[str | None, Sequence[Sequence[float]]]
BY_OBJECT = {"OBJECT_INFO", "ATTRIBUTE"}
LIGHT_LOOP = {
    "ShaderNodeLightAccumulation", "ShaderNodeLightEvaluation", "ShaderNodeLightInfo", "ShaderNodeShadowRaycast"
}


class MaterialTable:
    """Materials by name: `index(material)` converts one the first time.

    records: the materials, composed ones with `parts` that are numbered from the first of those records that are parts
    of others. by_object: whether some show what objects have of their own, which may change though no material does.
    """

    def __init__(
        self, textures: TextureTable, most: bool = True, colors: Callable[[], Colors] = dict[str | None, Any]
    ) -> None:
        """most: what is not modelled is taken for the most that it may do, so that an analysis errs on the side of
        seeing more: true displacement, emission, subsurface; else it is left out, or an average is there. colors: of
        the objects that show each material, by its name."""
        self._colors = colors
        self.textures = textures
        self.most = most
        self.records: list[Records] = []
        self.reliefs: list[Relief | None] = []
        self.by_object = False
        self.approximated: dict[str, None] = {}
        self._parts: list[Records] = []
        self._textured: list[bool] = []
        self._known: dict[str | None, int] = {}

    def index(self, material: Any) -> int:
        """Index of a bpy.types.Material, or of the default for None."""
        name = None if material is None else material.name_full
        if name not in self._known:
            tree, relief = (default_material(), None) if material is None else self._convert(material)
            self._known[name] = len(self.records)
            self._textured.append(any(_is_textured(record) for record in (*leaves(tree), *heads(tree))))
            self.reliefs.append(relief)
            self.records.append(self._flat(tree))
        return self._known[name]

    def textured(self, index: int) -> bool:
        """Whether a material needs UVs."""
        return self._textured[index]

    def build(self) -> Records:
        """(M,) of MATERIAL: those that have an index, then the parts of composed ones."""
        out = np.stack([*(self.records or [default_material()]), *self._parts])
        out["parts"][out["shader"] >= Shader.MIX] += len(out) - len(self._parts)
        return out

    def _flat(self, tree: Tree) -> Records:
        if not isinstance(tree, Composed):
            return tree
        parts = [self._flat(part) for part in (tree.first, tree.second)]
        tree.head["parts"] = np.arange(2) + len(self._parts)
        tree.head["emission"] = np.maximum(*(part["emission"] for part in parts))
        self._parts += parts
        return tree.head

    def _convert(self, material: Any) -> tuple[Tree, Relief | None]:
        def report(line: str) -> None:
            self.approximated.setdefault(f"material {material.name}: {line}")

        self.textures.report = report
        if material.node_tree is None:
            record = default_material()
            record["base_color"] = material.diffuse_color[:3]
            record["metallic"], record["roughness"] = material.metallic, material.roughness
            return record, None
        loops = loops_over_lights(material.node_tree)
        if loops:
            report("light loop not rendered")
        inlined = material.inline_shader_nodes()  # keeps the tree alive
        tree = inlined.node_tree
        if tree.get_output_node("CYCLES") is None:
            tree = material.node_tree  # only the active output is inlined, and that one may be EEVEE's
        self.by_object |= any(node.type in BY_OBJECT for node in tree.nodes)
        name = material.name_full
        picked = self.most and material.cycles.emission_sampling != "NONE"
        out = convert_tree(tree, self.textures, report, self.most, lambda: _rows(self._colors().get(name)), picked)
        if any(leaf["sure"] < DARKER for leaf in leaves(out)):
            out = half_sure(out)
        if loops:  # the constants in its place may be shares of anything
            out = unsure(mixed(out, clear()), whether=True)
        relief = relief_of(tree) if material.displacement_method != "BUMP" and self.most else None
        if relief is not None:
            far = "" if np.isfinite((relief.low, relief.high)).all() else ", as far as the object is large"
            report(
                f"displacement taken for two surfaces, at its lowest and its highest{far}: half of the rays pass each"
            )
            out = unsure(mixed(out, clear()))
        elif _is_linked(tree, "Displacement"):
            bumps = material.displacement_method == "BUMP"
            report("bump not rendered: half of what is reflected is spread" if bumps else "displacement not rendered")
            out = spread(out, UNKNOWN) if bumps and self.most else out
        if not material.use_transparent_shadow and any(passes_straight(leaf) for leaf in leaves(out)):
            out = opaque_to_shadows(out)
        reach = reach_of(tree) if self.most else 0.0
        for record in (*leaves(out), *heads(out)):
            record["reach"] = reach
            record["mis_emission"] = material.cycles.emission_sampling != "NONE"
            if not self.most:
                record["unsure"] &= np.uint32(Unsure.BEHIND)
        return out, relief


def _is_linked(tree: Any, name: str) -> bool:
    output = tree.get_output_node("CYCLES")
    return output is not None and bool(output.inputs[name].is_linked)


def loops_over_lights(tree: Any) -> bool:
    """Whether a shader tree, or a group in it, has a node of Blender 5.3 that asks for lights: inlining puts constants
    in their place."""
    trees, seen = [tree], set()
    while trees:
        tree = trees.pop()
        if tree is None or tree.session_uid in seen:
            continue
        seen.add(tree.session_uid)
        if any(node.bl_idname in LIGHT_LOOP for node in tree.nodes):
            return True
        trees += [node.node_tree for node in tree.nodes if node.bl_idname == "ShaderNodeGroup"]
    return False


def _is_textured(record: Records) -> bool:
    return any(record[name] >= 0 for name in record.dtype.names or () if name.endswith("_texture"))


def _rows(colors: Sequence[Sequence[float]] | None) -> NDArray[np.float64]:
    """(K, 4)."""
    return np.array(colors or (), np.float64).reshape(-1, 4)


def convert_tree(
    tree: Any,
    textures: TextureTable,
    report: Callable[[str], None],
    most: bool = True,
    objects: Callable[[], NDArray[np.float64]] = no_objects,
    picked: bool = False,
) -> Tree:
    """The material of an inlined shader tree. most: as of `MaterialTable`; objects: as of `Reader`; picked: what emits
    is picked by light sampling."""
    output = tree.get_output_node("CYCLES")
    if output is None:
        return black()

    def seen_by(view: View) -> tuple[Tree, bool]:
        """What a view sees, and whether that depends on it."""
        reader = Reader(textures, report, view, nodes, objects, most)
        return Converter(textures, report, reader, shaders, most).output(output), reader.asked

    out, asked = seen_by(View(0, False))
    if not asked:
        return out
    distinct: dict[bytes, tuple[Tree, int]] = {}
    glows: dict[bool, set[tuple[bytes, ...]]] = {False: set(), True: set()}  # of either side
    for k, (back, ray) in enumerate(product((False, True), range(VIEWS))):
        seen, _ = seen_by(View(ray, back))
        if ray not in (RayType.CAMERA, RayType.SHADOW):
            glows[back].add(_glow(seen))
        key = key_of(seen)
        distinct[key] = seen, distinct.get(key, (seen, 0))[1] | 1 << k
    if picked and any(len(glow) > 1 for glow in glows.values()):
        report(PICKED)
    (out, _), *others = distinct.values()
    for seen, rays in others:
        head = default_material()
        head["shader"], head["rays"] = Shader.BY_RAY, rays
        out = Composed(head, out, seen)
    return out


def _glow(tree: Tree) -> tuple[bytes, ...]:
    """What tells apart how a material emits; nothing where it does not."""
    glowing = [leaf for leaf in leaves(tree) if leaf["emission"].any()]
    parts = [(leaf["emission"], leaf["emission_texture"]) for leaf in glowing]
    parts += [(head["alpha"], head["alpha_texture"]) for head in heads(tree) if glowing]
    return tuple(np.asarray(value).tobytes() for part in parts for value in part)
