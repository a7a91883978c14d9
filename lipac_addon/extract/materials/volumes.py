"""How much volumes emit, at most."""

from __future__ import annotations

from typing import Any

from .ranges import MOST, most_of


def glow_of(socket: Any) -> float:
    """The most that a metre of what is linked to a Volume socket of an inlined tree emits, in any channel, W/m2/sr;
    that of a black body, or by attributes of a grid, may be anything."""
    if not socket.is_linked:
        return 0.0
    node = socket.links[0].from_node
    if node.type in {"ADD_SHADER", "MIX_SHADER"}:
        return max(glow_of(one) for one in node.inputs if one.type == "SHADER")
    if node.type == "EMISSION":
        return _product(node.inputs["Color"], node.inputs["Strength"])
    if node.type == "PRINCIPLED_VOLUME":
        hot = most_of(node.inputs["Blackbody Intensity"]) > 0
        return _product(node.inputs["Emission Color"], node.inputs["Emission Strength"]) + (MOST[0] if hot else 0.0)
    return _product(node.inputs["Emission Coefficients"]) if "Emission Coefficients" in node.inputs else 0.0


def _product(*sockets: Any) -> float:
    out = 1.0
    for socket in sockets:
        out *= max(most_of(socket), 0.0)
    return out
