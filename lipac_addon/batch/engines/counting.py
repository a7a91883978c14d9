"""What Blender is about to render, counted in passing: in the graph that it evaluates for its own render."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import bpy
import numpy as np

from ...extract.graph import GraphReader
from ...extract.instances import Placer
from ...keys import KEY, Keys


@dataclass
class Counted:
    """keys: of all instances; meshes: how many different ones these have; seconds: that counting took."""

    keys: Keys = field(default_factory=lambda: Keys(np.zeros(0, KEY), ()))
    meshes: int = 0
    seconds: float = 0.0


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
            rows = Placer(reader, np.zeros(3)).place(reader.read(depsgraph, False)).rows
            counted.keys, counted.meshes = Keys(rows.records, tuple(reader.names)), len(np.unique(rows.mesh))
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
