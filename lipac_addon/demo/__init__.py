"""Procedural scenes that come with the project (`lipac demo NAME`)."""

from __future__ import annotations

from ...core.errors import InputError
from . import mirror_city

SCENES = {"mirror-city": mirror_city.build}


def build(name: str, instances: int | None = None, seed: int = 0) -> None:
    """Replace what Blender has open by the demo scene `name`: `instances` instances (None: the scene's default), the same for the same seed.

    Raises InputError for an unknown name or an unusable number.
    """
    if name not in SCENES:
        raise InputError(f'there is no demo scene "{name}": choose one of {", ".join(sorted(SCENES))}')
    SCENES[name](instances, seed)
