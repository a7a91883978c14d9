"""The hybrid renderer's frame: Blender rasterizes everything, light paths over what is kept do the rest.

Blender draws on the main thread; meanwhile a worker decides what is kept, builds it, and traces. Only what needs both waits for both.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import bpy
import numpy as np

from ..core.culling import CullOptions, State
from ..core.errors import Cancelled, InputError
from ..core.progress import Progress, part, silent
from ..core.scene import F32, RayType, Scene
from .console import muted
from .pictures import save_pixels
from .raster import opengl
from .raster.denoise import denoise
from .raster.layers import save_layers
from .raster.passes import Passes, render_passes

if TYPE_CHECKING:
    from ..core.film import Picture
    from ..core.hybrid import Light
    from ..core.loop import CullingResult
    from ..core.primary import Primary

PRIMARY = ("raster", "traced")
DENOISE = ("on", "off")
AHEAD_BYTES = 1 << 28  # of first hits that wait to be traced
MOST_PASSES = 16  # of first hits; more samples than these start several paths at each hit


@dataclass(frozen=True)
class HybridOptions:
    """gi: one of `core.hybrid.MODES`. primary: "raster", or "traced" without OpenGL. denoise: the traced light. raster_samples: per pixel, EEVEE's."""

    gi: str = "path"
    primary: str = "raster"
    denoise: bool = True
    raster_samples: int = 8


@dataclass
class Timeline:
    """What ran when, in seconds since the frame began: (stage, thread, start, end)."""

    began: float = field(default_factory=time.perf_counter)
    stages: list[tuple[str, str, float, float]] = field(default_factory=list)

    @contextmanager
    def stage(self, name: str, thread: str = "main") -> Iterator[None]:
        """Times a block."""
        start = time.perf_counter() - self.began
        try:
            yield
        finally:
            self.stages.append((name, thread, start, time.perf_counter() - self.began))

    @property
    def overlap(self) -> float:
        """Seconds in which both threads were at work: what overlapping saved."""
        main, worker = ([(a, b) for _, t, a, b in self.stages if (t == "main") == wanted] for wanted in (True, False))
        return sum(max(min(b, d) - max(a, c), 0.0) for a, b in main for c, d in worker)

    @property
    def seconds(self) -> dict[str, float]:
        """By stage."""
        out: dict[str, float] = {}
        for name, _, start, end in self.stages:
            out[name] = out.get(name, 0.0) + end - start
        return out

    def summary(self) -> list[dict[str, Any]]:
        """For the report, by start; stages of one name that follow each other on a thread are one."""
        merged: list[dict[str, Any]] = []
        last: dict[str, dict[str, Any]] = {}
        for name, thread, start, end in sorted(self.stages, key=lambda s: s[2]):
            before = last.get(thread)
            if before and before["stage"] == name:
                before["end_s"] = end
            else:
                last[thread] = {"stage": name, "thread": thread, "start_s": start, "end_s": end}
                merged.append(last[thread])
        return merged


class FirstHits:
    """First hits of the whole scene, culled instances included, by a raster or by rays over everything (built for it, and freed again)."""

    def __init__(self, scene: Scene, primary: str, threads: int = 0) -> None:
        """Raises InputError where there is no OpenGL and primary asks for it."""
        if primary not in PRIMARY:
            raise InputError(f"unknown first hits '{primary}': choose one of {', '.join(PRIMARY)}")
        self.scene = scene
        self.draw: Callable[[tuple[int, int], int, int], Primary]
        if primary == "raster":
            opengl.require()
            from .raster.gbuffer import GBuffer

            buffer = GBuffer(scene)
            self.meshes, self.draw = buffer.meshes, buffer.draw
            return
        from ..core.blas import BlasCache
        from ..core.embree import shared_device
        from ..core.primary import MeshTable, in_view, pass_camera, trace_primary
        from ..core.tlas import Tlas

        seen = in_view(scene)
        blas = BlasCache(scene.meshes, shared_device(threads))
        blas.need(scene.instances.mesh[seen])
        tlas = Tlas(scene.instances, blas, seen)
        self.meshes = MeshTable(scene.meshes)

        def draw(size: tuple[int, int], index: int = 0, count: int = 1) -> Primary:
            return trace_primary(tlas, self.meshes, pass_camera(scene.camera, scene.film, size, index, count), size, scene.instances.mesh)

        self.draw = draw


def render_hybrid(
    scene: Scene,
    options: HybridOptions,
    cull: CullOptions,
    stem: Path,
    samples: int,
    seed: int = 0,
    threads: int = 0,
    progress: Progress = silent,
    cancelled: Callable[[], bool] = lambda: False,
    decide: Callable[[Scene], CullingResult] | None = None,
) -> tuple[CullingResult, dict[str, Any]]:
    """Cull and render the current frame of the open file; save stem.exr, stem.png and stem_layers.exr. Returns what was decided, and figures for the report.

    scene: the frame, extracted. samples: paths per pixel. decide: what culls, on a worker thread; the default analyses this frame by itself.
    Raises InputError where it cannot be rendered, Cancelled where cancelled() says so.
    """
    from ..core import hybrid
    from ..core.analysis import analyze

    blender_scene, line = bpy.context.scene, Timeline()
    if options.gi == "none":
        return _raster_only(scene, options, cull, stem, line)
    scene = hybrid.with_mode(scene, options.gi)
    with line.stage("first hits"):
        hits = FirstHits(scene, options.primary, threads)
        scene = dataclasses.replace(scene, meshes=hits.meshes)
        sizes = (cull.picture_size(scene.film), cull.coarse_size(scene.film)) if cull.policy == "light-paths" else ()
        known = {size: hits.draw(size, 0, 1) for size in sizes}
    size, count = (scene.film.width, scene.film.height), min(samples, MOST_PASSES)
    choose = decide or (lambda s: analyze(s, cull, part(progress, 0.0, 0.3), cancelled))
    tracing = _Tracing(scene, samples, count, seed, threads, part(progress, 0.3, 0.95), cancelled, line)
    ahead = min(count, max(AHEAD_BYTES // (size[0] * size[1] * 16), 1))  # what is drawn before EEVEE begins is traced while it renders
    with ThreadPoolExecutor(1) as worker:
        decided = worker.submit(tracing.decide, lambda: choose(dataclasses.replace(scene, first_hits=known)))
        with line.stage("first hits"):
            jobs = [worker.submit(tracing.trace, hits.draw(size, k, count), k) for k in range(ahead)]
        passes = None
        if options.primary == "raster":
            with line.stage("EEVEE"):
                passes = render_passes(blender_scene, options.raster_samples)
        for k in range(ahead, count):
            jobs[-1].result()  # no more than one waits
            with line.stage("first hits"):
                jobs.append(worker.submit(tracing.trace, hits.draw(size, k, count), k))
        for job in (decided, *jobs):
            job.result()
    if cancelled():
        raise Cancelled
    result, light, layers = tracing.result, tracing.light(), tracing.layers()
    if options.primary == "raster" and not result.active.any():  # nothing to meet: EEVEE's own sky and probes know more than paths that miss everything
        return _raster_only(scene, options, cull, stem, line, result)
    with line.stage("combine"):
        picture = _combine(light, passes, options.denoise, threads, layers)
        with muted():
            save_pixels(picture, blender_scene, stem)
        save_layers(stem.with_name(f"{stem.name}_layers.exr"), layers)
    spent = line.seconds
    figures = {
        "render_s": sum(spent.get(name, 0.0) for name in ("first hits", "EEVEE", "tracing", "combine")),
        "raster_s": spent.get("first hits", 0.0) + spent.get("EEVEE", 0.0),
        "overlap_s": line.overlap,
        "timeline": line.summary(),
        "render_rays": sum(p.rays for p in tracing.pictures),
    }
    return result, figures


def _raster_only(
    scene: Scene, options: HybridOptions, cull: CullOptions, stem: Path, line: Timeline, result: CullingResult | None = None
) -> tuple[CullingResult, dict[str, Any]]:
    """No path at all: EEVEE's picture with all the light that it makes itself. Nothing is met, so everything is culled."""
    from ..core.loop import Loop

    if options.primary != "raster":
        raise InputError("--gi none is a raster and nothing else: it cannot do with --primary traced")
    opengl.require()
    n = len(scene.instances)
    with ThreadPoolExecutor(1) as worker:
        nothing = np.zeros(n, bool), np.zeros(n, np.float32), np.zeros((n, len(RayType)), np.int64)
        future = worker.submit(lambda: result or Loop(scene, cull).result(*nothing))
        with line.stage("EEVEE"):
            passes = render_passes(bpy.context.scene, options.raster_samples, lamps_only=False)
        result = future.result()
    with muted():
        save_pixels(passes.combined, bpy.context.scene, stem)
    save_layers(stem.with_name(f"{stem.name}_layers.exr"), {"Combined": passes.combined} | _raster_layers(passes))
    spent = line.seconds["EEVEE"]
    return result, {"render_s": spent, "raster_s": spent, "overlap_s": line.overlap, "timeline": line.summary(), "render_rays": 0}


class _Tracing:
    """What the worker does: decides what is kept, builds it, traces pass after pass."""

    result: CullingResult

    def __init__(
        self, scene: Scene, samples: int, passes: int, seed: int, threads: int, progress: Progress, cancelled: Callable[[], bool], line: Timeline
    ) -> None:
        self.scene, self.seed, self.threads, self.progress, self.cancelled, self.line = scene, seed, threads, progress, cancelled, line
        self.size = (scene.film.width, scene.film.height)
        self.first = np.linspace(0, samples, passes + 1).round().astype(int)  # sample number of each pass
        self.pictures: list[Picture] = []
        self._shown = np.zeros((self.size[1], self.size[0], 8), np.float32)  # as `layers` names them

    def decide(self, choose: Callable[[], CullingResult]) -> None:
        """What is kept, and its structures."""
        from ..core.blas import BlasCache
        from ..core.embree import shared_device
        from ..core.hitboxes import Hitboxes
        from ..core.tlas import Tlas
        from ..core.tracer import prepare

        with self.line.stage("analysis", "worker"):
            result = choose()
        with self.line.stage("building", "worker"):
            device, active = shared_device(self.threads), result.active
            blas = BlasCache(self.scene.meshes, device)
            blas.need(self.scene.instances.mesh[active])
            self._tlas = Tlas(self.scene.instances, blas, active)
            self._prepared = prepare(self.scene, blas).with_emitters(active)
            self._boxes = Hitboxes(result.boxes, device)
        self.result = result

    def trace(self, primary: Primary, index: int) -> None:
        """Paths of a pass."""
        from ..core.guides import guides
        from ..core.tracer import trace

        if self.cancelled() or not hasattr(self, "result"):
            return
        with self.line.stage("tracing", "worker"):
            one = dataclasses.replace(self._prepared, scene=dataclasses.replace(self.scene, first_hits={self.size: primary}))
            first, last = self.first[index : index + 2].tolist()
            within = part(self.progress, index / (len(self.first) - 1), (index + 1) / (len(self.first) - 1))
            picture = trace(
                one, self._tlas, last - first, first, self.seed, threads=self.threads, progress=within, cancelled=self.cancelled, boxes=self._boxes
            )
            self.pictures.append(picture)
            self._shown += np.concatenate([_decided(primary, self.result), guides(self._prepared.table, primary)], axis=2)

    def light(self) -> Light:
        """Of all passes."""
        from ..core.hybrid import Light

        return Light.of(self.pictures)

    def layers(self) -> dict[str, F32]:
        """What was decided about what is seen, its base colours and normals."""
        shown = self._shown / np.float32(len(self.pictures))
        return {"Culling State": shown[..., 0], "Hit Feedback": shown[..., 1], "Albedo": shown[..., 2:5], "Normal": shown[..., 5:8]}


def _decided(primary: Primary, result: CullingResult) -> F32:
    """(H, W, 2) of what is seen: 1 where active, 0 where culled or nothing; and log10(1 + n) of the n rays of the analysis that met it."""
    instance = primary.hits["instance"]
    there = instance >= 0
    met = np.log10(1.0 + result.hits.sum(axis=1))
    active = there & (result.state[instance] == State.ACTIVE)
    return np.stack([active, np.where(there, met[instance], 0.0)], axis=2).astype(np.float32)


def _combine(light: Light, passes: Passes | None, clean: bool, threads: int, layers: dict[str, F32]) -> F32:
    """The picture, (H, W, 4), and its parts into layers."""
    visible = passes.shadow if passes is not None else None
    lamps = light.lamps(visible)
    traced = lamps + light.indirect
    layers["Traced Indirect"], layers["Traced Lamps"] = light.indirect, lamps
    if clean:
        traced = denoise(traced, passes.albedo if passes is not None else layers["Albedo"], layers["Normal"], threads)
        layers["Denoised"] = traced
    picture = np.concatenate([light.straight + traced, light.alpha[..., None]], axis=2)
    layers["Combined"] = picture
    layers["Shadow Doubt"] = light.doubt(visible)
    if passes is not None:
        layers |= _raster_layers(passes)
    return picture


def _raster_layers(passes: Passes) -> dict[str, F32]:
    surfaces = {"Raster Direct": passes.direct, "Shadow": passes.shadow, "Raster Albedo": passes.albedo}
    return surfaces | {"Raster Emission": passes.emission, "Raster Environment": passes.environment}
