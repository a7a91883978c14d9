"""Dependency graph -> core scene, frame by frame."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ...core.arrays import F32, I32, Records
from ...core.errors import InputError, NothingToAnalyse
from ...core.scene.change import Change
from ...core.scene.frustum import View
from ...core.scene.model import InstanceFlag, Scene, Unsure
from ...core.scene.placing import scene_origin
from ..depsgraph import STAND_IN
from ..keys import Keys, Kind, removal_of
from .camera import (
    NO_CAMERA,
    extract_camera,
    extract_film,
    extract_limits,
    far_from_origin,
    frame_camera,
    newer_than_tested,
)
from .differences import compare
from .geometry.coarser import EvaluatedCoarser
from .geometry.meshes import LazyMeshes
from .graph import GraphReader
from .graph_items import Node, casts_caustics, linked_materials
from .instances import Placed, Placer
from .lights import place_lamps
from .materials.displacement import Relief
from .materials.material_table import PICKED
from .materials.ranges import FARTHEST
from .materials.reader import WORTHLESS
from .materials.shaders import PORTAL
from .shading import Shading, ShadingReader, linked_emission, same_array, with_parts
from .shutter import Shutter, exposure, same_camera
from .world import VIEW, ExtractedWorld, extract_world

# of the diagonal of a mesh's box: displaced by more, it may be anywhere about, where paths pass between its shells
MUCH = 0.25
DISPLACED = "displacement by much of a mesh's size not rendered: these meshes stay, and what is within their reach"
CATCHERS = "shadow catchers: no error bound holds for light, beside shadows, that they show; --verify measures it"
VOLUME = ": volume not rendered"  # ends lines of objects that are one
VOLUMES = f"volume objects: what they light, and what only lights them or throws shadows into them, {WORTHLESS}"
VELOCITY = f"velocities not rendered: what is seen, lit or shaded by what they blur, elsewhere than it is, {WORTHLESS}"
CAUSTICS = f"shadow caustics not rendered: what only lights them, or shades them, {WORTHLESS}"
Look = Callable[[GraphReader, Sequence[Node]], None]  # is shown a graph, and the objects at its top


@dataclass(frozen=True)
class Extraction:
    """A frame of a Blender scene. It depends on Blender only through `scene.meshes`, which reads meshes on demand and
    stays valid after the graph is gone.

    scene: what the engine renders. keys: one per instance, finds it again in Blender. warnings: one line each: what is
    wrong with the input.
    change: what differs from the frame that was extracted before; None for the first one. scatters: by the full name of
    each object that instances by geometry nodes, where its rows are: (R, 3) float32 in its own space, as path[0] of the
    keys numbers them.
    moments: frames after this one, at which the shutter is open as well and other things are elsewhere
    (`Extractor.frame`).
    """

    scene: Scene
    keys: Keys
    warnings: tuple[str, ...]
    change: Change | None = None
    scatters: dict[str, F32] = field(default_factory=dict)
    moments: tuple[float, ...] = ()
    materials: tuple[str | None, ...] = ()  # full names, None: the default, by the numbers of `Scene.slot_materials`


@dataclass(frozen=True)
class Frame:
    """What was read of a graph, still without a world."""

    scene: Scene
    placed: Placed
    shading: Shading
    deformed: I32
    replaced: I32
    keys: Keys
    warnings: tuple[str, ...]
    scatters: dict[str, F32]
    moments: tuple[float, ...] = ()
    materials: tuple[str | None, ...] = ()

    def exposed(self, shutter: Shutter) -> Frame:
        """With the cameras of an exposure."""
        origin = np.column_stack((np.zeros((3, 3)), self.placed.origin))
        cameras = tuple(replace(camera, to_world=camera.to_world - origin) for camera in shutter.cameras)
        lines = self.scene.approximated
        if shutter.moments:
            lines = (
                *lines,
                "motion blur: what moves was looked at where it is when the shutter opens, half-way, and when it "
                "closes",
            )
        if shutter.rolling:
            lines = (*lines, "rolling shutter not rendered: each row was looked at over the whole exposure")
        return replace(self, scene=replace(self.scene, shutter=cameras, approximated=lines), moments=shutter.moments)

    def drawn(self, by: str, everywhere: bool) -> Frame:
        """With what stays for its lines: what is in view, or all. by: what draws lines, "" for nothing."""
        if not by:
            return self
        bounds, camera = self.scene.instances.bounds, self.scene.camera
        shown = View.of(camera, lens=True).shows(bounds, np.full(len(bounds), np.inf), 0.0) | everywhere
        if self.scene.stays is not None:
            shown |= self.scene.stays
        line = f"{by} draws lines: {'all' if everywhere else 'what is in view'} stays"
        scene = replace(self.scene, stays=shown, approximated=(*self.scene.approximated, line))
        return replace(self, scene=scene)


class SceneReader:
    """Reads the dependency graphs of the frames of a scene, and tells what changed from each to the next."""

    def __init__(self, allow_no_camera: bool = False, most: bool = True) -> None:
        """allow_no_camera: a scene without a camera is framed as a whole. most: as of `MaterialTable`."""
        self.allow_no_camera = allow_no_camera
        self.most = most
        self.graph = GraphReader(most)
        self._shading = ShadingReader(most)
        self._placed: Placed | None = None
        self._last: tuple[Scene, Shading] | None = None

    def read(self, depsgraph: Any, goes_on: bool, look: Look | None = None) -> Frame:
        """A frame, from its graph. goes_on: it is the graph of the last call, evaluated anew; look: as of
        `Extractor.frame`.

        Raises InputError: no camera, an unsupported camera, nothing to render.
        """
        scene, graph = depsgraph.scene_eval, self.graph
        film = extract_film(scene)
        if _stand_in(scene) and not self.allow_no_camera:
            raise InputError(NO_CAMERA)
        camera = None if _stand_in(scene) else extract_camera(scene.camera, scene, film)
        nodes = graph.read(depsgraph, goes_on)
        if look is not None:
            look(graph, nodes)
        shading = self._shading.read(graph)
        linked, names = linked_materials(graph.order), tuple(graph.geometry.slots.order)
        lines, materials = linked_emission(shading.materials, names, linked, self.most)
        reliefs = self._reliefs(shading, nodes)
        much = self._much(reliefs)
        materials = self._anywhere(materials, {mesh: reliefs[mesh] for mesh in much}, shading, nodes)
        graph.geometry.meshes.displace(reliefs)
        placed = Placer(graph, np.zeros(3) if camera is None else scene_origin(camera), camera, self._placed).place(
            nodes
        )
        if not len(placed.rows):
            raise NothingToAnalyse([*graph.unsupported])
        if camera is None:
            bounds = np.stack((placed.rows.bounds[:, 0].min(axis=0), placed.rows.bounds[:, 1].max(axis=0))).astype(
                np.float64
            )
            camera = frame_camera(bounds, film)
            # once more, with all digits where it is looked at
            placed = Placer(graph, scene_origin(camera), camera, self._placed).place(nodes)
        pairs = {pair for block in placed.blocks for pair in block.pairs}
        deformed, replaced = graph.geometry.meshes.finish(self._textured(pairs, shading), shading.uv_maps)
        places = placed.rows.bounds.astype(np.float64).mean(axis=1) + placed.origin - camera.to_world[:, 3]
        approximated, warnings = (
            dict.fromkeys(graph.unsupported),
            dict.fromkeys((*newer_than_tested(), *graph.geometry.warnings, *far_from_origin(camera, film, places))),
        )
        lights = _lights(placed, approximated, warnings)
        dropped = sum((Counter(block.dropped) for block in placed.blocks), Counter[str]())
        for name, count in dropped.items():
            warnings.setdefault(
                f"{count} instance{'s' if count > 1 else ''} of {name!r} left out: the transform is singular or not "
                "finite"
            )
        if any(casts_caustics(node.item) for node in graph.order):
            approximated.setdefault(CAUSTICS)
        approximated |= dict.fromkeys((*[DISPLACED][: len(much)], *shading.approximated, *lines))
        to_world = np.column_stack([camera.to_world[:, :3], camera.to_world[:, 3] - placed.origin])
        result = Scene(
            instances=placed.rows.instances(),
            meshes=LazyMeshes(graph.geometry.meshes.sources, shading.uv_maps),
            mesh_bounds=graph.geometry.meshes.bounds(),
            slot_materials=shading.slot_materials,
            materials=materials,
            lights=lights,
            world=ExtractedWorld.black().world,
            camera=replace(camera, to_world=to_world),
            film=film,
            textures=shading.textures,
            uv_maps=shading.uv_maps,
            limits=extract_limits(scene),
            origin=placed.origin,
            approximated=tuple(approximated),
            stays=np.isin(placed.rows.mesh, much) if much else None,
            whole=next((line for line in shading.approximated if self.most and line.endswith(PORTAL)), ""),
            simplifiable=graph.geometry.meshes.simplifiable(),
            coarser=EvaluatedCoarser(
                graph.geometry.meshes.steps(),
                graph.geometry.meshes.sources,
                shading.uv_maps,
                depsgraph.scene,
                depsgraph.view_layer.name,
            ),
            triangles=graph.geometry.meshes.triangles(),
            removal=removal_of(placed.rows.records),
        )
        scatters = {
            n.full_name: n.geometry.columns[:, 3, :3]
            for n in nodes
            if n.kind == Kind.GEOMETRY_NODES and n.geometry is not None
        }
        keys, result = Keys(placed.rows.records, tuple(graph.names)), _staying(result, depsgraph, graph)
        return Frame(result, placed, shading, deformed, replaced, keys, tuple(warnings), scatters, (), names)

    def finish(self, frame: Frame, world: ExtractedWorld) -> Extraction:
        """A frame with its world, and what changed since the last one."""
        scene, warnings = frame.scene, frame.warnings
        lit = (
            len(scene.lights)
            or world.world.image is not None
            or world.world.color.any()
            or scene.materials["emission"].any()
        )
        if not lit:
            warnings = (
                *warnings,
                "the scene has no light: no lamp, no emitting material, a black world; it renders black",
            )
        approximated = dict.fromkeys((*scene.approximated, *world.approximated))
        warnings = (*warnings, *(line for line in approximated if self.most and line.endswith(WORTHLESS)))
        if self.most and any(line.startswith("object ") and line.endswith(VOLUME) for line in approximated):
            warnings = (*warnings, VOLUMES)
        if self.most and (scene.instances.flags & InstanceFlag.SHADOW_CATCHER).any():
            warnings = (*warnings, CATCHERS)
        view = next((line for line in world.approximated if self.most and line.endswith(VIEW)), "")
        scene = replace(scene, world=world.world, approximated=tuple(approximated), whole=scene.whole or view)
        change = None
        if self._placed is not None and self._last is not None:
            last, shading = self._last
            previous, moved = compare(self._placed, frame.placed)
            if previous is None and moved is None:
                frame = replace(frame, placed=replace(frame.placed, rows=self._placed.rows))
                scene = replace(scene, instances=last.instances)
            shades = frame.shading is not shading or not _same_light(scene, last)
            change = Change(previous, moved, frame.deformed, frame.replaced, shades, not _same_view(scene, last))
        self._placed, self._last = frame.placed, (scene, frame.shading)
        return Extraction(scene, frame.keys, warnings, change, frame.scatters, frame.moments, frame.materials)

    def _reliefs(self, shading: Shading, nodes: Sequence[Node]) -> dict[int, Relief]:
        """How meshes are displaced, by index, whatever materials they are placed with. nodes: objects at the top, whose
        scale counts in world space."""
        out: dict[int, Relief] = {}
        if not any(shading.reliefs):
            return out
        for mesh, offset in sorted(self.graph.geometry.pairs):
            count = self.graph.geometry.meshes.source(mesh).slot_count
            found = [shading.reliefs[material] for material in shading.slot_materials[offset : offset + count].tolist()]
            relief = out.get(mesh)
            displaced = [one is not None for one in found]
            if relief is not None:
                displaced = [a or b for a, b in zip(displaced, relief.slots, strict=True)]
            for one in found:
                relief = relief if one is None else one.joined(relief)
            if relief is not None:
                out[mesh] = replace(relief, slots=tuple(displaced))
        for node in nodes:
            relief = None if node.geometry is None else out.get(node.geometry.mesh)
            if relief is not None and relief.world and node.geometry is not None:
                out[node.geometry.mesh] = relief.scaled(
                    1 / max(float(np.linalg.norm(node.world[:, :3], axis=0).min()), 1e-9)
                )
        return out

    def _much(self, reliefs: dict[int, Relief]) -> list[int]:
        """Meshes that are displaced by much of their size."""
        source = self.graph.geometry.meshes.source
        size = {mesh: float(np.linalg.norm(np.ptp(source(mesh).bounds, 0))) for mesh in reliefs}
        return [mesh for mesh, relief in reliefs.items() if relief.high - relief.low > MUCH * size[mesh]]

    def _anywhere(
        self, materials: Records, reliefs: dict[int, Relief], shading: Shading, nodes: Sequence[Node]
    ) -> Records:
        """Materials, of which those that displace a mesh by much of its size, which reliefs are of, are marked: what it
        looks like is not known, nor whether it is there, and what lies about may shade it. nodes: as of `_reliefs`."""
        rows: dict[int, float] = {}  # and within how many metres it may be
        scales: dict[int, float] = {}
        for node in nodes if reliefs else ():
            mesh = -1 if node.geometry is None else node.geometry.mesh
            scales[mesh] = max(scales.get(mesh, 0.0), float(np.linalg.norm(node.world[:, :3], axis=0).max()))
        for mesh, offset in self.graph.geometry.pairs:
            relief = reliefs.get(mesh)
            if relief is not None:
                count = self.graph.geometry.meshes.source(mesh).slot_count
                slots = shading.slot_materials[offset : offset + count].tolist()
                reach = min((relief.high - relief.low) * scales.get(mesh, np.inf), FARTHEST)
                rows |= {slot: max(reach, rows.get(slot, 0.0)) for slot in slots if shading.reliefs[slot] is not None}
        if not rows:
            return materials
        materials = materials.copy()
        materials["unsure"][with_parts(materials, set(rows))] |= np.uint32(Unsure.CLEAR)
        for row, reach in rows.items():
            parts = with_parts(materials, {row})
            materials["reach"][parts] = np.maximum(materials["reach"][parts], reach)
        return materials

    def _textured(self, pairs: set[tuple[int, int]], shading: Shading) -> set[int]:
        """Meshes with a material that needs UVs."""
        if not shading.textured.any():
            return set()
        table = shading.textured[shading.slot_materials]
        return {
            mesh
            for mesh, offset in pairs
            if table[offset : offset + self.graph.geometry.meshes.source(mesh).slot_count].any()
        }


def _lights(placed: Placed, approximated: dict[str, None], warnings: dict[str, None]) -> Records:
    lamps = [lamp for block in placed.blocks for lamp in block.lamps]
    box = np.zeros((2, 3))
    if any(lamp.data.growth for lamp in lamps):
        bounds = placed.rows.bounds
        box = np.stack((bounds[:, 0].min(axis=0), bounds[:, 1].max(axis=0))).astype(np.float64)
    return place_lamps(lamps, approximated.setdefault, warnings.setdefault, box)


def _staying(scene: Scene, depsgraph: Any, graph: GraphReader) -> Scene:
    """The scene, where what emits stays if how bright some of it is depends on what else is picked, for light sampling
    and rays then share what neither of them alone sees; and what is elsewhere while the shutter is open."""
    picked, lines = any(line.endswith(PICKED) for line in scene.approximated), scene.approximated
    moving = [mesh for mesh, source in enumerate(graph.geometry.meshes.sources) if source is not None and source.moving]
    rows = np.isin(scene.instances.mesh, moving) if moving else np.zeros(0, bool)
    blurred = bool(rows.any()) and exposure(depsgraph.scene_eval, depsgraph.view_layer_eval) is not None
    if not picked and not blurred:
        return scene
    stays = np.zeros(len(scene.instances), bool) if scene.stays is None else scene.stays.copy()
    if picked:
        from ...core.tracing.lights.lights import emissive_instances

        stays[emissive_instances(scene)] = True
    if blurred:
        stays |= rows
        lines = (*lines, VELOCITY)
    return replace(scene, stays=stays, approximated=lines)


def _stand_in(scene: Any) -> bool:
    return scene.camera is None or scene.camera.name.startswith(STAND_IN)


def _same_light(a: Scene, b: Scene) -> bool:
    """Whether lamps, world and path limits are the same."""
    x, y = a.world, b.world
    same_world = (
        x.image is y.image and x.seen is y.seen and np.array_equal(x.color, y.color) and x.visibility == y.visibility
    )
    return same_world and same_array(a.lights, b.lights) and a.limits == b.limits


def _same_view(a: Scene, b: Scene) -> bool:
    """Whether camera and film are the same."""
    x, y = a.camera, b.camera
    same = len(a.shutter) == len(b.shutter) and all(
        same_camera(*pair) for pair in zip((x, *a.shutter), (y, *b.shutter), strict=True)
    )
    return bool(a.film == b.film and np.array_equal(a.origin, b.origin) and same)


def extract(depsgraph: Any, world: ExtractedWorld | None = None, allow_no_camera: bool = False) -> Extraction:
    """The scene of a dependency graph, evaluated for rendering (`with_render_depsgraph`) or for the viewport, whichever
    it is.

    world: from `extract_world`, called before the render; None takes the world of the graph, which must then be
    constant.
    allow_no_camera: a scene without a camera is framed as a whole. Raises InputError: no camera, an unsupported camera,
    nothing to render.
    """
    reader = SceneReader(allow_no_camera)
    frame = reader.read(depsgraph, False)
    if world is None:
        world = extract_world(depsgraph.scene_eval, depsgraph.view_layer_eval)
    return reader.finish(frame, world)
