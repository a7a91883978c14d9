"""Work beside Blender: a thread computes, and the main thread loads for it what only it may read.

Blender's Python may be used on the main thread alone, while an analysis loads meshes when light paths ask for them. So
the thread gets `AskedMeshes`, which hand each request to the main thread and wait, and `in_thread` serves them, a
little at each step.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Generator, Sequence
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Any, TypeVar

from ....core.errors import Cancelled

if TYPE_CHECKING:
    from ....core.scene.mesh import Mesh

BUDGET = 0.02  # seconds of the main thread that a step may take to serve the thread
_WAIT = 0.002  # for the next mesh, once one was asked for
T = TypeVar("T")


class AskedMeshes(Sequence["Mesh"]):
    """Meshes for a thread: each item is loaded by the main thread, when it calls `serve`."""

    def __init__(self, meshes: Sequence[Mesh]) -> None:
        self._meshes = meshes
        self._wanted: SimpleQueue[tuple[int, SimpleQueue[Any]]] = SimpleQueue()
        self._closed = False

    def __len__(self) -> int:
        return len(self._meshes)

    def __getitem__(self, index: Any) -> Any:
        """Called by the thread. Raises Cancelled after `close`."""
        if self._closed:
            raise Cancelled
        answer: SimpleQueue[Any] = SimpleQueue()
        self._wanted.put((index, answer))
        mesh = answer.get()
        if isinstance(mesh, BaseException):
            raise mesh
        return mesh

    def serve(self, seconds: float) -> None:
        """Load what is asked for, and what is asked for next, for about so long; called by the main thread. Returns at
        once where nothing is."""
        end, wait = time.monotonic() + seconds, 0.0
        while (left := end - time.monotonic()) > 0:
            try:
                index, answer = self._wanted.get(wait > 0, min(wait, left))
            except Empty:
                return
            try:
                answer.put(Cancelled() if self._closed else self._meshes[index])
            except Exception as error:
                answer.put(error)
            wait = _WAIT

    def close(self) -> None:
        """Answer no more; called by the main thread, which goes on to serve until the thread has ended."""
        self._closed = True


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
