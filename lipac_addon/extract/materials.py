"""Node materials -> MATERIAL records.

Principled and the plain BSDF nodes map one to one. Mix and Add shaders are reduced to one model: with Transparent to alpha, with Emission to an emission, of
equal models to their average; anything else to the part with the larger weight. Whatever is lost is reported as "material NAME: WHAT".
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from ...core.scene import Records, Shader, default_material
from .nodes import MEAN, Reader, Value, grey
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
UNSUPPORTED = {"Subsurface Weight": "subsurface", "Sheen Weight": "sheen", "Anisotropic": "anisotropy", "Thin Film Thickness": "thin film"}
SCALARS = ("metallic", "roughness", "alpha", "transmission")


class MaterialTable:
    """Materials by name: `index(material)` converts one the first time."""

    def __init__(self, textures: TextureTable) -> None:
        self.textures = textures
        self.records: list[Records] = []
        self.approximated: dict[str, None] = {}
        self._known: dict[str | None, int] = {}

    def index(self, material: Any) -> int:
        """Index of a bpy.types.Material, or of the default for None."""
        name = None if material is None else material.name_full
        if name not in self._known:
            self._known[name] = len(self.records)
            self.records.append(default_material() if material is None else self._convert(material))
        return self._known[name]

    def textured(self, index: int) -> bool:
        """Whether a material needs UVs."""
        record = self.records[index]
        return any(record[name] >= 0 for name in record.dtype.names or () if name.endswith("_texture"))

    def build(self) -> Records:
        """(M,) of MATERIAL."""
        return np.stack(self.records) if self.records else default_material()[None]

    def _convert(self, material: Any) -> Records:
        def report(line: str) -> None:
            self.approximated.setdefault(f"material {material.name}: {line}")

        self.textures.report = report
        if material.node_tree is None:
            record = default_material()
            record["base_color"] = material.diffuse_color[:3]
            record["metallic"], record["roughness"] = material.metallic, material.roughness
            return record
        inlined = material.inline_shader_nodes()  # keeps the tree alive
        tree = inlined.node_tree
        if tree.get_output_node("CYCLES") is None:
            tree = material.node_tree  # only the active output is inlined, and that one may be EEVEE's
        record = convert_tree(tree, self.textures, report)
        record["mis_emission"] = material.cycles.emission_sampling != "NONE"
        return record


def convert_tree(tree: Any, textures: TextureTable, report: Callable[[str], None]) -> Records:
    """MATERIAL record of an inlined shader tree."""
    output = tree.get_output_node("CYCLES")
    if output is None:
        return _black()
    if output.inputs["Volume"].is_linked:
        report("volume not rendered")
    if output.inputs["Displacement"].is_linked:
        report("displacement not rendered")
    record = _Converter(textures, report).surface(output.inputs["Surface"])
    return _black() if record is None else record


def _black() -> Records:
    record = default_material()
    record["shader"] = Shader.EMISSION
    return record


class _Converter:
    def __init__(self, textures: TextureTable, report: Callable[[str], None]) -> None:
        self.textures = textures
        self.report = report
        self.reader = Reader(textures, report)

    def surface(self, socket: Any) -> Records | None:
        """Record of what is linked to a shader socket; None where nothing is (black)."""
        if not socket.is_linked:
            return None
        node = socket.links[0].from_node
        method = getattr(self, f"node_{node.type.lower()}", None)
        if method is None:
            return self._other(node)
        record: Records | None = method(node)
        return record

    # Filling a record

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
        self._color(record, "base_color", self.reader.value(node.inputs["Color"]))
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

    def node_bsdf_principled(self, node: Any) -> Records:
        record = default_material()
        sockets = node.inputs
        self._color(record, "base_color", self.reader.value(sockets["Base Color"]))
        names = {"metallic": "Metallic", "roughness": "Roughness", "alpha": "Alpha", "transmission": "Transmission Weight"}
        for field in SCALARS:
            self._scalar(record, field, self.reader.value(sockets[names[field]]))
        for field, name in CONSTANT.items():
            value = self.reader.constant(sockets[name])
            record[field] = value if record[field].shape else value[0]
        self._emit(record, sockets["Emission Color"], sockets["Emission Strength"])
        self._normal(record, node)
        for name, what in UNSUPPORTED.items():
            if name in sockets and (sockets[name].is_linked or sockets[name].default_value != 0):
                self.report(f"{what} not rendered")
        if "Thin Wall" in sockets and sockets["Thin Wall"].default_value:
            self.report("thin wall not rendered")
        if sockets["Coat Normal"].is_linked:
            self.report("coat normal not rendered")
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

    def _other(self, node: Any) -> Records:
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

    def node_add_shader(self, node: Any) -> Records | None:
        a, b = (self.surface(s) for s in node.inputs)
        if a is None or b is None:
            return b if a is None else a
        for one, other in ((a, b), (b, a)):
            if one["shader"] == Shader.EMISSION:
                return self._with_emission(other, one)
        self.report("Add Shader reduced to the brighter part")
        return a if _albedo(a) >= _albedo(b) else b

    def _with_emission(self, record: Records, emitter: Records) -> Records:
        if not emitter["emission"].any():
            return record
        if record["emission"].any():
            if record["emission_texture"] >= 0 or emitter["emission_texture"] >= 0:
                self.report("sum of two emissions reduced to the brighter one")
                if record["emission"].sum() < emitter["emission"].sum():
                    record["emission"], record["emission_texture"] = emitter["emission"], emitter["emission_texture"]
            else:
                record["emission"] += emitter["emission"]
            return record
        record["emission"], record["emission_texture"] = emitter["emission"], emitter["emission_texture"]
        return record

    def node_mix_shader(self, node: Any) -> Records | None:
        source = node.inputs[0].links[0].from_node if node.inputs[0].is_linked else None
        a, b = self.surface(node.inputs[1]), self.surface(node.inputs[2])
        if source is not None and source.type == "LIGHT_PATH":
            self.report("choice by Light Path: all rays see the part that is not transparent")
            return b if a is None or a["shader"] == Shader.TRANSPARENT else a
        if source is not None and source.type in {"FRESNEL", "LAYER_WEIGHT"}:
            return self._by_fresnel(source, a, b)
        factor = self.reader.value(node.inputs[0])
        if factor.use is None:
            t = min(max(factor.scalar, 0.0), 1.0)
            if t in (0.0, 1.0):
                return b if t else a
            factor = grey(t)
        a, b = (_black() if r is None else r for r in (a, b))
        for one, other, swapped in ((a, b, False), (b, a, True)):
            if one["shader"] == Shader.TRANSPARENT and other["shader"] != Shader.TRANSPARENT:
                if np.abs(one["base_color"] - 1).max() > 1e-3:
                    self.report("tint of the transparent part not rendered")
                return self._with_alpha(other, self._complement(factor) if swapped else factor)
        t = self._mean(factor)
        for one, other, weight in ((a, b, t), (b, a, 1 - t)):
            if one["shader"] == Shader.EMISSION and other["shader"] != Shader.EMISSION:
                if factor.use is not None:
                    self.report("texture that mixes with Emission replaced by its average")
                one["emission"] *= 1 - weight
                other["base_color"] *= weight
                other["emission"] *= weight
                if other["shader"] == Shader.PRINCIPLED:
                    other["specular_level"] *= weight
                    self.report("mix of Principled with Emission: its specular part is dimmed by its level only")
                return self._with_emission(other, one)
        if factor.use is not None:
            self.report("texture that mixes shaders replaced by its average")
        return self._blend(a, b, t)

    def _mean(self, factor: Value) -> float:
        return factor.scalar if factor.use is None else float(self.reader.pixels(factor)[..., 0].mean())

    def _complement(self, factor: Value) -> Value:
        return grey(1 - factor.scalar) if factor.use is None else self.reader.map(lambda x: 1 - x, factor)

    def _with_alpha(self, record: Records, alpha: Value) -> Records:
        """alpha: a scalar of the mix. Emission and the other models of the core are scaled by `alpha` as Principled is."""
        if record["alpha_texture"] >= 0 or record["alpha"] < 1:
            self.report("product of two alphas: only the outer one is textured")
            record["alpha_texture"] = -1
            factor = float(record["alpha"])
            alpha = Value(tuple(f * factor for f in alpha.factor), alpha.use, alpha.channel)  # type: ignore[arg-type]
        self._scalar(record, "alpha", alpha)
        return record

    def _blend(self, a: Records, b: Records, t: float) -> Records:
        """Two models, t of the second."""
        if a["shader"] == b["shader"]:
            larger, smaller, s = (b, a, 1 - t) if t > 0.5 else (a, b, t)
            out = larger.copy()
            for name in out.dtype.names or ():
                if out.dtype[name].base.kind == "f" and (f"{name}_texture" not in (out.dtype.names or ())):
                    out[name] = larger[name] * (1 - s) + smaller[name] * s
            for name in ("base_color", "emission", *SCALARS):
                texture = f"{name}_texture"
                if larger[texture] == smaller[texture]:
                    out[name] = larger[name] * (1 - s) + smaller[name] * s
            self.report("Mix Shader reduced to one model with averaged inputs")
            return out
        self.report(f"Mix Shader reduced to {Shader(int((b if t > 0.5 else a)['shader'])).name.lower()}, the part with the larger weight")
        return b if t > 0.5 else a

    def _by_fresnel(self, source: Any, a: Records | None, b: Records | None) -> Records | None:
        """The classic of older files: a coat of Glossy over Diffuse by Fresnel or Layer Weight is what Principled does."""
        if a is None or b is None:
            return b if a is None else a
        self.report(f"Mix Shader by {source.bl_label} rendered as Principled")
        if a["shader"] == Shader.DIFFUSE and b["shader"] == Shader.GLOSSY:
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
            out = (a if a["shader"] == Shader.REFRACTION else b).copy()
            out["shader"] = Shader.GLASS
            return out
        return a


def _albedo(record: Records) -> float:
    return float(record["base_color"].mean())
