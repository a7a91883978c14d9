"""Simplified meshes in the numbers of the program that they come from, as files of states have them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..arrays import I32


@dataclass(frozen=True)
class Level:
    """A simplified mesh, by what it has of the whole one. corners: (S, 3) int32 numbers of corners (loops); faces: (S,)
    int32, those of which the S triangles are parts."""

    corners: I32
    faces: I32


def level_arrays(levels: Mapping[str, Level]) -> dict[str, np.ndarray]:
    """Levels by the name of an object as arrays of a file of states, none where there are no levels."""
    if not levels:
        return {}
    return {
        "level_names": np.array(list(levels), dtype=np.str_),
        "level_counts": np.array([len(level.faces) for level in levels.values()]),
        "level_corners": np.concatenate([level.corners for level in levels.values()]),
        "level_faces": np.concatenate([level.faces for level in levels.values()]),
    }


def read_levels(data: Any) -> dict[str, Level]:
    """What `level_arrays` gave, of an open file of states. Objects with the same level have the same `Level`."""
    if "level_names" not in data.files:
        return {}
    ends = np.cumsum(data["level_counts"])[:-1]
    corners, faces = (np.split(data[f"level_{name}"], ends) for name in ("corners", "faces"))
    known: dict[bytes, Level] = {}
    found = (known.setdefault(c.tobytes() + f.tobytes(), Level(c, f)) for c, f in zip(corners, faces, strict=True))
    return dict(zip(data["level_names"].tolist(), found, strict=True))
