"""The light of a scene that is surely there.

Where nobody can say how much a light sends, or to whom, the scene has the most that it may be: whatever that lights or
shades counts. What changes are relative to must not count it: the picture may be darker.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from .model import Scene


def known_light(scene: Scene) -> Scene | None:
    """The scene without lamps and emission that are marked as unsure; None where none is."""
    lamps, materials = scene.lights["unsure"] != 0, scene.materials["unsure_emission"] != 0
    if not lamps.any() and not materials.any():
        return None
    dark = scene.materials.copy()
    dark["emission"] = np.where(materials[:, None], 0, dark["emission"])
    return dataclasses.replace(scene, lights=scene.lights[~lamps], materials=dark)
