"""The scene of a shot, opened for a step."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import bpy

from ...core.errors import InputError
from ..console import muted
from ..open import open_scene
from .layout import FarmShot
from .render_frames import use_settings

MOVIES = ("FFMPEG", "AVI_JPEG", "AVI_RAW")


def open_shot(shot: FarmShot) -> None:
    """Open the scene, with the size and samples that are asked for. Raises InputError where it is not what the job was
    written for, or cannot be read."""
    open_scene(shot.scene)
    if digest(shot.scene) != shot.digest:
        raise InputError(
            f"{shot.scene}, or a library of it, has changed since the job was written: write it again by lipac farm"
        )
    with muted():
        use_settings(bpy.context.scene, shot._asked)


def digest(path: Path) -> str:
    """SHA-256 of a .blend that is open, and of the libraries that it links: one that is missing counts as such."""
    found = hashlib.sha256()
    for each in (path, *linked_files()):
        if not each.is_file():
            found.update(b"missing")
            continue
        with each.open("rb") as file:
            hashlib.file_digest(file, lambda: found)
    return found.hexdigest()


def linked_files() -> list[Path]:
    """The library files that the open file, or one of these, links."""
    return sorted(
        {
            Path(bpy.path.abspath(library.filepath, library=library.parent))
            for library in bpy.data.libraries
            if not library.packed_file
        }
    )


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
