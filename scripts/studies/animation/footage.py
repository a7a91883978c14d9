"""Frames of demo scenes as the core's scenes."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from ....core.scene.change import Change
from ....core.scene.model import Scene


class Footage:
    """The open file's frames as scenes. own_s: seconds of the last one's extraction without Blender's own
    evaluation."""

    def __init__(self, size: tuple[int, int]) -> None:
        import bpy

        from ....lipac_addon.extract import Extractor

        self.scene = bpy.context.scene
        self.scene.render.resolution_x, self.scene.render.resolution_y, self.scene.render.resolution_percentage = (
            *size,
            100,
        )
        self._extractor = Extractor(self.scene)
        self.own_s = 0.0

    def frames(self, numbers: range) -> Iterator[tuple[int, Scene, Change | None]]:
        """Each frame, and how it differs from the one before."""
        from ....lipac_addon.console import muted

        with self._extractor:
            for number in numbers:
                with muted():
                    extraction = self._extractor.frame(number)
                self.own_s = self._extractor.read_s
                yield number, extraction.scene, extraction.change


def demo(name: str, instances: int, figure: Path | None = None) -> None:
    """Replace the open file by a demo scene."""
    from ....lipac_addon.console import muted
    from ....lipac_addon.demo import build

    with muted():
        build(name, instances, 0, figure)
