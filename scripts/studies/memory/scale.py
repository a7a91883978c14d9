"""A park of many objects with a large mesh each: what its analysis takes of memory, beside what Cycles takes for a
tenth of it.

    python -m lipac.scripts.studies.memory.scale -o DIR --objects 100 --triangles 1000000

Each figure is the peak of a process of its own, less what a process takes that has opened the same file. DIR/scale.json
keeps what is measured, so that a call that is stopped is followed by another that goes on.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ....core.files.atomic import replacing

SPACING, RADIUS = 4.0, 1.2  # metres: of the statues of the park
MODULE = "lipac.scripts.studies.memory.scale"


def main(argv: Sequence[str] | None = None) -> int:
    """Measure what is not there yet, and print the table; returns the exit status."""
    from ....core.files.report import output_folder
    from ...command.options import Parser
    from ..compare import markdown
    from ..machine import stamp

    parser = Parser(prog=f"python -m {MODULE}", description="Memory of an analysis of many large meshes.")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DIR")
    parser.add_argument("--objects", type=int, default=100, metavar="N")
    parser.add_argument("--triangles", type=int, default=1_000_000, metavar="N", help="of each object")
    args = parser.parse_args(argv)
    folder = output_folder(args.output)
    few = max(args.objects // 10, 1)
    rows = [("objects", "triangles of each", "what", "open file", "on top of it", "seconds")]
    for count, what in ((args.objects, "analysis"), (few, "Cycles"), (few, "analysis")):
        row = _measured(folder, count, args.triangles, what)
        opened, own = (f"{row[name] / 1e6:,.0f} MB" for name in ("open", "own"))
        rows.append((str(count), f"{args.triangles:,}", what, opened, own, f"{row['seconds']:.0f}"))
    print(stamp(f"python -m {MODULE}"), markdown(rows), sep="\n\n")
    return 0


def _measured(folder: Path, count: int, triangles: int, what: str) -> dict[str, Any]:
    """Bytes of a process with the file open, and how many more the work takes at most."""
    file, key = folder / "scale.json", f"{what} of {count} x {triangles}"
    data: dict[str, Any] = json.loads(file.read_text()) if file.exists() else {}
    if key not in data:
        scene = folder / f"park-{count}-{triangles}.blend"
        if not scene.exists():
            _process("build", str(scene), str(count), str(triangles))
        print(f"measuring the {key}", file=sys.stderr, flush=True)
        data[key] = _process(what.lower(), str(scene), str(folder / f"{count}-{triangles}"))
        with replacing(file) as part:
            part.write_text(json.dumps(data, indent=1) + "\n")
    found: dict[str, Any] = data[key]
    return found


def _process(*arguments: str) -> dict[str, Any]:
    """What a process of this module prints last."""
    command = [sys.executable, "-m", MODULE, *arguments]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


def measure(what: str, scene: str, folder: str) -> dict[str, Any]:
    """In a process of its own: open a file, and analyse it or have Cycles render it."""
    import time

    import bpy

    from ....core.files.usage import peak_memory, resident_memory

    bpy.ops.wm.open_mainfile(filepath=scene)
    opened, start = resident_memory(), time.monotonic()
    Path("/proc/self/clear_refs").write_text("5")  # the peak begins anew (Linux)
    figures: dict[str, Any] = {}
    if what == "cycles":
        bpy.ops.render.render()
    else:
        figures = _analyse(Path(folder))
    return {"open": opened, "own": peak_memory() - opened, "seconds": time.monotonic() - start} | figures


def _analyse(folder: Path) -> dict[str, Any]:
    """What `lipac analyze` does with the open file."""
    from ....core.culling.options import CullOptions
    from ....core.files.report import Report
    from ....lipac_addon.batch.job import Job
    from ....lipac_addon.batch.pipeline import run

    folder.mkdir(exist_ok=True)
    report = Report("park", "", "", "light-paths", "", 0, 0)
    run(Job(folder, (1,), CullOptions(parts=True)), report)
    names = ("active", "parts", "parts_active", "triangles", "iterations", "build_s", "trace_s", "sync_s")
    return {name: report.frames[0].get(name) for name in names}


def build(path: str, count: int, triangles: int) -> None:
    """Save a park: statues in rows, each of a mesh of its own, no two alike, seen by somebody who stands among them."""
    import bpy

    from ....lipac_addon.demo.builders import material

    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    stone, side = material("Stone", (0.5, 0.48, 0.45)), int(np.ceil(count**0.5))
    for k in range(count):
        ob = bpy.data.objects.new(f"Statue {k}", _statue(k, triangles))
        ob.data.materials.append(stone)
        ob.location = (SPACING * (k % side), SPACING * (k // side), RADIUS)
        scene.collection.objects.link(ob)
    bpy.ops.mesh.primitive_plane_add(size=20 * SPACING * side)
    bpy.context.object.data.materials.append(material("Gravel", (0.3, 0.28, 0.25)))
    bpy.ops.object.camera_add(location=(-0.4 * SPACING, -0.5 * SPACING, 1.7), rotation=(1.5, 0, -0.7))
    scene.camera = bpy.context.object
    bpy.ops.object.light_add(type="SUN", rotation=(0.9, 0.3, 0))
    bpy.context.object.data.energy = 3.0
    scene.world = bpy.data.worlds.new("Sky")
    render = scene.render
    render.engine, render.resolution_x, render.resolution_y, render.resolution_percentage = "CYCLES", 320, 180, 100
    scene.cycles.device, scene.cycles.samples, scene.cycles.use_denoising = "CPU", 4, False
    bpy.ops.wm.save_as_mainfile(filepath=path)


def _statue(seed: int, triangles: int) -> Any:
    """A smooth mesh of about so many triangles, in quadrilaterals: a ball with folds."""
    import bpy

    rings = max(int((triangles / 4) ** 0.5), 2)
    across = 2 * rings
    up, around = np.linspace(0.02, np.pi - 0.02, rings + 1), np.arange(across) * (2 * np.pi / across)
    theta, phi = (grid.ravel() for grid in np.meshgrid(up, around, indexing="ij"))
    folds = np.random.default_rng(seed).integers(2, 9, (4, 2))
    radius = RADIUS * (0.7 + sum(0.06 * np.sin(a * theta + seed) * np.cos(b * phi) for a, b in folds))
    points = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1) * radius[:, None]
    ring, at = (grid.ravel() for grid in np.meshgrid(np.arange(rings), np.arange(across), indexing="ij"))
    beside = (at + 1) % across
    rows = (ring * across + at, (ring + 1) * across + at, (ring + 1) * across + beside, ring * across + beside)
    faces = np.stack(rows, -1).astype(np.int32)
    mesh = bpy.data.meshes.new(f"Statue {seed}")
    mesh.vertices.add(len(points))
    mesh.vertices.foreach_set("co", points.astype(np.float32).ravel())
    mesh.loops.add(faces.size)
    mesh.loops.foreach_set("vertex_index", faces.ravel())
    mesh.polygons.add(len(faces))
    mesh.polygons.foreach_set("loop_start", np.arange(0, faces.size, 4, dtype=np.int32))
    mesh.update(calc_edges=True)
    mesh.shade_smooth()
    return mesh


if __name__ == "__main__":
    if len(sys.argv) > 2 and sys.argv[1] == "build":
        build(sys.argv[2], int(sys.argv[3]), int(sys.argv[4]))
        print("{}")
    elif len(sys.argv) > 2 and sys.argv[1] in {"analysis", "cycles"}:
        print(json.dumps(measure(*sys.argv[1:])))
    else:
        sys.exit(main())
