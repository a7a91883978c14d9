"""Nodes that make shaders: `node_TYPE(converter, node)` is the material of a node, or None (black)."""

from __future__ import annotations

from typing import Any

from ....core.arrays import Records
from ....core.scene.model import Shader, Unsure, default_material
from .converter import HALF, Converter, either
from .reader import Value, grey
from .trees import (
    Composed,
    Tree,
    add_emission,
    black,
    both_textured,
    clear,
    doubled,
    glowing_through,
    is_clear,
    leaves,
    mark,
    mixed,
    unsure,
)

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
    "Sheen Weight": "sheen",
    "Anisotropic": "anisotropy",
    "Thin Film Thickness": "thin film",
    "Transmission Dispersion Scale": "dispersion",
}
PORTAL = "Ray Portal not rendered: what it shows from elsewhere is not known; nothing is culled"
# of shares, what is not known where they are not
NOT_KNOWN = {"metallic": Unsure.LIGHT, "alpha": Unsure.BEHIND | Unsure.CLEAR, "transmission": Unsure.BEHIND}
SHEEN = 0.15  # of what comes from anywhere, sheen reflects so much or less where it is looked at from above
# linear in `base_color`
TINTED = {Shader.DIFFUSE, Shader.GLOSSY, Shader.GLASS, Shader.TRANSPARENT, Shader.REFRACTION, Shader.TRANSLUCENT}


def node_bsdf_principled(converter: Converter, node: Any) -> Tree:
    record = default_material()
    sockets = node.inputs
    converter.base(record, sockets["Base Color"])
    converter.roughness(record, sockets["Roughness"])
    names = {"metallic": "Metallic", "alpha": "Alpha", "transmission": "Transmission Weight"}
    for field, doubt in NOT_KNOWN.items():
        before, share = converter.reader.doubts, converter.reader.value(sockets[names[field]])
        if converter.reader.doubts > before and (field != "metallic" or converter.most):
            share = HALF
            mark(record, doubt)
        converter.scalar(record, field, share)
    for field, name in CONSTANT.items():
        converter.number(record, field, sockets[name])
    converter.emit(record, sockets["Emission Color"], sockets["Emission Strength"])
    # half of it shows, at an alpha or beside a transmission that nobody knows
    if record["unsure"] & Unsure.BEHIND and converter.most:
        doubled(record)
    converter.normal(record, node)
    if sockets["Subsurface Weight"].is_linked or sockets["Subsurface Weight"].default_value != 0:
        converter.report("subsurface not rendered: half of it comes out at the other side")
    for name, what in UNSUPPORTED.items():
        if name in sockets and (sockets[name].is_linked or sockets[name].default_value != 0):
            converter.report(f"{what} not rendered")
    if sockets["Coat Normal"].is_linked:
        converter.report("coat normal not rendered")
    if "Thin Wall" in sockets and sockets["Thin Wall"].default_value:
        converter.report("thin wall not rendered")
        if record["transmission"] > 0:  # passes straight on, where ours bends
            return unsure(mixed(record, clear()))
    weight = sockets["Subsurface Weight"]
    subsurface = HALF.scalar if weight.is_linked else min(weight.default_value, 1.0)
    return glowing_through(record, subsurface) if subsurface > 0 and converter.most else record


def node_subsurface_scattering(converter: Converter, node: Any) -> Tree:
    record = converter.diffuse(node)
    return glowing_through(record, 1.0) if converter.most else record


def node_bsdf_sheen(converter: Converter, node: Any) -> Tree:
    """Fibres that reflect little, but for grazing light: none of it is sure."""
    color = converter.reader.value(node.inputs["Color"])
    record = converter.diffuse(node)
    converter.color(record, "base_color", converter.product(color, grey(SHEEN)))
    if converter.most:
        mark(record, Unsure.LIGHT)
    return record


def node_bsdf_diffuse(converter: Converter, node: Any) -> Records:
    return converter.plain(node, Shader.DIFFUSE)


def node_bsdf_glossy(converter: Converter, node: Any) -> Records:
    return converter.plain(node, Shader.GLOSSY)


node_bsdf_anisotropic = node_bsdf_glossy


def node_bsdf_glass(converter: Converter, node: Any) -> Records:
    return converter.plain(node, Shader.GLASS)


def node_bsdf_refraction(converter: Converter, node: Any) -> Records:
    return converter.plain(node, Shader.REFRACTION)


def node_bsdf_translucent(converter: Converter, node: Any) -> Records:
    return converter.plain(node, Shader.TRANSLUCENT)


def node_bsdf_transparent(converter: Converter, node: Any) -> Records:
    return converter.plain(node, Shader.TRANSPARENT)


def node_emission(converter: Converter, node: Any) -> Records:
    record = black()
    converter.emit(record, node.inputs["Color"], node.inputs["Strength"])
    return record


node_background = node_emission


def node_holdout(converter: Converter, node: Any) -> Records:
    record = black()
    record["shader"] = Shader.HOLDOUT
    return record


def node_bsdf_metallic(converter: Converter, node: Any) -> Records:
    record = default_material()
    record["metallic"] = 1.0
    if node.fresnel_type == "PHYSICAL_CONDUCTOR":
        converter.report("physical conductor rendered by its colour at normal incidence")
        before = converter.reader.doubts
        n, k = converter.reader.constant(node.inputs["IOR"]), converter.reader.constant(node.inputs["Extinction"])
        record["base_color"] = ((n - 1) ** 2 + k * k) / ((n + 1) ** 2 + k * k)
        if converter.most and converter.reader.doubts > before:
            mark(record, Unsure.LIGHT)
    else:
        converter.base(record, node.inputs["Base Color"])
        converter.number(record, "specular_tint", node.inputs["Edge Tint"])
    converter.roughness(record, node.inputs["Roughness"])
    converter.normal(record, node)
    return record


def node_eevee_specular(converter: Converter, node: Any) -> Records | None:
    converter.report("Specular BSDF is EEVEE's alone: black, as in Cycles")
    return None


def node_bsdf_ray_portal(converter: Converter, node: Any) -> Tree:
    converter.report(PORTAL)
    return unsure(clear())


def node_script(converter: Converter, node: Any) -> Tree:
    converter.report("script not run: half of all rays pass")
    return unsure(mixed(converter.diffuse(node), clear()), whether=True)


def _mix(converter: Converter, first: Tree, second: Tree, share: Value) -> Tree:
    """Either of two, share of the second."""
    head = default_material()
    head["shader"] = Shader.MIX
    converter.scalar(head, "alpha", share)
    return Composed(head, first, second)


def node_add_shader(converter: Converter, node: Any) -> Tree | None:
    a, b = (converter.surface(s) for s in node.inputs)
    if a is None or b is None:
        return b if a is None else a
    for one, other in ((a, b), (b, a)):
        if not isinstance(one, Composed) and one["shader"] == Shader.EMISSION and not both_textured(one, other):
            for leaf in leaves(other):
                add_emission(leaf, one)
            return other
    for leaf in (*leaves(a), *leaves(b)):  # each is seen by half of the paths
        leaf["emission"] *= 2
        if int(leaf["shader"]) in TINTED:
            leaf["base_color"] *= 2
        elif leaf["shader"] != Shader.EMISSION:
            converter.report(
                f"{Shader(int(leaf['shader'])).name.title()} in an Add Shader rendered with half of its weight"
            )
    return mixed(a, b)


def node_mix_shader(converter: Converter, node: Any) -> Tree | None:
    a, b = converter.surface(node.inputs[1]), converter.surface(node.inputs[2])
    factor, doubtful = converter.weighed(node.inputs[0])
    t = min(max(factor.scalar, 0.0), 1.0)
    if factor.use is None:
        if t in (0.0, 1.0):
            return b if t else a
        factor = grey(t)
    a, b = (black() if r is None else r for r in (a, b))
    if doubtful:
        out = either(converter.textures, a, b) if converter.most else mixed(a, b)
        return unsure(out, whether=True)
    angle = factor.use is not None and factor.use.angle
    if angle or isinstance(a, Composed) or isinstance(b, Composed):
        return _mix(converter, a, b, factor)
    for one, other, swapped in ((a, b, False), (b, a, True)):
        if (
            is_clear(one)
            and other["shader"] == Shader.PRINCIPLED
            and other["alpha"] == 1
            and other["alpha_texture"] < 0
        ):
            converter.scalar(other, "alpha", _complement(converter, factor) if swapped else factor)
            return other
        plain = int(other["shader"]) in TINTED | {Shader.EMISSION}
        if one["shader"] == Shader.EMISSION and plain and factor.use is None and not both_textured(one, other):
            weight = 1 - t if swapped else t
            one["emission"] *= 1 - weight
            other["base_color"] *= weight
            other["emission"] *= weight
            add_emission(other, one)
            return other
    return _mix(converter, a, b, factor)


def _complement(converter: Converter, factor: Value) -> Value:
    return grey(1 - factor.scalar) if factor.use is None else converter.reader.map(lambda x: 1 - x, factor)
