"""Frames of a shot in any Blender, without LiPaC: `blender -b -P render_frames.py -- FOLDER --frames 1-4`, or Python
with the module bpy.

Renders shot.blend, or another file, by its own settings. Frames whose picture is there, from the same set, are left
alone. Each picture and its note (seconds, memory) are put in place whole. With --crops, parts of the picture are
rendered instead, to compare.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

import bpy

if __package__:
    from ...core.files.atomic import replacing
    from ...core.files.usage import peak_memory
else:  # they lie beside the script, where a Blender without LiPaC runs it
    sys.path.insert(0, str(Path(__file__).resolve().parent))
    from atomic import replacing  # type: ignore[no-redef]
    from usage import peak_memory  # type: ignore[no-redef]

GRID = (4, 3)  # crops of a picture, across and up


def main(arguments: list[str]) -> int:
    """Render; returns the exit status."""
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    parser.add_argument("--frames", required=True)
    parser.add_argument("--file", type=Path)
    parser.add_argument("--mended", default="")
    parser.add_argument("--crops", nargs="*")
    parser.add_argument("--into", type=Path)
    args = parser.parse_args(arguments)
    folder = args.folder.resolve()
    job = json.loads((folder / "job.json").read_text())
    first, _, last = args.frames.partition("-")
    frames = [*range(int(first), int(last or first) + 1)]
    if args.crops is None:
        stamp = stamp_of(folder, job, args.mended)
        frames = [frame for frame in frames if not is_done(folder, frame, job["ending"], stamp)]
    if not frames:
        return 0
    open_file((args.file or folder / "shot.blend").resolve())
    scene = bpy.context.scene
    use_settings(scene, job)
    for frame in frames:
        scene.frame_set(frame)
        if args.crops is None:
            render_picture(scene, folder / "pictures", frame, job["ending"], stamp)
        else:
            render_crops(scene, args.into, frame, args.crops)
    return 0


def stamp_of(folder: Path, job: dict[str, Any], mended: str) -> dict[str, str]:
    """What a picture is made from. Ends the process where that is not there."""
    try:
        chosen = json.loads((folder / "shot.json").read_text())
    except (OSError, ValueError) as error:
        raise SystemExit(f"{folder / 'shot.json'} cannot be read: unite first") from error
    if chosen["key"] != job["key"]:
        raise SystemExit(f"{folder / 'shot.json'} is of another job: unite again")
    return {"key": job["key"], "set": chosen["set"], "mended": mended}


def open_file(path: Path) -> None:
    """Open a file that is not open yet."""
    if bpy.data.filepath != str(path):
        bpy.ops.wm.open_mainfile(filepath=str(path), load_ui=False)


def use_settings(scene: Any, job: dict[str, Any]) -> None:
    """Size and samples that the job asks for."""
    if job["resolution"]:
        scene.render.resolution_x, scene.render.resolution_y = job["resolution"]
        scene.render.resolution_percentage = 100
    if job["samples"]:
        if scene.render.engine == "CYCLES":
            scene.cycles.samples = job["samples"]
        else:
            scene.eevee.taa_render_samples = job["samples"]


def is_done(folder: Path, frame: int, ending: str, stamp: dict[str, str]) -> bool:
    """Whether a picture is there: from the same set, and the same file where it was mended; what was mended from that
    set is not undone."""
    stem = folder / "pictures" / f"frame_{frame:04}"
    try:
        note = json.loads(stem.with_suffix(".json").read_text())
        size = stem.with_suffix(ending).stat().st_size
    except (OSError, ValueError):
        return False
    same = all(note.get(name) == stamp[name] for name in ("key", "set"))
    return same and size == note["bytes"] and (not stamp["mended"] or note["mended"] == stamp["mended"])


def render_picture(scene: Any, folder: Path, frame: int, ending: str, stamp: dict[str, str]) -> None:
    """A frame's picture and note."""
    folder.mkdir(parents=True, exist_ok=True)
    picture = folder / f"frame_{frame:04}{ending}"
    scene.render.use_file_extension = True
    with replacing(picture) as part:
        start = time.perf_counter()
        render(scene, part)
        note = {
            **stamp,
            "frame": frame,
            "seconds": time.perf_counter() - start,
            "peak_bytes": peak_memory(),
            "bytes": part.stat().st_size,
        }
    with replacing(picture.with_suffix(".json")) as part:
        part.write_text(json.dumps(note | {"blender": bpy.app.version_string}, indent=1) + "\n")
    print(f"Saved: '{picture}'", flush=True)


def render_crops(scene: Any, folder: Path, frame: int, crops: list[str]) -> None:
    """Parts of a frame, as frame_0001_x,y.exr, and what they took."""
    outputs = [
        node
        for tree in bpy.data.node_groups
        if tree.type == "COMPOSITING"
        for node in tree.nodes
        if node.type == "OUTPUT_FILE"
    ]
    for node in outputs:
        node.mute = True
    render_settings = scene.render
    render_settings.use_border = render_settings.use_crop_to_border = True
    render_settings.use_sequencer = render_settings.use_multiview = False
    image = render_settings.image_settings
    image.media_type = "IMAGE"
    image.file_format, image.color_depth, image.exr_codec = "OPEN_EXR", "32", "ZIP"
    start = time.perf_counter()
    for crop in crops:
        x, y = map(int, crop.split(","))
        render_settings.border_min_x, render_settings.border_max_x = x / GRID[0], (x + 1) / GRID[0]
        render_settings.border_min_y, render_settings.border_max_y = y / GRID[1], (y + 1) / GRID[1]
        render(scene, folder / f"frame_{frame:04}_{crop}.exr")
    note = {"seconds": time.perf_counter() - start, "peak_bytes": peak_memory()}
    (folder / f"frame_{frame:04}.json").write_text(json.dumps(note))


def render(scene: Any, path: Path) -> None:
    """Render to a file. Ends the process where there is none then."""
    name = str(path)
    if bpy.app.version >= (5, 0, 0):  # where braces are a template
        name = name.replace("{", "{{").replace("}", "}}")
    scene.render.filepath = name
    bpy.ops.render.render(write_still=True, scene=scene.name)
    if not path.is_file() or not path.stat().st_size:
        raise SystemExit(f"{path} was not written: is the disk full?")


if __name__ == "__main__":
    sys.exit(main(sys.argv[sys.argv.index("--") + 1 :]))
