"""The hybrid renderer's frame: Blender rasterizes everything, light paths over what is kept do the rest.

Blender draws on the main thread; meanwhile a worker decides what is kept, builds it, and traces. Only what needs both
waits for both.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import bpy
import numpy as np

from ....core.arrays import F32
from ....core.culling.options import CullOptions, State
from ....core.culling.policies import LIGHT_PATHS
from ....core.errors import Cancelled, InputError
from ....core.progress import Progress, part, silent
from ....core.scene.model import RayType, Scene
from ...console import muted
from ...pictures import save_pixels
from ...raster import opengl
from ...raster.denoise import denoise
from ...raster.denoise import require as require_denoiser
from ...raster.first_hits import FirstHits, first_hits
from ...raster.layers import save_layers
from ...raster.passes import Passes, render_passes
from ...timeline import Timeline

if TYPE_CHECKING:
    from ....core.culling.result import CullingResult
    from ....core.hybrid.composition import Light
    from ....core.scene.film import Picture
    from ....core.scene.model import FirstHitBuffer

AHEAD_BYTES = 1 << 28  # of first hits that wait to be traced
MOST_PASSES = 16  # of first hits; more samples than these start several paths at each hit


@dataclass(frozen=True)
class HybridOptions:
    """gi: one of `composition.MODES`. primary: one of `raster.first_hits.PRIMARY`. denoise: the traced light.
    raster_samples: per pixel, EEVEE's."""

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
    """Cull and render the current frame of the open file; save stem.exr, stem.png and stem_layers.exr. Returns what was
    decided, and figures for the report.

    scene: the frame, extracted. samples: paths per pixel. decide: what culls, on a worker thread; the default analyses
    this frame by itself.
    Raises InputError where it cannot be rendered, Cancelled where cancelled() says so.
    """
    from ....core.culling.analysis import analyze
    from ....core.hybrid import composition

    line = Timeline()
    if options.gi == "none":
        return _without_paths(scene, options, cull, stem, line)
    if options.denoise:
        require_denoiser()
    with line.stage("first hits"):
        hits = first_hits(composition.with_mode(scene, options.gi), options.primary, threads)
    scene = dataclasses.replace(hits.scene, meshes=hits.meshes)
    choose = decide or (lambda s: analyze(s, cull, part(progress, 0.0, 0.3), cancelled))
    tracing = _Tracing(scene, samples, seed, threads, part(progress, 0.3, 0.95), cancelled, line)
    passes = _draw(hits, tracing, choose, _sizes(scene, cull), options, line)
    del hits  # and what it has built
    if cancelled():
        raise Cancelled
    with line.stage("combine"):
        picture, layers = _combine(tracing.light(), passes, tracing.shown(), options.denoise, threads)
    share = 1.0
    if passes is not None and (asked := composition.in_question(tracing.result)) > 0:
        with line.stage("comparison"):
            truth, own = _compared(scene, options, cull, stem, cancelled)
            share = 1 - asked * (1 - composition.share_of_paths(truth, picture, own))
            picture = layers["Combined"] = composition.mixture(picture, own, share)
    with line.stage("saving"):
        if share > 0:
            with muted():
                save_pixels(picture, bpy.context.scene, stem)
        _save_layers(layers, stem)
    return tracing.result, _figures(line, tracing.rays, share)


def _sizes(scene: Scene, cull: CullOptions) -> tuple[tuple[int, int], ...]:
    """Of the pictures that an analysis traces."""
    return (cull.picture_size(scene.film), cull.coarse_size(scene.film)) if cull.policy == LIGHT_PATHS else ()


def _draw(
    hits: FirstHits,
    tracing: _Tracing,
    choose: Callable[[Scene], CullingResult],
    sizes: Sequence[tuple[int, int]],
    options: HybridOptions,
    line: Timeline,
) -> Passes | None:
    """Draw first hits and EEVEE's passes while tracing decides by `choose`, and traces. sizes: of pictures that this
    needs first hits of. None: no raster."""
    raster = options.primary == "raster"
    with line.stage("first hits"):
        known = {size: dataclasses.replace(hits.draw(size, 0, 1), lamps_known=raster) for size in sizes}
    size, count, passes = tracing.size, tracing.passes, None
    # what is drawn before EEVEE begins is traced while it renders
    ahead = min(count, max(AHEAD_BYTES // (size[0] * size[1] * 16), 1))
    with ThreadPoolExecutor(1) as worker, tracing.stopping():
        decided = worker.submit(tracing.decide, lambda: choose(dataclasses.replace(tracing.scene, first_hits=known)))
        with line.stage("first hits"):
            jobs = [worker.submit(tracing.trace, hits.draw(size, k, count), k) for k in range(ahead)]
        if raster:
            with line.stage("EEVEE"):
                passes = render_passes(
                    bpy.context.scene, options.raster_samples, unshadowed=len(tracing.scene.lights) > 0
                )
        decided.result()
        for k in range(ahead, count):
            jobs[-1].result()  # no more than one waits
            with line.stage("first hits"):
                jobs.append(worker.submit(tracing.trace, hits.draw(size, k, count), k))
        for job in jobs:
            job.result()
    return passes


def _without_paths(
    scene: Scene, options: HybridOptions, cull: CullOptions, stem: Path, line: Timeline
) -> tuple[CullingResult, dict[str, Any]]:
    """EEVEE's picture with all the light that it makes itself. Nothing is met, so everything is culled."""
    from ....core.culling.loop import Loop

    if options.primary != "raster":
        raise InputError("--gi none is a raster and nothing else: it cannot do with --primary traced")
    opengl.require()
    n = len(scene.instances)
    with line.stage("EEVEE"):
        passes = render_passes(bpy.context.scene, options.raster_samples, lamps_only=False, save=stem)
    result = Loop(scene, cull).result(np.zeros(n, bool), np.zeros(n, np.float32), np.zeros((n, len(RayType)), np.int64))
    with line.stage("saving"):
        _save_layers({"Combined": passes.combined} | _raster_layers(passes), stem)
    return result, _figures(line, 0, 0.0)


def _compared(
    scene: Scene, options: HybridOptions, cull: CullOptions, stem: Path, cancelled: Callable[[], bool]
) -> tuple[F32, F32]:
    """What paths show with nothing culled (`composition.reference`), and EEVEE's picture with all its own light, (H, W,
    4), which is saved as stem."""
    from ....core.hybrid import composition

    with ThreadPoolExecutor(1) as worker:
        truth = worker.submit(composition.reference, scene, cull, cancelled)
        own = render_passes(bpy.context.scene, options.raster_samples, lamps_only=False, save=stem)
        return truth.result(), own.combined


def _save_layers(layers: dict[str, F32], stem: Path) -> None:
    save_layers(stem.with_name(f"{stem.name}_layers.exr"), layers)


def _figures(line: Timeline, rays: int, share: float) -> dict[str, Any]:
    """Of the frame, for the report. render_s: in which anything but the analysis and its structures was at work. share:
    of the picture that paths have made."""
    spent = line.seconds
    return {
        "render_s": line.elapsed(without=("analysis", "building")),
        "raster_s": spent.get("first hits", 0.0) + spent.get("EEVEE", 0.0),
        "overlap_s": line.overlap,
        "timeline": line.summary(),
        "render_rays": rays,
        "path_share": share,
    }


class _Tracing:
    """What the worker does: decides what is kept, builds it, traces pass after pass.

    result: what was decided. passes: how many passes of first hits there are to be. rays: traced so far.
    """

    result: CullingResult

    def __init__(
        self,
        scene: Scene,
        samples: int,
        seed: int,
        threads: int,
        progress: Progress,
        cancelled: Callable[[], bool],
        line: Timeline,
    ) -> None:
        self.scene, self.seed, self.threads, self.progress, self.line = scene, seed, threads, progress, line
        self.size, self.passes = (scene.film.width, scene.film.height), min(samples, MOST_PASSES)
        self._cancelled, self._failed = cancelled, False
        self._first = np.linspace(0, samples, self.passes + 1).round().astype(int)  # sample number of each pass
        self._picture: Picture | None = None  # sums over the passes so far
        self._shown = np.zeros((self.size[1], self.size[0], 8), np.float32)  # likewise, as `shown` names them

    @contextmanager
    def stopping(self) -> Iterator[None]:
        """A block after whose failure nothing more is traced: who waits for the worker does not wait long."""
        try:
            yield
        except BaseException:
            self._failed = True
            raise

    @property
    def rays(self) -> int:
        return self._picture.rays if self._picture is not None else 0

    def decide(self, choose: Callable[[], CullingResult]) -> None:
        """What is kept, and its structures."""
        from ....core.accel.embree import shared_device
        from ....core.accel.hitboxes import Hitboxes
        from ....core.hybrid.composition import boxes_before_lamps

        with self.stopping():
            with self.line.stage("analysis", "worker"):
                result = choose()
            with self.line.stage("building", "worker"):
                device, active = shared_device(self.threads), result.active
                assert result.built is not None
                self._tlas = result.built.tlas
                self._prepared = result.built.prepared.with_emitters(active)
                instances = self.scene.instances
                blocks = ~active & (instances.flags & (1 << RayType.SHADOW) != 0)
                self._boxes = Hitboxes(boxes_before_lamps(instances.bounds, blocks), device)
            self.result = result

    def trace(self, primary: FirstHitBuffer, index: int) -> None:
        """Paths of a pass. Raises Cancelled, also where something else has failed."""
        from ....core.hybrid.composition import added
        from ....core.hybrid.denoiser_guides import guides
        from ....core.tracing.tracer import trace

        self._check()
        with self.stopping(), self.line.stage("tracing", "worker"):
            one = dataclasses.replace(
                self._prepared, scene=dataclasses.replace(self.scene, first_hits={self.size: primary})
            )
            first, last = self._first[index : index + 2].tolist()
            within = part(self.progress, index / self.passes, (index + 1) / self.passes)
            samples = {"samples": last - first, "first_sample": first, "seed": self.seed}
            picture = trace(
                one,
                self._tlas,
                **samples,
                threads=self.threads,
                progress=within,
                cancelled=self._stopped,
                boxes=self._boxes,
            )
            self._check()
            self._picture = added(self._picture, picture)
            self._shown += np.concatenate(
                [_decided(primary, self.result), guides(self._prepared.table, primary)], axis=2
            )

    def _stopped(self) -> bool:
        return self._failed or self._cancelled()

    def _check(self) -> None:
        if self._stopped():
            raise Cancelled

    def light(self) -> Light:
        """Of all passes."""
        from ....core.hybrid.composition import Light

        assert self._picture is not None
        return Light.of(self._picture)

    def shown(self) -> dict[str, F32]:
        """Layers of what was decided about what is seen, of its base colours and normals."""
        shown = self._shown / np.float32(self.passes)
        return {
            "Culling State": shown[..., 0],
            "Hit Feedback": shown[..., 1],
            "Albedo": shown[..., 2:5],
            "Normal": shown[..., 5:8],
        }


def _decided(primary: FirstHitBuffer, result: CullingResult) -> F32:
    """(H, W, 2) of what is seen: 1 where active, 0 where culled or nothing; and log10(1 + n) of the n rays of the
    analysis that met it."""
    instance = primary.hits["instance"]
    there = instance >= 0
    met = np.log10(1.0 + result.hits.sum(axis=1))
    active = there & (result.state[instance] == State.ACTIVE)
    return np.stack([active, np.where(there, met[instance], 0.0)], axis=2).astype(np.float32)


def _combine(
    light: Light, passes: Passes | None, shown: dict[str, F32], clean: bool, threads: int
) -> tuple[F32, dict[str, F32]]:
    """The picture, (H, W, 4), and all layers by name. shown: `_Tracing.shown`. clean: without noise."""
    visible = passes.visible if passes is not None else None
    lamps = light.lamps(visible)
    traced = lamps + light.indirect
    layers = {**shown, "Traced Indirect": light.indirect, "Traced Lamps": lamps, "Shadow Doubt": light.doubt(visible)}
    if clean:
        traced = layers["Denoised"] = denoise(
            traced, passes.albedo if passes is not None else shown["Albedo"], shown["Normal"], threads
        )
    picture = layers["Combined"] = np.concatenate([light.straight + traced, light.alpha[..., None]], axis=2)
    return picture, layers | (_raster_layers(passes) if passes is not None else {})


def _raster_layers(passes: Passes) -> dict[str, F32]:
    surfaces = {"Raster Direct": passes.direct, "Shadow": passes.visible, "Raster Albedo": passes.albedo}
    return surfaces | {"Raster Emission": passes.emission, "Raster Environment": passes.environment}
