"""What Blender's nodes do with colours and numbers, as functions of arrays."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]


def blend_colors(blend: str, a: Array, b: Array, t: Array) -> Array:
    """Blender's colour blend modes (`ramp_blend`)."""
    if blend == "MIX":
        out = b
    elif blend == "ADD":
        out = a + b
    elif blend == "MULTIPLY":
        out = a * b
    elif blend == "SUBTRACT":
        out = a - b
    elif blend == "SCREEN":
        out = 1 - (1 - a) * (1 - b)
    elif blend == "DIVIDE":
        out = np.where(b != 0, a / np.where(b != 0, b, 1), a)
    elif blend == "DIFFERENCE":
        out = np.abs(a - b)
    elif blend == "DARKEN":
        out = np.minimum(a, b)
    elif blend == "LIGHTEN":
        out = np.maximum(a, b)
    elif blend == "OVERLAY":
        out = np.where(a < 0.5, 2 * a * b, 1 - 2 * (1 - a) * (1 - b))
    elif blend == "LINEAR_LIGHT":
        return a + t * (2 * b - 1)
    else:
        raise NotImplementedError(blend)
    return a + t * (out - a)


MATH: dict[str, Callable[..., Any]] = {
    "ADD": lambda a, b, c: a + b,
    "SUBTRACT": lambda a, b, c: a - b,
    "MULTIPLY": lambda a, b, c: a * b,
    "DIVIDE": lambda a, b, c: np.where(b != 0, a / np.where(b != 0, b, 1), 0),
    "MULTIPLY_ADD": lambda a, b, c: a * b + c,
    "POWER": lambda a, b, c: np.where(a >= 0, np.maximum(a, 0) ** b, 0),
    "MINIMUM": lambda a, b, c: np.minimum(a, b),
    "MAXIMUM": lambda a, b, c: np.maximum(a, b),
    "LESS_THAN": lambda a, b, c: (a < b).astype(np.float32),
    "GREATER_THAN": lambda a, b, c: (a > b).astype(np.float32),
    "ABSOLUTE": lambda a, b, c: np.abs(a),
    "SQRT": lambda a, b, c: np.sqrt(np.maximum(a, 0)),
    "ROUND": lambda a, b, c: np.floor(a + 0.5),
    "FLOOR": lambda a, b, c: np.floor(a),
    "CEIL": lambda a, b, c: np.ceil(a),
    "FRACT": lambda a, b, c: a - np.floor(a),
    "SINE": lambda a, b, c: np.sin(a),
    "COSINE": lambda a, b, c: np.cos(a),
}


def hue_saturation(rgb: Array, hue: float, saturation: float, value: float) -> Array:
    """Blender's Hue/Saturation/Value node on (..., 3)."""
    low, high = rgb.min(axis=-1), rgb.max(axis=-1)
    span = high - low
    safe = np.where(span > 0, span, 1)
    r, g, b = rgb[..., 0], rgb[..., 1], rgb[..., 2]
    h = np.where(high == r, (g - b) / safe, np.where(high == g, 2 + (b - r) / safe, 4 + (r - g) / safe)) / 6
    h = np.where(span > 0, h % 1.0, 0)
    s = np.where(high > 0, span / np.where(high > 0, high, 1), 0)
    h, s, v = (h + hue + 0.5) % 1.0, np.clip(s * saturation, 0, 1), high * value
    k = np.stack([np.clip(np.abs((h * 6 + o) % 6 - 3) - 1, 0, 1) for o in (0, 4, 2)], axis=-1)
    return np.maximum(v[..., None] * (1 + s[..., None] * (k - 1)), 0).astype(np.float32)


def fresnel(cosine: NDArray[np.float64], eta: float) -> NDArray[np.float64]:
    """What a dielectric of relative index eta reflects at these cosines (Cycles' `fresnel_dielectric_cos`)."""
    g = np.sqrt(np.maximum(eta * eta - 1 + cosine * cosine, 0))
    a, b = (g - cosine) / (g + cosine), (cosine * (g + cosine) - 1) / (cosine * (g - cosine) + 1)
    return np.where(g > 0, 0.5 * a * a * (1 + b * b), 1.0)


def facing(cosine: NDArray[np.float64], blend: float) -> NDArray[np.float64]:
    """Layer Weight's Facing (Cycles' `svm_node_layer_weight`)."""
    blend = min(max(blend, 0.0), 1 - 1e-5)
    return 1 - cosine ** (2 * blend if blend < 0.5 else 0.5 / (1 - blend))
