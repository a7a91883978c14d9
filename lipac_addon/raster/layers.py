"""Multilayer EXR that Blender's compositor opens: one layer, a pass per picture."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from ...core.report import replacing
from ...core.scene import F32

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
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, "BlenderMultiChannel": "Blender V2.55.1 and newer"}
    with replacing(path) as part:
        OpenEXR.File(header, channels).write(str(part))
