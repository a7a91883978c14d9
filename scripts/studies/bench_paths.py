"""Benchmark part: paths per second against other path tracers."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from .bench_tracing import interleaved
from .compare import cores

SPHERES, SIDE, SAMPLES, BOUNCES = 10_000, 256, 16, 2


def _spheres() -> Any:
    """10,000 linked diffuse spheres under a constant sky; at most two bounces, so three vertices a path. Returns
    positions (n, 3)."""
    import bpy

    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    bpy.ops.mesh.primitive_uv_sphere_add(segments=32, ring_count=16, radius=0.4)
    first = bpy.context.object
    material = bpy.data.materials.new("Diffuse")
    tree = material.node_tree
    tree.nodes.remove(tree.nodes["Principled BSDF"])
    diffuse = tree.nodes.new("ShaderNodeBsdfDiffuse")
    diffuse.inputs["Color"].default_value = (0.8, 0.8, 0.8, 1)
    tree.links.new(diffuse.outputs[0], tree.nodes["Material Output"].inputs["Surface"])
    first.data.materials.append(material)
    at = np.random.default_rng(0).uniform(-15, 15, (SPHERES, 3))
    for k, position in enumerate(at.tolist()):
        copy = bpy.data.objects.new(f"Sphere {k}", first.data) if k else first
        copy.location = position
        if k:
            scene.collection.objects.link(copy)
    world = bpy.data.worlds.new("Sky")
    world.node_tree.nodes["Background"].inputs["Color"].default_value = (1, 1, 1, 1)
    scene.world = world
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    camera.location = (0, -45, 0)
    camera.rotation_euler = (np.pi / 2, 0, 0)
    scene.collection.objects.link(camera)
    scene.camera = camera
    scene.render.engine = "CYCLES"
    scene.render.resolution_x = scene.render.resolution_y = SIDE
    cycles = scene.cycles
    cycles.device, cycles.samples, cycles.use_adaptive_sampling, cycles.use_denoising = "CPU", SAMPLES, False, False
    cycles.max_bounces, cycles.diffuse_bounces = BOUNCES, BOUNCES
    cycles.sample_clamp_indirect = 0
    return at


def _mitsuba(positions: Any, camera: Any, mesh: Any) -> tuple[Callable[[], float], Callable[[], float]] | None:
    """Seconds of, and mean of, the same picture by Mitsuba 3 `scalar_rgb`; None where it is not installed."""
    try:
        import mitsuba as mi
    except ImportError:
        return None
    mi.set_variant("scalar_rgb")
    shape = mi.Mesh("sphere", len(mesh.positions), len(mesh.triangles))
    parameters = mi.traverse(shape)
    parameters["vertex_positions"], parameters["faces"] = mesh.positions.ravel(), mesh.triangles.ravel()
    parameters.update()
    ply = Path(os.environ.get("TMPDIR", "/tmp")) / f"lipac-bench-{os.getpid()}.ply"
    shape.write_ply(str(ply))
    fov = float(np.degrees(2 * np.arctan(camera.frame[1])))
    # Mitsuba's camera looks along +Z with +X to the left
    turned = np.vstack([camera.to_world @ np.diag([-1.0, 1, -1, 1]), [0, 0, 0, 1]])
    diffuse = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.8}}
    scene: dict[str, Any] = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": BOUNCES + 2, "rr_depth": 100},
        "sensor": {
            "type": "perspective",
            "fov": fov,
            "to_world": mi.ScalarTransform4f(turned),
            "film": {"type": "hdrfilm", "width": SIDE, "height": SIDE, "rfilter": {"type": "box"}},
            "sampler": {"type": "independent", "sample_count": SAMPLES},
        },
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": 1.0}},
        "group": {
            "type": "shapegroup",
            "sphere": {"type": "ply", "filename": str(ply), "face_normals": True, "bsdf": diffuse},
        },
    }
    for k, position in enumerate(positions.tolist()):
        scene[f"i{k}"] = {
            "type": "instance",
            "to_world": mi.ScalarTransform4f().translate(position),
            "group": {"type": "ref", "id": "group"},
        }
    loaded = mi.load_dict(scene)
    ply.unlink()
    last: dict[str, Any] = {}

    def seconds() -> float:
        start = time.perf_counter()
        last["picture"] = np.array(mi.render(loaded))
        return time.perf_counter() - start

    return seconds, lambda: float(last["picture"].mean())


def paths(folder: Path) -> dict[str, Any]:
    """Paths per second of one scene by the project's path tracer, by Mitsuba 3 and by Cycles on the CPU."""
    import bpy

    from ...core.accel.blas import BlasCache
    from ...core.accel.tlas import Tlas
    from ...core.tracing.tracer import prepare, trace
    from ...lipac_addon.console import muted
    from ...lipac_addon.extract import extract_frame
    from ...lipac_addon.pictures import read_picture, save_render_result

    positions = _spheres()
    scene = extract_frame(bpy.context.scene).scene
    blas = BlasCache(scene.meshes)
    blas.need(scene.instances.mesh)
    prepared, tlas = prepare(scene, blas), Tlas(scene.instances, blas, np.ones(len(scene.instances), bool))
    means: dict[str, float] = {}

    def ours() -> float:
        start = time.perf_counter()
        picture = trace(prepared, tlas, SAMPLES)
        seconds = time.perf_counter() - start
        means["ours"] = float(picture.mean[..., :3].mean())
        return seconds

    def cycles(samples: int) -> float:
        bpy.context.scene.cycles.samples = samples
        start = time.perf_counter()
        with muted():
            bpy.ops.render.render()
        return time.perf_counter() - start

    many = 4 * SAMPLES  # Cycles has no clock for sampling alone: the difference between many and few samples
    trace(prepared, tlas, 1)
    jobs: dict[str, Callable[[], float]] = {
        "ours": ours,
        "Cycles few": lambda: cycles(SAMPLES),
        "Cycles many": lambda: cycles(SAMPLES + many),
    }
    # The scene of Mitsuba is in Blender's world, the core's camera is relative to its origin.
    absolute = scene.camera.to_world.copy()
    absolute[:, 3] += scene.origin
    peer = _mitsuba(positions, replace(scene.camera, to_world=absolute), scene.meshes[int(scene.instances.mesh[0])])
    if peer:
        jobs["Mitsuba 3 scalar_rgb"] = peer[0]
    took = interleaved(jobs, 3)
    with muted():
        save_render_result(bpy.context.scene, folder / "spheres")
    means["Cycles"] = float(read_picture(folder / "spheres.exr")[..., :3].mean())
    n = SIDE * SIDE * SAMPLES
    out = {"ours": n / took["ours"], "Cycles": SIDE * SIDE * many / (took["Cycles many"] - took["Cycles few"])}
    if peer:
        out["Mitsuba 3 scalar_rgb"] = n / took["Mitsuba 3 scalar_rgb"]
        means["Mitsuba 3 scalar_rgb"] = peer[1]()
    return {"threads": cores(), "instances": SPHERES, "bounces": BOUNCES, "paths_per_s": out, "mean_radiance": means}
