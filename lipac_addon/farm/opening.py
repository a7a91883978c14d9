"""The scene of a shot, opened for a step."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy

from ...core.errors import InputError
from ...core.files.digest import digest
from ..console import muted
from ..open import linked_files, open_scene
from .layout import FarmShot
from .render_frames import use_settings

MOVIES = ("FFMPEG", "AVI_JPEG", "AVI_RAW")


def open_shot(shot: FarmShot) -> None:
    """Open the scene, with the size and samples that are asked for. Raises InputError where it is not what the job was
    written for, or cannot be read."""
    open_scene(shot.scene)
    if digest_of(shot.scene) != shot.digest:
        raise InputError(
            f"{shot.scene}, or a library of it, has changed since the job was written: write it again by lipac farm"
        )
    with muted():
        use_settings(bpy.context.scene, shot._asked)


def digest_of(path: Path) -> str:
    """SHA-256 of a .blend that is open and of the libraries that it links; a missing one counts as missing."""
    return digest(path, *linked_files())


def picture_ending(scene: Any) -> str:
    """Of the pictures that a scene's renders are saved as. Raises InputError where that is a film, or there is no
    camera."""
    if scene.render.image_settings.file_format in MOVIES:
        raise InputError(
            f"scene '{scene.name}' is rendered to a film, which machines cannot share: choose PNG or OpenEXR as output"
        )
    if scene.camera is None:
        raise InputError(f"scene '{scene.name}' has no camera: add one and make it active")
    return str(scene.render.file_extension)
