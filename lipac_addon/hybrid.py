"""The hybrid renderer's frame: Blender rasterizes everything, light paths over what is kept do the rest.

Blender draws on the main thread; meanwhile a worker decides what is kept, builds it, and traces. Only what needs both waits for both.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
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
from .raster.first_hits import FirstHits
from .raster.layers import save_layers
from .raster.passes import Passes, render_passes
from .timeline import Timeline

if TYPE_CHECKING:
    from ..core.film import Picture
    from ..core.hybrid import Light
    from ..core.loop import CullingResult
    from ..core.primary import Primary

AHEAD_BYTES = 1 << 28  # of first hits that wait to be traced
MOST_PASSES = 16  # of first hits; more samples than these start several paths at each hit


@dataclass(frozen=True)
class HybridOptions:
    """gi: one of `core.hybrid.MODES`. primary: one of `raster.first_hits.PRIMARY`. denoise: the traced light. raster_samples: per pixel, EEVEE's."""

    gi: str = "path"
    primary: str = "raster"
    denoise: bool = True
    raster_samples: int = 8


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

    line = Timeline()
    if options.gi == "none":
        return _without_paths(scene, options, cull, stem, line)
    scene = hybrid.with_mode(scene, options.gi)
    raster = options.primary == "raster"
    with line.stage("first hits"):
        hits = FirstHits(scene, options.primary, threads)
        scene = dataclasses.replace(scene, meshes=hits.meshes)
        sizes = (cull.picture_size(scene.film), cull.coarse_size(scene.film)) if cull.policy == "light-paths" else ()
        known = {size: dataclasses.replace(hits.draw(size, 0, 1), lamps_known=raster) for size in sizes}
    size, count = (scene.film.width, scene.film.height), min(samples, MOST_PASSES)
    choose = decide or (lambda s: analyze(s, cull, part(progress, 0.0, 0.3), cancelled))
    tracing = _Tracing(scene, samples, count, seed, threads, part(progress, 0.3, 0.95), cancelled, line)
    ahead = min(count, max(AHEAD_BYTES // (size[0] * size[1] * 16), 1))  # what is drawn before EEVEE begins is traced while it renders
    passes = None
    with ThreadPoolExecutor(1) as worker:
        decided = worker.submit(tracing.decide, lambda: choose(dataclasses.replace(scene, first_hits=known)))
        with line.stage("first hits"):
            jobs = [worker.submit(tracing.trace, hits.draw(size, k, count), k) for k in range(ahead)]
        if raster:
            with line.stage("EEVEE"):
                passes = render_passes(bpy.context.scene, options.raster_samples, unshadowed=len(scene.lights) > 0)
        for k in range(ahead, count):
            jobs[-1].result()  # no more than one waits
            with line.stage("first hits"):
                jobs.append(worker.submit(tracing.trace, hits.draw(size, k, count), k))
        for job in (decided, *jobs):
            job.result()
    if cancelled():
        raise Cancelled
    result, layers = tracing.result, tracing.layers()
    with line.stage("combine"):
        picture = _combine(tracing.light(), passes, options.denoise, threads, layers)
    if raster and hybrid.in_question(result):
        with line.stage("comparison"):
            own = _nearer_raster(scene, picture, options, cull, stem, cancelled)
        if own is not None:
            return result, _shown_by_raster(own, stem, line)
    with line.stage("saving"):
        with muted():
            save_pixels(picture, bpy.context.scene, stem)
        _save_layers(layers, stem)
    return result, _figures(line, sum(p.rays for p in tracing.pictures))


def _without_paths(scene: Scene, options: HybridOptions, cull: CullOptions, stem: Path, line: Timeline) -> tuple[CullingResult, dict[str, Any]]:
    """EEVEE's picture with all the light that it makes itself. Nothing is met, so everything is culled."""
    from ..core.loop import Loop

    if options.primary != "raster":
        raise InputError("--gi none is a raster and nothing else: it cannot do with --primary traced")
    opengl.require()
    n = len(scene.instances)
    with line.stage("EEVEE"):
        passes = render_passes(bpy.context.scene, options.raster_samples, lamps_only=False, save=stem)
    result = Loop(scene, cull).result(np.zeros(n, bool), np.zeros(n, np.float32), np.zeros((n, len(RayType)), np.int64))
    return result, _shown_by_raster(passes, stem, line)


def _nearer_raster(
    scene: Scene, picture: F32, options: HybridOptions, cull: CullOptions, stem: Path, cancelled: Callable[[], bool]
) -> Passes | None:
    """EEVEE's passes with all its own light, where its picture, saved as stem, is nearer to what paths show with nothing culled than picture is; else None."""
    from ..core import hybrid

    with ThreadPoolExecutor(1) as worker:
        truth = worker.submit(hybrid.reference, scene, cull, cancelled)
        own = render_passes(bpy.context.scene, options.raster_samples, lamps_only=False, save=stem)
    return None if hybrid.is_nearer(truth.result(), picture, own.combined) else own


def _shown_by_raster(passes: Passes, stem: Path, line: Timeline) -> dict[str, Any]:
    """Figures of a frame that EEVEE's picture shows, which is saved already; its layers are saved here."""
    _save_layers({"Combined": passes.combined} | _raster_layers(passes), stem)
    return {**_figures(line, 0), "raster_only": True}


def _save_layers(layers: dict[str, F32], stem: Path) -> None:
    save_layers(stem.with_name(f"{stem.name}_layers.exr"), layers)


def _figures(line: Timeline, rays: int) -> dict[str, Any]:
    """Of the frame, for the report. render_s: of all stages but the analysis and its structures."""
    spent = line.seconds
    return {
        "render_s": sum(seconds for stage, seconds in spent.items() if stage not in ("analysis", "building")),
        "raster_s": spent.get("first hits", 0.0) + spent.get("EEVEE", 0.0),
        "overlap_s": line.overlap,
        "timeline": line.summary(),
        "render_rays": rays,
    }


class _Tracing:
    """What the worker does: decides what is kept, builds it, traces pass after pass.

    result: what was decided. pictures: of the passes traced so far.
    """

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
        from ..core.hybrid import boxes_before_lamps
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
            instances = self.scene.instances
            blocks = ~active & (instances.flags & (1 << RayType.SHADOW) != 0)
            self._boxes = Hitboxes(boxes_before_lamps(instances.bounds, blocks), device)
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
    visible = passes.visible if passes is not None else None
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
    surfaces = {"Raster Direct": passes.direct, "Shadow": passes.visible, "Raster Albedo": passes.albedo}
    return surfaces | {"Raster Emission": passes.emission, "Raster Environment": passes.environment}
