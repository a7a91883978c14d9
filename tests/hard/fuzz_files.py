"""Damaged files: a clear message or a valid result. Blender's own readers may crash on them, so each is opened in a
process of its own."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from functools import cache
from pathlib import Path

from .choices import Seeded

OPEN = """
import sys
from pathlib import Path
from lipac.core.errors import InputError
from lipac.lipac_addon.console import muted
from lipac.lipac_addon.open import open_scene
from lipac.lipac_addon.extract import extract_frame
import bpy
for line in sys.stdin:
    try:
        open_scene(Path(line.strip()))
        with muted():
            scene = extract_frame(bpy.context.scene).scene
        said = f"opened {len(scene.instances)}"
    except InputError as error:
        said = "refused " + str(error)
        assert "\\n" not in said
    print(said, flush=True)
"""


@cache
def sound_file(suffix: str) -> bytes:
    """A small scene as .blend or .glb, made in a process of its own."""
    script = (
        "import bpy, sys\n"
        "bpy.ops.wm.read_homefile(use_factory_startup=True)\n"
        "bpy.ops.mesh.primitive_monkey_add()\n"
        "save = bpy.ops.export_scene.gltf if sys.argv[1].endswith('.glb') else bpy.ops.wm.save_as_mainfile\n"
        "save(filepath=sys.argv[1])\n"
    )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"sound{suffix}"
        subprocess.run([sys.executable, "-c", script, str(path)], check=True, capture_output=True)
        return path.read_bytes()


def damaged(choose: Seeded, suffix: str) -> bytes:
    """The file with some bytes changed, a part missing, doubled or zeroed, or its end cut off."""
    data = bytearray(sound_file(suffix))
    kind, at = choose.integer(0, 4), choose.integer(0, len(data) - 1)
    length = min(2 ** choose.integer(0, 16), len(data) - at)
    if kind == 0:
        del data[at:]
    elif kind == 1:
        del data[at : at + length]
    elif kind == 2:
        data[at : at + length] = bytes(length)
    elif kind == 3:
        data[at:at] = data[at : at + length]
    else:
        for _ in range(2 ** choose.integer(0, 8)):
            data[choose.integer(0, len(data) - 1)] = choose.integer(0, 255)
    return bytes(data)


def outcomes(choose: Seeded, count: int) -> dict[str, int]:
    """Open count damaged files: how many were opened, refused in one line, or ended the process ("crashed N" by signal,
    "failed" with a traceback)."""
    out: dict[str, int] = {}
    with tempfile.TemporaryDirectory() as folder:
        paths = []
        for k in range(count):
            suffix = choose.one((".blend", ".glb"))
            path = Path(folder) / f"damaged {k}{suffix}"
            path.write_bytes(damaged(choose, suffix))
            paths.append(path)
        while paths:
            lines = "".join(f"{path}\n" for path in paths)
            done = subprocess.run(
                [sys.executable, "-c", OPEN], input=lines, capture_output=True, text=True, timeout=600, check=False
            )
            said = [line for line in done.stdout.splitlines() if line.startswith(("opened", "refused"))]
            for line in said:
                out[line.split()[0]] = out.get(line.split()[0], 0) + 1
            if done.returncode or len(said) < len(paths):
                name = (
                    f"crashed {-done.returncode}"
                    if done.returncode < 0
                    else "failed " + done.stderr.strip().splitlines()[-1][:200]
                )
                out[name] = out.get(name, 0) + 1
            paths = paths[len(said) + 1 :]
    return out


def check(choose: Seeded) -> None:
    """One damaged file. Raises AssertionError."""
    assert set(outcomes(choose, 1)) <= {"opened", "refused"}
