"""Benchmark parts that trace: rays per second against a bare loop in C, paths per second against other path tracers,
seconds to compile."""

from __future__ import annotations

import ctypes
import os
import shutil
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numba import njit

from ...core.accel.embree import DIR, NG, ORG, RAY, TFAR, intersect, lib, set_ray
from ...core.accel.hitboxes import QUERY, count_crossings
from ...core.accel.tlas import hit_instance
from ...core.jit.atomics import atomic_add
from ...core.scene.model import RAY_TYPES
from .compare import cores

RAYS = 1_000_000  # of each kind
REPEATS = 7
_CHUNK = 1 << 12


def interleaved(jobs: dict[str, Callable[[], float]], repeats: int) -> dict[str, float]:
    """Median seconds of each job; the jobs take turns, so that what else the machine does meets all of them. A job
    returns its seconds."""
    seconds: dict[str, list[float]] = {name: [] for name in jobs}
    for _ in range(repeats):
        for name, job in jobs.items():
            seconds[name].append(job())
    return {name: statistics.median(values) for name, values in seconds.items()}


@njit(nogil=True, cache=True, error_model="numpy")
def _feedback_loop(tlas, ids, first, hitboxes, counters, box_every, rays, start, stop, hits, ray_type):
    """Trace rays start to stop of (n, 6) float32 with the path tracer's feedback: a hit counts for its instance, every
    `box_every`-th ray for boxes crossed."""
    ray, query = np.empty(RAY, np.float32), np.empty(QUERY, np.int64)
    for i in range(start, stop):
        set_ray(ray, rays[i, 0], rays[i, 1], rays[i, 2], rays[i, 3], rays[i, 4], rays[i, 5], 0.0, 1e30, 0xFFFFFFFF)
        if intersect(tlas, ray):
            atomic_add(hits, (hit_instance(ids, first, ray), ray_type), 1)
        if box_every > 0 and i % box_every == 0:
            count_crossings(hitboxes, counters, query, ray, ray[TFAR], ray_type, 0)


@njit(nogil=True, cache=True, error_model="numpy")
def _bounce(tlas, ids, first, transform, rays, uniform, out):
    """Rays of (n, 6) float32 that leave diffusely where `rays` hit; the number of them."""
    ray = np.empty(RAY, np.float32)
    count = 0
    for i in range(len(rays)):
        set_ray(ray, rays[i, 0], rays[i, 1], rays[i, 2], rays[i, 3], rays[i, 4], rays[i, 5], 0.0, 1e30, 0xFFFFFFFF)
        if not intersect(tlas, ray):
            continue
        m = transform[hit_instance(ids, first, ray)]
        n = np.zeros(3)
        for a in range(3):  # rotation and uniform scale: the linear part turns normals as well
            n[a] = m[a, 0] * ray[NG] + m[a, 1] * ray[NG + 1] + m[a, 2] * ray[NG + 2]
        n /= np.sqrt((n * n).sum())
        if n[0] * ray[DIR] + n[1] * ray[DIR + 1] + n[2] * ray[DIR + 2] > 0.0:
            n = -n
        z = 2.0 * uniform[i, 0] - 1.0  # cosine-distributed: the normal plus a point of the unit sphere
        r, phi = np.sqrt(max(0.0, 1.0 - z * z)), 2.0 * np.pi * uniform[i, 1]
        d = n + np.array([r * np.cos(phi), r * np.sin(phi), z])
        d /= max(np.sqrt((d * d).sum()), 1e-9)
        for a in range(3):
            out[count, a] = ray[ORG + a] + ray[TFAR] * ray[DIR + a] + 1e-3 * n[a]
            out[count, 3 + a] = d[a]
        count += 1
    return count


def _camera_rays(camera: Any, count: int, rng: np.random.Generator) -> np.ndarray:
    """Rays (count, 6) float32 through the picture, row by row as a renderer would."""
    left, right, bottom, top = camera.frame
    width = int(np.sqrt(count * 16 / 9))
    i = np.arange(count)
    x = left + (right - left) * ((i % width) + rng.uniform(size=count)) / width
    y = bottom + (top - bottom) * ((i // width) + rng.uniform(size=count)) / (count / width)
    direction = np.stack([x, y, -np.ones(count)], 1) @ camera.to_world[:, :3].T
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return np.concatenate([np.broadcast_to(camera.to_world[:, 3], (count, 3)), direction], 1).astype(np.float32)


def _compiled(folder: Path) -> ctypes.CDLL | None:
    """The C loop, compiled into folder; None where there is no compiler."""
    compiler = os.environ.get("CC") or shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    if not compiler:
        return None
    target = folder.resolve() / "bare_loop.so"
    source = Path(__file__).with_name("bare_loop.c")
    subprocess.run([compiler, "-O3", "-march=native", "-shared", "-fPIC", "-pthread", "-o", target, source], check=True)
    library = ctypes.CDLL(str(target))
    library.bare_loop.restype = ctypes.c_size_t
    library.bare_loop.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int]
    return library


def rays(folder: Path) -> dict[str, Any]:
    """Rays per second with feedback, over those of the bare loop: mirror-city with 100,000 instances all active, then
    culled with hitboxes."""
    library = _compiled(folder)
    if library is None:
        return {"skipped": "no C compiler (cc) here"}
    from ...core.accel.blas import BlasCache
    from ...core.accel.hitboxes import Hitboxes
    from ...core.accel.tlas import Tlas
    from ...core.culling.analysis import analyze
    from ...core.culling.options import CullOptions

    scene = _city(100_000)
    blas = BlasCache(scene.meshes)
    blas.need(scene.instances.mesh)
    everything = Tlas(scene.instances, blas, np.ones(len(scene.instances), bool))
    culling = analyze(scene, CullOptions())
    kept, boxes = Tlas(scene.instances, blas, culling.active), Hitboxes(culling.boxes)
    rng = np.random.default_rng(0)
    kinds = {"camera": _camera_rays(scene.camera, RAYS, rng)}
    bounced = np.empty_like(kinds["camera"])
    count = _bounce(
        everything.handle,
        everything.ids,
        everything.first,
        scene.instances.transform,
        kinds["camera"],
        rng.uniform(size=(RAYS, 2)),
        bounced,
    )
    kinds["diffuse bounce"] = bounced[:count].copy()
    function = ctypes.cast(lib.rtcIntersect1, ctypes.c_void_p)
    threads = cores()
    hits = np.zeros((len(scene.instances), RAY_TYPES), np.int64)
    out: dict[str, Any] = {
        "threads": threads,
        "instances": len(scene.instances),
        "active": int(culling.active.sum()),
        "hitboxes": len(boxes),
        "cases": [],
    }

    def bare(tlas: Tlas, batch: np.ndarray) -> float:
        start = time.perf_counter()
        library.bare_loop(function, int(tlas.handle), batch.ctypes.data, len(batch), threads)
        return time.perf_counter() - start

    def ours(tlas: Tlas, batch: np.ndarray, box_every: int) -> float:
        def work(first: int) -> None:
            stop = min(first + _CHUNK, len(batch))
            _feedback_loop(
                tlas.handle, tlas.ids, tlas.first, boxes.handle, boxes.counters, box_every, batch, first, stop, hits, 0
            )

        start = time.perf_counter()
        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(work, range(0, len(batch), _CHUNK)))
        return time.perf_counter() - start

    for label, tlas, box_every in (
        ("all active", everything, 0),
        ("culled, boxes on every 8th ray", kept, 8),
        ("culled, boxes on every ray", kept, 1),
    ):
        for kind, batch in kinds.items():
            ours(tlas, batch[:_CHUNK], box_every)  # compiled before the clock runs
            took = interleaved(
                {"bare": partial(bare, tlas, batch), "ours": partial(ours, tlas, batch, box_every)}, REPEATS
            )
            case = {
                "case": label,
                "rays": kind,
                "bare": len(batch) / took["bare"],
                "ours": len(batch) / took["ours"],
                "ratio": took["bare"] / took["ours"],
            }
            out["cases"].append(case)
    return out


def _city(instances: int) -> Any:
    import bpy

    from ...lipac_addon.demo import build
    from ...lipac_addon.extract import extract_frame

    build("mirror-city", instances)
    return extract_frame(bpy.context.scene).scene


_START = """
import sys, time
import bpy
from lipac.core.culling.options import CullOptions
from lipac.lipac_addon.extract import extract_frame
bpy.ops.wm.open_mainfile(filepath=sys.argv[1])
start = time.perf_counter()
scene = extract_frame(bpy.context.scene).scene
from lipac.core.culling.analysis import analyze
analyze(scene, CullOptions(width=16, paths=1))
print("SECONDS", time.perf_counter() - start)
"""


def feedback(_folder: Path) -> dict[str, Any]:
    """Seconds to trace the paths of a measurement of mirror-city with default options: bare; with hits, weights and
    path logs; and to decide by them.

    Deciding: relative weights, the selection, states and hysteresis; not the trials, which trace again.
    """
    from ...core.culling.loop import Loop
    from ...core.culling.options import CullOptions
    from ...core.error_budget.budget import Savings, select
    from ...core.error_budget.error_estimate import Reference
    from ...core.tracing.tracer import trace

    loop = Loop(_city(20_000), CullOptions())
    loop.run()
    tlas = loop.tracer.build(loop.activation.active)
    samples = loop.options.paths_per_pixel(loop.scene.film)
    measured = loop.measure(tlas, samples)  # all that it may take
    budget, mesh = loop.options.max_error, loop.scene.instances.mesh[tlas.ids]

    def timed(job: Callable[[], object]) -> Callable[[], float]:
        def run() -> float:
            start = time.perf_counter()
            job()
            return time.perf_counter() - start

        return run

    def decide() -> None:
        Reference(measured.log)
        selection = select(
            measured.weights.relative(), Savings.among(mesh, loop.blas.bytes_of).share, budget.mean, budget.worst
        )
        keep = np.zeros(len(loop.activation.active), bool)
        keep[tlas.ids[~selection.cull]] = True
        loop.result(keep, np.zeros(len(keep), np.float32), measured.feedback.hits)

    bare = timed(lambda: trace(loop.tracer.prepared, tlas, samples, size=loop.size))
    seconds = interleaved(
        {"bare": bare, "measured": timed(lambda: loop.measure(tlas, samples)), "deciding": timed(decide)}, 9
    )
    return {
        "seconds": seconds,
        "paths": int(measured.feedback.paths),
        "instances": len(loop.activation.active),
        "active": len(tlas),
    }


def compiling(folder: Path) -> dict[str, Any]:
    """Seconds from the file being open to the end of an analysis of a few pixels: with no kernel compiled, and with all
    of them cached."""
    from .compare import lipac

    scene = folder / "small-city.blend"
    lipac("demo", "mirror-city", "-o", scene, "--instances", "1000")
    cache = folder.resolve() / "numba"
    shutil.rmtree(cache, ignore_errors=True)
    environment = os.environ | {"LIPAC_CACHE_DIR": str(cache)}
    seconds = []
    for _ in range(4):
        done = subprocess.run(
            [sys.executable, "-c", _START, scene], env=environment, stdout=subprocess.PIPE, text=True, check=True
        )
        seconds.append(float(done.stdout.split("SECONDS")[1].split()[0]))
    shutil.rmtree(cache, ignore_errors=True)
    warm = statistics.median(seconds[1:])
    return {"cold_s": seconds[0], "warm_s": warm, "compile_s": seconds[0] - warm}
