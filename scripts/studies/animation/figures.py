"""What the sections of animation.md share: words, colours, plots."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from ....core.files.atomic import replacing

Part = dict[str, Any]
Row = tuple[str, ...]
STEADY = 3  # index of the first frame that counts as settled: before it, what deforms is built for being refitted
COLORS = ("tab:red", "tab:blue", "tab:green")
PICTURES = "animation"  # folder beside the page


def figure(path: Path, panels: int, draw: Callable[..., None], width: float = 11.0) -> None:
    """Save a figure that draw(axes, ...) makes."""
    from matplotlib.figure import Figure

    made = Figure(figsize=(width, 3.6), layout="constrained")
    draw(*made.subplots(1, panels, squeeze=False)[0])
    with replacing(path) as part:
        made.savefig(part, dpi=80)


def percent(x: float) -> str:
    return f"{100 * x:.3g} %"
