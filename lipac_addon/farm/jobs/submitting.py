"""A shot as a job for those who run it elsewhere."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy

from ....core.culling.options import CullOptions
from ..children import lipac_program, program
from ..layout import FarmShot
from . import flamenco, openjd
from .graph import Programs, graph
from .writing import Wanted, write_shot


def submit(folder: Path, farm: str, options: CullOptions, chunk: int, lipac: str, blender: str) -> str:
    """Write the range of the open file's scene; where it is, and how it is run. farm: openjd or flamenco; lipac,
    blender: on the farm's machines.

    Of the options the budget, the paths and the seed count. Raises InputError where the scene cannot be a shot, or the
    folder not be written to.
    """
    # written at once: nothing is measured, and no memory asked for
    wanted = Wanted((), options.max_error, options.paths, options.seed)
    shot = write_shot(folder, Path(bpy.data.filepath), wanted)
    programs = Programs(lipac_program(lipac), program(blender))
    return describe(shot, farm, chunk, programs)


def describe(shot: FarmShot, farm: str, chunk: int, programs: Programs, measured: dict[str, Any] | None = None) -> str:
    """Write the job into the shot's folder; where it is, and how it is run. farm: openjd or flamenco; others as of
    `graph`."""
    how = (
        flamenco.write(shot, chunk, programs)
        if farm == "flamenco"
        else openjd.write(shot, graph(shot, chunk, programs, measured), programs)
    )
    return f"{shot.folder} holds the job: {how}"
