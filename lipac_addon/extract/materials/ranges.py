"""Within what the values of shader sockets lie, by interval arithmetic over an inlined tree; how much volumes emit, at
most."""

from __future__ import annotations

from collections.abc import Callable
from contextvars import ContextVar, copy_context
from pathlib import Path
from typing import Any

import numpy as np

from ... import attributes

Interval = tuple[float, float]
UNKNOWN: Interval = (-np.inf, np.inf)
UNIT, SIGNED = (0.0, 1.0), (-1.0, 1.0)
# What the values of nodes lie within. Noise that is normalised is 0 to 1 but for rare peaks.
RANGES = {
    **dict.fromkeys(
        ("TEX_WAVE", "TEX_GRADIENT", "TEX_MAGIC", "TEX_WHITE_NOISE", "CLAMP"),
        UNIT,
    ),
    **dict.fromkeys(("FRESNEL", "LAYER_WEIGHT", "AMBIENT_OCCLUSION", "WIREFRAME"), UNIT),
}
# of outputs whose range is their own
OUTPUTS = {
    **{("OBJECT_INFO", name): UNIT for name in ("Random", "Alpha")},
    **{(kind, "Random"): UNIT for kind in ("PARTICLE_INFO", "HAIR_INFO", "CURVES_INFO", "POINT_INFO")},
    **{("HAIR_INFO", name): UNIT for name in ("Is Strand", "Intercept")},
    **{("NEW_GEOMETRY", name): UNIT for name in ("Backfacing", "Pointiness", "Random Per Island", "Parametric")},
    **{("NEW_GEOMETRY", name): SIGNED for name in ("Normal", "True Normal", "Tangent", "Incoming")},
    **{("TEX_COORD", name): UNIT for name in ("Generated", "Window")},
    **{("TEX_COORD", name): SIGNED for name in ("Normal", "Reflection")},
    **{(kind, name): UNIT for kind in ("TEX_CHECKER", "TEX_BRICK") for name in ("Factor", "Fac")},
    ("TEX_VORONOI", "Color"): UNIT,
    **{("TEX_VORONOI", name): UNKNOWN for name in ("Position", "W", "Radius")},
}
# nodes that ask what is around, and the socket that says within how many metres
AROUND = {"AMBIENT_OCCLUSION": "Distance", "MATERIAL_RAYCAST": "Length"}
FARTHEST = 1e30
BRIGHT = {".exr", ".hdr", ".tif", ".tiff", ".dpx", ".cin"}  # files whose pictures may be brighter than white
MOST = 10.0, 100.0  # what a colour and what a number is taken to be at most, where nothing says what bounds it
_LIT: ContextVar[bool] = ContextVar("whether what emits is asked for, which may be all that it may be", default=False)
_ASSUMED: ContextVar[bool] = ContextVar("whether that is assumed", default=False)
GROWTH = {"Quadratic": 0, "Linear": 1, "Constant": 2}  # of outputs of Light Falloff, against that of light
FAR = 100.0  # metres, taken to be the most from which something is lit that does not say how bright it is there
_FAR: ContextVar[float] = ContextVar("from how far something is lit, in metres", default=FAR)


def most_of(socket: Any, far: float = FAR) -> float:
    """The most that the value of a socket of emission may be, seen from within far metres."""
    return copy_context().run(_most_of, socket, far)


def _most_of(socket: Any, far: float) -> float:
    _FAR.set(far)
    if not is_bounded(socket):
        _ASSUMED.set(True)
    return _end(socket)


def is_bounded(socket: Any) -> bool:
    """Whether something says what the value of a socket of emission is at most."""
    return bool(np.isfinite(copy_context().run(_end, socket)))


def _end(socket: Any) -> float:
    _LIT.set(True)
    return range_of(socket)[1]


def total(a: Interval, b: Interval) -> Interval:
    return a[0] + b[0], a[1] + b[1]


def negative(a: Interval) -> Interval:
    return -a[1], -a[0]


def product(a: Interval, b: Interval) -> Interval:
    with np.errstate(invalid="ignore"):
        # 0 x inf is 0 here: an end that is 0 stays so whatever it is multiplied by
        ends = np.nan_to_num(np.outer(a, b), nan=0.0, posinf=np.inf, neginf=-np.inf)
    return float(ends.min()), float(ends.max())


def _hull(*parts: Interval) -> Interval:
    return min(low for low, _ in parts), max(high for _, high in parts)


def range_of(socket: Any) -> Interval:
    """Within what the value of a socket lies; of a vector or colour, each of its components."""
    if socket.is_linked:
        link = socket.links[0]
        return output_range(link.from_node, link.from_socket)
    value = socket.default_value
    numbers = [float(value)] if isinstance(value, (int, float)) else [float(v) for v in value[:3]]
    return min(numbers), max(numbers)


def output_range(node: Any, socket: Any) -> Interval:
    """Within what an output of a node lies, as `range_of`."""
    low, high = _output_range(node, socket)
    if _ASSUMED.get():
        most = MOST[socket.type == "VALUE"]
        return low if np.isfinite(low) else -most, high if np.isfinite(high) else most
    return low, high


def _output_range(node: Any, socket: Any) -> Interval:
    method: Callable[[Any], Interval] | None = _NODES.get(node.type)
    if (node.type, socket.name) in OUTPUTS:
        return OUTPUTS[node.type, socket.name]
    if socket.name.startswith("Is "):  # of Light Path
        return UNIT
    if socket.name == "Alpha":
        return UNIT
    if node.type == "LIGHT_FALLOFF":
        return product(range_of(node.inputs["Strength"]), (0.0, _FAR.get() ** GROWTH[socket.name]))
    if (node.type, socket.name) == ("OBJECT_INFO", "Color"):
        return attributes.bounds_of("color") or UNIT
    if method is not None:
        return method(node)
    if node.type in {"RGB", "VALUE"}:
        value = socket.default_value
        numbers = [float(value)] if isinstance(value, (int, float)) else [float(v) for v in value[:3]]
        return min(numbers), max(numbers)
    return RANGES.get(node.type, UNKNOWN)


def _attribute(node: Any) -> Interval:
    asked = node.attribute_type in {"OBJECT", "INSTANCER"}
    return (attributes.bounds_of(node.attribute_name) if asked else None) or UNKNOWN


def _noise(node: Any) -> Interval:
    return UNIT if node.normalize and node.noise_type == "FBM" else UNKNOWN


def _voronoi(node: Any) -> Interval:
    """Distances. By none is a cell's nearest point farther than the cell is across: its own lies within it; the second
    is within as much again. Octaves have weights of 1 at most, for roughness is a share."""
    if node.normalize:
        return UNIT
    size = float(node.voronoi_dimensions[0])
    power = {"EUCLIDEAN": 2.0, "MANHATTAN": 1.0, "CHEBYCHEV": np.inf}.get(node.distance)
    if power is None or node.feature not in {"F1", "F2", "DISTANCE_TO_EDGE"}:
        return UNKNOWN
    across = size ** (1 / (2.0 if node.feature == "DISTANCE_TO_EDGE" else power))
    octaves = 1 + max(0.0, range_of(node.inputs["Detail"])[1])
    return 0.0, (2 if node.feature == "F2" else 1) * octaves * across


def _image(node: Any) -> Interval:
    image = node.image
    # of others the first picture can be read at most, of files with layers none
    if image is not None and (image.source not in {"FILE", "GENERATED"} or 0 in image.size[:]):
        bright = image.is_float or Path(image.filepath).suffix.lower() in BRIGHT
        return UNIT if _LIT.get() and not bright else UNKNOWN
    if image is None or not image.is_float:
        return UNIT
    pixels = np.empty(len(image.pixels), np.float32)
    image.pixels.foreach_get(pixels)
    return (float(np.nanmin(pixels)), float(np.nanmax(pixels))) if len(pixels) else UNIT


def _math(node: Any) -> Interval:
    if node.use_clamp:
        return UNIT
    a, *more = [range_of(socket) for socket in node.inputs]
    b = more[0] if more else (0.0, 0.0)
    operations: dict[str, Callable[[], Interval]] = {
        "ADD": lambda: total(a, b),
        "SUBTRACT": lambda: total(a, negative(b)),
        "MULTIPLY": lambda: product(a, b),
        "MULTIPLY_ADD": lambda: total(product(a, b), more[1]),
        "DIVIDE": lambda: product(a, (1 / b[1], 1 / b[0])) if b[0] > 0 or b[1] < 0 else UNKNOWN,
        "MINIMUM": lambda: (min(a[0], b[0]), min(a[1], b[1])),
        "MAXIMUM": lambda: (max(a[0], b[0]), max(a[1], b[1])),
        "ABSOLUTE": lambda: (max(a[0], -a[1], 0.0), max(-a[0], a[1])),
        "POWER": lambda: UNIT if a[0] >= 0 and a[1] <= 1 and b[0] >= 0 else UNKNOWN,
        **{name: lambda: UNIT for name in ("LESS_THAN", "GREATER_THAN", "COMPARE", "FRACT")},
        **{name: lambda: (-1.0, 1.0) for name in ("SINE", "COSINE", "SIGN")},
    }
    return operations.get(node.operation, lambda: UNKNOWN)()


def _vector_math(node: Any) -> Interval:
    a, b = range_of(node.inputs[0]), range_of(node.inputs[3] if node.operation == "SCALE" else node.inputs[1])
    operations: dict[str, Callable[[], Interval]] = {
        "ADD": lambda: total(a, b),
        "SUBTRACT": lambda: total(a, negative(b)),
        "MULTIPLY": lambda: product(a, b),
        "SCALE": lambda: product(a, b),
        "NORMALIZE": lambda: (-1.0, 1.0),
    }
    return operations.get(node.operation, lambda: UNKNOWN)()


def _map_range(node: Any) -> Interval:
    if node.data_type != "FLOAT":
        return UNKNOWN
    sockets = {socket.identifier: socket for socket in node.inputs}
    ends = _hull(range_of(sockets["To Min"]), range_of(sockets["To Max"]))
    if node.clamp or node.interpolation_type in {"SMOOTHSTEP", "SMOOTHERSTEP"}:
        return ends
    value, start, end = (range_of(sockets[name]) for name in ("Value", "From Min", "From Max"))
    inside = (
        start[0] == start[1]
        and end[0] == end[1]
        and min(start[0], end[0]) <= value[0]
        and value[1] <= max(start[0], end[0])
    )
    return ends if inside else UNKNOWN


def _mix(node: Any) -> Interval:
    name = {"FLOAT": "Float", "RGBA": "Color", "VECTOR": "Vector"}.get(node.data_type)
    if name is None or not node.clamp_factor:
        return UNKNOWN
    sockets = {socket.identifier: socket for socket in node.inputs}
    a, b = range_of(sockets[f"A_{name}"]), range_of(sockets[f"B_{name}"])
    return _blend(node.blend_type if node.data_type == "RGBA" else "MIX", a, b)


def _blend(kind: str, a: Interval, b: Interval) -> Interval:
    """Of any share of the second."""
    results = {
        "MIX": b,
        "ADD": total(a, b),
        "SUBTRACT": total(a, negative(b)),
        "MULTIPLY": product(a, b),
        "LIGHTEN": _hull(a, b),
        "DARKEN": _hull(a, b),
    }
    return _hull(a, results[kind]) if kind in results else UNKNOWN


def _ramp(node: Any) -> Interval:
    table = np.array([node.color_ramp.evaluate(k / 255)[:3] for k in range(256)])
    return float(table.min()), float(table.max())


def _combined(node: Any) -> Interval:
    if node.mode == "RGB":
        return _hull(*(range_of(socket) for socket in node.inputs))
    return _hull((0.0, 0.0), range_of(node.inputs[2])) if node.mode == "HSV" else UNKNOWN  # no channel is above V


def _colors(node: Any) -> Interval:
    """Tiles: of any of the colours of a node."""
    return _hull(*(range_of(socket) for socket in node.inputs if socket.type == "RGBA"))


def _invert(node: Any) -> Interval:
    a = range_of(node.inputs["Color"])
    return _hull(a, total((1.0, 1.0), negative(a)))


def _hue_saturation(node: Any) -> Interval:
    """No channel of a colour of which hue and saturation differ is above the largest, or below 0."""
    a = range_of(node.inputs["Color"])
    return _hull(a, (0.0, 0.0), product(a, range_of(node.inputs["Value"])))


def _contrast(node: Any) -> Interval:
    color, bright, contrast = (range_of(socket) for socket in node.inputs[:3])
    out = total(total(product(total((1.0, 1.0), contrast), color), bright), product(contrast, (-0.5, -0.5)))
    return max(out[0], 0.0), max(out[1], 0.0)


def _gamma(node: Any) -> Interval:
    (low, high), powers = range_of(node.inputs["Color"]), range_of(node.inputs["Gamma"])
    if low < 0 or powers[0] < 0 or not np.isfinite((high, *powers)).all():
        return UNKNOWN
    ends = [x**y for x in (low, high) for y in powers]
    return min(ends), max(ends)


_NODES: dict[str, Callable[[Any], Interval]] = {
    "ATTRIBUTE": _attribute,
    "TEX_CHECKER": _colors,
    "TEX_BRICK": _colors,
    "INVERT": _invert,
    "HUE_SAT": _hue_saturation,
    "BRIGHTCONTRAST": _contrast,
    "GAMMA": _gamma,
    "BLACKBODY": lambda _: (-0.5, 5.5),  # of 800 K and less; the luminance of all is 1
    "TEX_ENVIRONMENT": _image,
    "TEX_NOISE": _noise,
    "TEX_VORONOI": _voronoi,
    "TEX_IMAGE": _image,
    "MATH": _math,
    "VECT_MATH": _vector_math,
    "MAP_RANGE": _map_range,
    "CLAMP": lambda node: _hull(range_of(node.inputs["Min"]), range_of(node.inputs["Max"])),
    "VALTORGB": _ramp,
    "MIX": _mix,
    "MIX_RGB": lambda node: _blend(node.blend_type, range_of(node.inputs[1]), range_of(node.inputs[2])),
    "RGBTOBW": lambda node: range_of(node.inputs[0]),
    "SEPARATE_COLOR": lambda node: range_of(node.inputs[0]) if node.mode == "RGB" else UNKNOWN,
    "SEPXYZ": lambda node: range_of(node.inputs[0]),
    "COMBXYZ": lambda node: _hull(*(range_of(socket) for socket in node.inputs)),
    "COMBINE_COLOR": _combined,
}


def glow_of(socket: Any, far: float = FAR) -> float:
    """The most that what is linked to the Surface socket of a lamp's inlined tree emits, or a metre of what is linked
    to a Volume socket, in any channel, W/m2/sr; that of a black body, or by attributes of a grid, may be anything.
    far: as of `most_of`."""
    if not socket.is_linked:
        return 0.0
    node = socket.links[0].from_node
    if node.type in {"ADD_SHADER", "MIX_SHADER"}:
        both = [glow_of(one, far) for one in node.inputs if one.type == "SHADER"]
        return sum(both) if node.type == "ADD_SHADER" else max(both)
    if node.type == "EMISSION":
        return max(most_of(node.inputs["Color"], far), 0.0) * max(most_of(node.inputs["Strength"], far), 0.0)
    if node.type == "PRINCIPLED_VOLUME":
        hot = most_of(node.inputs["Blackbody Intensity"]) > 0
        return _at_most(node.inputs["Emission Color"], node.inputs["Emission Strength"]) + (MOST[0] if hot else 0.0)
    return _at_most(node.inputs["Emission Coefficients"]) if "Emission Coefficients" in node.inputs else 0.0


def scatters(socket: Any) -> bool:
    """Whether what is linked to a Volume socket of an inlined tree may scatter light."""
    node = socket.links[0].from_node if socket.is_linked else None
    if node is not None and node.type in {"ADD_SHADER", "MIX_SHADER"}:
        return any(scatters(one) for one in node.inputs if one.type == "SHADER")
    return node is not None and node.type not in {"VOLUME_ABSORPTION", "EMISSION"}


def reach_of(tree: Any) -> float:
    """Within how many metres what is around a surface changes what it looks like, by nodes of an inlined tree that look
    around; 0: none does."""
    lengths = [
        range_of(node.inputs[AROUND[node.type]])[1]
        for node in tree.nodes
        if node.type in AROUND and not node.only_local
    ]
    # Ambient Occlusion of distance 0 has the world's
    return max((length if 0 < length < FARTHEST else FARTHEST for length in lengths), default=0.0)


def _at_most(*sockets: Any) -> float:
    out = 1.0
    for socket in sockets:
        out *= max(most_of(socket), 0.0)
    return out
