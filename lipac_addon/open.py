"""Opening a scene: a .blend as it is, other formats imported into an empty file with what they lack to be rendered."""

from __future__ import annotations

import json
import math
import re
import stat
import struct
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from ..core.errors import InputError
from . import roles
from .console import muted
from .extract import add_framing_camera, extract_frame

IMPORTERS: dict[str, Callable[..., Any]] = {
    ".glb": bpy.ops.import_scene.gltf,
    ".gltf": bpy.ops.import_scene.gltf,
    ".obj": bpy.ops.wm.obj_import,
    ".ply": bpy.ops.wm.ply_import,
    ".stl": bpy.ops.wm.stl_import,
    **dict.fromkeys((".usd", ".usda", ".usdc", ".usdz"), bpy.ops.wm.usd_import),
}
# glTF extensions whose decoders Blender's Python module does not carry
_DECODERS = {
    "KHR_draco_mesh_compression": "Draco",
    "EXT_meshopt_compression": "meshopt",
    "KHR_meshopt_compression": "meshopt",
}
_GREY = (0.5, 0.5, 0.5)
AUTO = "auto"
_GLB_JSON = 0x4E4F534A
_FAR = 1e18  # metres; what is beyond is nothing to frame


def open_scene(path: Path) -> None:
    """Open or import the scene file `path`; scripts in the file are not run.

    Formats: .blend, glTF, OBJ, PLY, STL, USD. Imported scenes get a camera that frames them, and a sun and a grey
    world, where they bring none. Raises InputError: no such file, a folder, an unknown format, damaged or empty,
    compressed by what cannot be decoded, nothing to render in an import.
    """
    if path.is_dir():
        raise InputError(f"{path} is a folder; name a scene file in it")
    if not path.is_file():
        raise InputError(f"no such file: {path}")
    if path.stat().st_size == 0:
        raise InputError(f"{path} is empty; export or copy it again")
    roles.make_known()
    suffix = path.suffix.lower()
    if suffix == ".blend":
        _call(bpy.ops.wm.open_mainfile, path, load_ui=False, use_scripts=False)
        leave_modes()
        _check_files()
    elif suffix in IMPORTERS:
        _check_gltf(path)
        bpy.ops.wm.read_factory_settings(use_empty=True)
        _call(IMPORTERS[suffix], path)
        _complete(bpy.context.scene)
    else:
        raise InputError(f"{path}: cannot read '{suffix or path.name}' files; use .blend, {', '.join(IMPORTERS)}")


def leave_modes() -> None:
    """Back to Object Mode, with whatever was being edited or sculpted when the file was saved: it is rendered just so,
    and its faces can be read."""
    for ob in [ob for ob in bpy.data.objects if ob.mode != "OBJECT"]:
        # what cannot leave is named by the extraction
        with muted(), suppress(RuntimeError), bpy.context.temp_override(active_object=ob, object=ob):
            bpy.ops.object.mode_set(mode="OBJECT")


def use_camera(scene: bpy.types.Scene, name: str) -> None:
    """Make the object `name` the scene's camera; 'auto' adds one that frames everything. Raises InputError where there
    is none of that name."""
    if name == AUTO:
        frame_everything(scene)
        return
    camera = scene.objects.get(name)
    if camera is None or camera.type != "CAMERA":
        cameras = ", ".join(ob.name for ob in scene.objects if ob.type == "CAMERA") or "none"
        raise InputError(f"no camera '{name}' in scene '{scene.name}'; its cameras: {cameras}; or use --camera {AUTO}")
    scene.camera = camera


def frame_everything(scene: bpy.types.Scene) -> None:
    """Add a camera that sees the whole scene. Raises InputError where there is nothing to render."""
    with muted():
        extracted = extract_frame(scene, allow_no_camera=True).scene
    boxes = extracted.instances.bounds + extracted.origin
    boxes = boxes[np.isfinite(boxes).all(axis=(1, 2)) & (np.abs(boxes).max(axis=(1, 2)) < _FAR)]
    low, high = (boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)) if len(boxes) else (-np.ones(3), np.ones(3))
    add_framing_camera(scene, np.stack((low, high)))


def missing_libraries() -> list[str]:
    """Warnings about linked files that the open file could not find."""
    return [f"linked library is missing: {library.filepath}" for library in bpy.data.libraries if library.is_missing]


def linked_files() -> list[Path]:
    """The library files that the open file links, directly or through other libraries; without packed ones."""
    return sorted(
        {
            Path(bpy.path.abspath(library.filepath, library=library.parent))
            for library in bpy.data.libraries
            if not library.packed_file
        }
    )


def _check_files() -> None:
    """Raise InputError where the open file reads a pipe or a device as a picture: whoever reads that waits for ever."""
    for image in bpy.data.images:
        if image.source in ("FILE", "SEQUENCE", "MOVIE", "TILED") and not image.packed_files and image.filepath:
            path = Path(bpy.path.abspath(image.filepath, library=image.library))
            with suppress(OSError, ValueError):
                kind = path.stat().st_mode
                if not stat.S_ISREG(kind) and not stat.S_ISDIR(kind):
                    raise InputError(
                        f"image {image.name!r} is no picture but a pipe or a device: {path}; give it a file"
                    )


def _call(operator: Callable[..., Any], path: Path, **arguments: object) -> None:
    """Run an operator on a file; its failure becomes one line."""
    try:
        with muted():
            done = operator(filepath=str(path.resolve()), **arguments)
    except RuntimeError as error:
        raise InputError(f"cannot read {path}: {_reason(str(error), path)}") from error
    except Exception as error:  # importers written in Python raise anything on damaged data
        raise InputError(f"cannot read {path}: {type(error).__name__}: {_reason(str(error), path)}") from error
    if "FINISHED" not in done:
        raise InputError(f"cannot read {path}: it is damaged or not what its name says")


def _reason(text: str, path: Path) -> str:
    """The last line of Blender's message, without the parts that say the path again; what to do after it."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    last = next((line for line in lines if line.startswith("Error:")), lines[-1] if lines else "it is damaged")
    last = last.removeprefix("Error:").strip().replace(str(path.resolve()), path.name)
    if last.startswith("Python: Traceback"):  # of an importer, which Blender may cut short before the error itself
        errors = [line for line in lines if re.match(r"[\w.]+(Error|Exception)\b", line)]
        last = errors[-1] if errors else "its importer fails"
    return f"{last.rstrip('.')}; save or export it again"


def _check_gltf(path: Path) -> None:
    """Raise InputError where a glTF file is truncated or needs a decoder that is missing."""
    if path.suffix.lower() not in (".glb", ".gltf"):
        return
    try:
        document = json.loads(_glb_json(path) if path.suffix.lower() == ".glb" else path.read_bytes())
        required = document.get("extensionsRequired", [])
        if not isinstance(required, list) or not all(isinstance(name, str) for name in required):
            raise ValueError("extensionsRequired is no list of names")
    except (ValueError, struct.error, AttributeError, RecursionError) as error:
        raise InputError(f"cannot read {path}: it is truncated or not glTF; export it again") from error
    for name in required:
        if name in _DECODERS:
            raise InputError(
                f"cannot read {path}: its meshes are compressed by {_DECODERS[name]} ({name}); export it again without "
                "compression"
            )


def _glb_json(path: Path) -> bytes:
    """The JSON chunk of a binary glTF file (glTF 2.0 specification, section 4.4). Raises ValueError where the file is
    not whole."""
    with path.open("rb") as file:
        magic, _version, length, size, kind = struct.unpack("<4sIIII", file.read(20))
        data = file.read(size)
    if magic != b"glTF" or kind != _GLB_JSON or len(data) < size or path.stat().st_size < length:
        raise ValueError("truncated")
    return data


def _complete(scene: bpy.types.Scene) -> None:
    """Give an imported scene the camera and light that it lacks."""
    cameras = [ob for ob in scene.objects if ob.type == "CAMERA"]
    if scene.camera is None and cameras:
        scene.camera = cameras[0]
    elif scene.camera is None:
        frame_everything(scene)
    if any(ob.type == "LIGHT" for ob in scene.objects):
        return
    sun = bpy.data.objects.new("Sun", bpy.data.lights.new("Sun", "SUN"))
    sun.data.energy = 3.0
    sun.rotation_euler = (math.radians(40), math.radians(15), math.radians(30))
    scene.collection.objects.link(sun)
    if scene.world is None:
        scene.world = bpy.data.worlds.new("World")
        scene.world.color = _GREY
        background = scene.world.node_tree.nodes.get("Background") if scene.world.node_tree else None
        if background is not None:
            background.inputs["Color"].default_value = (*_GREY, 1.0)
