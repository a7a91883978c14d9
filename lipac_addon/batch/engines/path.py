"""Renders by the path tracer of `core`."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import bpy
import numpy as np
from numpy.typing import NDArray

from ....core.errors import Cancelled
from ....core.progress import Progress, silent
from ....core.scene.model import Scene
from ...console import muted
from ...pictures import save_pixels
from .wishes import samples_of

if TYPE_CHECKING:
    from ....core.culling.result import Built


def render_path(
    scene: Scene,
    active: NDArray[np.bool_],
    stem: Path,
    samples: int | None = None,
    seed: int = 0,
    threads: int = 0,
    progress: Progress = silent,
    cancelled: Callable[[], bool] | None = None,
    built: Built | None = None,
) -> float:
    """Render the active instances, (N,) bool, of a core scene by the path tracer, save stem.exr and stem.png, and
    return the seconds, building included.

    samples: per pixel, None as the open file asks of Cycles; its view transform gives the .png. built: the structures
    of the active instances, where they are there.
    Raises Cancelled, and saves nothing, where cancelled() says so.
    """
    from ....core.accel.blas import BlasCache
    from ....core.accel.embree import shared_device
    from ....core.accel.tlas import Tlas
    from ....core.culling.result import Built
    from ....core.tracing.tracer import prepare, trace

    blender_scene = bpy.context.scene
    start = time.perf_counter()
    if built is None:
        blas = BlasCache(scene.meshes, shared_device(threads))
        blas.need(scene.instances.mesh[active])
        built = Built(blas, Tlas(scene.instances, blas, active), prepare(scene, blas))
    prepared, tlas = built.prepared.with_emitters(active), built.tlas
    picture = trace(
        prepared,
        tlas,
        samples or samples_of(blender_scene, "path"),
        seed=seed,
        threads=threads,
        progress=progress,
        cancelled=cancelled,
    )
    if cancelled is not None and cancelled():
        raise Cancelled
    seconds = time.perf_counter() - start
    with muted():
        save_pixels(picture.mean, blender_scene, stem)
    return seconds
