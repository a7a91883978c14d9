"""Scenes of one kind of thing each, from which the rates of `core.scene.render_costs` were read: what Cycles takes for
them on the CPU, beside what the model says. `python -m lipac.scripts.studies.memory.sweep` prints the table."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

from ..compare import markdown

CASES: dict[str, dict[str, Any]] = {
    "nothing": {},
    "1280 x 720": {"width": 1280},
    "1920 x 1080": {"width": 1920},
    "1280 x 720, denoised": {"width": 1280, "denoised": True},
    "a mesh of 500,000 triangles": {"triangles": 500_000},
    "a mesh of 2 million": {"triangles": 2_000_000},
    "40 meshes of 100,000": {"triangles": 100_000, "meshes": 40},
    "subdivided: 10 x 4,000 x 64": {"triangles": 4_000, "meshes": 10, "subdivided": 3},
    "100,000 by geometry nodes": {"scattered": 100_000},
    "300,000 by geometry nodes": {"scattered": 300_000},
    "an image of 4,096 x 4,096": {"image": 4096},
}


def main() -> int:
    """Measure each case in a process of its own, and print the table; returns the exit status."""
    rows = [("more than a picture of 320 x 180 of next to nothing", "predicted", "measured", "measured / predicted")]
    base = [0, 0]
    for name, case in CASES.items():
        command = [sys.executable, "-m", "lipac.scripts.studies.memory.sweep", json.dumps(case)]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        print(name, done.stdout.splitlines()[-1], file=sys.stderr, flush=True)
        found = json.loads(done.stdout.splitlines()[-1])
        if not case:
            base = found
            continue
        own, predicted = (x - y for x, y in zip(found, base, strict=True))
        rows.append((name, f"{predicted / 1e6:,.0f} MB", f"{own / 1e6:,.0f} MB", f"{own / predicted:.2f}"))
    print(markdown(rows))
    return 0


def measure(
    triangles: int = 2,
    meshes: int = 1,
    subdivided: int = 0,
    scattered: int = 0,
    image: int = 0,
    width: int = 320,
    denoised: bool = False,
) -> tuple[int, int]:
    """Bytes by which a render of such a scene raises what this process takes, and what the model says."""
    import bpy

    from ....core.files.usage import peak_memory, resident_memory
    from ....lipac_addon.extract import extract_frame
    from ....lipac_addon.memory.costs import costs_of

    scene = build(triangles, meshes, subdivided, scattered, image, width, denoised)
    before = resident_memory()
    Path("/proc/self/clear_refs").write_text("5")  # the peak begins anew (Linux)
    bpy.ops.render.render()
    own, extraction = peak_memory() - before, extract_frame(scene)
    costs, instances = costs_of(extraction, scene).costs, extraction.scene.instances
    return own, costs.total(instances.mesh, instances.slots, instances.mesh >= 0)


def build(
    triangles: int = 2,
    meshes: int = 1,
    subdivided: int = 0,
    scattered: int = 0,
    image: int = 0,
    width: int = 320,
    denoised: bool = False,
    objects: int = 0,
) -> Any:
    """A scene of so many meshes with so many triangles each, copies of the last of them by geometry nodes (scattered)
    and as objects, and an image, open; bpy.types.Scene."""
    import bpy

    from ....lipac_addon.demo.builders import material

    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    ob: Any = None
    painted = material("Painted", (0.8, 0.8, 0.8))
    if image:
        texture = painted.node_tree.nodes.new("ShaderNodeTexImage")
        texture.image = bpy.data.images.new("Image", image, image)
        color = painted.node_tree.nodes["Principled BSDF"].inputs["Base Color"]
        painted.node_tree.links.new(texture.outputs["Color"], color)
    side = max(int((triangles / 2) ** 0.5), 1)
    for _ in range(meshes):
        bpy.ops.mesh.primitive_grid_add(x_subdivisions=side, y_subdivisions=side, size=1)
        ob = bpy.context.object
        ob.data.materials.append(painted)
        if not image:
            ob.data.uv_layers.remove(ob.data.uv_layers[0])
        if subdivided:
            modifier = ob.modifiers.new("Subdivision", "SUBSURF")
            modifier.levels, modifier.render_levels = 0, subdivided
    for k in range(objects):
        other = bpy.data.objects.new("Copy", ob.data)
        other.location = (k % 100, k // 100, 0)
        scene.collection.objects.link(other)
    if scattered:
        _scatter(scene, ob, scattered)
    bpy.ops.object.camera_add(location=(0, 0, 3))
    scene.camera = bpy.context.object
    bpy.ops.object.light_add(type="SUN")
    render = scene.render
    render.engine, render.resolution_x, render.resolution_y, render.resolution_percentage = (
        "CYCLES",
        width,
        width * 9 // 16,
        100,
    )
    scene.cycles.device, scene.cycles.samples, scene.cycles.use_denoising = "CPU", 4, denoised
    bpy.context.view_layer.update()
    return scene


def _scatter(scene: Any, source: Any, count: int) -> None:
    """Copies of an object by geometry nodes."""
    import bpy
    import numpy as np

    cloud = bpy.data.meshes.new("Points")
    cloud.vertices.add(count)
    cloud.vertices.foreach_set("co", np.random.default_rng(0).random(3 * count, np.float32) * 100)
    host = bpy.data.objects.new("Host", cloud)
    scene.collection.objects.link(host)
    tree = bpy.data.node_groups.new("Scatter", "GeometryNodeTree")
    for way in ("INPUT", "OUTPUT"):
        tree.interface.new_socket("Geometry", in_out=way, socket_type="NodeSocketGeometry")
    given, out, info, put = (
        tree.nodes.new(kind)
        for kind in ("NodeGroupInput", "NodeGroupOutput", "GeometryNodeObjectInfo", "GeometryNodeInstanceOnPoints")
    )
    info.inputs["Object"].default_value, info.inputs["As Instance"].default_value = source, True
    tree.links.new(given.outputs[0], put.inputs["Points"])
    tree.links.new(info.outputs["Geometry"], put.inputs["Instance"])
    tree.links.new(put.outputs[0], out.inputs[0])
    host.modifiers.new("Scatter", "NODES").node_group = tree


if __name__ == "__main__":
    if len(sys.argv) > 1:
        print(json.dumps(measure(**json.loads(sys.argv[1]))))
    else:
        sys.exit(main())
