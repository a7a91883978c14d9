"""Damaged files are refused in a line, or opened; none ends the process. `python -m lipac.scripts.dev.fuzz files` tries
as many as wanted."""

from __future__ import annotations

from .choices import Seeded
from .fuzz_files import outcomes


def test_damaged_files() -> None:
    found = outcomes(Seeded(7), 24)
    assert set(found) == {"opened", "refused"}, found
