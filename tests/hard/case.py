"""What a hard case is: a function that measures something with a known answer or an invariant, and says how far off it
is.

The tests run every case that is quick; `scripts/dev/accuracy.py` runs all of them and writes docs/accuracy.md.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass


@dataclass(frozen=True)
class Figure:
    """One row of the table.

    stressed: what is stressed. measure: what the figure is. limit: the case holds where figure <= limit (false for
    NaN). why: where the limit comes from, or what is not supported beyond it. before: the same figure in the same run
    with the remedy left out, where there is one that can be.
    """

    stressed: str
    measure: str
    figure: float
    limit: float
    why: str = ""
    before: float | None = None

    @property
    def holds(self) -> bool:
        """Whether the figure is within its limit."""
        return self.figure <= self.limit


Function = Callable[[], Figure | Iterable[Figure]]


@dataclass(frozen=True)
class Case:
    """group: heading of the table; slow: only for the command, not for every run of the tests."""

    group: str
    name: str
    function: Function
    slow: bool

    def figures(self) -> list[Figure]:
        """Run it."""
        out = self.function()
        return [out] if isinstance(out, Figure) else list(out)


CASES: list[Case] = []


def case(group: str, slow: bool = False) -> Callable[[Function], Function]:
    """Decorator: enter a function into `CASES`."""

    def enter(function: Function) -> Function:
        CASES.append(Case(group, function.__name__, function, slow))
        return function

    return enter
