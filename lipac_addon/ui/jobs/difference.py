"""What culling a frame saves and changes, measured: two renders of it, each by a Blender of its own, so that time and
memory are those of one render alone.

The window stays usable meanwhile, and the file as it is: the two Blenders render copies, one of which has the culling
applied.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Generator
from pathlib import Path

import bpy
import numpy as np

from ....core.errors import InputError
from ..state import applying, results
from ..state.results import Difference
from .job import Job

IMAGE = "LiPaC Difference"
_CHILD = Path(__file__).with_name("child_render.py")
_NO_WINDOW = getattr(subprocess, "CREATE_NO_WINDOW", 0)  # Windows would open one
_FULL, _CULLED = "full", "culled"


class DifferenceJob(Job):
    """Measures the difference that the result of a scene's current frame makes. difference: what was found, in the
    end."""

    CANCELLED = "the renders were cancelled"
    FAILED = "measuring failed; see the console"

    def __init__(self, scene: bpy.types.Scene) -> None:
        """Raises InputError where the frame was not analysed."""
        result = results.at(scene)
        if result is None:
            raise InputError("analyze this frame first")
        super().__init__(scene, "saving copies of the file")
        self.difference: Difference | None = None
        self._result = result

    def _work(self) -> Generator[None, None, None]:
        from ...pictures import read_picture

        yield
        yield from self._no_render()
        name = self._scene().name
        with tempfile.TemporaryDirectory(prefix="lipac") as place:
            folder = Path(place)
            _save_copies(self._scene(), self._result, folder)
            taken = []
            for k, what in enumerate((_FULL, _CULLED)):
                self.progress, self.message = k / 2, f"rendering frame {self._result.frame}, {what}"
                taken.append((yield from self._render(name, folder, what)))
            pictures = [read_picture(folder / f"{what}.exr") for what in (_FULL, _CULLED)]
        self.difference = difference_of(pictures, taken)
        results.differences[self._uid, self._result.frame] = self.difference
        _show(pictures)
        self.progress, self.message = 1.0, "done"

    def _render(self, scene: str, folder: Path, what: str) -> Generator[None, None, dict[str, float]]:
        """Render a copy; returns what the child said."""
        program = [sys.executable] if bpy.app.module else [bpy.app.binary_path, "-b", "--python-exit-code", "1", "-P"]
        arguments = [str(folder / f"{what}.blend"), scene, str(self._result.frame), str(folder / f"{what}.exr")]
        with (folder / f"{what}.log").open("w+", encoding="utf-8", errors="replace") as log:
            child = subprocess.Popen(
                [*program, str(_CHILD), "--", *arguments],
                stdin=subprocess.PIPE,
                stdout=log,
                stderr=subprocess.STDOUT,
                creationflags=_NO_WINDOW,
            )
            try:
                while child.poll() is None:
                    self._check()
                    yield
            finally:
                child.kill()
                child.wait()
                assert child.stdin is not None
                child.stdin.close()
            log.seek(0)
            said = [line for line in log if line.startswith("LIPAC ")]
            if child.returncode or not said:
                log.seek(0)
                print(log.read(), file=sys.stderr)
                raise InputError(f"the {what} render failed: render the frame by F12 to see why, or read the console")
        taken: dict[str, float] = json.loads(said[-1].removeprefix("LIPAC "))
        return taken


def _save_copies(scene: bpy.types.Scene, result: results.FrameResult, folder: Path) -> None:
    """full.blend and culled.blend; the open file is left as it is."""
    if applying.marks():
        raise InputError("Restore first: the file is to be rendered in full, too")
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / f"{_FULL}.blend"), copy=True)
    try:
        applying.apply(scene, result)
        bpy.ops.wm.save_as_mainfile(filepath=str(folder / f"{_CULLED}.blend"), copy=True)
    finally:
        applying.restore()


def difference_of(pictures: list[np.ndarray], taken: list[dict[str, float]]) -> Difference:
    """From the full and the culled picture, (H, W, 4) float32, and what each child said."""
    from ....core.evaluation.judge import picture_change

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
    image.pack()  # else a file that is saved has it black, which is no difference
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "IMAGE_EDITOR":
                area.spaces.active.image = image
