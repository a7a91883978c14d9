"""Boxes to draw, as plain arrays: which there are, in what colour, and how they are laid out in a texture. No graphics here."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from ...core.scene import F32, F64
    from .results import FrameResult

# Okabe and Ito's colours, told apart by colour-blind people: sRGB.
KINDS = ("active", "regions", "culled")
COLORS = {"active": (0.90, 0.60, 0.00), "regions": (0.00, 0.45, 0.70), "culled": (0.00, 0.62, 0.45)}
ROW = 2048  # boxes in a row of the texture; a box is two texels, its low and its high corner

# Edges of the unit cube as pairs of corners; bit k of a corner is its coordinate k.
CORNERS = np.array([[(c >> k) & 1 for k in range(3)] for c in range(8)], np.float32)
EDGES = np.array([(a, a | 1 << k) for k in range(3) for a in range(8) if not a >> k & 1], np.int32)


@dataclass(frozen=True)
class Boxes:
    """texels: (rows, 2 ROW, 4) float32, corners relative to `origin` (3,) float64; ranges: first box and number of boxes of each of KINDS."""

    texels: F32
    origin: F64
    ranges: tuple[tuple[int, int], ...]


def boxes_of(result: FrameResult) -> Boxes:
    """All boxes of a result, kind by kind."""
    exists = np.isfinite(result.bounds).all(axis=(1, 2)) & (result.bounds[:, 0] <= result.bounds[:, 1]).all(axis=1)
    parts = (result.bounds[exists & ~result.culled], result.regions, result.bounds[exists & result.culled])
    counts = [len(part) for part in parts]
    firsts = np.concatenate([[0], np.cumsum(counts)[:-1]]).astype(int)
    rows = max(1, -(-sum(counts) // ROW))
    texels = np.zeros((rows * ROW, 2, 4), np.float32)
    for first, part in zip(firsts, parts, strict=True):
        texels[first : first + len(part), :, :3] = part
    return Boxes(texels.reshape(rows, 2 * ROW, 4), result.origin, tuple(zip(firsts.tolist(), counts, strict=True)))
