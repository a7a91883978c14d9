"""Light objects -> LIGHT records."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.arrays import F64, Records
from ...core.scene.model import LIGHT, AreaShape, LightKind
from ...core.scene.placing import usable_transforms
from .materials.converter import UNBOUNDED
from .materials.ranges import GROWTH, glow_of, is_bounded, most_of

KINDS = {"POINT": LightKind.POINT, "SUN": LightKind.SUN, "SPOT": LightKind.SPOT, "AREA": LightKind.AREA}


def _node_strength(light: Any, report: Callable[[str], None], most: bool) -> tuple[np.ndarray[Any, Any], bool, int]:
    """(3,) factor by the light's node tree: colour times strength of its Emission node, and whether that is but the
    most that it may be, for they are not constant; of a Light Falloff, its strength, and the power of the distance by
    which it grows.

    most: as of `MaterialTable`; else 1 stands for what is not constant.
    """
    if light.node_tree is None:
        return np.ones(3), False, 0
    inlined = light.inline_shader_nodes()
    output = inlined.node_tree.get_output_node("CYCLES")
    if output is None or not output.inputs["Surface"].is_linked:
        return np.ones(3) if output is None else np.zeros(3), False, 0
    node = output.inputs["Surface"].links[0].from_node
    falloffs = [n for n in inlined.node_tree.nodes if most and n.type == "LIGHT_FALLOFF"]
    growth = max((GROWTH[out.name] for n in falloffs for out in n.outputs if out.is_linked), default=0)
    if node.type != "EMISSION":
        report(f"light {light.name}: node {node.name!r} is not rendered")
        return np.ones(3) * (glow_of(output.inputs["Surface"], 1.0) if most else 1.0), True, growth
    factor, unsure = np.ones(3), False
    for name in ("Color", "Strength"):
        socket = node.inputs[name]
        if socket.is_linked:
            report(f"light {light.name}: {name.lower()} by nodes is not rendered")
            unsure = True
            source = socket.links[0].from_node
            if most:
                factor = factor * max(most_of(socket, 1.0), 0.0)
                if not is_bounded(socket):
                    report(f"light {light.name}: {UNBOUNDED}")
            elif source.type == "LIGHT_FALLOFF" and not source.inputs["Strength"].is_linked:
                factor = factor * source.inputs["Strength"].default_value
        else:
            value = socket.default_value
            factor = factor * (np.array(value[:3]) if name == "Color" else value)
    return factor, unsure, growth


@dataclass(frozen=True)
class LampData:
    """A light object's data. record: of LIGHT as bytes, without what depends on the place, one or more that shine
    together; lines: what is rendered differently; growth: the power of the distance by which it is brighter than it
    would be."""

    name: str
    record: bytes
    lines: tuple[str, ...]
    growth: int = 0


@dataclass
class Lamp:
    """Where a lamp is placed, (n, 3, 4) float64 object to world minus `Scene.origin`, and which rays see it: one for
    all, or per placement."""

    data: LampData
    visible: int | NDArray[Any]
    transform: F64


def read_lamp(item: Any, most: bool = True) -> LampData | None:
    """The data of a light object; None for a portal, which guides Cycles' sampling and is no light.

    Where light linking says what it lights, or what blocks it, nobody knows how much of its light arrives: all is lit,
    and where it says what blocks it, twice, by light that passes everything and by light that does not. So both what
    it lights and what shades it count, as much as they may, and its light is none that changes are relative to. most:
    as of `MaterialTable`; else half of such light passes everything.
    """
    light = item.data
    if light.type == "AREA" and light.cycles.is_portal:
        return None
    lines: list[str] = []
    record, growth = _template(light, lines.append, most)
    if item.light_linking.receiver_collection is not None:
        lines.append(f"light {light.name}: light linking not rendered: everything is lit")
        record["unsure"] |= 1
    if item.light_linking.blocker_collection is not None and light.use_shadow:
        lines.append(f"light {light.name}: shadow linking not rendered: it is there twice, once without shadows")
        record = np.repeat(record, 2)
        record["power"] *= 1.0 if most else 0.5
        record["cast_shadow"], record["unsure"] = (0, 1), record["unsure"] | 1
    if not most:
        record["unsure"] = 0
    return LampData(light.name, record.tobytes(), tuple(lines), growth)


def _template(light: Any, report: Callable[[str], None], most: bool) -> tuple[Records, int]:
    """What does not depend on the transform, as a record of shape (1,), and the growth as of `LampData`."""
    r = np.zeros(1, LIGHT)
    r["kind"] = KINDS[light.type]
    power = np.array(light.color, np.float64) * light.energy * 2.0**light.exposure
    if light.use_temperature:
        power *= np.array(light.temperature_color)[:3]
    strength, r["unsure"], growth = _node_strength(light, report, most)
    r["power"] = power * strength
    if most and (r["power"] < 0).any():
        r["power"] = np.abs(r["power"])
        report(f"light {light.name}: that it takes light away is not rendered: it gives as much")
        r["unsure"] = 2
    r["normalize"] = light.normalize
    r["cast_shadow"] = light.use_shadow
    r["use_mis"], r["max_bounces"] = light.cycles.use_multiple_importance_sampling, light.cycles.max_bounces
    r["spread"] = np.pi
    if light.type in {"POINT", "SPOT"}:
        r["radius"], r["soft_falloff"] = light.shadow_soft_size, light.use_soft_falloff
    if light.type == "SPOT":
        r["spot_size"], r["spot_blend"], r["size"] = light.spot_size, light.spot_blend, 1.0
    if light.type == "SUN":
        r["angle"] = light.angle
    if light.type == "AREA":
        r["shape"] = AreaShape.ELLIPSE if light.shape in {"DISK", "ELLIPSE"} else AreaShape.RECTANGLE
        r["size"] = light.size, light.size_y if light.shape in {"RECTANGLE", "ELLIPSE"} else light.size
        r["spread"] = light.spread
    return r, 0 if light.type == "SUN" else growth


def place_lamps(
    lamps: Sequence[Lamp], report: Callable[[str], object], warn: Callable[[str], object], box: F64
) -> Records:
    """(L,) of LIGHT for all placed lights. Axes are normalised; the scale of the object goes into the size of area
    lights and the cones of spots, as in Cycles. Those that fall off by less than light does are as bright as they are
    at the farthest corner of box, (2, 3) of all that there is, in the coordinates of the lamps."""
    parts = []
    for lamp in lamps:
        for line in lamp.data.lines:
            report(line)
        transform = lamp.transform
        good = usable_transforms(transform)
        if not good.all():
            warn(f"{int((~good).sum())} of light {lamp.data.name!r} left out: the transform is singular or not finite")
            transform = transform[good]
        record = np.frombuffer(lamp.data.record, LIGHT)
        records = np.repeat(record, len(transform))
        transform = np.tile(transform, (len(record), 1, 1))
        lengths = np.linalg.norm(transform[:, :, :3], axis=1)
        for k, axis in enumerate(("axis_x", "axis_y", "axis_z")):
            records[axis] = transform[:, :, k] / lengths[:, k : k + 1]
        records["position"] = transform[:, :, 3]
        if lamp.data.growth:
            reach = np.linalg.norm(np.abs(transform[:, None, :, 3] - box).max(axis=1), axis=1)
            records["power"] *= np.maximum(reach, 1.0)[:, None] ** lamp.data.growth
        spot = records["kind"] == LightKind.SPOT
        records["size"] *= lengths[:, :2] / np.where(spot[:, None], lengths[:, 2:], 1.0)
        records["visibility"] = (
            lamp.visible if isinstance(lamp.visible, int) else np.tile(np.asarray(lamp.visible)[good], len(record))
        )
        parts.append(records)
    return np.concatenate(parts) if parts else np.zeros(0, LIGHT)
