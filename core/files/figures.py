"""Figures as people read them."""

from __future__ import annotations

LEAST = 1e-5  # a smaller share is told as less than that


def percent(share: float) -> str:
    """A share in per cent as people read it, by two digits or more: 0.051 %, 4.4 %, 140 %; never 4e-06 %."""
    if 0 < share < LEAST:
        return f"<{100 * LEAST:g} %"
    return f"{100 * share:.2g} %" if abs(100 * share) < 99.5 else f"{100 * share:,.0f} %"


def size(count: float) -> str:
    """Bytes as people read them."""
    for unit in ("B", "kB", "MB"):
        if count < 1000:
            return f"{count:.3g} {unit}" if unit != "B" else f"{count:.0f} B"
        count /= 1000
    return f"{count:.3g} GB"
