"""How the rows of one frame differ from those of the frame before."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...core.arrays import I32, Records
from ..keys import packed
from .instances import Placed, Rows

Mask = NDArray[np.bool_]


def compare(before: Placed, now: Placed) -> tuple[I32 | None, Mask | None]:
    """`previous` and `moved` of `core.scene.change.Change`: rows are found again by their keys, and compared number by
    number."""
    if now.rows is before.rows:
        return None, None
    count = len(now.rows)
    previous, moved = np.full(count, -1, np.int32), np.ones(count, bool)
    for block, (known, taken) in zip(now.blocks, now.before, strict=True):
        if known is None:
            continue
        here, there = slice(block.first, block.first + block.count), slice(known.first, known.first + known.count)
        if taken:
            previous[here], moved[here] = np.arange(there.start, there.stop), False
            continue
        a, b = now.rows[here], before.rows[there]
        if _same_keys(a.records, b.records):
            previous[here], moved[here] = np.arange(there.start, there.stop), _differ(a, b)
        else:
            i, j = _matches(a.records, b.records)
            previous[block.first + i] = known.first + j
            moved[block.first + i] = _differ(_pick(a, i), _pick(b, j))
    same_rows = count == len(before.rows) and np.array_equal(previous, np.arange(count))
    return None if same_rows else previous, moved if moved.any() else None


def _pick(rows: Rows, index: NDArray[np.intp]) -> Rows:
    return Rows(*(getattr(rows, name)[index] for name in Rows.__dataclass_fields__))


def _differ(a: Rows, b: Rows) -> Mask:
    """(N,) bool, rows whose transform, bounds, mesh, slots or flags have changed."""
    out = (a.mesh != b.mesh) | (a.slots != b.slots) | (a.flags != b.flags)
    out |= (a.transform != b.transform).any(axis=(1, 2))
    return np.asarray(out | (a.bounds != b.bounds).any(axis=(1, 2)))


def _same_keys(a: Records, b: Records) -> bool:
    return len(a) == len(b) and all(np.array_equal(a[name], b[name]) for name in a.dtype.names or ())


def _matches(a: Records, b: Records) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Indices into a and b of records that are in both; of several equal ones the first."""
    _, i, j = np.intersect1d(packed(a), packed(b), return_indices=True)
    return i, j
