"""Shader sockets -> MATERIAL records: what is common to all shader nodes, and how records are filled with values."""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType
from typing import Any

import numpy as np

from ....core.arrays import Records
from ....core.scene.model import BY_ANGLE, Shader, Unsure, default_material
from .arithmetic import Array
from .ranges import MOST, glow_of, is_bounded, most_of, range_of, scatters
from .reader import LUMINANCE, MEAN, WORTHLESS, Reader, Value, grey
from .textures import TextureTable
from .trees import (
    ANY,
    UNKNOWN,
    Tree,
    black,
    clear,
    doubled,
    filled,
    glowing,
    glowing_through,
    half_sure,
    leaves,
    lets_in,
    mark,
    mixed,
    scattered,
    spread,
    unsure,
)

HALF = grey(0.5)
FOG = f": what only lights it or throws shadows into it {WORTHLESS}"
UNBOUNDED = (
    f"emission that nothing bounds: colours are taken for {MOST[0]:g} at most and numbers for {MOST[1]:g}; what more "
    f"of it lights {WORTHLESS}"
)
DARK = 0.15  # share of the places that are at most as bright as what is surely there: fewer fill no tile
FINE = 0.15  # roughness up to which what a map of normals has lost is its bytes' rounding


def _sure(pixels: Array) -> float:
    """What differs from place to place, and nobody knows where: to its mean, how bright a place surely is, that is, as
    its dark parts. pixels: (H, W, 4), as much of each colour as there is on the whole."""
    bright = pixels[..., :3] @ LUMINANCE
    return min(float(np.quantile(bright, DARK)) / max(float(bright.mean()), 1e-6), 1.0)


def either(textures: TextureTable, first: Tree, second: Tree) -> Tree:
    """Either of two, where nobody knows how much of each shows: they emit the most that they may, and what both send on
    is surely there."""
    out = doubled(mixed(first, second))
    sent = [_sent(textures, leaf) for leaf in leaves(out)]
    least = min(dark for _, dark in sent)
    for leaf, (mean, _) in zip(leaves(out), sent, strict=True):
        if least > 0:
            leaf["sure"] *= least / mean
        else:
            mark(leaf, Unsure.LIGHT)
    return out


def _sent(textures: TextureTable, record: Records) -> tuple[float, float]:
    """How bright a surface is on the whole, and where it is dark; 0 where that hangs on what it reflects or lets
    through."""
    plain = int(record["shader"]) in (Shader.DIFFUSE, Shader.PRINCIPLED) and not lets_in(record)
    shiny = record["shader"] == Shader.PRINCIPLED and (record["metallic"] > 0 or record["coat"] > 0)
    if not plain or shiny or int(record["unsure"]) & Unsure.LIGHT:
        return 0.0, 0.0
    mean, sure = float(record["base_color"] @ LUMINANCE), float(record["sure"])
    if record["base_color_texture"] >= 0:
        pixels = textures.linear(textures.use(int(record["base_color_texture"])))
        mean, sure = mean * float((pixels[..., :3] @ LUMINANCE).mean()), sure * _sure(pixels)
    return mean, mean * sure


def _doubt(record: Records, field: str, socket: Any) -> float:
    """Make the most of a field of a record whose socket is not known, and the roughness by which what it shows is
    spread."""
    low, high = range_of(socket)
    mark(record, Unsure.LIGHT)
    if field == "coat_roughness":
        record[field] = min(max(low, 0.0), 1.0)
    elif field in {"coat", "specular_level"}:
        record[field] = min(max(high, 0.0), 1.0)
    elif field in {"ior", "coat_ior"}:
        if not np.isfinite((low, high)).all():
            record[field] = socket.default_value
        if lets_in(record):
            mark(record, Unsure.BEHIND)
            return UNKNOWN
    return 0.0


def _most(socket: Any, report: Callable[[str], None]) -> Value:
    """The most that a socket of emission may be; said where nothing bounds it."""
    if not is_bounded(socket):
        report(UNBOUNDED)
    return grey(max(most_of(socket), 0.0))


def _takes(record: Records, least: float, color: Value) -> bool:
    """Have what takes light away give as much. least: of its strength, as far as that is known; color: it goes with."""
    if not ((record["emission"] < 0).any() or -np.inf < least < 0):
        return False
    most = np.abs(record["emission"])
    if record["unsure_emission"]:
        most = np.maximum(most, max(-least, 0.0) * np.abs(color.factor))
    record["emission"], record["unsure_emission"] = most, 2
    return True


def _lost(textures: TextureTable, value: Value) -> float:
    """Roughness that stands for what a map of normals has lost by being reduced: the shorter the mean of unit
    vectors, the more they differ (Toksvig, "Mipmapping Normal Maps", 2005); GGX's alpha is the root of twice the
    variance of slopes, and Blender's roughness the root of that."""
    if value.use is None or not textures.sources[value.use.source].reduced:
        return 0.0
    normals = 2 * textures.linear(value.use)[..., :3] - 1
    length = min(max(float(np.linalg.norm(normals, axis=2).mean()), 1e-3), 1.0)
    return min(float(2 * (1 - length) / length) ** 0.25, 1.0)


class Converter:
    """Makes records of the shader sockets of one inlined tree, as one view sees them."""

    def __init__(
        self,
        textures: TextureTable,
        report: Callable[[str], None],
        reader: Reader,
        shaders: ModuleType,
        most: bool = True,
    ) -> None:
        """shaders: its functions `node_TYPE(converter, node)` make materials of nodes of the type of that name in lower
        case; None is black. most: as of `MaterialTable`."""
        self.textures = textures
        self.report = report
        self.reader = reader
        self.shaders = shaders
        self._spread = 0.0  # roughness that stands for normals of the node that is converted which are not followed
        self.most = most

    def output(self, node: Any) -> Tree:
        """What an output node shows."""
        tree = self.surface(node.inputs["Surface"])
        if node.inputs["Volume"].is_linked:
            alone = not node.inputs["Surface"].is_linked
            self.report(f"volume not rendered{FOG if alone else ''}")
            glow = glow_of(node.inputs["Volume"]) if self.most else 0.0
            if alone:
                return unsure(mixed(clear(), glowing(scattered(), 2 * glow)))
            if tree is not None and self.most:
                return filled(tree, glow, scatters(node.inputs["Volume"]))
        return black() if tree is None else tree

    def surface(self, socket: Any) -> Tree | None:
        """What is linked to a shader socket; None where nothing is (black)."""
        if not socket.is_linked:
            return None
        node = socket.links[0].from_node
        function = getattr(self.shaders, f"node_{node.type.lower()}", None)
        outer, self._spread = self._spread, 0.0
        tree: Tree | None = self.other(node) if function is None else function(self, node)
        if self._spread and tree is not None:
            tree = spread(tree, self._spread)
        self._spread = outer
        return tree

    def weighed(self, socket: Any) -> tuple[Value, bool]:
        """A value that says how much of something shows, and whether it is but an approximation; then it is a half."""
        before, self.reader.angles = self.reader.doubts, True
        value = self.reader.value(socket)
        self.reader.angles = False
        return (HALF, True) if self.reader.doubts > before else (value, False)

    def color(self, record: Records, field: str, value: Value) -> None:
        """A colour and its texture."""
        if value.use is not None and value.channel is not None:
            value = self.reader.image(value)
        record[field] = value.factor
        if value.use is not None:
            record[f"{field}_texture"] = self.textures.index(value.use)

    def base(self, record: Records, socket: Any) -> None:
        """What it reflects or lets through; where nothing says what bounds that, or where it is another for each
        object, it is not known what light comes by it."""
        before, value = self.reader.doubts, self.reader.value(socket)
        self.color(record, "base_color", value)
        if self.most and self.reader.doubts > before:
            if value.use is None or not np.isfinite(range_of(socket)).all():
                mark(record, Unsure.LIGHT)
            else:
                record["sure"] = _sure(self.reader.pixels(value))

    def scalar(self, record: Records, field: str, value: Value) -> None:
        """A scalar, its texture and the channel it reads."""
        if value.use is None:
            record[field] = value.scalar
            return
        if len(set(value.factor)) > 1 or value.use.angle:
            value = self.reader.image(value)
        record[field] = value.factor[0]
        if value.use is not None:
            record[f"{field}_texture"] = self.textures.index(value.use)
            channel = MEAN if value.channel is None else value.channel
            record[f"{field}_channel"] = BY_ANGLE if value.use.angle else channel

    def roughness(self, record: Records, socket: Any) -> None:
        """The roughness; where it is not known, half of what is reflected is as sharp as it may be, and half as
        spread."""
        before, value = self.reader.doubts, self.reader.value(socket)
        if self.most and self.reader.doubts > before:
            low, high = (min(max(end, 0.0), 1.0) for end in range_of(socket))
            value, self._spread = grey(low), max(self._spread, high)
        self.scalar(record, "roughness", value)

    def number(self, record: Records, field: str, socket: Any) -> None:
        """What the core takes untextured. Where it is not known, it is what most is reflected by, and most sharply, of
        which nothing is surely there; what is seen by refraction is spread, too."""
        before = self.reader.doubts
        self.reader.value(socket)
        known = not self.most or self.reader.doubts == before
        value = self.reader.constant(socket)
        record[field] = value if record[field].shape else value[0]
        if known or field == "diffuse_roughness":
            return
        self._spread = max(self._spread, _doubt(record, field, socket))

    def product(self, a: Value, b: Value) -> Value:
        """Both multiplied, as one image at most."""
        if a.use is None or b.use is None:
            image, other = (a, b) if b.use is None else (b, a)
            factor = tuple(x * y for x, y in zip(image.factor, other.factor, strict=True))
            return Value(factor, image.use, image.channel)  # type: ignore[arg-type]
        return self.reader.map(lambda x, y: x * y, a, b)

    def emit(self, record: Records, color: Any, strength: Any) -> None:
        """Emission, from sockets of its colour and its strength; where it is not known, the most that it may be."""
        before = self.reader.doubts
        s = self.reader.value(strength)
        if self.reader.doubts == before and s.use is None and s.scalar == 0.0:
            return
        between = self.reader.doubts
        c = self.reader.value(color)
        if self.most and self.reader.doubts > before:
            s = _most(strength, self.report) if between > before else s
            c = _most(color, self.report) if self.reader.doubts > between else c
            record["unsure_emission"] = 1
        self.color(record, "emission", self.product(c, s))
        if self.most and _takes(record, range_of(strength)[0], c):
            self.report("that it takes light away is not rendered: it gives as much")

    def normal(self, record: Records, node: Any) -> None:
        """What is linked to a node's Normal: a tangent space normal map is followed."""
        socket = node.inputs["Normal"]
        if not socket.is_linked:
            return
        source = socket.links[0].from_node
        if source.type != "NORMAL_MAP" or source.space != "TANGENT":
            if source.type not in {"NEW_GEOMETRY", "TEX_COORD"}:
                self.report(f"{source.bl_label} node on Normal not rendered: half of what is reflected is spread")
                self._spread = max(self._spread, UNKNOWN if source.type == "BUMP" else ANY)
            return
        before, value = self.reader.doubts, self.reader.value(source.inputs["Color"])
        if self.reader.flat(value) is not value or (value.use is None and self.reader.doubts > before):
            self.report(f"{source.bl_label} node on Normal not rendered: half of what is reflected is spread")
            self._spread = max(self._spread, UNKNOWN)
            return
        value = self.reader.image(value)
        if value.use is None:
            return
        roughness = _lost(self.textures, value)
        if roughness > FINE:
            self.report("normal map looked at with fewer pixels: half of what is reflected is spread")
            self._spread = max(self._spread, roughness)
        record["normal_texture"] = self.textures.index(value.use)
        record["normal_strength"] = self.reader.constant(source.inputs["Strength"], "normal strength")[0]

    def plain(self, node: Any, shader: Shader) -> Records:
        """A BSDF node with Color, and perhaps Roughness, IOR and Normal."""
        record = default_material()
        record["shader"] = shader
        before = self.reader.doubts
        self.base(record, node.inputs["Color"])
        if shader == Shader.TRANSPARENT and self.reader.doubts > before:
            mark(record, Unsure.BEHIND | Unsure.CLEAR)
        if "Roughness" in node.inputs:
            field = "diffuse_roughness" if shader == Shader.DIFFUSE else "roughness"
            if field == "roughness":
                self.roughness(record, node.inputs["Roughness"])
            else:
                self.number(record, field, node.inputs["Roughness"])
        if "IOR" in node.inputs:
            self.number(record, "ior", node.inputs["IOR"])
        if getattr(node, "distribution", "GGX") not in {"GGX", "MULTI_GGX"}:
            self.report(f"{node.distribution} distribution rendered as GGX")
        for name in ("Anisotropy", "Thin Film Thickness"):
            if name in node.inputs and (node.inputs[name].is_linked or node.inputs[name].default_value != 0):
                self.report(f"{name.lower()} not rendered")
        if "Normal" in node.inputs:
            self.normal(record, node)
        return record

    def other(self, node: Any) -> Tree:
        """Sheen, toon, hair and the like: diffuse, of which half is surely there; through hair light comes, too."""
        record = self.diffuse(node)
        if not self.most:
            return record
        return glowing_through(record, 1.0) if "HAIR" in node.type else half_sure(record)

    def diffuse(self, node: Any) -> Records:
        """In place of a node: diffuse with its colour."""
        self.report(f"{node.bl_label} rendered as diffuse")
        record = default_material()
        record["shader"] = Shader.DIFFUSE
        if "Color" in node.inputs:
            self.base(record, node.inputs["Color"])
        if "Normal" in node.inputs:
            self.normal(record, node)
        return record
