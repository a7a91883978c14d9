"""What a farm elsewhere must be sent: a .blend and the files that it needs, found and packed by Blender Asset Tracer
(which knows Blender 5.1 and later)."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import bpy

from ....core.errors import InputError
from ....core.files.shell import quoted
from ...console import muted
from ..layout import FarmShot, read_json, write_json

PACKED = "packed"
_INSTALL = "packing takes Blender 5.1 and Blender Asset Tracer: pip install 'blender-asset-tracer>=2.2'"


def pack(shot: FarmShot, blender: str = "") -> dict[str, Any]:
    """Copy shot.blend and what it needs to `packed`; files and bytes of the scene before (`full`) and of that
    (`culled`), with those that are missing.

    blender: a Blender that rewrites paths where files of other places are needed; this one, where it is one. Raises
    InputError.
    """
    if read_json(shot.united, key=shot.key) is None:
        raise InputError(f"there is no set yet: run lipac shot unite {quoted(shot.folder)} first")
    try:
        from blender_asset_tracer.cli.pack import create_pack, perform_path_rewriting
    except (ImportError, SyntaxError) as error:
        raise InputError(_INSTALL) from error
    full, culled = needed(shot.scene), needed(shot.culled)
    if bpy.app.module and blender:
        bpy.app.binary_path = blender
    with muted():
        found = _dependencies(shot.culled, culled)
        if any(info.needs_path_rewriting for info in found.file_infoes.values()) and not bpy.app.binary_path:
            raise InputError(
                "some files are named by absolute paths, and only a Blender rewrites these: name one by --blender, or "
                "make paths relative"
            )
        if failed := perform_path_rewriting(found):
            path, why = next(iter(failed.items()))
            raise InputError(f"{path} cannot be packed: {why}")
        create_pack(found, shot.folder / PACKED)
    said = {"key": shot.key, "full": _sizes(full), "culled": _sizes(culled)}
    write_json(shot.folder / "packed.json", said)
    return said


def needed(blend: Path) -> list[Path]:
    """Files that a .blend needs, itself and its libraries' among them; it is open then."""
    with muted():
        bpy.ops.wm.open_mainfile(filepath=str(blend), load_ui=False, use_scripts=False)
        return sorted(_dependencies(blend, [blend]).file_infoes)


def _dependencies(blend: Path, files: list[Path]) -> Any:
    """Of the open file; paths below the folder that all of these files are in need not change."""
    from blender_asset_tracer import file_usage

    root = os.path.commonpath([blend.parent, *(path.parent for path in files)])
    return file_usage.dependencies_of_current_blendfile(Path(root), file_usage.Options())


def _sizes(files: list[Path]) -> dict[str, Any]:
    there = [path for path in files if path.is_file()]
    return {
        "files": len(there),
        "bytes": sum(path.stat().st_size for path in there),
        "missing": [str(path) for path in files if not path.exists()],
    }
