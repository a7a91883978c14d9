"""Light objects -> LIGHT records."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ...core.placing import usable_transforms
from ...core.scene import LIGHT, AreaShape, LightKind, Records
from .instances import Lamp

KINDS = {"POINT": LightKind.POINT, "SUN": LightKind.SUN, "SPOT": LightKind.SPOT, "AREA": LightKind.AREA}


def _node_strength(light: Any, report: Callable[[str], None]) -> np.ndarray[Any, Any]:
    """(3,) factor by the light's node tree: colour times strength of its Emission node where these are constant."""
    if light.node_tree is None:
        return np.ones(3)
    inlined = light.inline_shader_nodes()
    output = inlined.node_tree.get_output_node("CYCLES")
    if output is None or not output.inputs["Surface"].is_linked:
        return np.ones(3) if output is None else np.zeros(3)
    node = output.inputs["Surface"].links[0].from_node
    if node.type != "EMISSION":
        report(f"light {light.name}: node {node.name!r} is not rendered")
        return np.ones(3)
    factor = np.ones(3)
    for name in ("Color", "Strength"):
        socket = node.inputs[name]
        if socket.is_linked:
            report(f"light {light.name}: {name.lower()} by nodes is not rendered")
        else:
            value = socket.default_value
            factor = factor * (np.array(value[:3]) if name == "Color" else value)
    return factor


def _template(light: Any, report: Callable[[str], None]) -> Records:
    """What does not depend on the transform, as a record of shape (1,)."""
    r = np.zeros(1, LIGHT)
    r["kind"] = KINDS[light.type]
    power = np.array(light.color, np.float64) * light.energy * 2.0**light.exposure
    if light.use_temperature:
        power *= np.array(light.temperature_color)[:3]
    r["power"] = power * _node_strength(light, report)
    r["normalize"] = light.normalize
    r["cast_shadow"] = light.use_shadow
    r["use_mis"], r["max_bounces"] = light.cycles.use_multiple_importance_sampling, light.cycles.max_bounces
    r["spread"] = np.pi
    if light.type in {"POINT", "SPOT"}:
        r["radius"], r["soft_falloff"] = light.shadow_soft_size, light.use_soft_falloff
    if light.type == "SPOT":
        r["spot_size"], r["spot_blend"] = light.spot_size, light.spot_blend
    if light.type == "SUN":
        r["angle"] = light.angle
    if light.type == "AREA":
        r["shape"] = AreaShape.ELLIPSE if light.shape in {"DISK", "ELLIPSE"} else AreaShape.RECTANGLE
        r["size"] = light.size, light.size_y if light.shape in {"RECTANGLE", "ELLIPSE"} else light.size
        r["spread"] = light.spread
    return r


def extract_lights(lamps: Sequence[Lamp], report: Callable[[str], None], warn: Callable[[str], None]) -> Records:
    """(L,) of LIGHT for all placed lights. Axes are normalised; the scale of the object goes into the size of area lights, as in Cycles."""
    parts = []
    for lamp in lamps:
        light = lamp.data
        if light.type == "AREA" and light.cycles.is_portal:
            continue  # guides Cycles' sampling, is no light
        transform = lamp.transform
        good = usable_transforms(transform)
        if not good.all():
            warn(f"{int((~good).sum())} of light {lamp.name!r} left out: the transform is singular or not finite")
            transform = transform[good]
        records = np.repeat(_template(light, report), len(transform))
        lengths = np.linalg.norm(transform[:, :, :3], axis=1)
        for k, axis in enumerate(("axis_x", "axis_y", "axis_z")):
            records[axis] = transform[:, :, k] / lengths[:, k : k + 1]
        records["position"] = transform[:, :, 3]
        records["size"] *= lengths[:, :2]
        visible = lamp.visible if isinstance(lamp.visible, int) else np.asarray(lamp.visible)[good]
        records["visibility"] = visible
        parts.append(records)
    return np.concatenate(parts) if parts else np.zeros(0, LIGHT)
