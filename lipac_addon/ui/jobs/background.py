"""Work beside Blender: a thread computes, and the main thread loads for it what only it may read.

Blender's Python may be used on the main thread alone, while an analysis loads meshes when light paths ask for them. So
the thread gets `AskedMeshes`, which hand each request to the main thread and wait, and `in_thread` serves them, a
little at each step.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Any, TypeVar

from ....core.errors import Cancelled, InputError
from ...depsgraph import go_to
from ..state import session

if TYPE_CHECKING:
    from ....core.arrays import I64
    from ....core.scene.mesh import Mesh
    from ....core.scene.model import Scene
    from ...extract.geometry.coarser import EvaluatedCoarser

BUDGET = 0.02  # seconds of the main thread that a step may take to serve the thread
_WAIT = 0.002  # for the next mesh, once one was asked for
T = TypeVar("T")
# Work, where its result or error goes, and whether Blender evaluates the scene for it
_Wish = tuple[Callable[[], Any], "SimpleQueue[tuple[Any, BaseException | None]]", bool]


class AskedMeshes(Sequence["Mesh"]):
    """Meshes for a thread: each item is loaded by the main thread, when it calls `serve`; so is whatever else the
    thread asks for."""

    def __init__(self, meshes: Sequence[Mesh]) -> None:
        self._meshes = meshes
        self._wanted: SimpleQueue[_Wish] = SimpleQueue()
        self._waits: _Wish | None = None  # for the user's render, or Edit Mode, to end
        self._closed = False

    def __len__(self) -> int:
        return len(self._meshes)

    def __getitem__(self, index: Any) -> Any:
        """Called by the thread. Raises Cancelled after `close`."""
        return self.ask(partial(self._meshes.__getitem__, index))

    def ask(self, work: Callable[[], T], evaluates: bool = False) -> T:
        """What the main thread returns, or raises, that does some work; called by the thread. evaluates: Blender
        evaluates the scene for it, which it cannot within a render, nor all of what is edited. Raises Cancelled after
        `close`."""
        if self._closed:
            raise Cancelled
        answer: SimpleQueue[tuple[Any, BaseException | None]] = SimpleQueue()
        self._wanted.put((work, answer, evaluates))
        value, error = answer.get()
        if error is not None:
            raise error
        return value  # type: ignore[no-any-return]

    def serve(self, seconds: float) -> None:
        """Do what is asked for, and what is asked for next, for about so long; called by the main thread. Returns at
        once where nothing is."""
        end, wait = time.monotonic() + seconds, 0.0
        while (left := end - time.monotonic()) > 0:
            wish, self._waits = self._waits, None
            try:
                work, answer, evaluates = wish or self._wanted.get(wait > 0, min(wait, left))
            except Empty:
                return
            if evaluates and not self._closed and (session.is_rendering() or session.is_edited()):
                self._waits = work, answer, evaluates
                return
            try:
                answer.put((None, Cancelled()) if self._closed else (work(), None))
            except Exception as error:
                answer.put((None, error))
            wait = _WAIT

    def close(self) -> None:
        """Answer no more; called by the main thread, which goes on to serve until the thread has ended."""
        self._closed = True


class AskedCoarser:
    """`core.scene.mesh.CoarserMeshes` for a thread: the main one has Blender evaluate a scene at a frame for them,
    wherever the user has gone meanwhile."""

    def __init__(self, meshes: AskedMeshes, coarser: EvaluatedCoarser, uid: int, frame: float) -> None:
        """uid: of the scene."""
        self.steps: I64 = coarser.steps
        self._meshes, self._coarser, self._uid, self._frame = meshes, coarser, uid, frame

    def read(self, meshes: Sequence[int]) -> Mapping[int, Sequence[Mesh]]:
        """As `CoarserMeshes`."""
        return self._meshes.ask(partial(self._evaluated, lambda coarser: coarser.read(meshes)), evaluates=True)

    def at(self, steps: Mapping[int, int]) -> Mapping[int, Mesh]:
        """As `CoarserMeshes`."""
        return self._meshes.ask(partial(self._evaluated, lambda coarser: coarser.at(steps)), evaluates=True)

    def _evaluated(self, work: Callable[[EvaluatedCoarser], T]) -> T:
        scene = session.find_scene(self._uid)
        if scene is None:
            raise InputError(session.GONE)
        own = scene.frame_float
        go_to(scene, self._frame)
        try:
            return work(self._coarser.of(scene))
        finally:
            go_to(scene, own)


def for_thread(scene: Scene, uid: int, frame: float) -> tuple[Scene, AskedMeshes]:
    """An extracted frame for a thread, and what the main thread serves it by. uid: of the scene in Blender."""
    meshes = AskedMeshes(scene.meshes)
    coarser: Any = scene.coarser
    return replace(scene, meshes=meshes, coarser=coarser and AskedCoarser(meshes, coarser, uid, frame)), meshes


def in_thread(
    work: Callable[[], T], cancel: Callable[[], None], meshes: AskedMeshes | None = None, budget: float = BUDGET
) -> Generator[None, None, T]:
    """A generator that has a thread do the work, serves its meshes meanwhile for up to budget seconds a step, and
    returns or raises what it returned or raised.

    When the generator is closed, cancel() is called, and it waits until the thread has ended.
    """
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
                meshes.serve(budget)
            yield
    finally:  # also when the generator is closed
        if meshes is not None:
            meshes.close()
        while thread.is_alive():
            cancel()
            if meshes is not None:
                meshes.serve(_WAIT)
            thread.join(_WAIT)
    value, error = outcome[0]
    if error is not None:
        raise error
    return value
