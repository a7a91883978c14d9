"""`python -m lipac.scripts.studies.farm.packed`: what is sent of the demo `textures`, its images as files and its rows
as libraries, in full and culled; docs/farm.md."""

from __future__ import annotations

import re
import sys
import tempfile
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from ....core.files.figures import size
from ....lipac_addon.console import muted
from ....lipac_addon.demo import textures
from ....lipac_addon.farm import analyse, unite
from ....lipac_addon.farm.jobs import pack
from ....lipac_addon.farm.jobs.writing import Wanted, write_shot
from ....lipac_addon.farm.layout import read_json
from ....lipac_addon.open import open_scene
from .page import PAGE

IMAGES, PIXELS = 48, 512


def main() -> int:
    """Measure, and write the page's paragraph; returns the exit status."""
    with tempfile.TemporaryDirectory(prefix="lipac") as place:
        said = paragraph(packed(Path(place)))
    text = PAGE.read_text()
    PAGE.write_text(
        re.sub(r"(<!-- packed -->\n).*?(<!-- end -->)", lambda m: f"{m[1]}{said}\n{m[2]}", text, flags=re.DOTALL)
    )
    return 0


def packed(folder: Path) -> dict[str, Any]:
    """What packing says of a shot of one frame, and the counts of its set."""
    with muted():
        scene = project(folder)
    open_scene(scene)
    shot = write_shot(folder / "shot", scene, Wanted(frames=(1,)))
    analyse.analyse(shot, shot.frames)
    unite.unite(shot)
    return pack.pack(shot) | {"set": read_json(shot.united)}


def project(folder: Path) -> Path:
    """Save the demo: each image a file of noise, each row of panels a library; its .blend."""
    textures.build(IMAGES, pixels=PIXELS)
    (folder / "textures").mkdir()
    rng = np.random.default_rng(0)
    for image in [image for image in bpy.data.images if image.source == "GENERATED"]:
        image.pixels.foreach_set(rng.random(4 * PIXELS * PIXELS, np.float32))
        image.filepath_raw, image.file_format = str(folder / "textures" / f"{image.name}.png"), "PNG"
        image.save()
        image.use_fake_user = False
    scene, rows = folder / "scene.blend", range(0, IMAGES, textures.ROW)
    bpy.ops.wm.save_as_mainfile(filepath=str(scene))
    names = [[f"Panel {k}" for k in range(row, row + textures.ROW)] for row in rows]
    for number, row in enumerate(names):
        bpy.data.libraries.write(
            str(folder / f"row {number}.blend"), {bpy.data.objects[name] for name in row}, path_remap="RELATIVE_ALL"
        )
        for name in row:
            bpy.data.objects.remove(bpy.data.objects[name])
    bpy.data.orphans_purge(do_recursive=True)
    for number, row in enumerate(names):
        with bpy.data.libraries.load(str(folder / f"row {number}.blend"), link=True, relative=True) as (_, into):
            into.objects = row
        for ob in into.objects:
            bpy.context.scene.collection.objects.link(ob)
    bpy.ops.wm.save_mainfile()
    return scene


def paragraph(found: dict[str, Any]) -> str:
    """What was found, as a sentence."""
    full, culled, chosen = found["full"], found["culled"], found["set"]
    kept = f"{chosen['active']} of {chosen['instances']} instances stay"
    sent = f"{culled['files']} files of {size(culled['bytes'])} are sent in place of {full['files']}"
    return (
        f"Measured on the demo `textures`, with {IMAGES} images of {PIXELS} x {PIXELS} pixels of noise as files, and "
        f"its rows of {textures.ROW} panels as\nlibraries: {kept}, and {sent} of {size(full['bytes'])}."
    )


if __name__ == "__main__":
    sys.exit(main())
