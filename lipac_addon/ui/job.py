"""An analysis beside Blender: it reads the file on the main thread, a little at a time, and computes in a thread (`background`).

A modal operator steps it by a timer, scripts and tests in a loop.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, TypeVar

import bpy

from ...core.errors import Cancelled, InputError
from . import applying, preferences, props, results, scatters
from .background import AskedMeshes, in_thread
from .wheels import REINSTALL

if TYPE_CHECKING:
    from ...core.frames import Shot
    from ..extract import Extraction, Extractor
    from .difference import DifferenceJob

J = TypeVar("J", bound="AnalysisJob | DifferenceJob")


LOOK = 0.5  # seconds between looks at how many kernels are compiled


class AnalysisJob:
    """The analysis of some frames of a scene.

    progress: 0 to 1; message: what is being done; error: why it ended without a result, "" where it did not; results: by frame, in the end.
    compiled: kernels that were compiled meanwhile, which takes a minute, once.
    """

    def __init__(self, scene: bpy.types.Scene, frames: Sequence[int] | None = None, bake: bool = False) -> None:
        """frames: None takes those that the scene's settings ask for. bake: apply one set for all of them."""
        self.progress, self.message, self.error = 0.0, "starting", ""
        self.results: dict[int, results.FrameResult] = {}
        self.done = self.cancelled = self.was_applied = False
        self.compiled, self._kernels, self._looked = 0, preferences.compiled_kernels(), time.monotonic()
        self.baked: tuple[int, int] | None = None  # instances that some frame needs, and of all
        self._bake = bake
        self._uid = scene.session_uid
        self._extractor: Extractor | None = None  # these two go from frame to frame: what did not change is not analysed again
        self._shot: Shot | None = None
        self._frames = tuple(frames) if frames is not None else asked_frames(scene)
        self._steps = self._run()

    def step(self) -> bool:
        """Do a little on the main thread; False when all is done, failed or cancelled."""
        if self.done:
            return False
        if time.monotonic() - self._looked > LOOK:
            self.compiled, self._looked = preferences.compiled_kernels() - self._kernels, time.monotonic()
        try:
            next(self._steps)
        except StopIteration:
            self.done = True
        except Cancelled:
            self.done, self.error = True, "the analysis was cancelled"
        except InputError as error:
            self.done, self.error = True, str(error)
        except MemoryError:
            self.done, self.error = True, "the analysis ran out of memory: raise the error budget, or simplify the scene"
        except (ImportError, OSError) as error:
            self.done, self.error = True, f"LiPaC's libraries cannot be loaded ({error}): {REINSTALL}"
        except BaseException:
            self.done, self.error = True, "the analysis failed; see the console"
            raise
        return not self.done

    def cancel(self) -> None:
        """Ask to stop: `step` returns False soon after."""
        self.cancelled = True

    def run(self) -> None:
        """Step to the end, without an event loop."""
        while self.step():
            time.sleep(0.001)

    def _run(self) -> Iterator[None]:
        self.message = "loading; the first time, kernels are compiled, which takes a minute"
        yield
        yield from self._in_thread(_load_engine)
        scene = self._scene()
        frame, self.was_applied = scene.frame_current, scene.lipac.applied
        if self.was_applied:
            applying.restore()
        try:
            for k, number in enumerate(self._frames):
                self.results[number] = yield from self._analyse(number, k)
        except BaseException:
            self.results = {}
            raise
        finally:
            self._finish(frame)
        self.progress, self.message = 1.0, "done"

    def _finish(self, frame: int) -> None:
        """Keep the results, go back to the frame that was current, and cull renders again where they were culled before."""
        self._extractor = self._shot = None  # their memory
        scene = find_scene(self._uid)
        if scene is None:
            return
        if self.results:
            results.put(scene, self.results)
        if scene.frame_current != frame:
            scene.frame_set(frame)
        result = results.at(scene)
        if self._bake and self.results:
            shot = results.union(self.results.values())
            applying.apply(scene, shot)
            self.baked = int((~shot.culled).sum()), len(shot.culled)
        elif self.was_applied and result is not None:
            applying.apply(scene, result)

    def _analyse(self, number: int, k: int) -> Generator[None, None, results.FrameResult]:
        """A frame."""
        from ...core.frames import Shot

        n = len(self._frames)
        name = f"frame {number}: " if n > 1 else ""
        self.message = f"{name}reading the scene"
        yield
        while bpy.app.is_job_running("RENDER"):  # Blender cannot start a render inside a render
            self._check()
            yield
        scene = self._scene()
        extraction = self._extract(scene, number)
        uids = results.session_uids(extraction.keys)
        pinned = results.instances_of(extraction.keys, results.among(uids, props.marked(props.PIN)))
        hosts = [uid for name, uid in zip(extraction.keys.names, uids.tolist(), strict=True) if name in extraction.scatters]
        prints = scatters.prints_of(scene, hosts)
        shot = self._shot = self._shot or Shot(props.cull_options(scene.lipac))
        meshes = AskedMeshes(extraction.scene.meshes)

        def report(fraction: float, what: str) -> None:
            self.progress, self.message = (k + fraction) / n, name + what

        asked = replace(extraction.scene, meshes=meshes)
        result = yield from self._in_thread(lambda: shot.advance(asked, extraction.change, report, lambda: self.cancelled, pinned), meshes)
        return replace(results.FrameResult.of(number, extraction, uids, result), prints=prints)

    def _extract(self, scene: bpy.types.Scene, number: int) -> Extraction:
        """What a render sees of the frame."""
        from ..extract import Extractor

        self._extractor = self._extractor or Extractor(scene)
        self._extractor.follow(scene)
        layers = [layer.name for layer in scene.view_layers if layer.use]
        extraction = self._extractor.frame(number, keep=False)
        if len(layers) > 1:
            line = f"only view layer '{layers[0]}' was analysed: what others alone show may be culled"
            extraction = replace(extraction, warnings=(*extraction.warnings, line))
        return extraction

    def _in_thread(self, work: Callable[[], Any], meshes: AskedMeshes | None = None) -> Generator[None, None, Any]:
        """`in_thread`, until it is done or cancelled."""
        value = yield from in_thread(work, self.cancel, meshes)
        self._check()
        return value

    def close(self) -> None:
        """Stop at once: returns when the worker has ended."""
        self.cancelled = self.done = True
        self._steps.close()  # type: ignore[attr-defined]

    def _check(self) -> None:
        if self.cancelled:
            raise Cancelled

    def _scene(self) -> bpy.types.Scene:
        """The scene. Raises InputError where it is gone."""
        scene = find_scene(self._uid)
        if scene is None:
            raise InputError("the scene was removed while it was analysed")
        return scene


def find_scene(uid: int) -> bpy.types.Scene | None:
    """A scene by its session uid: undo makes new ones of everything, so references are not kept."""
    return next((s for s in bpy.data.scenes if s.session_uid == uid), None)


def asked_frames(scene: bpy.types.Scene) -> tuple[int, ...]:
    """Frames that the settings of a scene ask for."""
    return frame_range(scene) if scene.lipac.frames == props.RANGE else (scene.frame_current,)


def frame_range(scene: bpy.types.Scene) -> tuple[int, ...]:
    """The scene's frames, with its step."""
    return tuple(range(scene.frame_start, scene.frame_end + 1, scene.frame_step))


def _load_engine() -> None:
    """Import what the analysis needs: on another thread, for it takes seconds."""
    from ...core import frames  # noqa: F401


running: AnalysisJob | DifferenceJob | None = None


def start(new: Callable[[], J]) -> J:
    """Make the one job that the panel shows. Raises InputError where one is running."""
    global running  # noqa: PLW0603
    if is_running():
        raise InputError("an analysis is running; Esc cancels it")
    running = made = new()
    return made


def stop() -> None:
    """End a running analysis and forget it."""
    global running  # noqa: PLW0603
    if running is not None:
        running.close()
    running = None


def is_running() -> bool:
    """Whether an analysis is under way."""
    return running is not None and not running.done
