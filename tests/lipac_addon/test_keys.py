"""What instances can be taken out with, by their keys."""

from __future__ import annotations

import numpy as np
import pytest

from lipac.lipac_addon.keys import KEY, Kind, removal_of

ROCK, TREE, LEAF, HOST, EMPTY, OTHER = range(6)


def records(*rows: tuple[Kind, int, int, tuple[int, ...]]) -> np.ndarray:
    """Of kind, host, object, and the path's first indices."""
    out = np.zeros(len(rows), KEY)
    out["path"] = -1
    for k, (kind, host, shown, path) in enumerate(rows):
        out[k]["kind"], out[k]["host"], out[k]["object"] = kind, host, shown
        out[k]["path"][: len(path)] = path
    return out


@pytest.mark.parametrize(
    ("rows", "kept", "stay"),
    [
        # rows of a scatter of single objects, and objects, go alone
        ([(Kind.GEOMETRY_NODES, HOST, ROCK, (k,)) for k in range(3)] + [(Kind.OBJECT, -1, ROCK, ())], [0], [0]),
        # two things at each point
        ([(Kind.GEOMETRY_NODES, HOST, LEAF + k % 2, (k // 2, k % 2)) for k in range(6)], [1, 2], [0, 1, 2, 3]),
        # a part that is kept nowhere goes by its object
        ([(Kind.GEOMETRY_NODES, HOST, (ROCK, LEAF)[k % 2], (k // 2, k % 2)) for k in range(4)], [0, 2], [0, 2]),
        # particles of two emitters
        ([(Kind.PARTICLE, HOST + k % 2, ROCK, (k,)) for k in range(4)], [0], [0, 2]),
        # two collection instances of two parts: by instance or by part
        ([(Kind.COLLECTION, EMPTY + k // 2, (ROCK, TREE)[k % 2], (k % 2,)) for k in range(4)], [0], [0]),
        ([(Kind.COLLECTION, EMPTY + k // 2, (ROCK, TREE)[k % 2], (k % 2,)) for k in range(4)], [0, 3], [0, 1, 2, 3]),
        # an object that collection instances show, too
        ([(Kind.OBJECT, -1, ROCK, ()), (Kind.COLLECTION, EMPTY, ROCK, (0,))], [1], [0, 1]),
    ],
)
def test_what_goes_together(rows, kept, stay):
    made = records(*rows)
    keep = np.zeros(len(made), bool)
    keep[kept] = True
    removal = removal_of(made)
    found = keep if removal is None else removal.staying(keep)
    assert np.flatnonzero(found).tolist() == stay


def test_where_each_goes_alone_there_is_nothing_to_know():
    assert removal_of(records(*((Kind.GEOMETRY_NODES, HOST, ROCK, (k,)) for k in range(9)))) is None
    assert removal_of(records(*((Kind.OBJECT, -1, k, ()) for k in range(5)))) is None
    assert removal_of(records()) is None
