"""Where images lie on a surface: UV maps, and what mapping nodes do with them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .reader import Reader


def placement(reader: Reader, socket: Any) -> tuple[str, tuple[float, ...]]:
    """UV map name ("" the active one) and 2x3 matrix (row by row) that a vector socket amounts to."""
    name, m = _affine(reader, socket)
    return name, tuple(float(v) for v in (m[0, 0], m[0, 1], m[0, 3], m[1, 0], m[1, 1], m[1, 3]))


def _affine(reader: Reader, socket: Any) -> tuple[str, NDArray[np.float64]]:
    identity = np.eye(4)
    if not socket.is_linked:
        return "", identity
    node, output = socket.links[0].from_node, socket.links[0].from_socket
    if node.type == "UVMAP":
        return node.uv_map, identity
    if node.type == "TEX_COORD" and output.name == "UV":
        return "", identity
    if node.type == "MAPPING":
        name, m = _affine(reader, node.inputs["Vector"])
        return name, _mapping(reader, node) @ m
    if node.type == "VECT_MATH" and node.operation in {"ADD", "SUBTRACT", "MULTIPLY", "SCALE"}:
        name, m = _affine(reader, node.inputs[0])
        b = reader.value(node.inputs[3] if node.operation == "SCALE" else node.inputs[1])
        if b.use is None:
            step = np.eye(4)
            if node.operation in {"MULTIPLY", "SCALE"}:
                step[:3, :3] = np.diag(b.factor)
            else:
                step[:3, 3] = np.array(b.factor) * (1 if node.operation == "ADD" else -1)
            return name, step @ m
    if node.type == "ATTRIBUTE" and node.attribute_type == "GEOMETRY":
        return node.attribute_name, identity
    reader.doubt(f"texture coordinates of {node.bl_label} ({output.name}) replaced by UVs")
    return "", identity


def _mapping(reader: Reader, node: Any) -> NDArray[np.float64]:
    from mathutils import Euler

    values = {name: np.zeros(3) for name in ("Location", "Rotation")} | {"Scale": np.ones(3)}
    for name in values:
        if name in node.inputs and node.inputs[name].enabled:
            values[name] = reader.constant(node.inputs[name], f"mapping {name.lower()}")
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
