"""A copy of the open file in which culling is applied, for a Blender without this add-on."""

from __future__ import annotations

from pathlib import Path

import bpy

from ...core.errors import InputError
from ...core.files.atomic import replacing
from ..console import muted
from ..depsgraph import changed


def save_baked(path: Path) -> None:
    """Save the open file as it is now, culling included, as a copy at path. Raises InputError where it cannot be
    written, or is the open file itself."""
    check_target(path)
    try:
        save_copy(path)
    except (OSError, RuntimeError) as error:
        raise InputError(
            f"cannot write {path}: {str(error).removeprefix('Error:').strip()}; choose another with --save"
        ) from error


def save_copy(path: Path) -> None:
    """Save the open file as a copy at path. Raises OSError, RuntimeError."""
    # no backup (.blend1) of the empty file that is saved over
    with replacing(path) as part, muted(), changed(bpy.context.preferences.filepaths, save_version=0):
        bpy.ops.wm.save_as_mainfile(filepath=str(part.resolve()), check_existing=False, copy=True)


def check_target(path: Path) -> None:
    """Raise InputError where a .blend cannot be saved at path without harm."""
    if path.suffix != ".blend":
        raise InputError(f"--save {path}: name a .blend file")
    if not path.parent.is_dir():
        raise InputError(f"--save {path}: no such folder: {path.parent}")
    own = bpy.data.filepath
    if own and path.exists() and path.samefile(own):
        raise InputError(f"--save {path}: that is the scene itself, which is never changed; choose another file")
