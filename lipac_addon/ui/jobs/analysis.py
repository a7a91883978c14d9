"""An analysis beside Blender: it reads the file on the main thread, frame by frame, and computes in a thread
(`background`)."""

from __future__ import annotations

import time
from collections.abc import Generator, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import bpy

from ....core.errors import InputError
from ... import roles
from ...depsgraph import rendered_layers
from ...keys import any_of
from ..state import applying, asking, props, results, scatters, session, topology
from . import engine
from .background import for_thread, in_thread
from .certifying import certify
from .job import Job

if TYPE_CHECKING:
    from ....core.arrays import Records
    from ....core.culling.shot import Shot
    from ...extract import Extraction, Extractor
    from ...extract.graph import GraphReader
    from ...extract.graph_items import Node
    from .certifying import Asked


ATTEMPTS = 2  # at a frame whose memory is limited: Blender itself may have grown by the first one
LOST = "Nothing is hidden from renders any more"


def obstacle(scene: bpy.types.Scene) -> str:
    """Why a scene cannot be analysed now, "" where it can."""
    if scene.library is not None:
        return "The scene is linked from another file: analyze it there"
    if scene.render.use_multiview:
        return applying.MULTI_VIEW
    if any(other.lipac.applied for other in bpy.data.scenes if other != scene):
        return "Restore first: what was culled for another scene is hidden in this one, too"
    return "Leave Edit Mode first: the analysis cannot see what is edited" if session.is_edited() else ""


class AnalysisJob(Job):
    """The analysis of some frames of a scene.

    results: by frame, in the end; was_applied: something was hidden before, by this scene's result or whatever, so that
    all had to be shown: what the scene had applied is applied anew, but where nothing is known of its frame, and what
    others had is not: lost.
    baked: instances that some frame needs, and of all; objects at coarser levels of detail.
    """

    CANCELLED = "the analysis was cancelled"
    FAILED = "the analysis failed; see the console"

    def __init__(self, scene: bpy.types.Scene, frames: Sequence[int] | None = None, bake: bool = False) -> None:
        """frames: None takes those that the scene's settings ask for. bake: apply one set for all of them. Raises
        InputError where there is an obstacle."""
        super().__init__(scene, "starting")
        if obstacle(scene):
            raise InputError(obstacle(scene))
        self.results: dict[int, results.FrameResult] = {}
        self.was_applied = self.lost = False
        self.baked: tuple[int, int, int] | None = None
        self._bake, self._applied = bake, False
        self._independent = bake or props.own_levels(scene.lipac) or props.memory_limit(scene.lipac) > 0
        self._before: applying.Applied | None = None
        self._set_frame = scene.frame_current
        # these two go from frame to frame: what did not change is not analysed again
        self._extractor: Extractor | None = None
        self._shot: Shot | None = None
        self._frames = tuple(frames) if frames is not None else props.asked_frames(scene)
        self._range = props.frame_range(scene)

    def _work(self) -> Generator[None, None, None]:
        self.message = engine.LOADING
        yield
        yield from engine.load(self.cancel, kernels=props.memory_limit(self._scene().lipac) > 0)
        yield from self._no_render()
        self._check()
        scene = self._scene()
        # by parts, where no frame begins with the last one's, for which meshes would have to be whole again
        self._options = props.cull_options(scene.lipac, parts=self._independent or len(self._frames) == 1)
        asking.check(scene, self._options, self._bake)
        frame = scene.frame_current, scene.frame_subframe
        self._applied, self._before = scene.lipac.applied, applying.what_is_applied()
        self.was_applied = applying.restore()
        try:
            self.results = yield from self._analyse_all()
        except Exception:
            yield from self._render_ended()
            raise
        else:
            yield from self._render_ended()
        finally:
            self._finish(frame)
        self.progress, self.message = 1.0, "done"

    def _finish(self, frame: tuple[int, float]) -> None:
        """Keep the results, go back to the frame that was current, if the user has not gone to another, and cull
        renders again where they were before.

        frame: with its subframe.
        """
        self._extractor = self._shot = None
        self.results = asking.ended(self.results)
        scene = session.find_scene(self._uid)
        if scene is None:
            return
        if self.results:
            results.put(scene, self.results)
        if scene.frame_current == self._set_frame and (scene.frame_current, scene.frame_subframe) != frame:
            scene.frame_set(frame[0], subframe=frame[1])
        result = results.of(scene).get(frame[0])
        if self._bake and self.results:
            shot = results.union(self.results.values())
            done = applying.apply(scene, shot, frames=self._range)
            self.baked = int((~shot.culled).sum()), len(shot.culled), done.simplified
        elif self._before is not None and not self.results:
            applying.apply_again(self._before)
        elif self._applied and result is not None:
            applying.apply(scene, result)
        else:
            self.lost = self.was_applied

    def _end(self, error: str) -> None:
        super()._end(f"{error}. {LOST}" if error and self.lost else error)

    def _analyse_all(self) -> Generator[None, None, dict[int, results.FrameResult]]:
        """All frames, one after another."""
        found = {}
        try:
            for k, number in enumerate(self._frames):
                found[number] = yield from self._analyse(number, k)
            if self._bake and len(found) > 1:
                yield from certify(found, self._frames, self._options, self._analyse)
        except MemoryError as error:
            raise InputError("the analysis ran out of memory: raise the error budget, or simplify the scene") from error
        return found

    def _analyse(
        self, number: int, k: int, how: Asked | None = None, doing: str = ""
    ) -> Generator[None, None, results.FrameResult]:
        """A frame. how: what is done in it, by what was extracted and its uids; by default it decides. doing: what that
        is, in words."""
        from ....core.culling.analysis import decide
        from ....core.culling.shot import Shot
        from ...extract.shutter import of_more_steps

        n = len(self._frames)
        name = f"frame {number}: " if n > 1 else ""
        self.message = f"{name}reading the scene"
        yield
        yield from self._no_render()
        while session.is_edited():
            self.message = f"{name}waiting for the end of Edit Mode"
            self._check()
            yield
        scene, self._set_frame = self._scene(), number
        extraction, options = self._extract(scene, number), self._options
        shot = self._shot = self._shot or Shot(options, independent=self._independent)
        needed = yield from self._exposed(shot, extraction, number, how)
        if needed:
            extraction = self._extract(scene, number)
        uids = results.session_uids(extraction.keys)
        pinned = props.pinned(extraction.keys, uids)
        if needed:
            steps = roles.instances_of(extraction.keys, of_more_steps(extraction.keys))
            pinned = any_of(extraction.keys.records, needed) | steps | (False if pinned is None else pinned)
        hosts = [
            uid for name, uid in zip(extraction.keys.names, uids.tolist(), strict=True) if name in extraction.scatters
        ]
        prints = scatters.prints_of(scene, hosts)
        at, step = scene.frame_float, decide if how is None else how(extraction, uids)
        forms = asking.forms_of(extraction, uids, options)

        def report(fraction: float, what: str) -> None:
            self.progress, self.message = (k + fraction) / n, name + (doing or what)

        for _ in range(ATTEMPTS):
            looked_at, stays = asking.asked(extraction, uids, options, self._scene(), pinned)
            seen, meshes = for_thread(looked_at, self._uid, at)
            advance = partial(shot.advance, seen, extraction.change, report, lambda: self.cancelled, stays, step)
            result = yield from in_thread(advance, self.cancel, meshes)
            self._check()
            if options.memory:  # what was built is gone when Blender renders
                shot.forget()
                result = replace(result, built=None)
            found = results.FrameResult.of(number, extraction, uids, result, pinned)
            found = asking.weighed(found, extraction, result, options, self._scene())
            if not asking.exceeds(found, options):
                break
        shapes = topology.digests_of(found.faces)
        return replace(found, prints=prints, shapes=shapes, forms=forms, futile=self.note)

    def _exposed(
        self, shot: Shot, extraction: Extraction, number: int, how: Asked | None
    ) -> Generator[None, None, list[Records]]:
        """Keys of what the frame needs at other moments of its exposure, a part for each. how: as of `_analyse`."""
        from ....core.culling.analysis import decide
        from ...batch.session import of_one_picture
        from ...extract.shutter import Passing

        needed, passing = [], Passing()
        passing.add(0.0, extraction.keys, extraction.scene)
        for moment in extraction.moments:
            assert self._extractor is not None
            other = self._extractor.frame(number, keep=False, at=moment)
            passing.add(moment, other.keys, other.scene)
            other = replace(other, scene=of_one_picture(other, False))
            (seen, meshes), change = for_thread(other.scene, self._uid, 0.0), other.change
            step = decide if how is None else how(other, results.session_uids(other.keys))
            advance = partial(shot.advance, seen, change, cancelled=lambda: self.cancelled, how=step)
            result = yield from in_thread(advance, self.cancel, meshes)
            self._check()
            needed.append(other.keys.records[result.active])
        return [*needed, *passing.found()] if needed else []

    def _extract(self, scene: bpy.types.Scene, number: int) -> Extraction:
        """What a render sees of the frame."""
        from ...batch.session import of_one_picture
        from ...extract import Extractor

        self._extractor = self._extractor or Extractor(scene)
        self._extractor.follow(scene)
        self.note = ""
        layers = rendered_layers(scene)
        known = len(layers) == 1 and asking.may_be_futile(scene, self._options)
        look = partial(self._weigh, time.perf_counter()) if known else None
        extraction = self._extractor.frame(number, keep=False, look=look)
        extraction = replace(extraction, scene=of_one_picture(extraction, len(layers) == 1))
        if len(layers) > 1:
            line = f"only view layer '{layers[0]}' was analysed: what others alone show may be culled"
            extraction = replace(extraction, warnings=(*extraction.warnings, line))
        return extraction

    def _weigh(self, start: float, reader: GraphReader, nodes: Sequence[Node]) -> None:
        """Note where culling can save less than the analysis takes: here it was asked for. start:
        `time.perf_counter()` when the frame was begun."""
        spent = time.perf_counter() - start
        self.note = asking.futile(reader, nodes, self._scene(), self._options, len(self._frames), spent)
