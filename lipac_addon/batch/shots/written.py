"""The set that is written back into the open file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ....core.files.level import AnyLevel
from ... import writeback
from ...console import muted
from ..frame import write_back
from .shot_set import ShotSet


class Written:
    """What of a shot's sets is written back into the open file: the last. lines: what could not be; seconds: that all
    took; summary: for the report."""

    def __init__(self, lasting: bool) -> None:
        """lasting: the file is to be saved so."""
        self._lasting = lasting
        self._digest = ""
        self.lines: list[str] = []
        self.seconds = 0.0
        self.summary: dict[str, Any] = {}

    def use(self, shot: ShotSet, levels: Mapping[str, AnyLevel]) -> None:
        """Write a set back in place of the last. levels: as of `States`."""
        digest = shot.digest
        if digest == self._digest:
            return
        if self._digest:
            with muted():
                writeback.restore()
        entry: dict[str, Any] = {}
        self.lines, _ = write_back(~shot.active, shot.keys, entry, shot.faces, self._lasting, levels)
        self.seconds += entry["writeback_s"]
        self.summary = entry["writeback"]
        self._digest = digest

    def entry(self, frames: int) -> dict[str, Any]:
        """For the report, of each of so many frames."""
        return {"writeback_s": self.seconds / frames, "writeback": self.summary}
