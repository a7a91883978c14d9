"""Meshes with fewer triangles in the numbers of the program that they come from, as files of states have them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from ..arrays import I32


@dataclass(frozen=True)
class Level:
    """A simplified mesh, by what it has of the whole one. corners: (S, 3) int32 numbers of corners (loops); faces: (S,)
    int32, those of which the S triangles are parts."""

    corners: I32
    faces: I32


@dataclass(frozen=True)
class Steps:
    """A mesh that is made coarser by a setting of its object, by so many steps."""

    steps: int


AnyLevel: TypeAlias = Level | Steps


def finest(a: AnyLevel, b: AnyLevel, cut: bool) -> AnyLevel | None:
    """The finer of two levels of an object; None where they do not go together. cut: one of them has some faces
    alone."""
    if isinstance(a, Steps) and isinstance(b, Steps):
        return min(a, b, key=lambda level: level.steps)
    if isinstance(a, Level) and isinstance(b, Level):
        if np.array_equal(a.corners, b.corners) and np.array_equal(a.faces, b.faces):
            return a
        return None if cut else max(a, b, key=lambda level: len(level.faces))
    return None


def level_arrays(levels: Mapping[str, AnyLevel]) -> dict[str, np.ndarray]:
    """Levels by the name of an object as arrays of a file of states, by name, none where there are none of a kind."""
    out: dict[str, np.ndarray] = {}
    levels = dict(sorted(levels.items()))
    if simplified := {name: level for name, level in levels.items() if isinstance(level, Level)}:
        out |= {
            "level_names": np.array(list(simplified), dtype=np.str_),
            "level_counts": np.array([len(level.faces) for level in simplified.values()]),
            "level_corners": np.concatenate([level.corners for level in simplified.values()]),
            "level_faces": np.concatenate([level.faces for level in simplified.values()]),
        }
    if coarser := {name: level.steps for name, level in levels.items() if isinstance(level, Steps)}:
        out |= {
            "coarser_names": np.array(list(coarser), dtype=np.str_),
            "coarser_steps": np.array(list(coarser.values()), np.uint8),
        }
    return out


def read_levels(data: Any) -> dict[str, AnyLevel]:
    """What `level_arrays` gave, of an open file of states. Objects with the same level have the same `Level`."""
    out: dict[str, AnyLevel] = {}
    if "coarser_names" in data.files:
        steps = map(Steps, data["coarser_steps"].tolist())
        out |= zip(data["coarser_names"].tolist(), steps, strict=True)
    if "level_names" not in data.files:
        return out
    ends = np.cumsum(data["level_counts"])[:-1]
    corners, faces = (np.split(data[f"level_{name}"], ends) for name in ("corners", "faces"))
    known: dict[bytes, Level] = {}
    found = (known.setdefault(c.tobytes() + f.tobytes(), Level(c, f)) for c, f in zip(corners, faces, strict=True))
    return out | dict(zip(data["level_names"].tolist(), found, strict=True))
