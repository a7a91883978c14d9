"""The key that finds an instance again in Blender: names and indices, never references.

A `Records` array of KEY, one per instance of `core.scene.model.Instances`, beside a table of names:

kind: how Blender makes the instance (`Kind`).
host: name of the object at the top that instances it (-1 for a real object). object: name of the object that is
instanced (-1: a geometry without an object). path: index at each level of instancing, outermost first, -1 padded. For
geometry nodes path[0] is the row in the host's instance point cloud, that is, what a mask of the write-back addresses;
deeper levels index nested instance clouds, or the object's place in an instanced collection.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import Records


class Kind(IntEnum):
    """How Blender makes the instance: decides by what means it can be hidden."""

    OBJECT = 0
    COLLECTION = 1
    GEOMETRY_NODES = 2
    PARTICLE = 3
    DUPLI = 4  # vertex and face instancing


MAX_DEPTH = 8
KEY = np.dtype([("kind", "u1"), ("host", "i4"), ("object", "i4"), ("path", "i4", (MAX_DEPTH,))], align=True)


@dataclass(frozen=True)
class Keys:
    """records: (N,) of KEY; names: full names of objects (library path and name joined by a newline for linked
    ones)."""

    records: Records
    names: tuple[str, ...]


def full_name(data: Any) -> str:
    """The name of a datablock in `Keys.names`, which finds it again."""
    return f"{data.library.filepath}\n{data.name}" if data.library is not None else str(data.name)


def any_of(records: Records, others: Sequence[Records]) -> NDArray[np.bool_]:
    """(N,) bool, records of KEY that are among others; names as in one table."""
    return (
        np.isin(packed(records), np.concatenate([packed(other) for other in others]))
        if others
        else np.zeros(len(records), bool)
    )


def packed(records: Records) -> NDArray[np.void]:
    """(N,) records of KEY as items that can be sorted and compared, of a fixed number of bytes."""
    columns = np.column_stack([records["kind"].astype(np.int32), records["host"], records["object"], records["path"]])
    return np.ascontiguousarray(columns, np.int32).view(f"V{4 * columns.shape[1]}").ravel()
