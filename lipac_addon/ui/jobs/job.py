"""A job beside Blender, and the one that runs. A modal operator steps it by a timer, scripts and tests in a loop."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Generator, Iterator
from typing import ClassVar, TypeVar

import bpy

from ....core.errors import Cancelled, InputError
from ....core.progress import Pace
from ..state import kernel_folder, session

LOOK = 0.5  # seconds between looks at how many kernels are compiled


class Job:
    """Work for a scene that takes long: `_work` does it in small steps on the main thread, and waits for threads and
    other processes in between.

    progress: 0 to 1; message: what is being done; note: what the user may want to know meanwhile; error: why it ended
    without a result, "" where it did not; done: it has ended; cancelled: it was asked to. compiled: kernels that were
    compiled meanwhile, which takes a minute, once.
    """

    CANCELLED: ClassVar[str]
    FAILED: ClassVar[str]  # what the user is told of an error of ours

    def __init__(self, scene: bpy.types.Scene, message: str) -> None:
        self.progress, self.message, self.note, self.error = 0.0, message, "", ""
        self.done = self.cancelled = False
        self.compiled, self._kernels, self._looked = 0, kernel_folder.count(), time.monotonic()
        self._uid = scene.session_uid
        self._pace = Pace(time.monotonic())
        self._steps = self._work()

    @property
    def line(self) -> str:
        """What is being done, the time that was spent and, where it can be told, the time left."""
        fraction = self.progress or math.nan  # loading and reading tell nothing of how long the rest takes
        return f"{self.message} ({self._pace.words(fraction, time.monotonic())})"

    def _work(self) -> Generator[None, None, None]:
        """The steps. Raises Cancelled, InputError and OSError for the user to read."""
        raise NotImplementedError

    def step(self) -> bool:
        """Do a little; False when all is done, failed or cancelled."""
        if self.done:
            return False
        if time.monotonic() - self._looked > LOOK:
            self.compiled, self._looked = kernel_folder.count() - self._kernels, time.monotonic()
        try:
            next(self._steps)
        except StopIteration:
            self._end("")
        except Cancelled:
            self._end(self.CANCELLED)
        except (InputError, OSError) as error:
            self._end(str(error))
        except BaseException:
            self._end(self.FAILED)
            raise
        return not self.done

    def run(self) -> None:
        """Step to the end, without an event loop."""
        while self.step():
            time.sleep(0.001)

    def cancel(self) -> None:
        """Ask to stop: `step` returns False soon after."""
        self.cancelled = True

    def close(self) -> None:
        """Stop at once: returns when threads and other processes have ended."""
        self.cancelled = self.done = True
        self._steps.close()

    def _end(self, error: str) -> None:
        self.done, self.error = True, error

    def _check(self) -> None:
        if self.cancelled:
            raise Cancelled

    def _scene(self) -> bpy.types.Scene:
        """The scene. Raises InputError where it is gone."""
        scene = session.find_scene(self._uid)
        if scene is None:
            raise InputError(session.GONE)
        return scene

    def _no_render(self) -> Iterator[None]:
        """Wait for the end of a render: Blender cannot start another inside it, nor may what it shows change."""
        while session.is_rendering():
            self._check()
            yield

    def _render_ended(self) -> Iterator[None]:
        """The same for a job that ends, cancelled or not."""
        while session.is_rendering():
            yield


J = TypeVar("J", bound=Job)
running: Job | None = None  # or the one that ran last, for what it said


def start(new: Callable[[], J]) -> J:
    """Make the one job that the panel shows. Raises InputError where one is running."""
    global running  # noqa: PLW0603
    if is_running():
        raise InputError("an analysis is running: wait, or cancel it")
    running = made = new()
    return made


def stop() -> None:
    """End a running job and forget it."""
    global running  # noqa: PLW0603
    if running is not None:
        running.close()
    running = None


def cancel() -> None:
    """Ask the running job to stop."""
    if running is not None:
        running.cancel()


def is_running() -> bool:
    """Whether a job is under way."""
    return running is not None and not running.done
