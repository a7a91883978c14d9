"""Multilayer EXR that Blender's compositor opens: one layer, a pass per picture."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from ...core.arrays import F32
from ...core.files.atomic import replacing

LAYER = "Hybrid"
_LETTERS = {1: "V", 3: "RGB", 4: "RGBA"}


def save_layers(path: Path, passes: Mapping[str, F32]) -> None:
    """Write passes by name, (H, W) or (H, W, 1, 3 or 4) float32, linear, rows bottom up."""
    import OpenEXR

    channels = {}
    for name, picture in passes.items():
        planes = picture.reshape(*picture.shape[:2], -1)[::-1]
        for k, letter in enumerate(_LETTERS[planes.shape[2]]):
            channels[f"{LAYER}.{name}.{letter}"] = np.ascontiguousarray(planes[..., k], np.float32)
    header = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        "BlenderMultiChannel": "Blender V2.55.1 and newer",
    }
    with replacing(path) as part:
        OpenEXR.File(header, channels).write(str(part))


def read_layers(path: Path) -> dict[str, F32]:
    """The passes that `save_layers` wrote, by name: (H, W) or (H, W, 3 or 4) float32, rows bottom up."""
    import OpenEXR

    with OpenEXR.File(str(path), separate_channels=True) as file:
        channels = {name.partition(".")[2]: channel.pixels[::-1] for name, channel in file.channels().items()}
    names = {name.rpartition(".")[0] for name in channels}
    planes = {
        name: [channels[f"{name}.{letter}"] for letter in "VRGBA" if f"{name}.{letter}" in channels] for name in names
    }
    return {name: np.stack(p, axis=2) if len(p) > 1 else p[0] for name, p in planes.items()}
