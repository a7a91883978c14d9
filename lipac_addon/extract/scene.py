"""Dependency graph -> core scene: the one entry to this package."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np

from ...core.errors import InputError
from ...core.placing import scene_origin
from ...core.scene import F64, Camera, Scene
from ..keys import Keys
from .camera import NO_CAMERA, extract_camera, extract_film, extract_limits, frame_camera
from .depsgraph import STAND_IN, with_render_depsgraph
from .instances import Collector
from .lights import extract_lights
from .materials import MaterialTable
from .meshes import LazyMeshes
from .textures import TextureTable
from .world import ExtractedWorld, extract_world

T = TypeVar("T")


@dataclass(frozen=True)
class Extraction:
    """A frame of a Blender scene. It depends on Blender only through `scene.meshes`, which reads meshes on demand and stays valid after the graph is gone.

    scene: what the engine renders. keys: one per instance, finds it again in Blender. warnings: one line each: what is wrong with the input.
    """

    scene: Scene
    keys: Keys
    warnings: tuple[str, ...]


class _Slots:
    """Lists of materials by slot, each stored once."""

    def __init__(self, materials: MaterialTable, override: Any) -> None:
        self.materials = materials
        self.override = override
        self.table: list[int] = []
        self._known: dict[tuple[int, ...], int] = {}

    def __call__(self, item: Any, mesh: Any, count: int) -> int:
        """Offset of the materials of an object's mesh: a slot linked to the object comes before the mesh's own; past the last slot the last one counts."""
        own = item.material_slots
        data = mesh.materials
        size = max(len(own), len(data))
        if self.override is not None or size == 0:
            indices = [self.materials.index(self.override)] * count
        else:
            linked = {i: s.material for i, s in enumerate(own) if s.link == "OBJECT" and s.material is not None}
            indices = [self.materials.index(linked.get(i, data[i] if i < len(data) else None)) for i in range(min(size, count))]
            indices += indices[-1:] * (count - len(indices))
        key = tuple(indices)
        if key not in self._known:
            self._known[key] = len(self.table)
            self.table += indices
        return self._known[key]


def _stand_in(scene: Any) -> bool:
    return scene.camera is None or scene.camera.name.startswith(STAND_IN)


def extract(depsgraph: Any, world: ExtractedWorld | None = None, allow_no_camera: bool = False) -> Extraction:
    """The scene of a dependency graph, evaluated for rendering (`with_render_depsgraph`) or for the viewport, whichever it is.

    world: from `extract_world`, called before the render; None takes the world of the graph, which must then be constant.
    allow_no_camera: a scene without a camera is framed as a whole. Raises InputError: no camera, an unsupported camera, nothing to render.
    """
    scene = depsgraph.scene_eval
    film = extract_film(scene)
    if _stand_in(scene) and not allow_no_camera:
        raise InputError(NO_CAMERA)
    camera = None if _stand_in(scene) else extract_camera(scene.camera, scene, film)
    origin = np.zeros(3) if camera is None else scene_origin(camera)
    textures = TextureTable(print)
    materials = MaterialTable(textures)
    slots = _Slots(materials, getattr(depsgraph.view_layer_eval, "material_override", None))

    def collect(origin: F64) -> Collector:
        collector = Collector(depsgraph, origin, slots, camera)
        collector.run()
        return collector

    collector = collect(origin)
    instances, keys = collector.result()
    if not len(instances):
        raise InputError("nothing to render: no visible object of the scene has faces")
    if camera is None:
        bounds = np.stack((instances.bounds[:, 0].min(axis=0), instances.bounds[:, 1].max(axis=0))).astype(np.float64)
        camera = frame_camera(bounds, film)
        if np.abs(camera.to_world[:, 3]).max() > 1e3:  # far from the world's origin: once more, with all digits
            origin = np.round(camera.to_world[:, 3])
            collector = collect(origin)
            instances, keys = collector.result()
    sources = collector.meshes
    table = np.array(slots.table, np.int32)
    textured = np.array([materials.textured(k) for k in range(len(materials.records))], bool)
    for mesh, offset in np.unique(np.stack((instances.mesh, instances.slots), axis=1), axis=0) if textured.any() else ():
        sources[mesh].needs_uv |= bool(textured[table[offset : offset + sources[mesh].slot_count]].any())
    approximated = dict.fromkeys(collector.unsupported)
    report = approximated.setdefault
    lights = extract_lights(collector.lamps, report, collector.warnings.append)
    if world is None:
        world = extract_world(scene, depsgraph.view_layer_eval)
    if not len(lights) and world.world.image is None and not world.world.color.any() and not any(r["emission"].any() for r in materials.records):
        collector.warnings.append("the scene has no light: no lamp, no emitting material, a black world; it renders black")
    approximated |= materials.approximated | dict.fromkeys(world.approximated)
    result = Scene(
        instances=instances,
        meshes=LazyMeshes(sources, textures.uv_maps),
        mesh_bounds=collector.mesh_bounds(),
        slot_materials=table,
        materials=materials.build(),
        lights=lights,
        world=world.world,
        camera=_moved(camera, origin),
        film=film,
        textures=textures.build(),
        uv_maps=tuple(textures.uv_maps),
        limits=extract_limits(scene),
        origin=origin,
        approximated=tuple(approximated),
    )
    return Extraction(result, keys, tuple(dict.fromkeys(collector.warnings)))


def _moved(camera: Camera, origin: F64) -> Camera:
    to_world = camera.to_world.copy()
    to_world[:, 3] -= origin
    return replace(camera, to_world=to_world)


def extract_frame(
    scene: Any, frame: int | None = None, view_layer: str | None = None, allow_no_camera: bool = False, world: ExtractedWorld | None = None
) -> Extraction:
    """A frame of a Blender scene as a final render would see it. Raises InputError as `extract` and `with_render_depsgraph` do.

    world: from `extract_world`, to bake an unchanging world once for many frames; None bakes it here.
    """
    if frame is not None and frame != scene.frame_current:
        scene.frame_set(frame)
    if scene.camera is None and not allow_no_camera:
        raise InputError(NO_CAMERA)
    if world is None:
        world = extract_world(scene, scene.view_layers[view_layer] if view_layer else scene.view_layers[0])
    callback: Callable[[Any], Extraction] = lambda depsgraph: extract(depsgraph, world, allow_no_camera)  # noqa: E731
    return with_render_depsgraph(scene, None, callback, view_layer)
