"""Boxes to draw, as plain arrays: which there are, in what colour, and how they are laid out in a texture. No graphics
here."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from ....core.arrays import F32, F64
    from ..state.results import FrameResult

from ..state import results

# Okabe and Ito's colours, and white, told apart by colour-blind people: sRGB.
KINDS = ("active", "pending", "regions", "culled")
COLORS = {
    "active": (0.90, 0.60, 0.00),
    "pending": (1.0, 1.0, 1.0),
    "regions": (0.00, 0.45, 0.70),
    "culled": (0.00, 0.62, 0.45),
}
GREY = (0.85, 0.85, 0.85)  # regions beside the heat map, whose colours have blue and green
# Heat of instances, from none to most: viridis (van der Walt and Smith, 2015), brighter throughout, also to the
# colour-blind. sRGB, at equal steps.
HEAT = np.array(
    [(0.267, 0.005, 0.329), (0.275, 0.194, 0.496), (0.212, 0.359, 0.552), (0.153, 0.497, 0.558),
     (0.122, 0.633, 0.531), (0.290, 0.759, 0.428), (0.622, 0.854, 0.226), (0.993, 0.906, 0.144)]
)  # fmt: skip
ROW = 2048  # boxes in a row of the texture; a box is two texels, its low and its high corner

# Edges of the unit cube as pairs of corners; bit k of a corner is its coordinate k.
CORNERS = np.array([[(c >> k) & 1 for k in range(3)] for c in range(8)], np.float32)
EDGES = np.array([(a, a | 1 << k) for k in range(3) for a in range(8) if not a >> k & 1], np.int32)


def color_of(kind: str, heat_map: bool = False) -> tuple[float, float, float]:
    """The colour of a kind of boxes; beside the heat map, which colours instances, regions have another."""
    return GREY if heat_map and kind == "regions" else COLORS[kind]


@dataclass(frozen=True)
class Boxes:
    """texels: (rows, 2 ROW, 4) float32, corners relative to `origin` (3,) float64, in the first one's last channel its
    heat, 0 to 1 by the logarithm of the paths that met it, -1 for regions; ranges: first box and number of boxes of
    each of KINDS; hottest: the most paths that met an instance.
    """

    texels: F32
    origin: F64
    ranges: tuple[tuple[int, int], ...]
    hottest: int


STATES = {"active": results.ACTIVE, "pending": results.PENDING, "culled": results.CULLED}


def boxes_of(result: FrameResult) -> Boxes:
    """All boxes of a result, kind by kind."""
    low, high = result.bounds[:, 0], result.bounds[:, 1]
    with np.errstate(invalid="ignore"):
        exists = ((low <= high) & (np.abs(low) < np.inf) & (np.abs(high) < np.inf)).all(axis=1)
    met = result.hits.sum(axis=1)
    hottest = int(met.max(initial=0))
    heat = np.log1p(met) / max(np.log1p(hottest), 1.0)
    rows = {kind: np.flatnonzero(exists & (result.state == state)) for kind, state in STATES.items()}
    counts = [len(rows[kind]) if kind in rows else len(result.regions) for kind in KINDS]
    firsts = np.concatenate([[0], np.cumsum(counts)[:-1]]).astype(int)
    height = max(1, -(-sum(counts) // ROW))
    texels = np.zeros((height * ROW, 2, 4), np.float32)
    for kind, first, count in zip(KINDS, firsts, counts, strict=True):
        part = texels[first : first + count]
        if kind in rows:
            part[:, :, :3], part[:, 0, 3] = result.bounds[rows[kind]], heat[rows[kind]]
        else:
            part[:, :, :3], part[:, 0, 3] = result.regions, -1.0
    return Boxes(
        texels.reshape(height, 2 * ROW, 4), result.origin, tuple(zip(firsts.tolist(), counts, strict=True)), hottest
    )
