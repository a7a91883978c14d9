"""Nodes that make values: `node_TYPE(reader, node, socket)` is the Value at an output socket, or None where it cannot
say."""

from __future__ import annotations

from typing import Any

import numpy as np

from ....core.scene.model import RayType
from .arithmetic import MATH, Array, blend_colors, facing, fresnel, hue_saturation
from .placement import placement
from .reader import ALPHA, Reader, Value, grey
from .textures import EXTENSIONS, ImageUse

_ON = {  # outputs of Light Path that are 1, by what looks; those of other flags are 0
    "Is Camera Ray": {RayType.CAMERA},
    "Is Shadow Ray": {RayType.SHADOW},
    "Is Diffuse Ray": {RayType.DIFFUSE},
    "Is Glossy Ray": {RayType.GLOSSY, RayType.TRANSMISSION},  # Cycles means what is not diffuse
    "Is Reflection Ray": {RayType.DIFFUSE, RayType.GLOSSY},
    "Is Transmission Ray": {RayType.TRANSMISSION},
    "Is Volume Scatter Ray": set[RayType](),
}


def node_rgb(reader: Reader, node: Any, socket: Any) -> Value:
    return Value(tuple(socket.default_value[:3]))


def node_value(reader: Reader, node: Any, socket: Any) -> Value:
    return grey(socket.default_value)


def node_light_path(reader: Reader, node: Any, socket: Any) -> Value | None:
    reader.asked = True
    if socket.name in _ON:
        return grey(float(reader.view.ray in _ON[socket.name]))
    mirrored = reader.view.ray in {RayType.GLOSSY, RayType.TRANSMISSION}
    if (socket.name == "Is Singular Ray" and not mirrored) or (
        socket.name.endswith("Depth") and _straight(reader, socket.name)
    ):
        return grey(0.0)
    return None


def _straight(reader: Reader, name: str) -> bool:
    return reader.view.ray == RayType.CAMERA and name != "Transparent Depth"


def node_new_geometry(reader: Reader, node: Any, socket: Any) -> Value | None:
    if socket.name != "Backfacing":
        return None
    reader.asked = True
    return grey(float(reader.view.back))


def node_fresnel(reader: Reader, node: Any, socket: Any) -> Value | None:
    if not reader.angles or node.inputs["Normal"].is_linked:
        return None
    eta = max(float(reader.constant(node.inputs["IOR"])[0]), 1e-5)
    reader.asked = True
    return reader.by_angle(lambda cosine: fresnel(cosine, 1 / eta if reader.view.back else eta))


def node_layer_weight(reader: Reader, node: Any, socket: Any) -> Value | None:
    if not reader.angles or node.inputs["Normal"].is_linked:
        return None
    blend = float(reader.constant(node.inputs["Blend"])[0])
    if socket.name == "Facing":
        return reader.by_angle(lambda cosine: facing(cosine, blend))
    eta = max(1 - blend, 1e-5)
    reader.asked = True
    return reader.by_angle(lambda cosine: fresnel(cosine, eta if reader.view.back else 1 / eta))


def node_object_info(reader: Reader, node: Any, socket: Any) -> Value | None:
    """Colour and alpha: what all objects have that show the material, or their mean."""
    colors = reader.objects() if socket.name in {"Color", "Alpha"} else np.zeros((0, 4))
    if not len(colors):
        return None
    found = colors[:, :3] if socket.name == "Color" else np.repeat(colors[:, 3:], 3, axis=1)
    if (found != found[0]).any():
        return reader.average(node, found.mean(axis=0))
    return Value(tuple(float(v) for v in found[0]))  # type: ignore[arg-type]


def node_vertex_color(reader: Reader, node: Any, socket: Any) -> Value:
    return reader.attribute(node.layer_name) if socket.name == "Color" else reader.average(node, 1.0)


def node_attribute(reader: Reader, node: Any, socket: Any) -> Value:
    if node.attribute_type == "GEOMETRY" and node.attribute_name and socket.name in {"Color", "Factor", "Fac"}:
        return reader.attribute(node.attribute_name)
    return reader.average(node, 1.0)


def node_tex_image(reader: Reader, node: Any, socket: Any) -> Value | None:
    if node.projection != "FLAT":
        reader.doubt(
            f"{node.projection.lower()} projection of image {node.image.name if node.image else ''!r} replaced by UVs"
        )
    uv_map, matrix = placement(reader, node.inputs["Vector"])
    alpha_read = node.outputs["Alpha"].is_linked
    source = reader.textures.image(node.image, not alpha_read)
    if not reader.textures.sources[source].exact:
        if reader.patterns:
            return None  # other pictures than the first may show anything
        reader.doubts += 1
    use = ImageUse(
        source, reader.textures.uv_map(uv_map), matrix, int(EXTENSIONS[node.extension]), node.interpolation == "Closest"
    )
    return Value((1.0, 1.0, 1.0), use, ALPHA if socket.name == "Alpha" else None)


def node_separate_color(reader: Reader, node: Any, socket: Any) -> Value | None:
    if getattr(node, "mode", "RGB") != "RGB":
        return None
    return _channel(reader, node.inputs[0], list(node.outputs).index(socket))


node_seprgb = node_sepxyz = node_separate_color


def _channel(reader: Reader, source: Any, k: int) -> Value:
    value = reader.value(source)
    if value.use is None:
        return grey(value.factor[k])
    return Value((value.factor[k],) * 3, value.use, k if value.channel is None else value.channel)


def node_combine_color(reader: Reader, node: Any, socket: Any) -> Value | None:
    if getattr(node, "mode", "RGB") != "RGB":
        return None
    return reader.map(
        lambda r, g, b: np.concatenate(np.broadcast_arrays(r[..., :1], g[..., :1], b[..., :1]), axis=2),
        *map(reader.value, node.inputs[:3]),
    )


node_combrgb = node_combxyz = node_combine_color


def node_rgbtobw(reader: Reader, node: Any, socket: Any) -> Value:
    return reader.convert(reader.value(node.inputs[0]), node.inputs[0], socket)


def _scaled(a: Value, b: Value) -> Value | None:
    """Product where at least one side is constant."""
    if b.use is None:
        a, b = b, a
    if a.use is not None:
        return None
    return Value(tuple(x * y for x, y in zip(a.factor, b.factor, strict=True)), b.use, b.channel)  # type: ignore[arg-type]


def node_math(reader: Reader, node: Any, socket: Any) -> Value | None:
    values = [reader.value(s) for s in node.inputs]
    if node.operation == "MULTIPLY" and not node.use_clamp:
        product = _scaled(values[0], values[1])
        if product is not None:
            return product
    function = MATH.get(node.operation)
    if function is None:
        return None
    values += [grey(0.0)] * (3 - len(values))
    return reader.map(
        lambda a, b, c: np.clip(function(a, b, c), 0, 1) if node.use_clamp else function(a, b, c), *values[:3]
    )


def node_vect_math(reader: Reader, node: Any, socket: Any) -> Value | None:
    function = MATH.get({"SCALE": "MULTIPLY"}.get(node.operation, node.operation))
    if function is None:
        return None
    a, b = reader.value(node.inputs[0]), reader.value(node.inputs[3] if node.operation == "SCALE" else node.inputs[1])
    return reader.map(function, a, b, grey(0.0))


def node_mix(reader: Reader, node: Any, socket: Any) -> Value | None:
    if node.data_type not in {"FLOAT", "RGBA", "VECTOR"} or (
        node.data_type == "VECTOR" and node.factor_mode != "UNIFORM"
    ):
        return None
    name = {"FLOAT": "Float", "RGBA": "Color", "VECTOR": "Vector"}[node.data_type]
    inputs = {s.identifier: s for s in node.inputs}
    blend = node.blend_type if node.data_type == "RGBA" else "MIX"
    clamp = node.clamp_result and node.data_type == "RGBA"
    return _blend(
        reader, blend, inputs["Factor_Float"], inputs[f"A_{name}"], inputs[f"B_{name}"], clamp, node.clamp_factor
    )


def node_mix_rgb(reader: Reader, node: Any, socket: Any) -> Value | None:
    return _blend(reader, node.blend_type, node.inputs[0], node.inputs[1], node.inputs[2], node.use_clamp, True)


def _blend(
    reader: Reader, blend: str, factor: Any, first: Any, second: Any, clamp: bool, clamp_factor: bool
) -> Value | None:
    t = reader.value(factor)
    if t.use is None and clamp_factor:
        t = grey(min(max(t.scalar, 0.0), 1.0))
    if t.use is None and t.scalar == 0.0 and not clamp:
        return reader.value(first)
    b = reader.value(second)
    if t.use is None and t.scalar == 1.0 and not clamp and blend == "MIX":
        return b
    a = reader.value(first)
    if blend == "MULTIPLY" and t.use is None and t.scalar == 1.0 and not clamp:
        product = _scaled(a, b)
        if product is not None:
            return product
    try:
        return reader.map(
            lambda x, y, s: np.clip(blend_colors(blend, x, y, s), 0, 1) if clamp else blend_colors(blend, x, y, s),
            a,
            b,
            t,
        )
    except NotImplementedError:
        return None


def node_invert(reader: Reader, node: Any, socket: Any) -> Value:
    return reader.map(lambda t, a: a + t * (1 - 2 * a), reader.value(node.inputs[0]), reader.value(node.inputs[1]))


def node_gamma(reader: Reader, node: Any, socket: Any) -> Value:
    return reader.map(
        lambda a, g: np.where(a > 0, np.maximum(a, 1e-30) ** g, a),
        reader.value(node.inputs[0]),
        reader.value(node.inputs[1]),
    )


def node_brightcontrast(reader: Reader, node: Any, socket: Any) -> Value:
    values = [reader.value(s) for s in node.inputs[:3]]
    return reader.map(lambda a, bright, contrast: np.maximum((1 + contrast) * a + bright - 0.5 * contrast, 0), *values)


def node_clamp(reader: Reader, node: Any, socket: Any) -> Value:
    return reader.map(np.clip, *[reader.value(s) for s in node.inputs[:3]])


def node_map_range(reader: Reader, node: Any, socket: Any) -> Value | None:
    if node.data_type != "FLOAT" or node.interpolation_type != "LINEAR":
        return None
    values = [reader.value(s) for s in node.inputs[:5]]

    def function(x: Array, a: Array, b: Array, c: Array, d: Array) -> Array:
        t = np.where(b != a, (x - a) / np.where(b != a, b - a, 1), 0)
        return c + (np.clip(t, 0, 1) if node.clamp else t) * (d - c)

    return reader.map(function, *values)


def node_valtorgb(reader: Reader, node: Any, socket: Any) -> Value:
    table = np.array([node.color_ramp.evaluate(k / 255) for k in range(256)], np.float32)
    if socket.name == "Alpha":
        table[:, :3] = table[:, 3:]
    grid = np.arange(256) / 255

    def ramp(x: Array) -> Array:
        return np.stack([np.interp(x[..., 0], grid, table[:, k]) for k in range(3)], axis=-1).astype(np.float32)

    return reader.map(ramp, reader.value(node.inputs[0]))


def node_curve_rgb(reader: Reader, node: Any, socket: Any) -> Value | None:
    mapping = node.mapping
    mapping.initialize()
    if node.inputs[0].is_linked or node.inputs[0].default_value != 1.0:
        return None
    grid = np.arange(257) / 256
    tables = [
        np.array([mapping.evaluate(mapping.curves[k], mapping.evaluate(mapping.curves[3], x)) for x in grid])
        for k in range(3)
    ]
    return reader.map(
        lambda a: np.stack([np.interp(a[..., k], grid, tables[k]) for k in range(3)], axis=-1),
        reader.value(node.inputs[1]),
    )


def node_hue_sat(reader: Reader, node: Any, socket: Any) -> Value | None:
    hue, saturation, value, factor = (
        reader.flat(reader.value(node.inputs[k])) for k in ("Hue", "Saturation", "Value", "Factor")
    )
    if any(v.use is not None for v in (hue, saturation, value, factor)):
        return None
    h, s, v, t = hue.scalar, saturation.scalar, value.scalar, factor.scalar
    return reader.map(lambda a: a + t * (hue_saturation(a, h, s, v) - a), reader.value(node.inputs["Color"]))
