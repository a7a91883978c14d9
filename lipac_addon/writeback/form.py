"""What a mesh is: values of its attributes, and a digest of them, by which one of ours is told from one that was edited
since."""

from __future__ import annotations

import hashlib
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..attributes import FIELDS

VALUES = FIELDS | {  # of all types of attributes
    "INT8": ("value", 1, np.int32),
    "FLOAT2": ("vector", 2, np.float32),
    "INT16_2D": ("value", 2, np.int32),
    "INT32_2D": ("value", 2, np.int32),
    "QUATERNION": ("value", 4, np.float32),
    "FLOAT4X4": ("value", 16, np.float32),
}
_FORM = "lipac_form"  # the custom property that has the digest


def values_of(attribute: Any) -> NDArray[Any]:
    """(n, width) of an attribute."""
    name, width, kind = VALUES[attribute.data_type]
    values: NDArray[Any] = np.empty(len(attribute.data) * width, kind)
    attribute.data.foreach_get(name, values)
    return values.reshape(-1, width)


def seal(mesh: bpy.types.Mesh) -> None:
    """Have what becomes of a mesh be told."""
    mesh[_FORM] = _digest(mesh)


def is_sealed(mesh: bpy.types.Mesh) -> bool:
    """Whether it was."""
    return _FORM in mesh


def is_edited(mesh: bpy.types.Mesh) -> bool:
    """Whether a sealed mesh has other corners, attributes or material slots since."""
    return is_sealed(mesh) and mesh[_FORM] != _digest(mesh)


def unseal(mesh: bpy.types.Mesh) -> None:
    """Leave no trace."""
    del mesh[_FORM]


def _digest(mesh: bpy.types.Mesh) -> str:
    """Of all but what is selected or hidden, and weights."""
    corners: NDArray[np.int32] = np.empty(len(mesh.loops), np.int32)
    mesh.loops.foreach_get("vertex_index", corners)
    digest = hashlib.blake2b(digest_size=16)
    digest.update(f"{len(mesh.materials)} {len(mesh.polygons)}".encode())
    digest.update(corners)
    for name in sorted(a.name for a in mesh.attributes if not a.name.startswith(".") and a.data_type in VALUES):
        digest.update(name.encode())
        digest.update(np.ascontiguousarray(values_of(mesh.attributes[name])))
    return digest.hexdigest()
