"""What goes from frame to frame: Blender in, and the decision which instances stay."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ...core.culling.options import CullOptions, State
from ...core.culling.policies import LIGHT_PATHS
from ...core.progress import Progress, part, silent
from ...core.scene.bounds import existing
from ...core.scene.model import RAY_TYPES, Scene
from ...core.warmup import load_ahead, not_needed
from .. import roles, writeback
from ..console import muted
from ..depsgraph import rendered_layers
from ..extract import Extraction, Extractor
from ..extract.geometry.coarser import EvaluatedCoarser
from ..extract.shutter import Passing, in_between, of_more_steps
from ..keys import any_of
from ..memory.limit import PROCESS, limited
from ..memory.stakes import NothingToWin, stakes_of
from .engines.choices import BLENDER_ENGINES, ENGINES
from .engines.wishes import samples_of
from .job import Cancel, Job, never

if TYPE_CHECKING:
    from ...core.culling.result import CullingResult
    from ...core.culling.shot import How, Shot
    from ..extract.graph import GraphReader
    from ..extract.graph_items import Node

Decide = Callable[["Session", Extraction, Progress, Cancel], "CullingResult"]


class Session:
    """What goes from frame to frame of a job, for one view layer: the extractor, and the loop."""

    def __init__(self, job: Job, layer: str | None = None, keep: bool = True) -> None:
        """layer: name, None takes the first that renders. keep: hold Blender's graph from frame to frame, where that
        pays: one at a time can."""
        self.job, self.layer = job, layer
        renders = bool(job.engine) and ENGINES[job.engine].uses_blender
        self.alone = keep
        # Blender evaluates once more for meshes with fewer triangles, which another graph would come in between
        self.keep = keep and not renders and len(job.frames) > 1 and not job.options.levels
        self._extractor: Extractor | None = None
        self._shot: Shot | None = None
        self._pinned: NDArray[np.bool_] | None = None  # what the frame needs at other moments of its exposure

    def __enter__(self) -> Session:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def forget(self) -> None:
        """Let go of the loop, and what it has built."""
        self._shot = None

    def close(self) -> None:
        """Let go of everything, in Blender too."""
        self.forget()
        if self._extractor is not None:
            with muted():
                self._extractor.release()
            self._extractor = None
        gc.collect()

    def sync(self, frame: int) -> tuple[Extraction, dict[str, Any]]:
        """Extract a frame of the open file with nothing culled; the second value is the frame's entry for the report so
        far. Raises NothingToWin where the job asks for it."""
        start = time.perf_counter()
        with muted():
            writeback.restore()
            whole = self.job.engine in ("", *BLENDER_ENGINES)
            self._extractor = self._extractor or Extractor(bpy.context.scene, self.layer, whole=whole)
            look = partial(self._weigh, start) if self.job.if_it_pays and self.alone else None
            extraction = replace(self._extractor.frame(frame, self.keep, look=look), scatters={})
        self._pinned = None
        return extraction, {"frame": frame, "sync_s": time.perf_counter() - start}

    def _weigh(self, start: float, reader: GraphReader, nodes: Sequence[Node]) -> None:
        """Raise NothingToWin where that is so; else what decides is wanted soon. start: `time.perf_counter()` when the
        frame was begun."""
        job, scene = self.job, bpy.context.scene
        spent, samples = time.perf_counter() - start, job.samples or samples_of(scene, job.engine)
        stakes = stakes_of(reader, nodes, scene, job.options, samples, len(job.frames), spent)
        if stakes is not None and stakes.nothing_to_win:
            not_needed()
            raise NothingToWin(stakes, time.perf_counter() - start)
        load_ahead()

    def expose(
        self,
        extraction: Extraction,
        frame: int,
        progress: Progress = silent,
        cancelled: Cancel = never,
        decide: Decide | None = None,
    ) -> Extraction:
        """Find out what a frame needs while its shutter is open and things are elsewhere: it stays, whatever the
        frame's own moment needs. decide: of each moment, by default `self.decide`. Returns the frame as it is,
        extracted anew where there was anything to find out."""
        if not extraction.moments or self._extractor is None:
            return extraction
        needed, passing = [], Passing()
        passing.add(0.0, extraction.keys, extraction.scene)
        for k, moment in enumerate(extraction.moments):
            with muted():
                other = self._extractor.frame(frame, True, moment)
            passing.add(moment, other.keys, other.scene)
            within = part(
                progress, k / len(extraction.moments), (k + 1) / len(extraction.moments), f"{moment:+.2g} frames: "
            )
            needed.append(other.keys.records[(decide or Session.decided)(self, other, within, cancelled).active])
        with muted():
            extraction = replace(self._extractor.frame(frame, self.keep), scatters={})
        keys = extraction.keys
        fast = any_of(keys.records, passing.found()) | roles.instances_of(keys, of_more_steps(keys))
        self._pinned = any_of(keys.records, needed) | fast
        if fast.any():
            extraction = replace(extraction, warnings=(*extraction.warnings, in_between(int(fast.sum()))))
        return extraction

    def limit_memory(self, extraction: Extraction) -> Extraction:
        """Where the render's memory is limited: the frame that was extracted with what its render takes. What cannot be
        taken away is pinned."""
        if not self.job.options.memory:
            return extraction
        scene, stays = limited(extraction, bpy.context.scene, self.job.process or PROCESS)
        self._pinned = _either(self._pinned, stays)
        return replace(extraction, scene=scene)

    def end_reading(self) -> None:
        """No frame follows: let go of what would tell it from the last one. Meshes of that can still be read."""
        if not self.keep:
            self._extractor = None

    def decide(
        self,
        extraction: Extraction,
        scene: Scene | None = None,
        progress: Progress = silent,
        cancelled: Cancel = never,
        how: How | None = None,
    ) -> CullingResult:
        """Which instances of the frame that was extracted last stay. scene: what to look at in its place, with the same
        instances and meshes. how: as in `Shot.advance`, by default it decides."""
        from ...core.culling.analysis import decide
        from ...core.culling.shot import Shot

        pinned = _either(self._pinned, roles.untouched(extraction.keys))
        if self.job.options.policy != LIGHT_PATHS and self.job.engine in BLENDER_ENGINES:
            return _by_rule(extraction.scene, self.job.options, pinned)
        if self._shot is None:
            self._shot = Shot(self.job.options, independent=not self.job.warm)
        scene = of_one_picture(extraction, self.alone, scene)
        result = self._shot.advance(scene, extraction.change, progress, cancelled, pinned, how or decide)
        return with_levels_that_stay(result, scene) if self.job.options.levels else result

    def decided(self, extraction: Extraction, progress: Progress, cancelled: Cancel) -> CullingResult:
        """As `decide`, of the frame as it is."""
        return self.decide(extraction, None, progress, cancelled)


def of_one_picture(extraction: Extraction, alone: bool, scene: Scene | None = None) -> Scene:
    """What is looked at of an extracted frame: simplified meshes are judged by one moment of one picture, and there are
    none where there are more of these. alone: one view layer renders. scene: as of `Session.decide`."""
    scene = scene or extraction.scene
    return replace(scene, simplifiable=None, coarser=None) if extraction.moments or not alone else scene


def with_levels_that_stay(result: CullingResult, scene: Scene) -> CullingResult:
    """A result that says of what stays of a scene which meshes keep levels of subdivision, and why."""
    if not isinstance(scene.coarser, EvaluatedCoarser):
        return result
    lines = scene.coarser.kept(scene.instances.mesh[result.active])
    return replace(result, warnings=(*result.warnings, *lines))


def _either(a: NDArray[np.bool_] | None, b: NDArray[np.bool_] | None) -> NDArray[np.bool_] | None:
    """What one of two masks names, where there is any."""
    return b if a is None else a if b is None else a | b


def _by_rule(scene: Scene, options: CullOptions, pinned: np.ndarray | None) -> CullingResult:
    """What a policy without light paths keeps, and pinned, (N,) bool. No mesh need be read for it: the engine builds
    its own structures."""
    from ...core.culling.result import CullingResult

    start = time.perf_counter()
    keep = options.rule(scene) & existing(scene.instances.bounds)
    for stays in (pinned, scene.stays):
        keep |= False if stays is None else stays
    n, active = len(keep), int(np.count_nonzero(keep))
    meshes = len(np.unique(scene.instances.mesh[keep]))
    stats = {
        "instances": n,
        "active": active,
        "pending": 0,
        "culled": n - active,
        "meshes": meshes,
        "feedback_s": time.perf_counter() - start,
    }
    nothing = np.zeros(n, np.float32), np.zeros((n, RAY_TYPES), np.int64), np.zeros((0, 2, 3), np.float32)
    return CullingResult(np.where(keep, np.uint8(State.ACTIVE), np.uint8(State.CULLED)), *nothing, stats)


def sessions_of(job: Job) -> list[Session]:
    """One for each view layer that the job's engine renders."""
    layers = rendered_layers(bpy.context.scene) if job.engine in ("", *BLENDER_ENGINES) else ()
    return [Session(job, layer, keep=len(layers) == 1) for layer in layers] or [Session(job)]
