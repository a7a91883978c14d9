"""Path tracing of a scene: what is built once per scene (`prepare`), and one picture over a TLAS (`trace`)."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from concurrent.futures import Future, wait
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ..accel.blas import BlasCache
from ..accel.hitboxes import ALL_CROSSINGS, Hitboxes
from ..accel.tlas import Tlas
from ..arrays import F32, I64
from ..feedback.hits import Feedback
from ..feedback.path_log import PathLog
from ..jit.pointers import address
from ..progress import Progress, silent
from ..scene.camera import camera_constants
from ..scene.change import Change
from ..scene.film import Picture, filter_offsets
from ..scene.model import InstanceFlag, Instances, Scene, Shader
from ..threads import processors, start
from . import path_state as state
from .bsdf.lobes import SHADING_FLAGS
from .lights.lamps import FAR
from .lights.lights import Lights, emissive_instances
from .path_rays import OTHERS
from .second_process import share
from .surface import SceneTable
from .tile_kernel import trace_tiles

TILE = 16  # pixels
_POLL = 0.05  # seconds between looks at progress and cancellation
_INT32_MAX = 2**31 - 1


@dataclass(frozen=True, eq=False)
class Prepared:
    """A scene in the form that kernels read; valid as long as the scene does not change."""

    scene: Scene
    blas: BlasCache
    table: SceneTable
    lights: Lights
    camera: F32
    pixel_filter: F32

    @property
    def emissive(self) -> NDArray[np.int64]:
        """Indices of the instances that are sampled as lights, culled or not."""
        return self.lights.emissive

    def with_instances(self, instances: Instances) -> Prepared:
        """The same scene and lights with other visibility flags, transforms or slots of its instances."""
        scene = dataclasses.replace(self.scene, instances=instances)
        return dataclasses.replace(self, scene=scene, table=SceneTable(scene))

    def divided(self, scene: Scene) -> Prepared:
        """The same lights where the scene has more instances behind those that it had, none of which emits."""
        lights = self.lights.with_more_instances(len(scene.instances) - len(self.scene.instances))
        return dataclasses.replace(self, scene=scene, table=SceneTable(scene), lights=lights)

    def relit(self, scene: Scene) -> Prepared:
        """The same scene with other lights: lamps, and emission of materials."""
        lights = Lights(scene, None, self.lights.meshes)
        return dataclasses.replace(self, scene=scene, table=SceneTable(scene), lights=lights)

    def exchanged(self, scene: Scene) -> Prepared:
        """The same lights where instances that do not emit have other meshes."""
        return dataclasses.replace(self, scene=scene, table=SceneTable(scene))

    def with_emitters(self, active: NDArray[np.bool_]) -> Prepared:
        """The same scene where only those emissive instances light it that are active, (N,) bool: what is left when the
        others are removed."""
        kept = emissive_instances(self.scene)
        lights = Lights(self.scene, kept[active[kept]], self.lights.meshes)
        return Prepared(self.scene, self.blas, self.table, lights, self.camera, self.pixel_filter)


def prepare(scene: Scene, blas: BlasCache) -> Prepared:
    """Build lights, camera and tables of a scene whose loaded meshes are in blas. Loads the meshes of emissive
    instances, no other, and keeps them."""
    return Prepared(scene, blas, SceneTable(scene), Lights(scene), _cameras(scene), filter_offsets(scene.film))


def advanced(prepared: Prepared, scene: Scene, change: Change) -> Prepared:
    """`prepare` for the next frame of a scene: lights are made anew only where one of them may be another, from the
    meshes that are the same."""
    lights = prepared.lights
    changed = {*change.deformed.tolist(), *change.replaced.tolist()}.intersection(lights.meshes)
    emits = change.moved is not None and bool((scene.materials["emission"] > 0).any())
    if change.shading or change.previous is not None or changed or emits:
        lights = Lights(scene, None, {m: mesh for m, mesh in lights.meshes.items() if m not in changed})
    pixel_filter = prepared.pixel_filter if scene.film == prepared.scene.film else filter_offsets(scene.film)
    return Prepared(scene, prepared.blas, SceneTable(scene), lights, _cameras(scene), pixel_filter)


def _cameras(scene: Scene) -> F32:
    """(C, CAMERA) float32, constants of the cameras that paths start at."""
    return np.stack([camera_constants(camera) for camera in scene.shutter or (scene.camera,)])


def has_transparent_shadows(scene: Scene) -> bool:
    """Whether some material lets shadow rays through."""
    m = scene.materials
    through = (m["shader"] == Shader.TRANSPARENT) | (m["shader"] >= Shader.MIX)
    return bool((through | ((m["shader"] == Shader.PRINCIPLED) & ((m["alpha"] < 1) | (m["alpha_texture"] >= 0)))).any())


def trace(
    prepared: Prepared,
    tlas: Tlas,
    samples: int,
    first_sample: int = 0,
    seed: int = 0,
    feedback: Feedback | None = None,
    hitbox_every: int = 1,
    nearest: int = ALL_CROSSINGS,
    size: tuple[int, int] | None = None,
    threads: int = 0,
    progress: Progress = silent,
    cancelled: Callable[[], bool] | None = None,
    strategy: int = state.BOTH,
    log: PathLog | None = None,
    only: NDArray[np.uint8] | None = None,
    boxes: Hitboxes | None = None,
    full: Tlas | None = None,
) -> Picture:
    """Trace samples paths per pixel through the instances in tlas.

    first_sample, seed: which random numbers; the same ones give the same picture and counts, bit for bit, at any number
    of threads.
    feedback: hits and box crossings are added to it; nearest: boxes counted per segment (hitboxes.ALL_CROSSINGS: every
    one); hitbox_every: count boxes on one path in so many. size: (width, height) of the picture in pixels, default that
    of the film. threads: 0 for all. cancelled: polled now and then; where it says True the picture is returned as far
    as it is. strategy: path_state.BOTH, or one of LIGHT_ONLY and BSDF_ONLY (for tests).
    log: gets the light of each path (less light that is known without tracing, `FirstHitBuffer.lamps_known`, and less
    its backdrop), and, where feedback is given, what the path met. only: (H, W, samples) uint8, trace those paths that
    are not 0.
    Where the scene has first hits of a picture of `size`, paths start at these and the picture has parts. boxes: of
    what is culled, to tell for the parts which light of lamps that may block.
    full: what tlas is a part of. A path that meets surfaces which share a place, where something in full hid them from
    it, brings no light from there: what such places show is not known.
    """
    share()
    scene = prepared.scene
    if not prepared.blas.table["triangle_count"][scene.instances.mesh[tlas.ids]].all():
        raise RuntimeError("a mesh was freed that the TLAS shows")
    width, height = size or (scene.film.width, scene.film.height)
    sums = np.zeros((height, width, 4), np.float32)
    stats = np.zeros(state.STATS, np.int64)
    settings, limits = _settings(scene, width, height, samples, first_sample, seed, hitbox_every, nearest, strategy)
    if feedback is not None and feedback.weights is not None:
        weights = feedback.weights
        limits[state.V_AMBIENT], limits[state.V_UNITS] = weights.ambient, 1 / weights.unit
        settings[state.I_WEIGHED_FROM] = weights.first
        if weights.first + len(weights.light) > len(tlas):
            settings[state.I_UNBUILT] = len(tlas)
    addresses = _addresses(prepared, tlas, feedback, settings, limits, sums, stats)
    if log is not None:
        addresses[state.A_COLOR], limits[state.V_BACKDROP] = address(log.color), log.backdrop
        addresses[state.A_LOG] = address(log.records) if feedback is not None else 0
    entries = np.zeros(0, np.int32)
    if feedback is not None and (feedback.weights is not None or log is not None):
        entries = tlas.entry_of(len(scene.instances))  # of emitters, that light sampling finds
        addresses[state.A_ENTRIES] = address(entries)
    if only is not None:
        addresses[state.A_ONLY] = address(only)
    if full is not None:
        addresses[state.FULL] = int(full.handle)
    parts, primary = None, scene.first_hits.get((width, height))
    if primary is not None:
        parts, camera = np.zeros((height, width, state.PARTS), np.float32), camera_constants(primary.camera)
        addresses[state.A_PARTS], addresses[state.A_CAMERA] = address(parts), address(camera)
        settings[state.I_LAMPS_KNOWN], settings[state.I_CAMERAS] = primary.lamps_known, 1
        addresses[state.A_PRIMARY], addresses[state.A_PRIMARY_MESHES] = (
            address(primary.hits),
            address(primary.meshes.table),
        )
        if boxes is not None and len(boxes):
            addresses[state.BOXES], addresses[state.A_BOX_COUNTERS] = boxes.handle, address(boxes.counters)
            addresses[state.N_BOXES] = len(boxes)
    _run(
        tiles_to_trace(width, height, only),
        addresses,
        threads or processors(),
        f"tracing {width} x {height}, {samples} paths per pixel",
        progress,
        cancelled,
    )
    paths, rays, looks, coincident = (
        int(stats[count]) for count in (state.PATHS, state.RAYS, state.LOOKS, state.COINCIDENT)
    )
    return Picture(sums, samples, paths, rays, parts, looks, coincident)


def tiles_to_trace(width: int, height: int, only: NDArray[np.uint8] | None) -> I64:
    """(n, 4) int64: x, y of each tile and where it ends. only: as in `trace`; those with the most paths come first, so
    that no thread begins the longest when the others are done."""
    x, y = np.meshgrid(np.arange(0, width, TILE), np.arange(0, height, TILE))
    tiles = np.stack([x, y, np.minimum(x + TILE, width), np.minimum(y + TILE, height)], -1).reshape(-1, 4)
    if only is not None:
        paths = np.zeros(len(tiles), np.int64)
        _count_paths(only, x.shape[1], paths)
        tiles = tiles[np.argsort(-paths, kind="stable")[: np.count_nonzero(paths)]]
    return np.ascontiguousarray(tiles, np.int64)


@njit(cache=True, nogil=True)
def _count_paths(only, columns, paths):
    """Add to paths, (n,), the number of those that only, (H, W, S), marks in each tile."""
    for y in range(only.shape[0]):
        for x in range(only.shape[1]):
            count = 0
            for k in range(only.shape[2]):
                count += only[y, x, k] != 0
            paths[y // TILE * columns + x // TILE] += count


def _run(
    tiles: I64,
    addresses: NDArray[np.uint64],
    threads: int,
    text: str,
    progress: Progress,
    cancelled: Callable[[], bool] | None,
) -> None:
    """Trace all tiles; progress and cancelled are asked for now and then."""
    if not len(tiles) or (cancelled and cancelled()):
        return
    taken = np.zeros(1, np.int64)
    running: set[Future[None]] = set()
    try:
        running = start(lambda: trace_tiles(tiles, taken, addresses), min(threads, len(tiles)), threads)
        while running:
            done, running = wait(running, _POLL)
            if cancelled and cancelled():
                taken[0] = len(tiles)
            for future in done:
                future.result()
            progress(min(int(taken[0]), len(tiles)) / len(tiles), text)
    finally:
        taken[0] = len(tiles)
        wait(running)  # they write to arrays of ours


def _settings(
    scene: Scene,
    width: int,
    height: int,
    samples: int,
    first_sample: int,
    seed: int,
    hitbox_every: int,
    nearest: int,
    strategy: int,
) -> tuple[NDArray[np.int64], F32]:
    """The kernel's settings and limits."""
    limits = scene.limits
    settings = np.zeros(state.SETTINGS, np.int64)
    for slot, value in {
        state.I_WIDTH: width,
        state.I_HEIGHT: height,
        state.I_FIRST_SAMPLE: first_sample,
        state.I_SAMPLES: samples,
        state.I_SEED: seed,
        state.I_TOTAL: limits.total,
        state.I_DIFFUSE: limits.diffuse,
        state.I_GLOSSY: limits.glossy,
        state.I_TRANSMISSION: limits.transmission,
        state.I_TRANSPARENT: limits.transparent,
        state.I_REFLECTIVE: limits.caustics_reflective,
        state.I_REFRACTIVE: limits.caustics_refractive,
        state.I_SHADING: SHADING_FLAGS[limits.shading],
        state.I_TRANSPARENT_FILM: scene.film.transparent,
        state.I_TRANSPARENT_SHADOWS: has_transparent_shadows(scene),
        state.I_HITBOX_EVERY: hitbox_every,
        state.I_HITBOX_NEAREST: nearest,
        state.I_STRATEGY: strategy,
        state.I_CAMERAS: max(len(scene.shutter), 1),
        state.I_UNBUILT: -1,
        state.I_FAST_GI: limits.fast_gi,
        state.I_WORLD: limits.world,
        state.I_CATCHERS: bool((scene.instances.flags & InstanceFlag.SHADOW_CATCHER).any()),
    }.items():
        settings[slot] = value
    values = np.zeros(state.LIMITS, np.float32)
    values[state.V_CLAMP_DIRECT] = 3 * limits.clamp_direct if limits.clamp_direct > 0 else FAR
    values[state.V_CLAMP_INDIRECT] = 3 * limits.clamp_indirect if limits.clamp_indirect > 0 else FAR
    values[state.V_FILTER_GLOSSY] = 1 / limits.filter_glossy if limits.filter_glossy > 0 else 0
    values[state.V_EXPOSURE] = scene.film.exposure
    values[state.V_WORLD : state.V_WORLD + 3] = scene.world.color
    values[state.V_FAST_REACH], values[state.V_FAST_FACTOR] = limits.fast_reach, limits.fast_factor
    values[state.V_GLASS] = scene.film.glass
    return settings, values


def _addresses(
    prepared: Prepared,
    tlas: Tlas,
    feedback: Feedback | None,
    settings: NDArray[np.int64],
    limits: F32,
    sums: F32,
    stats: NDArray[np.int64],
) -> NDArray[np.uint64]:
    """Where the kernel finds everything; the caller keeps it alive."""
    lights = prepared.lights
    out = np.zeros(state.ADDRESSES, np.uint64)
    places: dict[int, int] = {
        state.A_TABLE: address(prepared.table.table),
        state.A_LIGHTS: address(lights.table),
        state.A_LAMPS: address(lights.lamps),
        state.A_NODES: address(lights.nodes),
        state.A_CHILDREN: address(lights.children),
        state.A_MESHES: address(prepared.blas.table),
        state.TLAS: int(tlas.handle),
        state.OTHERS: OTHERS,
        state.A_IDS: address(tlas.ids),
        state.A_FIRST: address(tlas.first),
        state.A_SETTINGS: address(settings),
        state.A_LIMITS: address(limits),
        state.A_CAMERA: address(prepared.camera),
        state.A_FILTER: address(prepared.pixel_filter),
        state.A_SUMS: address(sums),
        state.A_STATS: address(stats),
    }
    for slot, value in places.items():
        out[slot] = value
    if feedback is not None:
        out[state.HITBOXES] = feedback.hitboxes
        out[state.A_COUNTERS], out[state.N_COUNTERS] = address(feedback.boxes), len(feedback.boxes)
        out[state.A_FEEDBACK] = address(feedback.hits)
        if feedback.weights is not None:
            out[state.A_WEIGHTS], out[state.A_TILE_LIGHT] = (
                address(feedback.weights.light),
                address(feedback.weights.total),
            )
    return out
