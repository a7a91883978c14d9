"""A shot's folder, made from the open file: what is asked, and what render nodes run."""

from __future__ import annotations

import os
import shutil
from dataclasses import dataclass
from pathlib import Path

import bpy

from ....core.error_budget.budget import Budget
from ....core.errors import InputError
from ....core.files import atomic, usage
from ....core.files.report import output_folder
from ...writeback.marks import all_marks, culled_libraries
from .. import render_frames
from ..layout import SCRIPT, FarmShot
from ..opening import digest_of, picture_ending

FRAMES_TO_A_CHECK = 25  # so that a shot of 250 frames is measured in 10


@dataclass(frozen=True)
class Wanted:
    """What a user says of a shot; None: as in the scene, or by default. Fields as of `FarmShot`."""

    frames: tuple[int, ...] = ()
    budget: Budget = Budget(0.01, 0.05)  # noqa: RUF009
    paths: int = 0
    seed: int = 0
    resolution: tuple[int, int] | None = None
    samples: int | None = None
    checks: int | None = None


def write_shot(folder: Path, scene: Path, wanted: Wanted) -> FarmShot:
    """Write what is asked of the open file, which lies at `scene`, into a folder. Raises InputError where that cannot
    be a shot."""
    output_folder(folder)
    if scene.resolve().parent == folder.resolve() and scene.name == "shot.blend":
        raise InputError(f"{scene} is what a shot is saved as: choose another folder with -o")
    if all_marks():
        where = ", ".join(culled_libraries()) or "the file"
        raise InputError(
            f"LiPaC's culling is applied in {where}: restore first, for frames are rendered in full, too, to compare"
        )
    opened = bpy.context.scene
    if opened.render.use_multiview:
        raise InputError(
            f"scene '{opened.name}' is rendered from several cameras (Stereoscopy), of which one is analysed: switch "
            "that off, or render it without culling"
        )
    if not wanted.frames and opened.frame_step != 1:
        raise InputError(
            f"scene '{opened.name}' renders one frame in {opened.frame_step}: give frames without gaps, or set its "
            "step to 1"
        )
    frames = wanted.frames or tuple(range(opened.frame_start, opened.frame_end + 1))
    if frames[0] < 0:
        raise InputError(f"a farm counts frames from 0, and these begin at {frames[0]}: move them, or use lipac render")
    checks = min(len(frames), wanted.checks or max(2, -(-len(frames) // FRAMES_TO_A_CHECK)))
    shot = FarmShot(
        Path(os.path.abspath(folder)),  # as they are called here: other machines may have other links
        Path(os.path.abspath(scene)),
        digest_of(scene),
        frames[0],
        frames[-1],
        *(wanted.budget.mean, wanted.budget.worst, wanted.paths, wanted.seed, wanted.resolution, wanted.samples),
        checks,
        ending=picture_ending(opened),
    )
    for source in (Path(render_frames.__file__), Path(atomic.__file__), Path(usage.__file__)):
        copied = (folder / SCRIPT).with_name(source.name)
        copied.parent.mkdir(exist_ok=True)
        with atomic.replacing(copied) as part:
            shutil.copyfile(source, part)
    shot.save()
    return shot
