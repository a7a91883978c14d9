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
from ..core.scene.together import Removal


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


def removal_of(records: Records) -> Removal | None:
    """What instances of records of KEY can be taken out with, as far as keys tell; None where each goes alone.

    An object that is hidden takes all with it that shows or makes it; parts of what an object instances go with the
    object, too; rows of geometry nodes go with all that is nested in them; particles with all of their emitter.
    """
    nodes = records["kind"] == Kind.GEOMETRY_NODES
    chosen = np.arange(len(records)) if _nested(records, nodes) else np.flatnonzero(~nodes)
    kind, host, shown = (records[name][chosen].astype(np.int64) for name in ("kind", "host", "object"))
    nodes, row, deep = nodes[chosen], records["path"][chosen, 0], records["path"][chosen, 1] >= 0
    names = int(max(host.max(initial=-1), shown.max(initial=-1))) + 1
    part = (kind == Kind.COLLECTION) | (kind == Kind.DUPLI)
    hidden = np.where((kind == Kind.OBJECT) | part | (nodes & deep), shown, -1)
    other = np.where(part, host, -1)
    particle = (kind == Kind.PARTICLE) & (host >= 0)
    other[particle] = names + host[particle]
    other[nodes] = 2 * names + np.unique((host << 32 | row)[nodes], return_inverse=True)[1]
    groups = np.stack([hidden, other])
    size = np.bincount(groups[groups >= 0])
    shared = np.flatnonzero((np.append(size, 0)[groups] > 1).any(axis=0))
    return Removal(chosen[shared], groups[:, shared].astype(np.int32)) if len(shared) else None


def _nested(records: Records, nodes: NDArray[np.bool_]) -> bool:
    """Whether a row of geometry nodes shows several things. Those of one follow each other."""
    host, row, deep = records["host"], records["path"][:, 0], records["path"][:, 1] >= 0
    same = (row[1:] == row[:-1]) & nodes[1:] & nodes[:-1]
    return bool((deep & nodes).any() or (same.any() and (same & (host[1:] == host[:-1])).any()))
