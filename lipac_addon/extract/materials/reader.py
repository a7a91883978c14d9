"""Values of shader sockets: a constant, an image times a factor, or the pixels that a chain of nodes makes of images.

Works on trees from `inline_shader_nodes()`: Blender has dissolved groups, reroutes, muted nodes and constant arithmetic
there.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ....core.scene.model import Extension
from ... import attributes
from .arithmetic import Array
from .ranges import AROUND, output_range
from .textures import ImageUse, TextureTable

LUMINANCE = np.array([0.2126729, 0.7151522, 0.0721750], np.float32)  # Rec.709
ALPHA = 3
WORTHLESS = "is taken to be worth nothing"  # ends lines that say what can be culled although the picture shows it
TILES = {"TEX_CHECKER", "TEX_BRICK"}
MEAN = 4  # the channel value that stands for luminance
ANGLES = 256  # steps of what depends on the angle at which a ray meets a surface


@dataclass(frozen=True)
class Value:
    """factor (r, g, b) times an image's colour, or times one `channel` of it (3: alpha); without an image the factor
    alone."""

    factor: tuple[float, float, float]
    use: ImageUse | None = None
    channel: int | None = None

    @property
    def scalar(self) -> float:
        """As a float socket gets it: a colour's luminance (Rec.709)."""
        r, g, b = self.factor
        return r if r == g == b else float(np.dot(LUMINANCE, self.factor))


@dataclass(frozen=True)
class View:
    """What looks at a material. ray: `core.scene.model.RayType`, or LIGHT_VIEW for light sampling; back: at its
    back."""

    ray: int
    back: bool


def grey(value: float) -> Value:
    """The same in all channels."""
    return Value((float(value),) * 3)


def no_objects() -> NDArray[np.float64]:
    """The colours of no objects."""
    return np.zeros((0, 4))


class Reader:
    """Reads the sockets of one inlined tree, as one view sees them.

    asked: whether anything depended on the view. angles: whether a value may depend on the angle at which a ray meets
    the surface. doubts: how many values so far are but stand-ins for others.
    """

    def __init__(
        self,
        textures: TextureTable,
        report: Callable[[str], None],
        view: View,
        nodes: ModuleType,
        objects: Callable[[], NDArray[np.float64]] = no_objects,
        patterns: bool = False,
    ) -> None:
        """nodes: its functions `node_TYPE(reader, node, socket)` evaluate nodes of the type of that name in lower case,
        or return None. objects: the colours, (K, 4), of the objects that show the tree. patterns: what is not followed
        but lies within known bounds is a pattern of all that it may be; else its average."""
        self.nodes, self.objects, self.patterns = nodes, objects, patterns
        self.textures = textures
        self.report = report
        self.view = view
        self.asked = False
        self.angles = False
        self.doubts = 0

    def doubt(self, line: str) -> None:
        """Report a value that is but a stand-in."""
        self.doubts += 1
        self.report(line)

    # Values

    def value(self, socket: Any) -> Value:
        """What arrives at an input socket."""
        if socket.is_linked:
            link = socket.links[0]
            return self.convert(self._output(link.from_node, link.from_socket), link.from_socket, socket)
        default = socket.default_value
        if isinstance(default, (int, float)):
            return grey(default)
        return Value(tuple(float(v) for v in default[:3]))  # type: ignore[arg-type]

    def constant(self, socket: Any, what: str = "") -> NDArray[np.float64]:
        """(3,) of an input that the core takes untextured: the mean where an image is linked, and a report."""
        value = self.flat(self.value(socket))
        if value.use is not None:
            self.doubt(f"texture on {what or socket.name} replaced by its average")
            return self.pixels(value)[..., :3].reshape(-1, 3).mean(axis=0).astype(np.float64)
        return np.array(value.factor)

    def pixels(self, value: Value) -> Array:
        """(H, W, 4) linear pixels, or (1, 1, 4): colour times factor, and the image's alpha."""
        if value.use is None:
            return np.array([[[*value.factor, 1.0]]], np.float32)
        image = self.textures.linear(value.use)
        out = image.copy()
        if value.channel == MEAN:
            out[..., :3] = (image[..., :3] @ LUMINANCE)[..., None]
        elif value.channel is not None:
            out[..., :3] = image[..., value.channel, None]
        out[..., :3] *= np.array(value.factor, np.float32)
        return out

    def image(self, value: Value) -> Value:
        """The same with factor 1 and no channel: what a colour texture of the core can be."""
        if value.use is None or (value.channel is None and value.factor == (1.0, 1.0, 1.0)):
            return value
        return Value((1.0, 1.0, 1.0), self.textures.derive(value.use, self.pixels(value)))

    def map(self, function: Callable[..., Any], *values: Value) -> Value:
        """A function of (H, W, 3) arrays, pixel by pixel. Images that are placed differently cannot be combined: all
        but the first become their average."""
        uses = [v.use for v in values if v.use is not None]
        first = next((use for use in uses if not self._is_pattern(use)), uses[0] if uses else None)
        arrays = []
        for v in values:
            pixels = self.pixels(v)
            if v.use is not None and first is not None and not self._aligned(v.use, first):
                if not self._is_pattern(v.use):
                    self.doubt("images with different placement are combined: one is replaced by its average")
                pixels = pixels.mean(axis=(0, 1), keepdims=True)
            arrays.append(pixels[..., :3])
        with np.errstate(all="ignore"):
            out = np.nan_to_num(np.asarray(function(*arrays), np.float32))
        if first is None:
            return Value(tuple(float(x) for x in np.broadcast_to(out, (1, 1, 3))[0, 0]))  # type: ignore[arg-type]
        base = self.textures.sources[first.source].data.shape
        data = np.ones((base[0], base[1], 4), np.float32)
        data[..., :3] = out
        return Value((1.0, 1.0, 1.0), self.textures.derive(first, data))

    def _aligned(self, a: ImageUse, b: ImageUse) -> bool:
        shapes = [self.textures.sources[u.source].data.shape[:2] for u in (a, b)]
        places = [(u.uv_map, u.matrix, u.extension, u.angle) for u in (a, b)]
        return places[0] == places[1] and shapes[0] == shapes[1]

    def convert(self, value: Value, source: Any, target: Any) -> Value:
        """Implicit conversion between socket types: colour to float is luminance, vector to float the mean."""
        if target.type != "VALUE" or source.type not in {"RGBA", "VECTOR"}:
            return value
        if value.use is not None and value.channel is None and source.type == "RGBA":
            r, g, b = value.factor
            if r == g == b:
                return Value(value.factor, value.use, MEAN)
        if value.use is not None and value.channel is not None and len(set(value.factor)) == 1:
            return value
        weights = LUMINANCE if source.type == "RGBA" else np.full(3, 1 / 3, np.float32)
        return self.map(lambda a: np.repeat((a @ weights)[..., None], 3, axis=2), value)

    def attribute(self, name: str) -> Value:
        """A colour or number that meshes have by this name."""
        palette = self.textures.add(attributes.palette())
        place = self.textures.uv_map(f"{attributes.NAME}{name}")
        return Value((1.0, 1.0, 1.0), ImageUse(palette, place, extension=int(Extension.EXTEND), closest=True))

    def by_angle(self, function: Callable[[NDArray[np.float64]], NDArray[np.float64]]) -> Value:
        """A function of the cosine of the angle at which a ray meets the surface."""
        data = np.ones((1, ANGLES, 4), np.float32)
        data[..., :3] = function((np.arange(ANGLES) + 0.5) / ANGLES)[:, None]
        return Value((1.0, 1.0, 1.0), ImageUse(self.textures.add(data), extension=int(Extension.EXTEND), angle=True))

    def flat(self, value: Value) -> Value:
        """The value, in place of a pattern its average."""
        if value.use is None or not self._is_pattern(value.use):
            return value
        mean = self.pixels(value)[..., :3].mean(axis=(0, 1))
        return Value(tuple(float(x) for x in mean))  # type: ignore[arg-type]

    def _is_pattern(self, use: ImageUse) -> bool:
        return self.textures.uv_maps[use.uv_map] == attributes.PLACE

    def _pattern(self, node: Any, first: Any, second: Any) -> Value:
        """Stand-in for a node that lies between two colours: now one, now the other, and, but for tiles, what is
        between."""
        self.doubt(f"{node.bl_label} node replaced by a pattern")
        place = self.textures.uv_map(attributes.PLACE)
        value = Value((1.0, 1.0, 1.0), ImageUse(self.textures.add(attributes.pattern()), place))
        a, b = (np.broadcast_to(np.asarray(x, np.float32), 3) for x in (first, second))
        if node.type in TILES:
            return self.map(lambda t: np.where(t < 0.5, a, b), value)
        return value if not a.any() and (b == 1).all() else self.map(lambda t: a + t * (b - a), value)

    def average(self, node: Any, color: Any) -> Value:
        """Stand-in for a node that the engine does not evaluate."""
        self.doubt(f"{node.bl_label} node replaced by a constant")
        return Value(tuple(float(c) for c in np.broadcast_to(np.asarray(color, float), 3)))  # type: ignore[arg-type]

    def _output(self, node: Any, socket: Any) -> Value:
        function = getattr(self.nodes, f"node_{node.type.lower()}", None)
        if function is not None:
            result = function(self, node, socket)
            return result if isinstance(result, Value) else self._unknown(node, socket)
        if node.type in TILES and socket.type == "RGBA":
            a, b = (self.constant(node.inputs[k]) for k in ("Color1", "Color2"))
            return self._pattern(node, a, b) if self.patterns else self.average(node, (a + b) / 2)
        return self._unknown(node, socket)

    def _unknown(self, node: Any, socket: Any) -> Value:
        """Stand-in for an output that is not followed."""
        if node.type in AROUND and not node.only_local:
            self.report(f"{node.bl_label} not rendered: what is within its reach stays")
        bounds = output_range(node, socket)
        return self._pattern(node, *bounds) if self.patterns and np.isfinite(bounds).all() else self.average(node, 0.5)
