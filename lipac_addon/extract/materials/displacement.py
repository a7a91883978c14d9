"""True displacement: how far a material moves a surface, by interval arithmetic, and the two shells between which the
surface then lies.

The tracer does not displace. In place of the surface it has the innermost and the outermost one that it can be, each of
which lets half of all rays pass: so whatever the displaced surface hides, shows or is hit by, paths meet.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ....core.arrays import F32
from ....core.scene.mesh import Mesh

Interval = tuple[float, float]
UNKNOWN: Interval = (-np.inf, np.inf)
UNIT = (0.0, 1.0)
# What the values of nodes lie within. Noise that is normalised is 0 to 1 but for rare peaks.
RANGES = {
    **dict.fromkeys(
        (
            "TEX_WAVE", "TEX_GRADIENT", "TEX_MAGIC", "TEX_CHECKER", "TEX_BRICK", "TEX_WHITE_NOISE", "RGBTOBW", "INVERT",
            "CLAMP"
        ),
        UNIT,
    ),
    **dict.fromkeys(("FRESNEL", "LAYER_WEIGHT", "AMBIENT_OCCLUSION", "LIGHT_PATH", "WIREFRAME"), UNIT),
}


@dataclass(frozen=True)
class Relief:
    """Within what a surface is moved along its normals, in metres of the object's space (infinite: not known); world:
    the material means the world's.

    slots: of the mesh, which are displaced; none: those of one material.
    """

    low: float
    high: float
    world: bool = False
    slots: tuple[bool, ...] = ()

    def joined(self, other: Relief | None) -> Relief:
        """What holds for both."""
        return (
            self
            if other is None
            else replace(
                self, low=min(self.low, other.low), high=max(self.high, other.high), world=self.world or other.world
            )
        )

    def scaled(self, factor: float) -> Relief:
        """Larger by a factor, where that is more than 1."""
        return replace(self, low=min(self.low, self.low * factor), high=max(self.high, self.high * factor))


def relief_of(tree: Any) -> Relief | None:
    """The relief by an inlined shader tree; None where it moves nothing."""
    output = tree.get_output_node("CYCLES")
    if output is None or not output.inputs["Displacement"].is_linked:
        return None
    node = output.inputs["Displacement"].links[0].from_node
    world = getattr(node, "space", "OBJECT") == "WORLD"
    if node.type == "DISPLACEMENT":
        low, high = _product(
            _sum(_range(node.inputs["Height"]), _negative(_range(node.inputs["Midlevel"]))),
            _range(node.inputs["Scale"]),
        )
    elif node.type == "VECTOR_DISPLACEMENT":
        offset = _product(
            _sum(_range(node.inputs["Vector"]), _negative(_range(node.inputs["Midlevel"]))),
            _range(node.inputs["Scale"]),
        )
        high = float(np.sqrt(3) * np.abs(offset).max())  # in any direction
        low = -high
    else:
        low, high = UNKNOWN
    return None if low == high == 0 else Relief(low, high, world)


def _sum(a: Interval, b: Interval) -> Interval:
    return a[0] + b[0], a[1] + b[1]


def _negative(a: Interval) -> Interval:
    return -a[1], -a[0]


def _product(a: Interval, b: Interval) -> Interval:
    with np.errstate(invalid="ignore"):
        # 0 x inf is 0 here: an end that is 0 stays so whatever it is multiplied by
        ends = np.nan_to_num(np.outer(a, b), nan=0.0, posinf=np.inf, neginf=-np.inf)
    return float(ends.min()), float(ends.max())


def _hull(*parts: Interval) -> Interval:
    return min(low for low, _ in parts), max(high for _, high in parts)


def _range(socket: Any) -> Interval:
    """Within what the value of a socket lies; of a vector or colour, each of its components."""
    if socket.is_linked:
        link = socket.links[0]
        return _output(link.from_node, link.from_socket)
    value = socket.default_value
    numbers = [float(value)] if isinstance(value, (int, float)) else [float(v) for v in value[:3]]
    return min(numbers), max(numbers)


def _output(node: Any, socket: Any) -> Interval:
    method: Callable[[Any], Interval] | None = _NODES.get(node.type)
    if socket.name == "Alpha":
        return UNIT
    if method is not None:
        return method(node)
    if node.type in {"RGB", "VALUE"}:
        value = socket.default_value
        numbers = [float(value)] if isinstance(value, (int, float)) else [float(v) for v in value[:3]]
        return min(numbers), max(numbers)
    return RANGES.get(node.type, UNKNOWN)


def _noise(node: Any) -> Interval:
    return UNIT if node.normalize and node.noise_type == "FBM" else UNKNOWN


def _image(node: Any) -> Interval:
    image = node.image
    if image is None or not image.is_float:
        return UNIT
    pixels = np.empty(len(image.pixels), np.float32)
    image.pixels.foreach_get(pixels)
    return (float(np.nanmin(pixels)), float(np.nanmax(pixels))) if len(pixels) else UNIT


def _math(node: Any) -> Interval:
    if node.use_clamp:
        return UNIT
    a, *more = [_range(socket) for socket in node.inputs]
    b = more[0] if more else (0.0, 0.0)
    operations: dict[str, Callable[[], Interval]] = {
        "ADD": lambda: _sum(a, b),
        "SUBTRACT": lambda: _sum(a, _negative(b)),
        "MULTIPLY": lambda: _product(a, b),
        "MULTIPLY_ADD": lambda: _sum(_product(a, b), more[1]),
        "DIVIDE": lambda: _product(a, (1 / b[1], 1 / b[0])) if b[0] > 0 or b[1] < 0 else UNKNOWN,
        "MINIMUM": lambda: (min(a[0], b[0]), min(a[1], b[1])),
        "MAXIMUM": lambda: (max(a[0], b[0]), max(a[1], b[1])),
        "ABSOLUTE": lambda: (max(a[0], -a[1], 0.0), max(-a[0], a[1])),
        "POWER": lambda: UNIT if a[0] >= 0 and a[1] <= 1 and b[0] >= 0 else UNKNOWN,
        **{name: lambda: UNIT for name in ("LESS_THAN", "GREATER_THAN", "COMPARE", "FRACT")},
        **{name: lambda: (-1.0, 1.0) for name in ("SINE", "COSINE", "SIGN")},
    }
    return operations.get(node.operation, lambda: UNKNOWN)()


def _vector_math(node: Any) -> Interval:
    a, b = _range(node.inputs[0]), _range(node.inputs[3] if node.operation == "SCALE" else node.inputs[1])
    operations: dict[str, Callable[[], Interval]] = {
        "ADD": lambda: _sum(a, b),
        "SUBTRACT": lambda: _sum(a, _negative(b)),
        "MULTIPLY": lambda: _product(a, b),
        "SCALE": lambda: _product(a, b),
        "NORMALIZE": lambda: (-1.0, 1.0),
    }
    return operations.get(node.operation, lambda: UNKNOWN)()


def _map_range(node: Any) -> Interval:
    if node.data_type != "FLOAT":
        return UNKNOWN
    sockets = {socket.identifier: socket for socket in node.inputs}
    ends = _hull(_range(sockets["To Min"]), _range(sockets["To Max"]))
    if node.clamp or node.interpolation_type in {"SMOOTHSTEP", "SMOOTHERSTEP"}:
        return ends
    value, start, end = (_range(sockets[name]) for name in ("Value", "From Min", "From Max"))
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
    a, b = _range(sockets[f"A_{name}"]), _range(sockets[f"B_{name}"])
    return _blend(node.blend_type if node.data_type == "RGBA" else "MIX", a, b)


def _blend(kind: str, a: Interval, b: Interval) -> Interval:
    """Of any share of the second."""
    results = {
        "MIX": b,
        "ADD": _sum(a, b),
        "SUBTRACT": _sum(a, _negative(b)),
        "MULTIPLY": _product(a, b),
        "LIGHTEN": _hull(a, b),
        "DARKEN": _hull(a, b),
    }
    return _hull(a, results[kind]) if kind in results else UNKNOWN


def _ramp(node: Any) -> Interval:
    table = np.array([node.color_ramp.evaluate(k / 255)[:3] for k in range(256)])
    return float(table.min()), float(table.max())


_NODES: dict[str, Callable[[Any], Interval]] = {
    "TEX_NOISE": _noise,
    "TEX_VORONOI": lambda node: UNIT if node.normalize else UNKNOWN,
    "TEX_IMAGE": _image,
    "MATH": _math,
    "VECT_MATH": _vector_math,
    "MAP_RANGE": _map_range,
    "CLAMP": lambda node: _hull(_range(node.inputs["Min"]), _range(node.inputs["Max"])),
    "VALTORGB": _ramp,
    "MIX": _mix,
    "MIX_RGB": lambda node: _blend(node.blend_type, _range(node.inputs[1]), _range(node.inputs[2])),
    "RGBTOBW": lambda node: _range(node.inputs[0]),
    "SEPARATE_COLOR": lambda node: _range(node.inputs[0]) if node.mode == "RGB" else UNKNOWN,
    "SEPXYZ": lambda node: _range(node.inputs[0]),
    "COMBXYZ": lambda node: _hull(*(_range(socket) for socket in node.inputs)),
    "COMBINE_COLOR": lambda node: _hull(*(_range(socket) for socket in node.inputs)) if node.mode == "RGB" else UNKNOWN,
}


def shells(mesh: Mesh, normals: F32, relief: Relief) -> Mesh:
    """A mesh whose displaced triangles are there twice: moved as far in and out along the normals of the vertices, (V,
    3) float32, as they may be."""
    slots: NDArray[Any] = np.zeros(len(mesh.triangles), np.uint16) if mesh.slots is None else mesh.slots
    displaced = np.array(relief.slots, bool)[np.minimum(slots, len(relief.slots) - 1)]
    count = len(mesh.positions)
    positions = np.concatenate(
        [mesh.positions, *(mesh.positions + normals * np.float32(offset) for offset in (relief.low, relief.high))]
    )
    rows = np.concatenate([np.flatnonzero(~displaced), *2 * (np.flatnonzero(displaced),)])
    moved = np.concatenate(
        [
            np.zeros(int((~displaced).sum())),
            np.full(int(displaced.sum()), count),
            np.full(int(displaced.sum()), 2 * count),
        ]
    )
    shading = mesh.normals
    if shading is not None:
        shading = np.concatenate(3 * (shading,)) if shading.ndim == 2 else shading[rows]
    return Mesh(
        positions.astype(np.float32),
        mesh.triangles[rows] + moved.astype(np.uint32)[:, None],
        shading,
        None if mesh.uvs is None else np.ascontiguousarray(mesh.uvs[:, rows]),
        None if mesh.slots is None else mesh.slots[rows],
    )
