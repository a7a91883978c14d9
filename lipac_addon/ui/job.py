"""An analysis beside Blender: it reads the file on the main thread, a little at a time, and computes in a worker.

Blender's Python may be used on the main thread alone, while the analysis loads meshes when light paths ask for them. So the worker gets `AskedMeshes`, which
hand each request to the main thread and wait, and the job's `step` serves them. A modal operator steps it by a timer, scripts and tests in a loop.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Any, TypeVar

import bpy
import numpy as np

from ...core.errors import Cancelled, InputError
from . import applying, props, results
from .wheels import REINSTALL

if TYPE_CHECKING:
    from ...core.scene import Mesh
    from ..extract import Extraction

BUDGET = 0.02  # seconds of the main thread that a step may take to serve the worker
_WAIT = 0.002
T = TypeVar("T")


class AskedMeshes(Sequence["Mesh"]):
    """Meshes for a worker: each item is loaded by the main thread, when it calls `serve`."""

    def __init__(self, meshes: Sequence[Mesh]) -> None:
        self._meshes = meshes
        self._wanted: SimpleQueue[tuple[int, SimpleQueue[Any]]] = SimpleQueue()
        self._closed = False

    def __len__(self) -> int:
        return len(self._meshes)

    def __getitem__(self, index: Any) -> Any:
        """Called by the worker. Raises Cancelled after `close`."""
        if self._closed:
            raise Cancelled
        answer: SimpleQueue[Any] = SimpleQueue()
        self._wanted.put((index, answer))
        mesh = answer.get()
        if isinstance(mesh, BaseException):
            raise mesh
        return mesh

    def serve(self, seconds: float) -> None:
        """Load what is asked for, and what is asked for next, for about so long; called by the main thread."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            try:
                index, answer = self._wanted.get(timeout=min(_WAIT, left))
            except Empty:
                return
            try:
                answer.put(Cancelled() if self._closed else self._meshes[index])
            except Exception as error:
                answer.put(error)

    def close(self) -> None:
        """Answer no more; called by the main thread, which goes on to serve until the worker has ended."""
        self._closed = True


class AnalysisJob:
    """The analysis of some frames of a scene.

    progress: 0 to 1; message: what is being done; error: why it ended without a result, "" where it did not; results: by frame, in the end.
    """

    def __init__(self, scene: bpy.types.Scene, frames: Sequence[int] | None = None) -> None:
        """frames: None takes those that the scene's settings ask for."""
        self.progress, self.message, self.error = 0.0, "starting", ""
        self.results: dict[int, results.FrameResult] = {}
        self.done = self.cancelled = self.was_applied = False
        self._uid = scene.session_uid
        self._frames = tuple(frames) if frames is not None else asked_frames(scene)
        self._steps = self._run()

    def step(self) -> bool:
        """Do a little on the main thread; False when all is done, failed or cancelled."""
        if self.done:
            return False
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
        yield from self._in_worker(_load_engine)
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
        scene = find_scene(self._uid)
        if scene is None:
            return
        if self.results:
            results.put(scene, self.results)
        if scene.frame_current != frame:
            scene.frame_set(frame)
        result = results.at(scene)
        if self.was_applied and result is not None:
            applying.apply(scene, result)

    def _analyse(self, number: int, k: int) -> Any:
        """A frame; a generator like `_run` that returns its FrameResult."""
        from ...core.analysis import analyze

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
        pinned = results.instances_of(extraction.keys, _among(uids, props.marked(props.PIN)))
        options = props.cull_options(scene.lipac)
        meshes = AskedMeshes(extraction.scene.meshes)

        def report(fraction: float, what: str) -> None:
            self.progress, self.message = (k + fraction) / n, name + what

        result = yield from self._in_worker(
            lambda: analyze(replace(extraction.scene, meshes=meshes), options, report, lambda: self.cancelled, pinned), meshes
        )
        return results.FrameResult.of(number, extraction, uids, result)

    def _extract(self, scene: bpy.types.Scene, number: int) -> Extraction:
        """What a render sees of the frame."""
        from ..extract import extract_frame

        layers = [layer.name for layer in scene.view_layers if layer.use]
        extraction = extract_frame(scene, number)
        if len(layers) > 1:
            line = f"only view layer '{layers[0]}' was analysed: what others alone show may be culled"
            extraction = replace(extraction, warnings=(*extraction.warnings, line))
        return extraction

    def _in_worker(self, work: Callable[[], T], meshes: AskedMeshes | None = None) -> Any:
        """A generator that has a thread do the work, serves its meshes meanwhile, and returns or raises what it returned or raised."""
        outcome: list[Any] = []

        def body() -> None:
            try:
                outcome.append((work(), None))
            except BaseException as error:
                outcome.append((None, error))

        thread = threading.Thread(target=body, name="LiPaC analysis", daemon=True)
        thread.start()
        try:
            while thread.is_alive():
                if meshes is not None:
                    meshes.serve(BUDGET)
                yield
        finally:  # also when the generator is closed
            if meshes is not None:
                meshes.close()
            while thread.is_alive():
                self.cancelled = True
                if meshes is not None:
                    meshes.serve(_WAIT)
                thread.join(_WAIT)
        value, error = outcome[0]
        if error is not None:
            raise error
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
    if scene.lipac.frames == props.RANGE:
        return tuple(range(scene.frame_start, scene.frame_end + 1, scene.frame_step))
    return (scene.frame_current,)


def _among(uids: Any, objects: set[bpy.types.Object]) -> Any:
    wanted = {ob.session_uid for ob in objects}
    return np.array([int(uid) in wanted for uid in uids], bool)


def _load_engine() -> None:
    """Import what the analysis needs: on another thread, for it takes seconds."""
    from ...core import analysis  # noqa: F401


running: AnalysisJob | None = None


def start(scene: bpy.types.Scene, frames: Sequence[int] | None = None) -> AnalysisJob:
    """Make the one analysis that the panel shows. Raises InputError where one is running."""
    global running  # noqa: PLW0603
    if running is not None and not running.done:
        raise InputError("an analysis is running; Esc cancels it")
    running = AnalysisJob(scene, frames)
    return running


def stop() -> None:
    """End a running analysis and forget it."""
    global running  # noqa: PLW0603
    if running is not None:
        running.close()
    running = None


def is_running() -> bool:
    """Whether an analysis is under way."""
    return running is not None and not running.done
