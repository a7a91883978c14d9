"""Curves as SVG inside a page, by Matplotlib: text stays text, and colours are told apart by colour-blind people."""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLORS = ("#0072b2", "#d55e00", "#009e73", "#555555")  # Okabe and Ito's, those that are dark enough on white
WIDTH, HEIGHT = 8.0, 2.4  # inches, of 96 pixels


@dataclass(frozen=True)
class Curve:
    """A line over the frames. x, y: what is known of it; a bound is drawn dashed, points that are not joined as
    dots."""

    label: str
    x: Sequence[float]
    y: Sequence[float]
    bound: bool = False
    dots: bool = False


def curves(lines: Sequence[Curve], what: str, alone: str = "frame") -> str:
    """Lines over the frames as an `<svg>`. what: the name of the vertical axis, which begins at nothing; alone: that of
    the horizontal one."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    figure = Figure(figsize=(WIDTH, HEIGHT), layout="constrained")
    axes = figure.subplots()
    for line, color in zip(lines, COLORS, strict=False):
        style = "--" if line.bound else "" if line.dots else "-"
        marker = "o" if line.dots or len(line.x) == 1 else ""
        axes.plot(
            line.x, line.y, linestyle=style, marker=marker, markersize=4, color=color, label=line.label, linewidth=1.5
        )
    axes.set(xlabel=alone, ylabel=what)
    axes.set_ylim(bottom=0)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
    if len(lines) > 1:
        figure.legend(loc="outside upper left", ncols=len(lines), frameon=False)
    return svg_of(figure, what)


def svg_of(figure: Figure, name: str = "") -> str:
    """A figure as an `<svg>` to stand within HTML, the same for the same figure: no date, no addresses but those of
    SVG's own names. name: tells it from others of the page, so that none refers to a part of another."""
    from matplotlib import rc_context

    text = io.StringIO()
    nothing = dict.fromkeys(("Creator", "Date", "Format", "Type"))
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": f"lipac {name}", "font.family": "sans-serif"}):
        figure.savefig(text, format="svg", metadata=nothing, transparent=True)
    found = text.getvalue()
    found = re.sub(r'<g id="[^"]*">', "<g>", found[found.index("<svg") :])
    return re.sub(r' (?:height|width)="[\d.]+pt"', "", found, count=2)
