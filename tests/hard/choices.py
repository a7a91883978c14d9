"""Where a random scene takes its choices from: a seed, for recorded runs, or Hypothesis, which makes what fails
small."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np

T = TypeVar("T")


class Seeded:
    """Choices from a seed."""

    def __init__(self, seed: int) -> None:
        self._rng = np.random.default_rng(seed)

    def integer(self, low: int, high: int) -> int:
        """low to high, both included."""
        return int(self._rng.integers(low, high + 1))

    def one(self, items: Sequence[T]) -> T:
        """One of items."""
        return items[self.integer(0, len(items) - 1)]

    def rarely(self) -> bool:
        """True one time in eight."""
        return self.integer(0, 7) == 7

    def numbers(self) -> np.random.Generator:
        """For numbers in bulk."""
        return np.random.default_rng(self.integer(0, 2**31))


class Drawn(Seeded):
    """Choices of Hypothesis. data: what `strategies.data()` gives."""

    def __init__(self, data: Any) -> None:
        super().__init__(0)
        self._data = data

    def integer(self, low: int, high: int) -> int:
        """low to high, both included; shrinks towards low."""
        from hypothesis import strategies as st

        return int(self._data.draw(st.integers(low, high)))
