"""Blender's texture cache: tiles of images at the sizes that a render asks for, from files beside it, instead of whole
images in memory."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import bpy

from ....core.errors import InputError
from ...depsgraph import changed

SINCE = (5, 2, 0)


@contextmanager
def texture_cache(scene: bpy.types.Scene, folder: Path | None) -> Iterator[list[str]]:
    """Have Cycles read a scene's images by way of files in a folder, made where there are none or their image has
    changed; None leaves all as it is set. Yields a line each for what it does not work for; settings are put back.
    Several processes may share the folder. Raises InputError where there can be none."""
    with ExitStack() as stack:
        lines: list[str] = []
        if folder is not None and bpy.app.version < SINCE:
            lines.append(f"texture cache: Blender has one from {SINCE[0]}.{SINCE[1]} on; images are loaded whole")
        elif folder is not None:
            try:
                folder.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise InputError(f"--texture-cache {folder}: cannot make it: {error.strerror}") from error
            if whole := [image.name for image in bpy.data.images if _is_loaded_whole(image)]:
                lines.append(
                    f"texture cache: {len(whole):,} images are packed or made in Blender and loaded whole: "
                    f"{', '.join(sorted(whole)[:3])}"
                )
            stack.enter_context(
                changed(bpy.context.preferences.filepaths, texture_cache_directory=str(folder.resolve()))
            )
            stack.enter_context(changed(scene.render, use_texture_cache=True, use_auto_generate_texture_cache=True))
        yield lines


def _is_loaded_whole(image: bpy.types.Image) -> bool:
    """Whether an image that something uses is in no file of its own."""
    return (
        image.type not in {"RENDER_RESULT", "COMPOSITING"}
        and image.users > 0
        and (image.source == "GENERATED" or bool(image.packed_files))
    )
