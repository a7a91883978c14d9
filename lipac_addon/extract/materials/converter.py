"""Node materials -> MATERIAL records.

Principled and the plain BSDF nodes map one to one. Mix and Add shaders become materials composed of others, which paths pick at random by their shares; with
Transparent a Principled gets an alpha, with Emission a plain BSDF an emission. A tree that tells rays or sides apart is converted for each of them.

What is not modelled errs on the side of seeing more: where nobody can say how much passes through, half of the paths do, and the record is marked as unsure, so
that what they see there is kept. Whatever differs from Blender is reported as "material NAME: WHAT".
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np

from ....core.arrays import Records
from ....core.scene.model import VIEWS, Shader, default_material
from .displacement import Relief, relief_of
from .nodes import MEAN, Reader, Value, View, grey
from .textures import TextureTable

CONSTANT = {  # record field: socket of Principled, for inputs that the core takes untextured
    "ior": "IOR",
    "diffuse_roughness": "Diffuse Roughness",
    "specular_level": "Specular IOR Level",
    "specular_tint": "Specular Tint",
    "coat": "Coat Weight",
    "coat_roughness": "Coat Roughness",
    "coat_ior": "Coat IOR",
    "coat_tint": "Coat Tint",
}
UNSUPPORTED = {
    "Subsurface Weight": "subsurface",
    "Sheen Weight": "sheen",
    "Anisotropic": "anisotropy",
    "Thin Film Thickness": "thin film",
    "Transmission Dispersion Scale": "dispersion",
}
LIGHT_LOOP = {"ShaderNodeLightAccumulation", "ShaderNodeLightEvaluation", "ShaderNodeLightInfo", "ShaderNodeShadowRaycast"}
SCALARS = ("metallic", "roughness", "alpha", "transmission")


TINTED = {Shader.DIFFUSE, Shader.GLOSSY, Shader.GLASS, Shader.TRANSPARENT, Shader.REFRACTION, Shader.TRANSLUCENT}  # linear in `base_color`
HALF = grey(0.5)


@dataclass(frozen=True)
class Composed:
    """A material that consists of two others. head: its own record, MIX or BY_RAY."""

    head: Records
    first: Tree
    second: Tree


Tree = Records | Composed


def leaves(tree: Tree) -> Iterator[Records]:
    """All records of a material that are not composed, to be changed in place."""
    if isinstance(tree, Composed):
        yield from leaves(tree.first)
        yield from leaves(tree.second)
    else:
        yield tree


def heads(tree: Tree) -> Iterator[Records]:
    """All records of a material that are composed of others."""
    if isinstance(tree, Composed):
        yield tree.head
        yield from heads(tree.first)
        yield from heads(tree.second)


def unsure(tree: Tree) -> Tree:
    """The material, where it is not known how much passes through it."""
    for leaf in leaves(tree):
        leaf["unsure"] = 1
    return tree


class MaterialTable:
    """Materials by name: `index(material)` converts one the first time.

    records: the materials, composed ones with `parts` that are numbered from the first of those records that are parts of others.
    """

    def __init__(self, textures: TextureTable, displaced: bool = True) -> None:
        """displaced: true displacement is allowed for, as `displacement` says; else it is left out."""
        self.textures = textures
        self.displaced = displaced
        self.records: list[Records] = []
        self.reliefs: list[Relief | None] = []
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
        out = convert_tree(tree, self.textures, report)
        if loops:  # the constants in its place may be shares of anything
            out = unsure(mixed(out, _clear()))
        relief = relief_of(tree) if material.displacement_method != "BUMP" and self.displaced else None
        if relief is not None:
            far = "" if np.isfinite((relief.low, relief.high)).all() else ", as far as the object is large"
            report(f"displacement taken for two surfaces, at its lowest and its highest{far}: half of the rays pass each")
            out = unsure(mixed(out, _clear()))
        elif _is_linked(tree, "Displacement"):
            report("bump not rendered" if material.displacement_method == "BUMP" else "displacement not rendered")
        for record in (*leaves(out), *heads(out)):
            record["mis_emission"] = material.cycles.emission_sampling != "NONE"
        return out, relief


def _is_linked(tree: Any, name: str) -> bool:
    output = tree.get_output_node("CYCLES")
    return output is not None and bool(output.inputs[name].is_linked)


def loops_over_lights(tree: Any) -> bool:
    """Whether a shader tree, or a group in it, has a node of Blender 5.3 that asks for lights: inlining puts constants in their place."""
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


def convert_tree(tree: Any, textures: TextureTable, report: Callable[[str], None]) -> Tree:
    """The material of an inlined shader tree."""
    output = tree.get_output_node("CYCLES")
    if output is None:
        return _black()
    first = _Converter(textures, report, View(0, False))
    out = first.output(output)
    if not first.reader.asked:
        return out
    distinct: dict[bytes, tuple[Tree, int]] = {}
    for k, (back, ray) in enumerate(product((False, True), range(VIEWS))):
        seen = _Converter(textures, report, View(ray, back)).output(output)
        key = _key(seen)
        distinct[key] = seen, distinct.get(key, (seen, 0))[1] | 1 << k
    (out, _), *others = distinct.values()
    for seen, rays in others:
        head = default_material()
        head["shader"], head["rays"] = Shader.BY_RAY, rays
        out = Composed(head, out, seen)
    return out


def _key(tree: Tree) -> bytes:
    """Tells materials apart."""
    return tree.head.tobytes() + _key(tree.first) + _key(tree.second) if isinstance(tree, Composed) else tree.tobytes()


def mixed(first: Tree, second: Tree) -> Composed:
    """Half of each."""
    head = default_material()
    head["shader"], head["alpha"] = Shader.MIX, 0.5
    return Composed(head, first, second)


def _black() -> Records:
    record = default_material()
    record["shader"] = Shader.EMISSION
    return record


def _clear() -> Records:
    record = default_material()
    record["shader"], record["base_color"] = Shader.TRANSPARENT, 1.0
    return record


class _Converter:
    def __init__(self, textures: TextureTable, report: Callable[[str], None], view: View) -> None:
        self.textures = textures
        self.report = report
        self.reader = Reader(textures, report, view)

    def output(self, node: Any) -> Tree:
        """What an output node shows."""
        tree = self.surface(node.inputs["Surface"])
        if node.inputs["Volume"].is_linked:
            self.report("volume not rendered")
            if not node.inputs["Surface"].is_linked:
                return self._volume()
        return _black() if tree is None else tree

    def _volume(self) -> Tree:
        """The boundary of a volume: what passes it is scattered, or is not."""
        scatters = default_material()
        scatters["shader"] = Shader.TRANSLUCENT
        return unsure(mixed(_clear(), scatters))

    def surface(self, socket: Any) -> Tree | None:
        """What is linked to a shader socket; None where nothing is (black)."""
        if not socket.is_linked:
            return None
        node = socket.links[0].from_node
        method = getattr(self, f"node_{node.type.lower()}", None)
        if method is None:
            return self._other(node)
        tree: Tree | None = method(node)
        return tree

    # Filling a record

    def _weighed(self, socket: Any) -> tuple[Value, bool]:
        """A value that says how much of something shows, and whether it is but an approximation; then it is a half."""
        before = self.reader.doubts
        value = self.reader.value(socket)
        return (HALF, True) if self.reader.doubts > before else (value, False)

    def _color(self, record: Records, field: str, value: Value) -> None:
        """A colour and its texture."""
        if value.use is not None and value.channel is not None:
            value = self.reader.image(value)
        record[field] = value.factor
        if value.use is not None:
            record[f"{field}_texture"] = self.textures.index(value.use)

    def _scalar(self, record: Records, field: str, value: Value) -> None:
        """A scalar, its texture and the channel it reads."""
        if value.use is None:
            record[field] = value.scalar
            return
        if len(set(value.factor)) > 1:
            value = self.reader.image(value)
        record[field] = value.factor[0]
        if value.use is not None:
            record[f"{field}_texture"] = self.textures.index(value.use)
        record[f"{field}_channel"] = MEAN if value.channel is None else value.channel

    def _product(self, a: Value, b: Value) -> Value:
        if a.use is None or b.use is None:
            image, other = (a, b) if b.use is None else (b, a)
            return Value(tuple(x * y for x, y in zip(image.factor, other.factor, strict=True)), image.use, image.channel)  # type: ignore[arg-type]
        return self.reader.map(lambda x, y: x * y, a, b)

    def _emit(self, record: Records, color: Any, strength: Any) -> None:
        s = self.reader.value(strength)
        if s.use is None and s.scalar == 0.0:
            return
        self._color(record, "emission", self._product(self.reader.value(color), s))

    def _normal(self, record: Records, node: Any) -> None:
        socket = node.inputs["Normal"]
        if not socket.is_linked:
            return
        source = socket.links[0].from_node
        if source.type != "NORMAL_MAP" or source.space != "TANGENT":
            if source.type not in {"NEW_GEOMETRY", "TEX_COORD"}:
                self.report(f"{source.bl_label} node on Normal not rendered")
            return
        value = self.reader.image(self.reader.value(source.inputs["Color"]))
        if value.use is None:
            return
        record["normal_texture"] = self.textures.index(value.use)
        record["normal_strength"] = self.reader.constant(source.inputs["Strength"], "normal strength")[0]

    def _plain(self, node: Any, shader: Shader) -> Records:
        """A BSDF node with Color, and perhaps Roughness, IOR and Normal."""
        record = default_material()
        record["shader"] = shader
        before = self.reader.doubts
        self._color(record, "base_color", self.reader.value(node.inputs["Color"]))
        record["unsure"] = shader == Shader.TRANSPARENT and self.reader.doubts > before
        if "Roughness" in node.inputs:
            field = "diffuse_roughness" if shader == Shader.DIFFUSE else "roughness"
            if field == "roughness":
                self._scalar(record, field, self.reader.value(node.inputs["Roughness"]))
            else:
                record[field] = self.reader.constant(node.inputs["Roughness"])[0]
        if "IOR" in node.inputs:
            record["ior"] = self.reader.constant(node.inputs["IOR"])[0]
        if getattr(node, "distribution", "GGX") not in {"GGX", "MULTI_GGX"}:
            self.report(f"{node.distribution} distribution rendered as GGX")
        for name in ("Anisotropy", "Thin Film Thickness"):
            if name in node.inputs and (node.inputs[name].is_linked or node.inputs[name].default_value != 0):
                self.report(f"{name.lower()} not rendered")
        if "Normal" in node.inputs:
            self._normal(record, node)
        return record

    # Shader nodes

    def node_bsdf_principled(self, node: Any) -> Tree:
        record = default_material()
        sockets = node.inputs
        self._color(record, "base_color", self.reader.value(sockets["Base Color"]))
        names = {"metallic": "Metallic", "roughness": "Roughness", "alpha": "Alpha", "transmission": "Transmission Weight"}
        for field in SCALARS:
            before, share = self.reader.doubts, self.reader.value(sockets[names[field]])
            if self.reader.doubts > before and field in {"alpha", "transmission"}:
                share, record["unsure"] = HALF, 1
            self._scalar(record, field, share)
        for field, name in CONSTANT.items():
            value = self.reader.constant(sockets[name])
            record[field] = value if record[field].shape else value[0]
        self._emit(record, sockets["Emission Color"], sockets["Emission Strength"])
        self._normal(record, node)
        for name, what in UNSUPPORTED.items():
            if name in sockets and (sockets[name].is_linked or sockets[name].default_value != 0):
                self.report(f"{what} not rendered")
        if sockets["Coat Normal"].is_linked:
            self.report("coat normal not rendered")
        if "Thin Wall" in sockets and sockets["Thin Wall"].default_value:
            self.report("thin wall not rendered")
            if record["transmission"] > 0:  # passes straight on, where ours bends
                return unsure(mixed(record, _clear()))
        return record

    def node_bsdf_diffuse(self, node: Any) -> Records:
        return self._plain(node, Shader.DIFFUSE)

    def node_bsdf_glossy(self, node: Any) -> Records:
        return self._plain(node, Shader.GLOSSY)

    node_bsdf_anisotropic = node_bsdf_glossy

    def node_bsdf_glass(self, node: Any) -> Records:
        return self._plain(node, Shader.GLASS)

    def node_bsdf_refraction(self, node: Any) -> Records:
        return self._plain(node, Shader.REFRACTION)

    def node_bsdf_translucent(self, node: Any) -> Records:
        return self._plain(node, Shader.TRANSLUCENT)

    def node_bsdf_transparent(self, node: Any) -> Records:
        return self._plain(node, Shader.TRANSPARENT)

    def node_emission(self, node: Any) -> Records:
        record = _black()
        self._emit(record, node.inputs["Color"], node.inputs["Strength"])
        return record

    node_background = node_emission

    def node_holdout(self, node: Any) -> Records:
        record = _black()
        record["shader"] = Shader.HOLDOUT
        return record

    def node_bsdf_metallic(self, node: Any) -> Records:
        record = default_material()
        record["metallic"] = 1.0
        if node.fresnel_type == "PHYSICAL_CONDUCTOR":
            self.report("physical conductor rendered by its colour at normal incidence")
            n, k = self.reader.constant(node.inputs["IOR"]), self.reader.constant(node.inputs["Extinction"])
            record["base_color"] = ((n - 1) ** 2 + k * k) / ((n + 1) ** 2 + k * k)
        else:
            self._color(record, "base_color", self.reader.value(node.inputs["Base Color"]))
            record["specular_tint"] = self.reader.constant(node.inputs["Edge Tint"])
        self._scalar(record, "roughness", self.reader.value(node.inputs["Roughness"]))
        self._normal(record, node)
        return record

    def node_eevee_specular(self, node: Any) -> Records | None:
        self.report("Specular BSDF is EEVEE's alone: black, as in Cycles")
        return None

    def node_bsdf_ray_portal(self, node: Any) -> Tree:
        self.report("Ray Portal rendered as transparent: what it shows from elsewhere is not known")
        return unsure(_clear())

    def node_script(self, node: Any) -> Tree:
        self.report("script not run: half of all rays pass")
        return unsure(mixed(self._other(node), _clear()))

    def _other(self, node: Any) -> Tree:
        """Subsurface, sheen, toon, hair and the like: diffuse with their colour."""
        self.report(f"{node.bl_label} rendered as diffuse")
        record = default_material()
        record["shader"] = Shader.DIFFUSE
        if "Color" in node.inputs:
            self._color(record, "base_color", self.reader.value(node.inputs["Color"]))
        if "Normal" in node.inputs:
            self._normal(record, node)
        return record

    # Combinations

    def _mix(self, first: Tree, second: Tree, share: Value) -> Tree:
        """Either of two, share of the second."""
        head = default_material()
        head["shader"] = Shader.MIX
        self._scalar(head, "alpha", share)
        return Composed(head, first, second)

    def node_add_shader(self, node: Any) -> Tree | None:
        a, b = (self.surface(s) for s in node.inputs)
        if a is None or b is None:
            return b if a is None else a
        for one, other in ((a, b), (b, a)):
            if not isinstance(one, Composed) and one["shader"] == Shader.EMISSION and not _both_textured(one, other):
                for leaf in leaves(other):
                    _add_emission(leaf, one)
                return other
        for leaf in (*leaves(a), *leaves(b)):  # each is seen by half of the paths
            leaf["emission"] *= 2
            if int(leaf["shader"]) in TINTED:
                leaf["base_color"] *= 2
            elif leaf["shader"] != Shader.EMISSION:
                self.report(f"{Shader(int(leaf['shader'])).name.title()} in an Add Shader rendered with half of its weight")
        return mixed(a, b)

    def node_mix_shader(self, node: Any) -> Tree | None:
        source = node.inputs[0].links[0].from_node if node.inputs[0].is_linked else None
        a, b = self.surface(node.inputs[1]), self.surface(node.inputs[2])
        if source is not None and source.type in {"FRESNEL", "LAYER_WEIGHT"}:
            return self._by_fresnel(source, a, b)
        factor, doubtful = self._weighed(node.inputs[0])
        t = min(max(factor.scalar, 0.0), 1.0)
        if factor.use is None:
            if t in (0.0, 1.0):
                return b if t else a
            factor = grey(t)
        a, b = (_black() if r is None else r for r in (a, b))
        if doubtful:
            return unsure(mixed(a, b))
        if isinstance(a, Composed) or isinstance(b, Composed):
            return self._mix(a, b, factor)
        for one, other, swapped in ((a, b, False), (b, a, True)):
            if _is_clear(one) and other["shader"] == Shader.PRINCIPLED and other["alpha"] == 1 and other["alpha_texture"] < 0:
                self._scalar(other, "alpha", self._complement(factor) if swapped else factor)
                return other
            plain = int(other["shader"]) in TINTED | {Shader.EMISSION}
            if one["shader"] == Shader.EMISSION and plain and factor.use is None and not _both_textured(one, other):
                weight = 1 - t if swapped else t
                one["emission"] *= 1 - weight
                other["base_color"] *= weight
                other["emission"] *= weight
                _add_emission(other, one)
                return other
        return self._mix(a, b, factor)

    def _complement(self, factor: Value) -> Value:
        return grey(1 - factor.scalar) if factor.use is None else self.reader.map(lambda x: 1 - x, factor)

    def _by_fresnel(self, source: Any, a: Tree | None, b: Tree | None) -> Tree | None:
        """The classic of older files: a coat of Glossy over Diffuse by Fresnel or Layer Weight is what Principled does."""
        if a is None or b is None:
            return b if a is None else a
        if not isinstance(a, Composed) and not isinstance(b, Composed):
            if a["shader"] == Shader.DIFFUSE and b["shader"] == Shader.GLOSSY:
                self.report(f"Mix Shader by {source.bl_label} rendered as Principled")
                out = a.copy()
                out["shader"] = Shader.PRINCIPLED
                for name in ("roughness", "roughness_texture", "roughness_channel"):
                    out[name] = b[name]
                if source.type == "FRESNEL":
                    out["ior"] = self.reader.constant(source.inputs["IOR"])[0]
                else:  # Layer Weight: blend b stands for an index of refraction of 1 / (1 - b)
                    out["ior"] = 1 / (1 - min(float(self.reader.constant(source.inputs["Blend"])[0]), 0.9))
                return out
            if {int(a["shader"]), int(b["shader"])} == {int(Shader.REFRACTION), int(Shader.GLOSSY)}:
                self.report(f"Mix Shader by {source.bl_label} rendered as Glass")
                out = (a if a["shader"] == Shader.REFRACTION else b).copy()
                out["shader"] = Shader.GLASS
                return out
        self.report(f"Mix Shader by {source.bl_label}: half of each, at any angle")
        return unsure(mixed(a, b))


def _is_clear(record: Records) -> bool:
    return bool(record["shader"] == Shader.TRANSPARENT and np.abs(record["base_color"] - 1).max() <= 1e-3 and record["base_color_texture"] < 0)


def _both_textured(emitter: Records, tree: Tree) -> bool:
    """Whether some leaf cannot take the emission on."""
    return any(_clash(emitter, leaf) for leaf in leaves(tree))


def _clash(a: Records, b: Records) -> bool:
    both = a["emission"].any() and b["emission"].any()
    return bool(both and (a["emission_texture"] >= 0 or b["emission_texture"] >= 0))


def _add_emission(record: Records, emitter: Records) -> None:
    record["emission"] += emitter["emission"]
    if emitter["emission"].any():
        record["emission_texture"] = emitter["emission_texture"]
