"""The light of a scene that is surely there.

Where nobody can say how much a light sends, or to whom, the scene has the most that it may be: whatever that lights or
shades counts. What changes are relative to must not count it: the picture may be darker.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from .model import InstanceFlag, Scene, Shader, Unsure


def known_light(scene: Scene) -> Scene | None:
    """The scene without lamps and emission that are marked as unsure, with colours as dark as they may be, with nothing
    but its own light in place of a material of which it is not known what light it sends on, and with nothing to be
    seen of shadow catchers, which show what is behind them; None where there are none."""
    lamps, materials = scene.lights["unsure"] != 0, scene.materials["unsure_emission"] != 0
    veils = scene.materials["unsure"] & (Unsure.CLEAR | Unsure.LIGHT) != 0
    materials |= scene.materials["unsure"] & Unsure.CLEAR != 0  # it may not be there
    catchers = scene.instances.flags & InstanceFlag.SHADOW_CATCHER != 0
    dim = (scene.materials["sure"] < 1).any()
    if not (lamps.any() or materials.any() or veils.any() or dim or catchers.any()):
        return None
    dark = scene.materials.copy()
    dark["base_color"] *= dark["sure"][:, None]
    dark["emission"] = np.where(materials[:, None], 0, dark["emission"])
    dark["shader"] = np.where(veils, Shader.EMISSION, dark["shader"])
    dark["unsure"] = np.where(veils, 0, dark["unsure"])
    flags = scene.instances.flags | np.where(catchers, np.uint8(InstanceFlag.HOLDOUT), np.uint8(0))
    instances = dataclasses.replace(scene.instances, flags=flags)
    return dataclasses.replace(scene, lights=scene.lights[~lamps], materials=dark, instances=instances)
