"""Procedural scenes that come with the project (`lipac demo NAME`)."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from ...core.errors import InputError
from . import crowd, family, flythrough, mirror_city, textures

SCENES: dict[str, Callable[..., None]] = {
    "mirror-city": mirror_city.build,
    "flythrough": flythrough.build,
    "crowd": crowd.build,
    "textures": textures.build,
    "family": family.build,
}


def build(name: str, instances: int | None = None, seed: int = 0, figure: Path | None = None) -> None:
    """Replace what Blender has open by the demo scene `name`: `instances` instances (None: the scene's default), the
    same for the same seed.

    figure: file with the animated character of `crowd`, None for one of our own. Raises InputError for an unknown name,
    an unusable number or file.
    """
    if name not in SCENES:
        raise InputError(f'there is no demo scene "{name}": choose one of {", ".join(sorted(SCENES))}')
    if name == "crowd":
        crowd.build(instances, seed, figure)
    elif figure is not None:
        raise InputError(f"--figure is for crowd: {name} has no characters")
    else:
        SCENES[name](instances, seed)
