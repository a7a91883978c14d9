"""Values of shader sockets: a constant, an image times a factor, or the pixels that a chain of nodes makes of images.

Works on trees from `inline_shader_nodes()`: Blender has dissolved groups, reroutes, muted nodes and constant arithmetic there.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ....core.scene.model import RayType
from .textures import EXTENSIONS, ImageUse, TextureTable

Array = NDArray[np.float32]
LUMINANCE = np.array([0.2126729, 0.7151522, 0.0721750], np.float32)  # Rec.709
ALPHA = 3
MEAN = 4  # the channel value that stands for luminance


@dataclass(frozen=True)
class Value:
    """factor (r, g, b) times an image's colour, or times one `channel` of it (3: alpha); without an image the factor alone."""

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
    """What looks at a material. ray: `core.scene.model.RayType`, or LIGHT_VIEW for light sampling; back: at its back."""

    ray: int
    back: bool


_ON = {  # outputs of Light Path that are 1, by what looks; those of other flags are 0
    "Is Camera Ray": {RayType.CAMERA},
    "Is Shadow Ray": {RayType.SHADOW},
    "Is Diffuse Ray": {RayType.DIFFUSE},
    "Is Glossy Ray": {RayType.GLOSSY, RayType.TRANSMISSION},  # Cycles means what is not diffuse
    "Is Reflection Ray": {RayType.DIFFUSE, RayType.GLOSSY},
    "Is Transmission Ray": {RayType.TRANSMISSION},
    "Is Volume Scatter Ray": set[RayType](),
}


def grey(value: float) -> Value:
    """The same in all channels."""
    return Value((float(value),) * 3)


def _mix(blend: str, a: Array, b: Array, t: Array) -> Array:
    """Blender's colour blend modes (`ramp_blend`)."""
    if blend == "MIX":
        out = b
    elif blend == "ADD":
        out = a + b
    elif blend == "MULTIPLY":
        out = a * b
    elif blend == "SUBTRACT":
        out = a - b
    elif blend == "SCREEN":
        out = 1 - (1 - a) * (1 - b)
    elif blend == "DIVIDE":
        out = np.where(b != 0, a / np.where(b != 0, b, 1), a)
    elif blend == "DIFFERENCE":
        out = np.abs(a - b)
    elif blend == "DARKEN":
        out = np.minimum(a, b)
    elif blend == "LIGHTEN":
        out = np.maximum(a, b)
    elif blend == "OVERLAY":
        out = np.where(a < 0.5, 2 * a * b, 1 - 2 * (1 - a) * (1 - b))
    elif blend == "LINEAR_LIGHT":
        return a + t * (2 * b - 1)
    else:
        raise NotImplementedError(blend)
    return a + t * (out - a)


MATH: dict[str, Callable[..., Any]] = {
    "ADD": lambda a, b, c: a + b,
    "SUBTRACT": lambda a, b, c: a - b,
    "MULTIPLY": lambda a, b, c: a * b,
    "DIVIDE": lambda a, b, c: np.where(b != 0, a / np.where(b != 0, b, 1), 0),
    "MULTIPLY_ADD": lambda a, b, c: a * b + c,
    "POWER": lambda a, b, c: np.where(a >= 0, np.maximum(a, 0) ** b, 0),
    "MINIMUM": lambda a, b, c: np.minimum(a, b),
    "MAXIMUM": lambda a, b, c: np.maximum(a, b),
    "LESS_THAN": lambda a, b, c: (a < b).astype(np.float32),
    "GREATER_THAN": lambda a, b, c: (a > b).astype(np.float32),
    "ABSOLUTE": lambda a, b, c: np.abs(a),
    "SQRT": lambda a, b, c: np.sqrt(np.maximum(a, 0)),
    "ROUND": lambda a, b, c: np.floor(a + 0.5),
    "FLOOR": lambda a, b, c: np.floor(a),
    "CEIL": lambda a, b, c: np.ceil(a),
    "FRACT": lambda a, b, c: a - np.floor(a),
    "SINE": lambda a, b, c: np.sin(a),
    "COSINE": lambda a, b, c: np.cos(a),
}


class Reader:
    """Reads the sockets of one inlined tree, as one view sees them.

    asked: whether anything depended on the view. doubts: how many values so far are but stand-ins for others.
    """

    def __init__(self, textures: TextureTable, report: Callable[[str], None], view: View) -> None:
        self.textures = textures
        self.report = report
        self.view = view
        self.asked = False
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
            return self._convert(self._output(link.from_node, link.from_socket), link.from_socket, socket)
        default = socket.default_value
        if isinstance(default, (int, float)):
            return grey(default)
        return Value(tuple(float(v) for v in default[:3]))  # type: ignore[arg-type]

    def constant(self, socket: Any, what: str = "") -> NDArray[np.float64]:
        """(3,) of an input that the core takes untextured: the mean where an image is linked, and a report."""
        value = self.value(socket)
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
        """A function of (H, W, 3) arrays, pixel by pixel. Images that are placed differently cannot be combined: all but the first become their average."""
        first = next((v.use for v in values if v.use is not None), None)
        arrays = []
        for v in values:
            pixels = self.pixels(v)
            if v.use is not None and first is not None and not self._aligned(v.use, first):
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
        return (a.uv_map, a.matrix, a.extension) == (b.uv_map, b.matrix, b.extension) and shapes[0] == shapes[1]

    def _convert(self, value: Value, source: Any, target: Any) -> Value:
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

    def average(self, node: Any, color: Any) -> Value:
        """Stand-in for a node that the engine does not evaluate."""
        self.doubt(f"{node.bl_label} node replaced by a constant")
        return Value(tuple(float(c) for c in np.broadcast_to(np.asarray(color, float), 3)))  # type: ignore[arg-type]

    def _output(self, node: Any, socket: Any) -> Value:
        method = getattr(self, f"node_{node.type.lower()}", None)
        if method is not None:
            result = method(node, socket)
            return result if isinstance(result, Value) else self.average(node, 0.5)
        if node.type in {"TEX_CHECKER", "TEX_BRICK"}:
            a, b = (self.constant(node.inputs[k]) for k in ("Color1", "Color2"))
            return self.average(node, (a + b) / 2 if socket.type == "RGBA" else 0.5)
        if node.type in {"VERTEX_COLOR", "ATTRIBUTE"}:
            return self.average(node, 1.0)
        return self.average(node, 0.5)

    # Nodes: each returns a Value, or None where it cannot say

    def node_rgb(self, node: Any, socket: Any) -> Value:
        return Value(tuple(socket.default_value[:3]))

    def node_value(self, node: Any, socket: Any) -> Value:
        return grey(socket.default_value)

    def node_light_path(self, node: Any, socket: Any) -> Value | None:
        self.asked = True
        if socket.name in _ON:
            return grey(float(self.view.ray in _ON[socket.name]))
        mirrored = self.view.ray in {RayType.GLOSSY, RayType.TRANSMISSION}
        if (socket.name == "Is Singular Ray" and not mirrored) or (socket.name.endswith("Depth") and self._straight(socket.name)):
            return grey(0.0)
        return None

    def _straight(self, name: str) -> bool:
        return self.view.ray == RayType.CAMERA and name != "Transparent Depth"

    def node_new_geometry(self, node: Any, socket: Any) -> Value | None:
        if socket.name != "Backfacing":
            return None
        self.asked = True
        return grey(float(self.view.back))

    def node_tex_image(self, node: Any, socket: Any) -> Value:
        if node.projection != "FLAT":
            self.doubt(f"{node.projection.lower()} projection of image {node.image.name if node.image else ''!r} replaced by UVs")
        uv_map, matrix = self.placement(node.inputs["Vector"])
        alpha_read = node.outputs["Alpha"].is_linked
        source = self.textures.image(node.image, not alpha_read)
        self.doubts += not self.textures.sources[source].exact
        use = ImageUse(source, self.textures.uv_map(uv_map), matrix, int(EXTENSIONS[node.extension]), node.interpolation == "Closest")
        return Value((1.0, 1.0, 1.0), use, ALPHA if socket.name == "Alpha" else None)

    def node_separate_color(self, node: Any, socket: Any) -> Value | None:
        if getattr(node, "mode", "RGB") != "RGB":
            return None
        return self._channel(node.inputs[0], list(node.outputs).index(socket))

    node_seprgb = node_sepxyz = node_separate_color

    def _channel(self, source: Any, k: int) -> Value:
        value = self.value(source)
        if value.use is None:
            return grey(value.factor[k])
        return Value((value.factor[k],) * 3, value.use, k if value.channel is None else value.channel)

    def node_combine_color(self, node: Any, socket: Any) -> Value | None:
        if getattr(node, "mode", "RGB") != "RGB":
            return None
        return self.map(lambda r, g, b: np.concatenate(np.broadcast_arrays(r[..., :1], g[..., :1], b[..., :1]), axis=2), *map(self.value, node.inputs[:3]))

    node_combrgb = node_combxyz = node_combine_color

    def node_rgbtobw(self, node: Any, socket: Any) -> Value:
        return self._convert(self.value(node.inputs[0]), node.inputs[0], socket)

    def _scaled(self, a: Value, b: Value) -> Value | None:
        """Product where at least one side is constant."""
        if b.use is None:
            a, b = b, a
        if a.use is not None:
            return None
        return Value(tuple(x * y for x, y in zip(a.factor, b.factor, strict=True)), b.use, b.channel)  # type: ignore[arg-type]

    def node_math(self, node: Any, socket: Any) -> Value | None:
        values = [self.value(s) for s in node.inputs]
        if node.operation == "MULTIPLY" and not node.use_clamp:
            product = self._scaled(values[0], values[1])
            if product is not None:
                return product
        function = MATH.get(node.operation)
        if function is None:
            return None
        values += [grey(0.0)] * (3 - len(values))
        return self.map(lambda a, b, c: np.clip(function(a, b, c), 0, 1) if node.use_clamp else function(a, b, c), *values[:3])

    def node_vect_math(self, node: Any, socket: Any) -> Value | None:
        function = MATH.get({"SCALE": "MULTIPLY"}.get(node.operation, node.operation))
        if function is None:
            return None
        a, b = self.value(node.inputs[0]), self.value(node.inputs[3] if node.operation == "SCALE" else node.inputs[1])
        return self.map(function, a, b, grey(0.0))

    def node_mix(self, node: Any, socket: Any) -> Value | None:
        if node.data_type not in {"FLOAT", "RGBA", "VECTOR"} or (node.data_type == "VECTOR" and node.factor_mode != "UNIFORM"):
            return None
        name = {"FLOAT": "Float", "RGBA": "Color", "VECTOR": "Vector"}[node.data_type]
        inputs = {s.identifier: s for s in node.inputs}
        blend = node.blend_type if node.data_type == "RGBA" else "MIX"
        clamp = node.clamp_result and node.data_type == "RGBA"
        return self._blend(blend, inputs["Factor_Float"], inputs[f"A_{name}"], inputs[f"B_{name}"], clamp, node.clamp_factor)

    def node_mix_rgb(self, node: Any, socket: Any) -> Value | None:
        return self._blend(node.blend_type, node.inputs[0], node.inputs[1], node.inputs[2], node.use_clamp, True)

    def _blend(self, blend: str, factor: Any, first: Any, second: Any, clamp: bool, clamp_factor: bool) -> Value | None:
        t = self.value(factor)
        if t.use is None and clamp_factor:
            t = grey(min(max(t.scalar, 0.0), 1.0))
        if t.use is None and t.scalar == 0.0 and not clamp:
            return self.value(first)
        b = self.value(second)
        if t.use is None and t.scalar == 1.0 and not clamp and blend == "MIX":
            return b
        a = self.value(first)
        if blend == "MULTIPLY" and t.use is None and t.scalar == 1.0 and not clamp:
            product = self._scaled(a, b)
            if product is not None:
                return product
        try:
            return self.map(lambda x, y, s: np.clip(_mix(blend, x, y, s), 0, 1) if clamp else _mix(blend, x, y, s), a, b, t)
        except NotImplementedError:
            return None

    def node_invert(self, node: Any, socket: Any) -> Value:
        return self.map(lambda t, a: a + t * (1 - 2 * a), self.value(node.inputs[0]), self.value(node.inputs[1]))

    def node_gamma(self, node: Any, socket: Any) -> Value:
        return self.map(lambda a, g: np.where(a > 0, np.maximum(a, 1e-30) ** g, a), self.value(node.inputs[0]), self.value(node.inputs[1]))

    def node_brightcontrast(self, node: Any, socket: Any) -> Value:
        values = [self.value(s) for s in node.inputs[:3]]
        return self.map(lambda a, bright, contrast: np.maximum((1 + contrast) * a + bright - 0.5 * contrast, 0), *values)

    def node_clamp(self, node: Any, socket: Any) -> Value:
        return self.map(np.clip, *[self.value(s) for s in node.inputs[:3]])

    def node_map_range(self, node: Any, socket: Any) -> Value | None:
        if node.data_type != "FLOAT" or node.interpolation_type != "LINEAR":
            return None
        values = [self.value(s) for s in node.inputs[:5]]

        def function(x: Array, a: Array, b: Array, c: Array, d: Array) -> Array:
            t = np.where(b != a, (x - a) / np.where(b != a, b - a, 1), 0)
            return c + (np.clip(t, 0, 1) if node.clamp else t) * (d - c)

        return self.map(function, *values)

    def node_valtorgb(self, node: Any, socket: Any) -> Value:
        table = np.array([node.color_ramp.evaluate(k / 255) for k in range(256)], np.float32)
        if socket.name == "Alpha":
            table[:, :3] = table[:, 3:]
        grid = np.arange(256) / 255

        def ramp(x: Array) -> Array:
            return np.stack([np.interp(x[..., 0], grid, table[:, k]) for k in range(3)], axis=-1).astype(np.float32)

        return self.map(ramp, self.value(node.inputs[0]))

    def node_curve_rgb(self, node: Any, socket: Any) -> Value | None:
        mapping = node.mapping
        mapping.initialize()
        if node.inputs[0].is_linked or node.inputs[0].default_value != 1.0:
            return None
        grid = np.arange(257) / 256
        tables = [np.array([mapping.evaluate(mapping.curves[k], mapping.evaluate(mapping.curves[3], x)) for x in grid]) for k in range(3)]
        return self.map(lambda a: np.stack([np.interp(a[..., k], grid, tables[k]) for k in range(3)], axis=-1), self.value(node.inputs[1]))

    def node_hue_sat(self, node: Any, socket: Any) -> Value | None:
        hue, saturation, value, factor = (self.value(node.inputs[k]) for k in ("Hue", "Saturation", "Value", "Factor"))
        if any(v.use is not None for v in (hue, saturation, value, factor)):
            return None
        h, s, v, t = hue.scalar, saturation.scalar, value.scalar, factor.scalar
        return self.map(lambda a: a + t * (_hue_saturation(a, h, s, v) - a), self.value(node.inputs["Color"]))

    # Placement of images

    def placement(self, socket: Any) -> tuple[str, tuple[float, ...]]:
        """UV map name ("" the active one) and 2x3 matrix (row by row) that a vector socket amounts to."""
        name, m = self._affine(socket)
        return name, tuple(float(v) for v in (m[0, 0], m[0, 1], m[0, 3], m[1, 0], m[1, 1], m[1, 3]))

    def _affine(self, socket: Any) -> tuple[str, NDArray[np.float64]]:
        identity = np.eye(4)
        if not socket.is_linked:
            return "", identity
        node, output = socket.links[0].from_node, socket.links[0].from_socket
        if node.type == "UVMAP":
            return node.uv_map, identity
        if node.type == "TEX_COORD" and output.name == "UV":
            return "", identity
        if node.type == "MAPPING":
            name, m = self._affine(node.inputs["Vector"])
            return name, self._mapping(node) @ m
        if node.type == "VECT_MATH" and node.operation in {"ADD", "SUBTRACT", "MULTIPLY", "SCALE"}:
            name, m = self._affine(node.inputs[0])
            b = self.value(node.inputs[3] if node.operation == "SCALE" else node.inputs[1])
            if b.use is None:
                step = np.eye(4)
                if node.operation in {"MULTIPLY", "SCALE"}:
                    step[:3, :3] = np.diag(b.factor)
                else:
                    step[:3, 3] = np.array(b.factor) * (1 if node.operation == "ADD" else -1)
                return name, step @ m
        if node.type == "ATTRIBUTE" and node.attribute_type == "GEOMETRY":
            return node.attribute_name, identity
        self.doubt(f"texture coordinates of {node.bl_label} ({output.name}) replaced by UVs")
        return "", identity

    def _mapping(self, node: Any) -> NDArray[np.float64]:
        from mathutils import Euler

        values = {name: np.zeros(3) for name in ("Location", "Rotation")} | {"Scale": np.ones(3)}
        for name in values:
            if name in node.inputs and node.inputs[name].enabled:
                values[name] = self.constant(node.inputs[name], f"mapping {name.lower()}")
        rotation = np.array(Euler(values["Rotation"]).to_matrix(), np.float64)
        scale = values["Scale"]
        m = np.eye(4)
        if node.vector_type == "TEXTURE":
            m[:3, :3] = np.diag(1 / np.where(scale == 0, 1, scale)) @ rotation.T
            m[:3, 3] = -m[:3, :3] @ values["Location"]
        else:
            m[:3, :3] = rotation @ np.diag(scale)
            if node.vector_type == "POINT":
                m[:3, 3] = values["Location"]
        return m


def _hue_saturation(rgb: Array, hue: float, saturation: float, value: float) -> Array:
    """Blender's Hue/Saturation/Value node on (..., 3)."""
    low, high = rgb.min(axis=-1), rgb.max(axis=-1)
    span = high - low
    safe = np.where(span > 0, span, 1)
    r, g, b = rgb[..., 0], rgb[..., 1], rgb[..., 2]
    h = np.where(high == r, (g - b) / safe, np.where(high == g, 2 + (b - r) / safe, 4 + (r - g) / safe)) / 6
    h = np.where(span > 0, h % 1.0, 0)
    s = np.where(high > 0, span / np.where(high > 0, high, 1), 0)
    h, s, v = (h + hue + 0.5) % 1.0, np.clip(s * saturation, 0, 1), high * value
    k = np.stack([np.clip(np.abs((h * 6 + o) % 6 - 3) - 1, 0, 1) for o in (0, 4, 2)], axis=-1)
    return np.maximum(v[..., None] * (1 + s[..., None] * (k - 1)), 0).astype(np.float32)
