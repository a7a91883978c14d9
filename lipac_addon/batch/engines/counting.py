"""What Blender is about to render, counted in passing: in the graph that it evaluates for its own render."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any

import bpy
import numpy as np

from ....core.files.memory_table import MemoryRow
from ...extract.graph import GraphReader
from ...keys import KEY, Keys
from ...memory.rows import Weighed
from ...memory.stakes import weigh


@dataclass
class Counted:
    """keys: of all instances; meshes: how many different ones these have; seconds: that counting took; weighed: what
    the render takes, of each graph that was counted."""

    keys: Keys = field(default_factory=lambda: Keys(np.zeros(0, KEY), ()))
    meshes: int = 0
    seconds: float = 0.0
    weighed: list[Weighed] = field(default_factory=list)

    def figures(self, process: int) -> dict[str, int]:
        """What the process that renders is predicted to take. process: what it takes before."""
        found = [one.figures(process) for one in self.weighed]
        return max(found, key=lambda figures: figures["memory_bytes"], default={})

    def memory(self, frame: int) -> list[MemoryRow]:
        """Who takes the memory of the render."""
        return [row for one in self.weighed for row in replace(one, frame=frame).rows()]


@contextmanager
def counting() -> Iterator[Counted]:
    """Counts the instances of a frame that is rendered within the block; what comes out of it is complete at its
    end."""
    counted, errors = Counted(), []

    def note(_scene: Any, depsgraph: Any = None) -> None:
        if depsgraph is None or depsgraph.mode != "RENDER":
            return
        start = time.perf_counter()
        try:
            reader = GraphReader()
            named, rows = weigh(reader, reader.read(depsgraph, False), bpy.context.scene)
            counted.keys, counted.meshes = Keys(rows.records, tuple(reader.names)), len(np.unique(rows.mesh))
            counted.weighed.append(Weighed.whole(named, rows.instances(), counted.keys))
            reader.forget()
        except Exception as error:  # Blender would print it and go on
            errors.append(error)
        counted.seconds += time.perf_counter() - start

    bpy.app.handlers.frame_change_post.append(note)
    try:
        yield counted
    finally:
        bpy.app.handlers.frame_change_post.remove(note)
    if errors:
        raise errors[0]
