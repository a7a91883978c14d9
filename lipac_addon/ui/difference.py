"""What culling a frame saves and changes, measured: two renders of it, each by a Blender of its own, so that time and memory are those of one render alone.

The window stays usable meanwhile, and the file as it is: the two Blenders render copies, one of which has the culling applied.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Generator, Iterator
from dataclasses import dataclass
from pathlib import Path

import bpy
import numpy as np

from ...core.errors import Cancelled, InputError
from . import applying, job, results

IMAGE = "LiPaC Difference"
_CHILD = Path(__file__).with_name("child_render.py")
_NO_WINDOW = getattr(subprocess, "CREATE_NO_WINDOW", 0)  # Windows would open one
_FULL, _CULLED = "full", "culled"


@dataclass(frozen=True)
class Difference:
    """Seconds and peak bytes of the full and of the culled render; mean, worst: relative change of the picture's coarse tiles, noise included."""

    seconds: tuple[float, float]
    peak_bytes: tuple[int, int]
    mean: float
    worst: float


class DifferenceJob:
    """Measures the difference that the result of a scene's current frame makes. progress, message, error, compiled as of `AnalysisJob`."""

    def __init__(self, scene: bpy.types.Scene) -> None:
        """Raises InputError where the frame was not analysed."""
        result = results.at(scene)
        if result is None:
            raise InputError("analyze this frame first")
        self.progress, self.message, self.error = 0.0, "saving copies of the file", ""
        self.difference: Difference | None = None
        self.done = self.cancelled = False
        self.compiled = 0
        self._uid, self._result = scene.session_uid, result
        self._steps = self._run()

    def step(self) -> bool:
        """Look whether the renders go on; False when all is done, failed or cancelled."""
        try:
            next(self._steps)
        except StopIteration:
            self.done = True
        except Cancelled:
            self.done, self.error = True, "the renders were cancelled"
        except (InputError, OSError) as error:
            self.done, self.error = True, str(error)
        except BaseException:
            self.done, self.error = True, "measuring failed; see the console"
            raise
        return not self.done

    def cancel(self) -> None:
        """Ask to stop: `step` returns False soon after."""
        self.cancelled = True

    def run(self) -> None:
        """Step to the end, without an event loop."""
        while self.step():
            time.sleep(0.02)

    def close(self) -> None:
        """Stop at once."""
        self.cancelled = self.done = True
        self._steps.close()  # type: ignore[attr-defined]

    def _run(self) -> Iterator[None]:
        from ..pictures import read_picture

        yield
        scene = job.find_scene(self._uid)
        if scene is None:
            raise InputError("the scene was removed")
        with tempfile.TemporaryDirectory(prefix="lipac") as name:
            folder = Path(name)
            _save_copies(scene, self._result, folder)
            taken = []
            for k, what in enumerate((_FULL, _CULLED)):
                self.progress, self.message = k / 2, f"rendering frame {self._result.frame}, {what}"
                taken.append((yield from self._render(scene.name, folder, what)))
            pictures = [read_picture(folder / f"{what}.exr") for what in (_FULL, _CULLED)]
        self.difference = difference_of(pictures, taken)
        results.differences[self._uid, self._result.frame] = self.difference
        _show(pictures)
        self.progress, self.message = 1.0, "done"

    def _render(self, scene: str, folder: Path, what: str) -> Generator[None, None, dict[str, float]]:
        """Render a copy; returns what the child said."""
        program = [sys.executable] if bpy.app.module else [bpy.app.binary_path, "-b", "--python-exit-code", "1", "-P"]
        arguments = [str(folder / f"{what}.blend"), scene, str(self._result.frame), str(folder / f"{what}.exr")]
        with (folder / f"{what}.log").open("w+") as log:
            child = subprocess.Popen([*program, str(_CHILD), "--", *arguments], stdout=log, stderr=subprocess.STDOUT, creationflags=_NO_WINDOW)
            try:
                while child.poll() is None:
                    if self.cancelled:
                        raise Cancelled
                    yield
            finally:
                child.kill()
                child.wait()
            log.seek(0)
            said = [line for line in log if line.startswith("LIPAC ")]
            if child.returncode or not said:
                raise InputError(f"the {what} render failed: render the frame by F12 to see why")
        taken: dict[str, float] = json.loads(said[-1].removeprefix("LIPAC "))
        return taken


def _save_copies(scene: bpy.types.Scene, result: results.FrameResult, folder: Path) -> None:
    """full.blend and culled.blend; the open file is left as it is."""
    was_applied = any(s.lipac.applied for s in bpy.data.scenes)
    if was_applied:
        raise InputError("Restore first: the file is to be rendered in full, too")
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / f"{_FULL}.blend"), copy=True)
    try:
        applying.apply(scene, result)
        bpy.ops.wm.save_as_mainfile(filepath=str(folder / f"{_CULLED}.blend"), copy=True)
    finally:
        applying.restore()


def difference_of(pictures: list[np.ndarray], taken: list[dict[str, float]]) -> Difference:
    """From the full and the culled picture, (H, W, 4) float32, and what each child said."""
    from ...core.judge import picture_change

    mean, worst = picture_change(*pictures)
    (full_s, culled_s), (full_b, culled_b) = ([t[name] for t in taken] for name in ("seconds", "peak_bytes"))
    return Difference((full_s, culled_s), (int(full_b), int(culled_b)), mean, worst)


def _show(pictures: list[np.ndarray]) -> None:
    """The absolute difference as an image of the file, shown where an Image Editor is open."""
    height, width = pictures[0].shape[:2]
    image = bpy.data.images.get(IMAGE)
    if image is not None and tuple(image.size) != (width, height):
        bpy.data.images.remove(image)
        image = None
    image = image or bpy.data.images.new(IMAGE, width, height, float_buffer=True)
    pixels = np.ones((height, width, 4), np.float32)
    pixels[..., :3] = np.abs(pictures[1][..., :3] - pictures[0][..., :3])
    image.pixels.foreach_set(pixels.ravel())
    image.update()
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "IMAGE_EDITOR":
                area.spaces.active.image = image
